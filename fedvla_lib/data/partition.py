"""Partitioning: an episode table -> one list of episode ids per client.

Whole episodes are assigned, since neighbouring frames are nearly identical. Two schemes use flwr-datasets' partitioners
with an episode as a row and its task as the label. This module does not know images or training.
"""

import warnings
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import pandas as pd
from datasets import Dataset

from fedvla_lib.config import PARTITIONS

MAX_DRAWS = 20  # seeds tried for a Dirichlet partition without an empty client; each draws up to 11 times


def partition(
    table: pd.DataFrame, num_clients: int, scheme: str, *, seed: int = 0, alpha: float = 0.5
) -> list[list[int]]:
    """Return the episode ids of each client: disjoint, complete, sorted, none empty.

    - modulo: episodes are ordered by task, then id, and the k-th goes to client ``k % num_clients``. Every client gets
      the same mix, up to one episode per task. (``episode_id % num_clients`` would not work: recordings alternate the
      tasks, so with 3 tasks and 3 clients each client would get one task.)
    - task: client k holds task ``k % num_tasks``; clients with the same task share its episodes evenly. With fewer
      clients than tasks, client k holds tasks k, k + num_clients, ...
    - lab: client k holds the episodes of lab ``k % num_labs``; clients of the same lab take its episodes in turn. With
      fewer clients than labs, client k holds labs k, k + num_clients, ...
    - dirichlet: each task's episodes are divided in proportions drawn from Dirichlet(alpha, ..., alpha) over the
      clients (Hsu et al., arXiv:1909.06335). A small `alpha` gives few tasks per client and unequal sizes. Draws that
      leave a client without an episode are repeated.

    Args:
        table: one row per episode, with columns episode_id, task and, for scheme lab, lab.
        num_clients: number of lists to return.
        scheme: modulo, task, dirichlet or lab.
        seed: fixes the Dirichlet draw; the other schemes are deterministic.
        alpha: concentration of the Dirichlet scheme, above 0.

    Raises:
        ValueError: unknown scheme, fewer episodes than clients, or every partition drawn leaves a client empty.
    """
    _check_request(table, num_clients, scheme, alpha)
    table = table.sort_values(["task", "episode_id"], kind="stable").reset_index(drop=True)
    if scheme == "modulo":
        parts = [table["episode_id"].iloc[client::num_clients] for client in range(num_clients)]
    elif scheme == "dirichlet":
        parts = _dirichlet(table, num_clients, seed, alpha)
    else:
        parts = (_by_task if scheme == "task" else _by_lab)(table, num_clients)
    parts = [sorted(int(episode_id) for episode_id in part) for part in parts]
    check_partition(parts, table["episode_id"])
    return parts


def check_partition(parts: Sequence[Sequence[int]], episode_ids: Iterable[int]) -> None:
    """Raise ValueError unless every episode is assigned to exactly one client and every client has one.

    The message names the client and the episode.
    """
    owner: dict[int, int] = {}
    for client, part in enumerate(parts):
        if not len(part):
            raise ValueError(f"client {client} has no episode: use fewer clients, more episodes or another scheme")
        for episode_id in part:
            if episode_id in owner:
                raise ValueError(f"episode {episode_id} is assigned to clients {owner[episode_id]} and {client}")
            owner[episode_id] = client
    expected = {int(episode_id) for episode_id in episode_ids}
    for episode_id in sorted(expected ^ owner.keys()):
        if episode_id in expected:
            raise ValueError(f"episode {episode_id} is assigned to no client")
        raise ValueError(f"episode {episode_id} of client {owner[episode_id]} is not one of those to assign")


def _check_request(table: pd.DataFrame, num_clients: int, scheme: str, alpha: float) -> None:
    if scheme not in PARTITIONS:
        raise ValueError(f"unknown partition scheme {scheme!r}: choose one of {', '.join(PARTITIONS)}")
    if not 1 <= num_clients <= len(table):
        raise ValueError(f"num_clients={num_clients} is not usable: give 1 to {len(table)}, the number of episodes")
    if scheme == "lab" and "lab" not in table:
        raise ValueError("scheme 'lab' needs a column lab: record with num-labs above 1, or choose another scheme")
    if not alpha > 0:
        raise ValueError(f"alpha={alpha} is not usable: give a number above 0")
    duplicates = table.loc[table["episode_id"].duplicated(), "episode_id"]
    if len(duplicates):
        raise ValueError(f"episode {duplicates.iloc[0]} is in the table twice")


def _by_task(table: pd.DataFrame, num_clients: int) -> list[list[int]]:
    """Use flwr-datasets' pathological partitioner with one group of tasks per client."""
    tasks = sorted(table["task"].unique())
    # The partitioner gives each client the same number of labels and drops the remaining ones, so with fewer clients
    # than tasks a label stands for the group of tasks of one client.
    labels = {task: i % num_clients for i, task in enumerate(tasks)}
    table = table.assign(label=table["task"].map(labels))
    groups = min(num_clients, len(tasks))
    available = table["label"].value_counts()
    for label in range(groups):
        sharing = len(range(label, num_clients, groups))
        if available[label] < sharing:
            names = ", ".join(task for task in tasks if labels[task] == label)
            message = f"{sharing} clients cannot share the {available[label]} episodes of {names}: use fewer clients"
            raise ValueError(message)
    from flwr_datasets.partitioner import PathologicalPartitioner  # loads seaborn and SciPy: a second

    partitioner = PathologicalPartitioner(
        num_clients, "label", num_classes_per_partition=1, class_assignment_mode="deterministic", shuffle=False
    )
    return _ids(partitioner, table, num_clients)


def _by_lab(table: pd.DataFrame, num_clients: int) -> list[list[int]]:
    groups = min(num_clients, table["lab"].nunique())
    parts: list[list[int]] = [[] for _ in range(num_clients)]
    for i, (_, episodes) in enumerate(table.groupby("lab", sort=True)):
        holders = range(i % groups, num_clients, groups)
        for turn, episode_id in enumerate(episodes["episode_id"]):
            parts[holders[turn % len(holders)]].append(episode_id)
    return parts


def _dirichlet(table: pd.DataFrame, num_clients: int, seed: int, alpha: float) -> list[list[int]]:
    """Use flwr-datasets' Dirichlet partitioner, with more draws than its own 11."""
    from flwr_datasets.partitioner import DirichletPartitioner

    for draw in range(MAX_DRAWS):
        generator_seed = int(np.random.SeedSequence([seed, draw]).generate_state(1)[0])
        partitioner = DirichletPartitioner(
            num_clients, "task", alpha=float(alpha), min_partition_size=1, shuffle=False, seed=generator_seed
        )
        try:
            with warnings.catch_warnings():
                warnings.filterwarnings("ignore", message="The specified min_partition_size")
                return _ids(partitioner, table, num_clients)
        except ValueError as error:
            if "max number of attempts" not in str(error):
                raise
    raise ValueError(
        f"no Dirichlet partition with alpha={alpha} gives each of {num_clients} clients one of {len(table)} episodes: "
        "use a larger alpha, fewer clients or more episodes"
    )


def _ids(partitioner: Any, table: pd.DataFrame, num_clients: int) -> list[list[int]]:
    """Return the episodes that a partitioner of flwr-datasets gives each client."""
    partitioner.dataset = Dataset.from_pandas(table, preserve_index=False)
    return [list(partitioner.load_partition(client)["episode_id"]) for client in range(num_clients)]
