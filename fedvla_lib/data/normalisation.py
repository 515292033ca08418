"""Normalisation statistics of state and action: per client, pooled exactly, and as JSON text for messages."""

import json
from collections.abc import Iterable, Sequence

import numpy as np
from lerobot.datasets import aggregate_stats

from fedvla_lib.config import Config
from fedvla_lib.data.batches import frame_rows
from fedvla_lib.data.frame_store import FrameStore
from fedvla_lib.data.splits import held_out_episodes
from fedvla_lib.robot.spec import ACTION_KEY, JOINT_NAMES, NUM_JOINTS, STATE_KEY

FAR = 4.0  # usual spreads; single episodes of different tasks are within three
LEAST_SPREAD = 30.0  # degrees, or percent of the gripper: one task turns the wrist by 90 that others hardly move

Stats = dict[str, dict[str, np.ndarray]]  # feature key -> mean, std, min, max, count


def episode_stats(store: FrameStore, episode_ids: Iterable[int]) -> Stats:
    """Return mean, std, min, max (float64 (6,)) and count (int64 (1,)) of state and action over these episodes only.

    Raises:
        ValueError: no episodes, or one that is not in the store.
    """
    rows = frame_rows(store, episode_ids)
    return {STATE_KEY: _describe(store.states[rows]), ACTION_KEY: _describe(store.actions[rows])}


def pool_stats(stats: Sequence[Stats]) -> Stats:
    """Return the statistics of all clients' frames together, computed from the statistics of each client.

    With client k's n_k frames, mean m_k and standard deviation s_k: mean m = sum(n_k m_k) / sum(n_k) and variance
    sum(n_k (s_k^2 + (m_k - m)^2)) / sum(n_k); this is exact (LeRobot's `aggregate_stats`).
    """
    return aggregate_stats(list(stats))


def implausible(stats: Sequence[Stats]) -> list[str]:
    """Return for each client what of its statistics is implausible beside those of the others, or "".

    That is a mean further from the median of all means than `FAR` usual spreads, or a spread as large. Of less than
    three clients none can be called the odd one out, and nothing helps once most of them lie.
    """
    reasons = [""] * len(stats)
    for key in (STATE_KEY, ACTION_KEY) if len(stats) > 2 else ():
        means, stds = (np.stack([of[key][name] for of in stats]) for name in ("mean", "std"))
        limit = FAR * np.maximum(np.median(stds, axis=0), LEAST_SPREAD)
        far = (np.abs(means - np.median(means, axis=0)) > limit) | (stds > limit)
        for client, joints in enumerate(far):
            if joints.any():
                joint = int(joints.argmax())
                found = f"mean {means[client, joint]:.4g}, std {stds[client, joint]:.4g}"
                reasons[client] = f"{key} of {JOINT_NAMES[joint]} has {found}, unlike the other clients"
    return reasons


def _describe(values: np.ndarray) -> dict[str, np.ndarray]:
    values = values.astype(np.float64)
    stats = {name: getattr(values, name)(axis=0) for name in ("mean", "std", "min", "max")}
    return stats | {"count": np.array([len(values)])}


def asks_clients(config: Config) -> bool:
    """Return whether clients send statistics of their data."""
    return config.normalisation not in ("base", "none")


def common_statistics(config: Config, pooled: Stats) -> Stats:
    """Return the statistics sent to all clients: the pooled ones, mean 0 and std 1, or {} for those of the base."""
    if config.normalisation == "base":
        return {}
    identity = {"mean": np.zeros(NUM_JOINTS), "std": np.ones(NUM_JOINTS)}
    return {STATE_KEY: identity, ACTION_KEY: identity} if config.normalisation == "none" else pooled


def evaluation_statistics(config: Config, common: Stats, store: FrameStore) -> Stats:
    """Return the statistics for evaluating the global model: `common`, or as a deliberate leak the held-out ones."""
    return common if config.normalisation != "held-out" else episode_stats(store, held_out_episodes(store, config))


def pack_stats(stats: Stats) -> str:
    """Return normalisation statistics as JSON text; float64 values are preserved exactly."""
    return json.dumps({key: {name: np.asarray(v).tolist() for name, v in s.items()} for key, s in stats.items()})


def unpack_stats(text: str) -> Stats:
    """Return the statistics in `pack_stats`'s text: ``stats[feature][mean|std|min|max|count]``."""
    return {key: {name: np.asarray(v) for name, v in s.items()} for key, s in json.loads(text).items()}
