"""Training batches from a frame store, optionally with augmented images.

A sample is the observation at one frame and the chunk of actions that starts there (LeRobot's ``delta_timestamps`` of
``[0, 1 / fps, ...]``). Past the end of the episode the last action is repeated and ``action_is_pad`` is true, so that
the loss can mask it.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch

from fedvla_lib.data.augmentation import augmented, to_float
from fedvla_lib.data.frame_store import FrameStore
from fedvla_lib.robot.spec import ACTION_KEY, STATE_KEY, image_key

ORDER_STREAM, AUGMENT_STREAM = 0, 1  # independent random streams of one seed


def frame_rows(store: FrameStore, episode_ids: Iterable[int]) -> np.ndarray:
    """Return the store's rows of these episodes, int64 (n,), ascending; raise ValueError for none or an unknown one."""
    table = store.episodes.set_index("episode_id")
    ids = sorted({int(episode_id) for episode_id in episode_ids})
    if not ids:
        raise ValueError("no episodes: give at least one")
    if unknown := [episode_id for episode_id in ids if episode_id not in table.index]:
        raise ValueError(f"{store.root} has no episode {unknown[0]}")
    return np.concatenate([np.arange(table.at[i, "start"], table.at[i, "end"]) for i in ids])


@dataclass(frozen=True, eq=False)
class Batches:
    """Training batches; `at(step)` depends only on the fields and the step, so that resuming needs no state."""

    store: FrameStore
    episode_ids: Sequence[int]
    chunk_size: int  # actions per sample
    batch_size: int  # samples per batch
    seed: int  # of order and augmentation
    augment: bool = False
    supply: Callable[[FrameStore, np.ndarray, int], dict[str, Any]] | None = None  # in place of `batch_of_rows`

    @cached_property
    def rows(self) -> np.ndarray:
        """The store's rows of the training frames, int64 (num_examples,)."""
        return frame_rows(self.store, self.episode_ids)

    @property
    def num_examples(self) -> int:
        """Number of training frames."""
        return len(self.rows)

    def at(self, step: int) -> dict[str, Any]:
        """Return the batch of a gradient step, in the format of `batch_of_rows`.

        Every epoch visits each frame once, in a new random order; a batch may span two epochs.
        """
        if self.supply:
            return self.supply(self.store, self.rows_at(step), self.chunk_size)
        rng = np.random.default_rng([self.seed, AUGMENT_STREAM, step]) if self.augment else None
        return batch_of_rows(self.store, self.rows_at(step), self.chunk_size, rng)

    def rows_at(self, step: int) -> np.ndarray:
        """Return the store's rows in the batch of a gradient step, int64 (batch_size,)."""
        positions = np.arange(step * self.batch_size, (step + 1) * self.batch_size)  # in the concatenated epochs
        epochs, offsets = np.divmod(positions, self.num_examples)
        indices = np.empty_like(positions)
        for epoch in np.unique(epochs):
            rng = np.random.default_rng([self.seed, ORDER_STREAM, int(epoch)])
            indices[epochs == epoch] = rng.permutation(self.num_examples)[offsets[epochs == epoch]]
        return self.rows[indices]


def batch_of_rows(
    store: FrameStore, rows: Sequence[int] | np.ndarray, chunk_size: int, rng: np.random.Generator | None = None
) -> dict[str, Any]:
    """Return the batch of these rows, with images augmented by `rng` if it is given.

    ``observation.images.<camera>``: float32 (B, 3, size, size) in [0, 1]; ``observation.state``: float32 (B, 6);
    ``action``: float32 (B, chunk_size, 6); ``action_is_pad``: bool (B, chunk_size); ``task``: B instructions.
    """
    rows = np.asarray(rows)
    pixels = {camera: images[rows] for camera, images in store.images.items()}  # uint8 (B, H, W, 3)
    floats = {camera: to_float(images) for camera, images in pixels.items()} if rng is None else augmented(pixels, rng)
    return {image_key(camera): images for camera, images in floats.items()} | targets_of_rows(store, rows, chunk_size)


def targets_of_rows(store: FrameStore, rows: np.ndarray, chunk_size: int) -> dict[str, Any]:
    """Return the batch of these rows without its images."""
    chunk_rows = rows[:, None] + np.arange(chunk_size)  # (B, chunk)
    ends = store.episode_ends[rows][:, None]
    return {
        STATE_KEY: torch.from_numpy(store.states[rows]),
        ACTION_KEY: torch.from_numpy(store.actions[np.minimum(chunk_rows, ends - 1)]),
        "action_is_pad": torch.from_numpy(chunk_rows >= ends),
        "task": [store.instructions[row] for row in rows],
    }
