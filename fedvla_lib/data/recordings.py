"""The data set of a run: the one in its settings, or a recording in the cache."""

import hashlib
import json
from pathlib import Path

from fedvla_lib.config import Config, split_names, task_names
from fedvla_lib.data import frame_store
from fedvla_lib.data.lerobot_reader import CAMERA_ALIASES, locate
from fedvla_lib.data.record import record
from fedvla_lib.files import cache_dir
from fedvla_lib.provenance import code_digest
from fedvla_lib.robot.spec import CAMERAS


def resolve(config: Config) -> Path | str:
    """Return the data set of a run: `config.data`, or else a recording in the cache, made if it is missing.

    Raises:
        ValueError: only the clients have data.
    """
    if config.data:
        folder = Path(config.data).expanduser()
        return folder if folder.exists() else config.data
    if config.client_data:
        raise ValueError(
            "client-data has a data set for each client, and data is empty: give data for all, or a client"
        )
    tasks, counts = task_names(config), [config.image_size, config.episodes_per_task, config.seed]
    key = json.dumps([tasks, *counts, config.num_labs, config.one_task_per_lab, code_digest(record)])
    name = f"{'-'.join(tasks)}_{config.image_size}px_{hashlib.sha256(key.encode()).hexdigest()[:8]}"
    return record_into(cache_dir() / "recordings" / name, config)


def with_client_data(config: Config) -> Config:
    """Return the settings; raise DataError if a client's data set, which has to be on this machine, is missing."""
    for source in split_names(config.client_data):
        locate(source)
    return config


def record_into(root: Path, config: Config) -> Path:
    """Record the demonstrations that a run's settings describe into `root`, and return it; errors as in `record`."""
    scenes = {"image_size": config.image_size, "seed": config.seed, "num_labs": config.num_labs}
    scenes["one_task_per_lab"] = config.one_task_per_lab
    return record(task_names(config), config.episodes_per_task, root, **scenes)


def open_frames(config: Config) -> frame_store.FrameStore:
    """Open the data set of a run, recording and decoding it first if necessary."""
    source, cameras = resolve(config), camera_names(config)
    return frame_store.open_store(source, image_size=config.image_size, cameras=cameras, fps=config.fps)


def camera_names(config: Config) -> dict[str, tuple[str, ...]] | None:
    """Return `config.camera_map` as our camera -> the names that it may have in a data set; None if it is empty.

    Raises:
        ValueError: it is not of the form ``top=overhead,wrist=front``, names a camera twice, or one that no policy has.
    """
    pairs = [tuple(part.strip() for part in pair.split("=")) for pair in split_names(config.camera_map)]
    usable = all(len(pair) == 2 and pair[0] and pair[1] in CAMERAS for pair in pairs)
    if not usable or len({pair[0] for pair in pairs}) < len(pairs):
        raise ValueError(
            f"camera-map={config.camera_map!r} is not usable: give cameras of the data, each once, as one of "
            f"{', '.join(CAMERAS)}, for instance top=overhead,wrist=front"
        )
    given = {ours: tuple(name for name, role in pairs if role == ours) for ours in CAMERAS}
    named = {name for name, _ in pairs}
    usual = {ours: tuple(name for name in CAMERA_ALIASES[ours] if name not in named) for ours in CAMERAS}
    return {ours: (*given[ours], ours) if given[ours] else usual[ours] for ours in CAMERAS} if pairs else None
