"""From a data set to training batches: split by episode, statistics without a leak, chunks of actions, augmentation.

A sample is the observation at one frame and the chunk of actions that starts there (LeRobot's ``delta_timestamps`` of
``[0, 1 / fps, ...]``). Where the chunk runs over the end of the episode, its last action is repeated and
``action_is_pad`` is true, so that the loss can leave it out.
"""

import hashlib
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from lerobot.datasets import aggregate_stats

from fedvla_lib.config import Config, cache_dir, task_names
from fedvla_lib.provenance import code_digest
from fedvla_lib.record import record
from fedvla_lib.source import DataError
from fedvla_lib.spec import ACTION_KEY, JOINT_NAMES, STATE_KEY, image_key
from fedvla_lib.store import FrameStore, open_store

Stats = dict[str, dict[str, np.ndarray]]  # feature key -> mean, std, min, max, count

SHIFT_SHARE = 0.01  # largest random shift, as a share of the image side: 1 pixel of 96
CONTRAST, BRIGHTNESS = 0.2, 0.1  # contrast is scaled by 1 +- 0.2, brightness moved by +- 0.1 of full scale
ORDER_STREAM, AUGMENT_STREAM = 0, 1  # which independent random stream of a seed is meant


def resolve(config: Config) -> Path | str:
    """Return the data set of a run: `config.data`, else a recording in the cache, made now if it is not there yet."""
    if config.data:
        folder = Path(config.data).expanduser()
        return folder if folder.exists() else config.data
    tasks = task_names(config)
    settings = [tasks, config.image_size, config.episodes_per_task, config.seed, config.num_labs]
    key = json.dumps([*settings, code_digest(record)])
    name = f"{'-'.join(tasks)}_{config.image_size}px_{hashlib.sha256(key.encode()).hexdigest()[:8]}"
    root = cache_dir() / "recordings" / name
    return record(
        tasks,
        config.episodes_per_task,
        root,
        image_size=config.image_size,
        seed=config.seed,
        num_labs=config.num_labs,
    )


def split(source: FrameStore | pd.DataFrame, val_fraction: float, seed: int) -> tuple[list[int], list[int]]:
    """Return (training, validation) episode ids, drawn per task.

    Each task gives ``round(val_fraction * n)`` of its n episodes to validation; at least one if the fraction is above 0
    and there are two, and never all of them. Frames of one episode are never on both sides.
    """
    if not 0 <= val_fraction <= 1:
        raise ValueError(f"val_fraction={val_fraction} is not a share: give a number from 0 to 1")
    table = source.episodes if isinstance(source, FrameStore) else source
    rng = np.random.default_rng(seed)
    held_out: list[int] = []
    for _, group in table.groupby("task", sort=True):
        ids = rng.permutation(np.sort(group["episode_id"].to_numpy()))
        count = min(max(round(val_fraction * len(ids)), 1), len(ids) - 1) if val_fraction else 0
        held_out += [int(episode_id) for episode_id in ids[:count]]
    train = [int(episode_id) for episode_id in sorted(table["episode_id"]) if episode_id not in set(held_out)]
    return train, sorted(held_out)


def episode_stats(store: FrameStore, episode_ids: Iterable[int]) -> Stats:
    """Return mean, std, min, max (float64 (6,)) and count (int64 (1,)) of state and action over these episodes only.

    Raises:
        ValueError: no episodes, or one that the store lacks.
    """
    rows = frame_rows(store, episode_ids)
    return {STATE_KEY: _describe(store.states[rows]), ACTION_KEY: _describe(store.actions[rows])}


def pool_stats(stats: Sequence[Stats]) -> Stats:
    """Return the statistics of the pooled frames from each client's own, without seeing a frame.

    With client k's n_k frames, mean m_k and standard deviation s_k: mean m = sum(n_k m_k) / sum(n_k) and variance
    sum(n_k (s_k^2 + (m_k - m)^2)) / sum(n_k), which is exact (LeRobot's `aggregate_stats`).
    """
    return aggregate_stats(list(stats))


def no_stats() -> Stats:
    """Return statistics that leave state and action as they are: mean 0 and std 1 of each joint."""
    as_is = {"mean": np.zeros(len(JOINT_NAMES)), "std": np.ones(len(JOINT_NAMES))}
    return {STATE_KEY: as_is, ACTION_KEY: as_is}


def frame_rows(store: FrameStore, episode_ids: Iterable[int]) -> np.ndarray:
    """Return the store's rows of these episodes, int64 (n,), in ascending order.

    Raises:
        ValueError: no episodes, or one that the store lacks.
    """
    table = store.episodes.set_index("episode_id")
    ids = sorted({int(episode_id) for episode_id in episode_ids})
    unknown = [episode_id for episode_id in ids if episode_id not in table.index]
    if unknown or not ids:
        raise ValueError(
            f"{store.root} has no episode {unknown[0]}" if unknown else "no episodes: give at least one id"
        )
    return np.concatenate([np.arange(table.at[i, "start"], table.at[i, "end"]) for i in ids])


@dataclass(frozen=True, eq=False)
class Batches:
    """Training batches; `at(step)` is a pure function of the fields and the step, so that resuming needs no state."""

    store: FrameStore
    episode_ids: Sequence[int]
    chunk_size: int  # actions per sample
    batch_size: int  # samples per batch
    seed: int  # fixes order and augmentation
    augment: bool = False

    @cached_property
    def rows(self) -> np.ndarray:
        """The store's rows that these batches draw from, int64 (num_examples,)."""
        return frame_rows(self.store, self.episode_ids)

    @property
    def num_examples(self) -> int:
        """Number of training frames."""
        return len(self.rows)

    def at(self, step: int) -> dict[str, Any]:
        """Return the batch of a training step, as `frames` describes it.

        Frames come in a new random order each epoch, each once; a batch may run over the end of an epoch.
        """
        rng = np.random.default_rng([self.seed, AUGMENT_STREAM, step]) if self.augment else None
        return _batch(self.store, self.rows_at(step), self.chunk_size, rng)

    def rows_at(self, step: int) -> np.ndarray:
        """Return the store's rows of the batch of a training step, int64 (batch_size,)."""
        return self._order(np.arange(step * self.batch_size, (step + 1) * self.batch_size))

    def _order(self, places: np.ndarray) -> np.ndarray:
        """Rows at places of the endless sequence that strings the epochs together."""
        epochs, offsets = np.divmod(places, self.num_examples)
        picked = np.empty_like(places)
        for epoch in np.unique(epochs):
            rng = np.random.default_rng([self.seed, ORDER_STREAM, int(epoch)])
            picked[epochs == epoch] = rng.permutation(self.num_examples)[offsets[epochs == epoch]]
        return self.rows[picked]


def frames(store: FrameStore, rows: Sequence[int] | np.ndarray, chunk_size: int) -> dict[str, Any]:
    """Return the batch of these rows as they are, without augmentation.

    ``observation.images.<camera>``: float32 (B, 3, size, size) in [0, 1]; ``observation.state``: float32 (B, 6);
    ``action``: float32 (B, chunk_size, 6); ``action_is_pad``: bool (B, chunk_size); ``task``: B instructions.
    """
    return _batch(store, np.asarray(rows), chunk_size, None)


def _batch(store: FrameStore, rows: np.ndarray, chunk_size: int, rng: np.random.Generator | None) -> dict[str, Any]:
    pictures = {camera: images[rows] for camera, images in store.images.items()}  # uint8 (B, H, W, 3)
    if rng is None:
        images = {camera: to_float(picture) for camera, picture in pictures.items()}
    else:
        images = augmented(pictures, rng)
    return {image_key(camera): image for camera, image in images.items()} | targets(store, rows, chunk_size)


def targets(store: FrameStore, rows: np.ndarray, chunk_size: int) -> dict[str, Any]:
    """Return the batch of these rows without its images."""
    wanted = rows[:, None] + np.arange(chunk_size)  # (B, chunk)
    ends = store.episode_ends[rows][:, None]
    return {
        STATE_KEY: torch.from_numpy(store.states[rows]),
        ACTION_KEY: torch.from_numpy(store.actions[np.minimum(wanted, ends - 1)]),
        "action_is_pad": torch.from_numpy(wanted >= ends),
        "task": [store.instructions[row] for row in rows],
    }


def augmented(pictures: dict[str, np.ndarray], rng: np.random.Generator) -> dict[str, torch.Tensor]:
    """Return uint8 (B, H, W, 3) pictures of each camera as float32 (B, 3, H, W) in [0, 1], changed at random.

    Each camera's picture is shifted on its own, as if its mount were knocked; the light is common to all cameras.
    """
    batch_size = len(next(iter(pictures.values())))
    contrast = _column(rng.uniform(1 - CONTRAST, 1 + CONTRAST, batch_size))
    brightness = _column(rng.uniform(-BRIGHTNESS, BRIGHTNESS, batch_size))
    images = {}
    for camera, picture in pictures.items():
        image = to_float(_shift(picture, rng))  # (B, 3, H, W)
        mean = image.mean(dim=(1, 2, 3), keepdim=True)
        images[camera] = image.mul_(contrast).add_(mean * (1 - contrast) + brightness).clamp_(0.0, 1.0)
    return images


def _shift(picture: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Move uint8 (B, H, W, 3) by a few pixels, repeating the edge: the pad-and-crop of DrQ (arXiv:2004.13649)."""
    _, height, width, _ = picture.shape
    most = max(1, round(SHIFT_SHARE * height))
    padded = np.pad(picture, ((0, 0), (most, most), (most, most), (0, 0)), mode="edge")
    tops, lefts = rng.integers(0, 2 * most + 1, (2, len(picture)))
    crops = zip(padded, tops, lefts, strict=True)
    return np.stack([image[top : top + height, left : left + width] for image, top, left in crops])


def to_float(picture: np.ndarray) -> torch.Tensor:
    """uint8 (B, H, W, 3) -> float32 (B, 3, H, W) in [0, 1]."""
    channels_first = torch.from_numpy(picture).permute(0, 3, 1, 2).contiguous()
    return channels_first.to(torch.float32).div_(255.0)


def _column(values: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(values.astype(np.float32)).reshape(-1, 1, 1, 1)


def _describe(values: np.ndarray) -> dict[str, np.ndarray]:
    values = values.astype(np.float64)
    return {
        "mean": values.mean(axis=0),
        "std": values.std(axis=0),
        "min": values.min(axis=0),
        "max": values.max(axis=0),
        "count": np.array([len(values)]),
    }
