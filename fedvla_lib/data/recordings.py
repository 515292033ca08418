"""The data set of a run: the one in its settings, or a recording in the cache."""

import hashlib
import json
from pathlib import Path

from fedvla_lib.config import Config, task_names
from fedvla_lib.data import frame_store
from fedvla_lib.data.record import record
from fedvla_lib.files import cache_dir
from fedvla_lib.provenance import code_digest


def resolve(config: Config) -> Path | str:
    """Return the data set of a run: `config.data`, or else a recording in the cache, made if it is missing."""
    if config.data:
        folder = Path(config.data).expanduser()
        return folder if folder.exists() else config.data
    tasks, counts = task_names(config), [config.image_size, config.episodes_per_task, config.seed]
    key = json.dumps([tasks, *counts, config.num_labs, config.one_task_per_lab, code_digest(record)])
    name = f"{'-'.join(tasks)}_{config.image_size}px_{hashlib.sha256(key.encode()).hexdigest()[:8]}"
    return record_into(cache_dir() / "recordings" / name, config)


def record_into(root: Path, config: Config) -> Path:
    """Record the demonstrations that a run's settings describe into `root`, and return it; errors as in `record`."""
    scenes = {"image_size": config.image_size, "seed": config.seed, "num_labs": config.num_labs}
    scenes["one_task_per_lab"] = config.one_task_per_lab
    return record(task_names(config), config.episodes_per_task, root, **scenes)


def open_frames(config: Config) -> frame_store.FrameStore:
    """Open the data set of a run, recording and decoding it first if necessary."""
    return frame_store.open_store(resolve(config), image_size=config.image_size)
