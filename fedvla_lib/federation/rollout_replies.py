"""A client's rollouts in an evaluation reply: rows and films, checked in full before the server keeps any of them."""

import io
import json
import math
import zipfile
from collections.abc import Collection
from pathlib import Path
from typing import Annotated, Any

import av
import numpy as np
from flwr.app import ConfigRecord, RecordDict
from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from fedvla_lib.federation.messages import NOTE, make_note
from fedvla_lib.files import parse_json
from fedvla_lib.policy.parameters import ParameterError

# Rows, one per rollout, as from `rollouts.evaluate` with file names as videos; and the files (mp4, npz) by name.
Rollouts = tuple[list[dict[str, Any]], dict[str, bytes]]
MOST_STEPS = 10_000  # of a rollout, and frames of its film
MOST_BYTES = 20_000_000  # of a film, and of an unpacked trajectory
MOST_PIXELS = 4_000_000  # of a film's frame
TRAJECTORY = {"states.npy", "actions.npy", "success.npy", "seed.npy"}
VIDEO_NAME = r"^rollout_[A-Za-z0-9_]{1,200}\.mp4$"  # short enough for any file system

Text = Annotated[str, Field(max_length=1000)]
Seconds = Annotated[float, AfterValidator(lambda value: _seconds(value))]


class Row(BaseModel):
    """One rollout, see `rollouts.evaluate`. A client can say nothing else: who and when is the server's to say."""

    model_config = ConfigDict(extra="forbid", strict=True)

    task: Text
    instruction: Text
    lab: Text
    seed: Annotated[int, Field(ge=0, lt=2**63)]
    success: bool
    steps: Annotated[int, Field(ge=1, le=MOST_STEPS)]
    completion_time_s: Seconds
    action_smoothness: Annotated[float, Field(ge=0, le=1e6)]
    video: Annotated[str, Field(pattern=VIDEO_NAME)]


def pack_rollouts(rows: list[dict[str, Any]], folder: Path) -> ConfigRecord:
    """Return rows and the files of `folder` as a note, so that they reach the server on every engine."""
    files = sorted(folder.iterdir())
    rollouts = json.dumps([{**row, "video": Path(row["video"]).name} for row in rows])
    return make_note(rollouts=rollouts, file_names=[f.name for f in files], files=[f.read_bytes() for f in files])


def unpack_rollouts(content: RecordDict, tasks: Collection[str], most: int) -> Rollouts:
    """Return the rollouts of an evaluation reply.

    Args:
        tasks: those that the client may have rolled out.
        most: how many rollouts it was asked for.

    Raises:
        ParameterError: they cannot be read, are not what was asked for, or a file is not a rollout's.
    """
    note = content.config_records.get(NOTE, {})
    try:
        found = parse_json(note["rollouts"], list[Row], "the list of rollouts")
        rows = [{name: row[name] for name in Row.model_fields} for row in found]  # in one order, whoever sent them
        files = dict(zip(note["file-names"], note["files"], strict=True))
    except (KeyError, TypeError, ValueError) as error:
        raise ParameterError("rollouts", f"rollouts cannot be read: {error!r}") from error
    if len(rows) > most:
        raise ParameterError("rollouts", f"{len(rows)} rollouts, expected at most {most}")
    if unknown := sorted({row["task"] for row in rows} - set(tasks)):
        raise ParameterError("rollouts", f"a rollout of task {unknown[0]!r}: the client has {sorted(tasks)}")
    wanted = {name for row in rows for name in (row["video"], _trajectory(row["video"]))}
    if set(files) != wanted or len(wanted) != 2 * len(rows):
        raise ParameterError("rollouts", f"expected files rollout_....mp4 and .npz of {len(rows)} rollouts")
    for row in rows:
        _check_files(files[row["video"]], files[_trajectory(row["video"])], row["steps"])
    return rows, files


def _trajectory(video: str) -> str:
    return video.removesuffix("mp4") + "npz"


def _seconds(value: float) -> float:
    if not (math.isnan(value) or 0 <= value <= MOST_STEPS):
        raise ValueError("expected seconds, or NaN for a failure")
    return value


def _check_files(film: Any, trajectory: Any, steps: int) -> None:
    """Raise ParameterError unless the film can be played and the trajectory can be read, both of usual size."""
    if not all(isinstance(file, bytes) and len(file) <= MOST_BYTES for file in (film, trajectory)):
        raise ParameterError("rollouts", f"a film or trajectory is not bytes, at most {MOST_BYTES:,}")
    try:
        frames = _count_frames(film)
        with zipfile.ZipFile(io.BytesIO(trajectory)) as archive:
            sizes = {info.filename: info.file_size for info in archive.infolist()}
        if set(sizes) != TRAJECTORY or sum(sizes.values()) > MOST_BYTES:
            raise ValueError(f"the trajectory holds {sorted(sizes)[:9]}, {sum(sizes.values()):,} bytes")
        actions = len(dict(np.load(io.BytesIO(trajectory), allow_pickle=False))["actions"])
    # Decoders of films, archives and headers can fail in many ways; none of them may end the run.
    except Exception as error:
        raise ParameterError("rollouts", f"a film or trajectory cannot be read: {error}") from error
    if frames != steps or actions != steps:
        found = f"a film of {frames} frames and {actions} actions"
        raise ParameterError("rollouts", f"{found} for a rollout of {steps} steps")


def _count_frames(film: bytes) -> int:
    """Return the number of frames that can be decoded, stopping at the first too many."""
    av.logging.set_level(None)  # the exception says what is wrong
    with av.open(io.BytesIO(film), format="mp4") as container:
        stream = container.streams.video[0]
        if stream.width * stream.height > MOST_PIXELS:
            raise ValueError(f"frames of {stream.width} x {stream.height} pixels")
        return sum(1 for _, _ in zip(container.decode(stream), range(MOST_STEPS + 1), strict=False))
