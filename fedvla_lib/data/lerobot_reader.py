"""Reads and checks a LeRobotDataset v3.0 of an SO-100, from a folder or the Hugging Face hub.

Every problem is a `DataError` that names file and episode. This module caches nothing: `data.frame_store` writes what
it yields into arrays.
"""

import io
import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any, TypedDict

import av
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from huggingface_hub import snapshot_download
from huggingface_hub.errors import RevisionNotFoundError
from lerobot.utils.constants import HF_LEROBOT_HOME, HF_LEROBOT_HUB_CACHE
from PIL import Image

from fedvla_lib.files import checked
from fedvla_lib.robot.spec import ACTION_KEY, CAMERAS, IMAGE_PREFIX, JOINT_NAMES, LAB_KEY, NUM_JOINTS, STATE_KEY
from fedvla_lib.robot.tasks import task_of

FORMAT, OLD_FORMAT = "v3.0", "v2.1"  # versions of LeRobotDataset: what is read, and what LeRobot converts to it
CAMERA_ALIASES = {  # our camera -> names in other data sets, preferred first
    "overhead": ("overhead", "top", "up", "above", "phone"),
    "front": ("front", "side", "wrist", "gripper", "laptop"),
}
Cameras = Mapping[str, str | Sequence[str]]  # our camera -> the data set's, or names of which it has one
TIMESTAMP_TOLERANCE_S = 1e-3
FPS_TOLERANCE = 0.01  # relative; video containers round frame rates such as 29.97


class DataError(ValueError):
    """A data set cannot be used; the message names the file, the episode and the problem."""


def locate(source: str | Path) -> Path:
    """Return the folder of a data set: `source` itself, or the local copy of a hub id, downloaded if necessary.

    Raises:
        DataError: neither a folder nor a hub id, the hub cannot be reached, or it does not have the data set.
    """
    folder = Path(source).expanduser()
    if folder.is_dir():
        return folder
    if folder.exists() or not re.fullmatch(r"[\w.-]+/[\w.-]+", str(source)):
        raise DataError(f"no data set at {source}: give a folder, or a hub id like lerobot/svla_so100_pickplace")
    if (HF_LEROBOT_HOME / source / "meta/info.json").exists():
        return HF_LEROBOT_HOME / source
    options = {"repo_id": str(source), "repo_type": "dataset", "cache_dir": HF_LEROBOT_HUB_CACHE}
    try:
        try:
            return Path(snapshot_download(**options, revision=FORMAT))
        except RevisionNotFoundError:
            return Path(snapshot_download(**options, revision=OLD_FORMAT))
    except OSError as error:  # of the network, and all errors of the hub
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise DataError(
            f"cannot get data set {str(source)!r} from the Hugging Face hub ({type(error).__name__}: {reason}); with a "
            f"network connection run `hf download {source} --repo-type dataset --revision {FORMAT} --local-dir DIR` "
            "and give the folder DIR instead of the id"
        ) from error


@dataclass(frozen=True, eq=False)
class Outline:
    """The checked metadata of a data set."""

    root: Path
    info: dict[str, Any]  # meta/info.json
    cameras: dict[str, str]  # our camera -> feature key
    files: pd.DataFrame  # meta/episodes: the files of each episode, and its position in them

    @property
    def starts(self) -> np.ndarray:
        """Row at which each episode begins in the arrays of the data set, int64 (episodes,)."""
        lengths = self.files["length"].to_numpy()
        return np.cumsum(lengths) - lengths


@dataclass(frozen=True, eq=False)
class ReadDataset:
    """The checked metadata and rows of a data set, without its images."""

    outline: Outline
    episodes: pd.DataFrame  # this and the arrays as in `FrameStore`
    states: np.ndarray
    actions: np.ndarray


def read_outline(root: Path, cameras: Cameras | None) -> Outline:
    """Read and check the metadata; raise DataError if it is broken, or not of an SO-100."""
    info = read_info(root)
    _check_features(root, info)
    return Outline(root, info, _map_cameras(root, info, cameras), _read_episodes(root, info))


def read_dataset(root: Path, cameras: Cameras | None) -> ReadDataset:
    """Read and check everything but the images; raise DataError if it is broken, or not of an SO-100."""
    outline = read_outline(root, cameras)
    states, actions, labs = _read_rows(outline)
    lengths, ids = outline.files["length"].to_numpy(), outline.files["episode_index"].astype(int)
    ends = outline.starts + lengths
    episodes = pd.DataFrame({"episode_id": ids, "start": outline.starts, "end": ends, "num_frames": lengths})
    episodes["instruction"] = [tasks[0] for tasks in outline.files["tasks"]]
    episodes["task"] = [task_of(text) for text in episodes["instruction"]]
    episodes["lab"] = labs
    return ReadDataset(outline, episodes, states, actions)


class Feature(TypedDict):
    """What is read of a feature's description."""

    dtype: str


class Info(TypedDict):
    """What has to be in ``meta/info.json``."""

    features: dict[str, Feature]
    fps: float
    data_path: str


def read_info(root: Path) -> dict[str, Any]:
    """Return the description of a data set; raise DataError if it has none, or is in another format."""
    path = root / "meta/info.json"
    try:
        info = json.loads(path.read_text())
    except FileNotFoundError:
        raise DataError(f"{path} is missing: {root} is not a LeRobotDataset, or its recording never started") from None
    except ValueError as error:
        raise DataError(f"{path} is not JSON: {error}") from error
    version = info.get("codebase_version") if isinstance(info, dict) else None
    if version != FORMAT:
        raise DataError(
            f"{path} says format {version}, this reads {FORMAT} and {OLD_FORMAT}: convert it to "
            f"{OLD_FORMAT} with LeRobot 0.3"
        )
    try:
        return checked(info, Info, str(path))
    except ValueError as error:
        raise DataError(str(error)) from error


def _check_features(root: Path, info: dict[str, Any]) -> None:
    """Require state and action to be six numbers with the names and the order of the SO-100's joints."""
    path = root / "meta/info.json"
    for key in (STATE_KEY, ACTION_KEY):
        if (feature := info["features"].get(key)) is None:
            raise DataError(f"{path} has no feature {key}: every episode lacks it")
        if (shape := tuple(feature["shape"])) != (NUM_JOINTS,):
            raise DataError(f"{path}, every episode: {key} has shape {shape}, an SO-100 has ({NUM_JOINTS},)")
        names = feature.get("names") or []  # a list, or {"motors": [...]}
        names = [str(name) for name in (chain(*names.values()) if isinstance(names, Mapping) else names)]
        if _plain(names) != _plain(JOINT_NAMES):
            raise DataError(
                f"{path}, every episode: {key} has the columns {', '.join(names) or 'nothing'}, "
                f"but must have {', '.join(JOINT_NAMES)} in this order"
            )


def _plain(names: Iterable[str]) -> list[str]:
    """Return the joint names that ``main_shoulder_pan`` and ``shoulder_pan.pos`` share."""
    return [name.removeprefix("main_").removesuffix(".pos") for name in names]


def _map_cameras(root: Path, info: dict[str, Any], cameras: Cameras | None) -> dict[str, str]:
    """Return our camera -> feature key, from the given mapping or `CAMERA_ALIASES`."""
    keys = {key.removeprefix(IMAGE_PREFIX): key for key in image_features(info)}
    wanted = {ours: [names] if isinstance(names, str) else names for ours, names in (cameras or CAMERA_ALIASES).items()}
    mapping, where = {}, root / "meta/info.json"
    for ours, names in wanted.items():
        found = [name for name in (each.removeprefix(IMAGE_PREFIX) for each in names) if name in keys]
        if found and found[0] != ours and len(set(found) - {ours}) > 1:
            raise DataError(
                f"{where}: {' and '.join(found)} could each be camera {ours}: say which, for instance "
                f"camera-map={found[0]}={ours}"
            )
        mapping |= {ours: keys[found[0]]} if found else {}
    missing = [ours for ours in wanted if ours not in mapping]
    if missing and (cameras or len(keys) >= len(CAMERAS) or not mapping):
        raise DataError(
            f"{where}: no camera for {', '.join(missing)} among {', '.join(keys) or 'none'}: "
            f"specify it, for instance camera-map={next(iter(keys), 'NAME')}={missing[0]}"
        )
    return mapping


def image_features(info: dict[str, Any]) -> list[str]:
    """Return the keys of the cameras in a data set's description."""
    return [key for key, feature in info["features"].items() if feature["dtype"] in ("video", "image")]


def _read_episodes(root: Path, info: dict[str, Any]) -> pd.DataFrame:
    """Return the episode table in order, without rows that info.json does not count."""
    tables = [pd.DataFrame({"episode_index": []})]
    for path in sorted((root / "meta/episodes").glob("*/*.parquet")):
        file = _parquet(path, "all")
        columns = [name for name in file.schema_arrow.names if not name.startswith("stats/")]
        tables.append(file.read(columns=columns).to_pandas())
    if not (total := info["total_episodes"]):
        raise DataError(f"{root} has no complete episode: record some first")
    table = pd.concat(tables[1:] or tables).sort_values("episode_index").set_index("episode_index", drop=False)
    if lacking := sorted(set(range(total)) - set(table.index)):
        raise DataError(f"{root / 'meta/episodes'}: episode {lacking[0]} is not listed, info.json counts {total}")
    return table.loc[range(total)].reset_index(drop=True)


def _parquet(path: Path, episodes: Any) -> pq.ParquetFile:
    try:
        return pq.ParquetFile(path)
    except FileNotFoundError:
        raise DataError(f"{path} is missing (episode {episodes})") from None
    except (pa.ArrowInvalid, OSError) as error:
        raise DataError(f"{path} cannot be read (episode {episodes}): {error}") from error


def episode_rows(outline: Outline) -> Iterator[tuple[str, int, pd.DataFrame]]:
    """Yield file and name, number, and rows (times, states, actions, lab) of each episode, by file; not checked yet."""
    root, info, files = outline.root, outline.info, outline.files
    columns = ["episode_index", "timestamp", STATE_KEY, ACTION_KEY, *([LAB_KEY] if LAB_KEY in info["features"] else [])]
    for (chunk, file), group in files.groupby(["data/chunk_index", "data/file_index"]):
        first_id = group["episode_index"].iloc[0]
        path = root / info["data_path"].format(chunk_index=chunk, file_index=file)
        parquet = _parquet(path, first_id)
        if lacking := [name for name in columns if name not in parquet.schema_arrow.names]:
            raise DataError(f"{path} (episode {first_id}) has no column {', '.join(lacking)}")
        table = parquet.read(columns=columns).to_pandas()
        for episode_id in group["episode_index"]:
            yield f"{path}, episode {episode_id}", episode_id, table[table["episode_index"] == episode_id]


def _read_rows(outline: Outline) -> tuple[np.ndarray, np.ndarray, list[int]]:
    """Return checked states and actions of all episodes, float32 (N, 6) each, and the lab of each episode."""
    lengths = outline.files.set_index("episode_index")["length"]
    parts: dict[int, tuple[np.ndarray, np.ndarray, int]] = {}
    for episode, episode_id, rows in episode_rows(outline):
        states, actions = check_rows(episode, rows, lengths[episode_id])
        _check_times(episode, rows["timestamp"].to_numpy(), outline.info["fps"])
        parts[episode_id] = (states, actions, int(rows[LAB_KEY].iloc[0]) if LAB_KEY in rows else 0)
    states, actions, labs = zip(*(parts[episode_id] for episode_id in outline.files["episode_index"]), strict=True)
    return np.concatenate(states), np.concatenate(actions), list(labs)


def check_rows(episode: str, rows: pd.DataFrame, length: int) -> tuple[np.ndarray, np.ndarray]:
    """Return states and actions of one episode, float32 (T, 6); raise DataError, naming `episode`, if they cannot be.

    Args:
        length: number of frames that the metadata states.
    """
    if len(rows) != length:
        raise DataError(f"{episode}: has {len(rows)} frames, its metadata says {length}")
    return _vectors(episode, STATE_KEY, rows[STATE_KEY]), _vectors(episode, ACTION_KEY, rows[ACTION_KEY])


def _check_times(episode: str, times_s: np.ndarray, fps: float) -> None:
    drift = np.abs(times_s - np.arange(len(times_s)) / fps)
    if drift.max() > max(TIMESTAMP_TOLERANCE_S, 1e-6 * len(times_s)):
        frame = int(np.argmax(drift > TIMESTAMP_TOLERANCE_S))
        raise DataError(
            f"{episode}: frame {frame} is at {times_s[frame]:.4f} s, but at fps={fps} "
            f"it should be at {frame / fps:.4f} s"
        )


def _vectors(episode: str, key: str, column: pd.Series) -> np.ndarray:
    """Return a column of six-vectors as float32 (T, 6), all finite."""
    shapes = sorted({np.shape(value) for value in column})
    if shapes != [(NUM_JOINTS,)]:
        shape = shapes[0] if len(shapes) == 1 else shapes
        raise DataError(f"{episode}: {key} has shape {shape}, but must have ({NUM_JOINTS},)")
    values = np.stack(column.to_list()).astype(np.float32)
    if not np.isfinite(values).all():
        frame, joint = np.argwhere(~np.isfinite(values))[0]
        raise DataError(f"{episode}: {key} of frame {frame} is {values[frame, joint]} at {JOINT_NAMES[joint]}")
    return values


def read_images(outline: Outline, key: str) -> Iterator[tuple[int, np.ndarray]]:
    """Yield each frame of one camera once: row, uint8 (H, W, 3); raise DataError if a file is damaged or gone."""
    info, starts = outline.info, outline.starts
    kind, pattern, read = "data", "data_path", _still_images
    if info["features"][key]["dtype"] == "video":
        kind, pattern, read = f"videos/{key}", "video_path", _video_images
    for (chunk, file), group in outline.files.groupby([f"{kind}/chunk_index", f"{kind}/file_index"]):
        path = outline.root / info[pattern].format(video_key=key, chunk_index=chunk, file_index=file)
        yield from read(path, key, group, starts[group.index], info["fps"])


def _video_images(
    path: Path, key: str, group: pd.DataFrame, starts: np.ndarray, fps: float
) -> Iterator[tuple[int, np.ndarray]]:
    """Yield the frames of the episodes in `group`, all in the video `path`; the frame at t s has number t * fps."""
    first = np.round(group[f"videos/{key}/from_timestamp"].to_numpy() * fps).astype(int)
    lengths = group["length"].to_numpy()
    steps = np.concatenate([np.arange(length) for length in lengths])
    rows = dict(zip(np.repeat(first, lengths) + steps, np.repeat(starts, lengths) + steps, strict=True))
    for number, image in _decode(path, fps, group["episode_index"].iloc[0]):
        if number in rows:
            yield rows.pop(number), image
    if rows:
        row = min(rows.values())
        i = int(np.searchsorted(starts, row, side="right")) - 1
        raise DataError(
            f"{path}, episode {group['episode_index'].iloc[i]}: the video lacks frame {row - starts[i]} of "
            f"{lengths[i]}; it is cut off or damaged"
        )


def _decode(path: Path, fps: float, episode_id: int) -> Iterator[tuple[int, np.ndarray]]:
    """Yield the frames of a video as (number, uint8 (H, W, 3)) until its end or a decoding error."""
    if not path.exists():
        raise DataError(f"{path} is missing (episode {episode_id})")
    try:
        container = av.open(str(path))
    except (av.FFmpegError, OSError) as error:
        raise DataError(f"{path} cannot be opened as a video (episode {episode_id}): {error.strerror}") from error
    with container:
        if not container.streams.video:
            raise DataError(f"{path} contains no video (episode {episode_id})")
        stream = container.streams.video[0]
        rate = float(stream.average_rate or 0)
        if abs(rate - fps) > FPS_TOLERANCE * fps:
            raise DataError(f"{path}, episode {episode_id}: has {rate:g} frames per second, meta/info.json says {fps}")
        with suppress(av.FFmpegError):  # the caller reports the frames that are missing
            for frame in container.decode(stream):
                yield round(float(frame.pts * stream.time_base) * fps), frame.to_ndarray(format="rgb24")


def _still_images(
    path: Path, key: str, group: pd.DataFrame, starts: np.ndarray, fps: float
) -> Iterator[tuple[int, np.ndarray]]:
    """Yield frames that are stored as compressed images in the rows of a parquet file."""
    table = _parquet(path, group["episode_index"].iloc[0]).read(columns=["episode_index", key]).to_pandas()
    for episode_id, start in zip(group["episode_index"], starts, strict=True):
        for step, cell in enumerate(table.loc[table["episode_index"] == episode_id, key]):
            try:
                yield start + step, np.asarray(Image.open(io.BytesIO(cell["bytes"])).convert("RGB"))
            except (OSError, TypeError) as error:
                where = f"{path}, episode {episode_id}"
                raise DataError(f"{where}: image {step} of {key} cannot be read: {error}") from error
