"""Who was in it: whether a demonstration was trained on, from a model's loss on it.

The attacker has the demonstration and the model, and a model of its own that was not trained on it. The loss has fixed
noise and flow time, and what the attacker's model finds difficult is taken off (difficulty calibration: Watson et al.
2022, https://arxiv.org/abs/2111.08440).
"""

from collections.abc import Sequence

import numpy as np
from scipy.stats import mannwhitneyu, rankdata

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


def auc(members: np.ndarray, strangers: np.ndarray) -> float:
    """Return the area under the ROC curve: how often a member scores above a stranger; chance is 0.5."""
    return float(mannwhitneyu(members, strangers).statistic / (len(members) * len(strangers)))


def auc_interval(members: np.ndarray, strangers: np.ndarray) -> tuple[float, float]:
    """Return a 95 % interval of the AUC (DeLong et al. 1988)."""
    m, n = len(members), len(strangers)
    ranks = rankdata([*members, *strangers])
    above = (ranks[:m] - rankdata(members)) / n  # for each member: the share of strangers below it
    below = 1 - (ranks[m:] - rankdata(strangers)) / m
    error = np.sqrt(above.var(ddof=1) / m + below.var(ddof=1) / n)
    middle = auc(members, strangers)
    return max(0.0, middle - 1.96 * error), min(1.0, middle + 1.96 * error)


def true_positives(members: np.ndarray, strangers: np.ndarray, false_positives: float = 0.01) -> float:
    """Return the share of members found by the threshold that `false_positives` of the strangers pass."""
    return float((members > np.quantile(strangers, 1 - false_positives, method="higher")).mean())
