"""Which episodes are held out, and which training and held-out episodes each client has."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from fedvla_lib.config import Config
from fedvla_lib.data import frame_store, partition
from fedvla_lib.data.frame_store import FrameStore
from fedvla_lib.robot.labs import REFERENCE, Lab, labs
from fedvla_lib.robot.tasks import ALL_TASKS


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


@dataclass(frozen=True)
class Share:
    """Episode ids of one client; no two clients share any."""

    train_ids: list[int]
    val_ids: list[int]


def shares(store: frame_store.FrameStore, config: Config) -> list[Share]:
    """Split off held-out episodes, then deal both kinds out; all from the settings, so that every client agrees."""
    train_ids, val_ids = split(store, config.val_fraction, config.seed)
    table = store.episodes
    parts = partition.partition(
        table[table.episode_id.isin(train_ids)],
        config.num_clients,
        config.partition,
        seed=config.seed,
        alpha=config.dirichlet_alpha,
    )
    partition.check_partition(parts, train_ids)
    held_out = _deal_out(table, parts, val_ids)
    return [Share(list(part), held) for part, held in zip(parts, held_out, strict=True)]


def held_out_episodes(store: frame_store.FrameStore, config: Config) -> list[int]:
    """Episodes no client trains on: what the global model is validated on."""
    return split(store, config.val_fraction, config.seed)[1]


def num_frames(store: frame_store.FrameStore, episode_ids: Sequence[int]) -> int:
    """Number of frames in the given episodes."""
    return sum(end - start for start, end in frame_spans(store, episode_ids))


def tasks_of(store: frame_store.FrameStore, episode_ids: Sequence[int]) -> list[str]:
    """Return the simulated tasks among the given episodes, in a fixed order."""
    held = set(store.episodes.set_index("episode_id").loc[list(episode_ids), "task"])
    return [task for task in ALL_TASKS if task in held]


def labs_of(store: frame_store.FrameStore, episode_ids: Sequence[int], config: Config) -> list[Lab]:
    """Return the laboratories in which the given episodes were recorded."""
    there = labs(config.num_labs)
    found = sorted(set(store.episodes.set_index("episode_id").loc[list(episode_ids), "lab"]))
    return [there[int(index)] for index in found if index < len(there)] or [REFERENCE]


def _deal_out(table: Any, parts: list[list[int]], val_ids: Sequence[int]) -> list[list[int]]:
    """Give each held-out episode to a client that trains on its task, the one with the fewest held-out so far."""
    task = dict(zip(table.episode_id, table.task, strict=True))
    tasks_held = [{task[episode] for episode in part} for part in parts]
    held_out: list[list[int]] = [[] for _ in parts]
    for episode in sorted(val_ids):
        holders = [k for k, held in enumerate(tasks_held) if task[episode] in held] or range(len(parts))
        held_out[min(holders, key=lambda k: (len(held_out[k]), k))].append(episode)
    return held_out


def frame_spans(store: frame_store.FrameStore, episode_ids: Sequence[int]) -> list[tuple[int, int]]:
    rows = store.episodes.set_index("episode_id").loc[list(episode_ids)]
    return list(zip(rows.start.astype(int), rows.end.astype(int), strict=True))
