"""Held-out episodes, and each client's training and held-out episodes."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from fedvla_lib.config import Config
from fedvla_lib.data.frame_store import FrameStore
from fedvla_lib.data.partition import partition
from fedvla_lib.robot.labs import REFERENCE, Lab, labs
from fedvla_lib.robot.tasks import ALL_TASKS


def split(source: FrameStore | pd.DataFrame, val_fraction: float, seed: int) -> tuple[list[int], list[int]]:
    """Return (training, validation) episode ids, drawn per task.

    Of the n episodes of each task, ``round(val_fraction * n)`` are for validation: at least one if ``val_fraction > 0``
    and n > 1, and never all. The frames of an episode are never split.
    Raises ValueError if `val_fraction` is outside [0, 1].
    """
    if not 0 <= val_fraction <= 1:
        raise ValueError(f"val_fraction={val_fraction} is not usable: give a number from 0 to 1")
    table = source.episodes if isinstance(source, FrameStore) else source
    rng = np.random.default_rng(seed)
    held_out: list[int] = []
    for _, group in table.groupby("task", sort=True):
        ids = rng.permutation(np.sort(group["episode_id"].to_numpy()))
        count = min(max(round(val_fraction * len(ids)), 1), len(ids) - 1) if val_fraction else 0
        held_out += [int(episode_id) for episode_id in ids[:count]]
    train = [int(episode_id) for episode_id in sorted(table["episode_id"]) if episode_id not in set(held_out)]
    return train, sorted(held_out)


@dataclass(frozen=True)
class Share:
    """Episode ids of one client; clients have no episodes in common."""

    train_ids: list[int]
    val_ids: list[int]


def shares(store: FrameStore, config: Config) -> list[Share]:
    """Assign training and held-out episodes to the clients; depends on store and settings only."""
    train_ids, val_ids = split(store, config.val_fraction, config.seed)
    table = store.episodes[store.episodes.episode_id.isin(train_ids)]
    parts = partition(table, config.num_clients, config.partition, seed=config.seed, alpha=config.dirichlet_alpha)
    held_out = _assign_held_out(store.episodes, parts, val_ids)
    return [Share(part, held) for part, held in zip(parts, held_out, strict=True)]


def held_out_episodes(store: FrameStore, config: Config) -> list[int]:
    """Return the episodes that no client trains on, for validating the global model."""
    return split(store, config.val_fraction, config.seed)[1]


def tasks_of(store: FrameStore, episode_ids: Sequence[int]) -> list[str]:
    """Return the simulated tasks of the given episodes, in the order of `ALL_TASKS`."""
    held = set(store.episodes.set_index("episode_id").loc[list(episode_ids), "task"])
    return [task for task in ALL_TASKS if task in held]


def labs_of(store: FrameStore, episode_ids: Sequence[int], config: Config) -> list[Lab]:
    """Return the labs in which the given episodes were recorded, in order; the reference lab if none is known."""
    all_labs = labs(config.num_labs)
    indices = sorted(set(store.episodes.set_index("episode_id").loc[list(episode_ids), "lab"]))
    return [all_labs[int(index)] for index in indices if index < len(all_labs)] or [REFERENCE]


def _assign_held_out(table: pd.DataFrame, parts: list[list[int]], val_ids: Sequence[int]) -> list[list[int]]:
    """Assign each held-out episode to a client that trains on its task, to the one with the fewest held-out so far."""
    task = dict(zip(table.episode_id, table.task, strict=True))
    tasks_held = [{task[episode] for episode in part} for part in parts]
    held_out: list[list[int]] = [[] for _ in parts]
    for episode in sorted(val_ids):
        holders = [k for k, held in enumerate(tasks_held) if task[episode] in held] or range(len(parts))
        held_out[min(holders, key=lambda k: (len(held_out[k]), k))].append(episode)
    return held_out
