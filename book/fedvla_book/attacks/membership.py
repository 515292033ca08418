"""Who was in it: whether a demonstration was trained on, from a model's loss on it.

The attacker has the demonstration and the model, and a model of its own that was not trained on it. The loss has fixed
noise and flow time, and what the attacker's model finds difficult is taken off (difficulty calibration: Watson et al.
2022, https://arxiv.org/abs/2111.08440).
"""

from collections.abc import Sequence

import numpy as np

from fedvla_lib.data.batches import batch_of_rows, frame_rows
from fedvla_lib.data.frame_store import FrameStore
from fedvla_lib.evaluation.held_out import measure_frames
from fedvla_lib.policy.model import Bundle

STRIDE, BATCH = 5, 32  # frames: neighbouring ones are nearly the same


def losses(bundle: Bundle, store: FrameStore, episode_ids: Sequence[int], chunk_size: int, seed: int) -> np.ndarray:
    """Return the mean flow-matching loss of each episode, with noise and flow time fixed by `seed`."""
    found = []
    for episode in episode_ids:
        rows = frame_rows(store, [episode])[::STRIDE]
        batches = [batch_of_rows(store, rows[i : i + BATCH], chunk_size) for i in range(0, len(rows), BATCH)]
        found.append(measure_frames(bundle, batches, tolerance=5.0, seed=seed)["loss"].mean())
    return np.array(found)
