"""Who holds which episodes: an episode table -> one list of episode ids per client, and how different the clients are.

Episodes, not frames, are dealt out: neighbouring frames are nearly the same picture. The partitioners are
flwr-datasets', which split the rows of a table; here a row is an episode and its label the task. This module knows
nothing about pictures or training.
"""

import warnings
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import pandas as pd
from datasets import Dataset
from flwr_datasets.partitioner import DirichletPartitioner, PathologicalPartitioner
from flwr_datasets.partitioner.partitioner import Partitioner

from fedvla_lib.config import PARTITIONS

MAX_DRAWS = 20  # generators tried for a Dirichlet partition without an empty client; each draws up to 11 times


def partition(
    table: pd.DataFrame, num_clients: int, scheme: str, *, seed: int = 0, alpha: float = 0.5
) -> list[list[int]]:
    """Return the episode ids of each client: disjoint, complete, sorted, none empty.

    - modulo: episodes are ordered by task, then id, and dealt out like cards, the k-th to client ``k % num_clients``.
      Every client gets the same mix, give or take one episode of each task. (Plain ``episode_id % num_clients`` would
      not do: recordings alternate the tasks, so with 3 tasks and 3 clients each client would get one task.)
    - task: client k holds task ``k % num_tasks``; clients with the same task share its episodes evenly. With fewer
      clients than tasks, client k holds tasks k, k + num_clients, ...
    - lab: client k holds the episodes of laboratory ``k % num_labs``; clients of the same laboratory are dealt its
      episodes like cards. With fewer clients than laboratories, client k holds k, k + num_clients, ...
    - dirichlet: each task's episodes are divided in proportions drawn from Dirichlet(alpha, ..., alpha) over the
      clients (Hsu et al., arXiv:1909.06335). Small `alpha` gives few tasks a client and unequal sizes. Draws that leave
      a client without an episode are drawn again.

    Args:
        table: one row per episode, with columns episode_id, task and, for the scheme lab, lab.
        num_clients: how many lists to return.
        scheme: modulo, task, dirichlet or lab.
        seed: fixes the Dirichlet draw; the other schemes have nothing to draw.
        alpha: concentration of the Dirichlet scheme, above 0.

    Raises:
        ValueError: unknown scheme, fewer episodes than clients, or no partition without an empty client found.
    """
    _check_request(table, num_clients, scheme, alpha)
    table = table.sort_values(["task", "episode_id"], kind="stable").reset_index(drop=True)
    if scheme == "modulo":
        ids = table["episode_id"].to_numpy()
        parts = [ids[client::num_clients].tolist() for client in range(num_clients)]
    elif scheme == "task":
        parts = _by_task(table, num_clients)
    elif scheme == "lab":
        parts = _by_lab(table, num_clients)
    else:
        parts = _dirichlet(table, num_clients, seed, alpha)
    parts = [sorted(int(episode_id) for episode_id in part) for part in parts]
    check_partition(parts, table["episode_id"])
    return parts


def check_partition(parts: Sequence[Sequence[int]], episode_ids: Iterable[int]) -> None:
    """Raise ValueError unless every episode is with exactly one client and every client has one.

    The message names the client and the episode.
    """
    owner: dict[int, int] = {}
    for client, part in enumerate(parts):
        if not len(part):
            raise ValueError(f"client {client} has no episode: use fewer clients, more episodes or another scheme")
        for episode_id in part:
            if episode_id in owner:
                raise ValueError(f"episode {episode_id} is with client {owner[episode_id]} and with client {client}")
            owner[episode_id] = client
    wanted = {int(episode_id) for episode_id in episode_ids}
    for episode_id in sorted(wanted ^ owner.keys()):
        if episode_id in wanted:
            raise ValueError(f"episode {episode_id} is with no client")
        raise ValueError(f"episode {episode_id} of client {owner[episode_id]} is not one of those to be dealt out")


def heterogeneity(parts: Sequence[Sequence[int]], table: pd.DataFrame, by: str = "task") -> dict[str, Any]:
    """Measure how different the clients' mixes of tasks are, or of laboratories with ``by="lab"``.

    Client k holds n_k of n episodes, a share p_k(t) of its own being of task t; p(t) is the share among all. The total
    variation distance of client k is ``d_k = 1/2 * sum_t |p_k(t) - p(t)|``: the share of its episodes that would have
    to be swapped to make its mix the common one. The measure is ``sum_k (n_k / n) * d_k``: 0 if all clients have the
    same mix (IID), ``1 - sum_t p(t)^2`` if each has one task only (2/3 for three equal tasks).

    Returns:
        ``total_variation`` (the measure), ``per_client`` (d_k), ``sizes`` (n_k), ``frames`` (per client; if `table` has
        num_frames), ``size_imbalance`` (largest n_k over mean n_k) and ``counts`` (DataFrame: client x task
        or lab, episodes).
    """
    client_of = {episode_id: client for client, part in enumerate(parts) for episode_id in part}
    held = table[table["episode_id"].isin(client_of.keys())].copy()
    held["client"] = held["episode_id"].map(client_of)
    counts = pd.crosstab(held["client"], held[by]).reindex(range(len(parts)), fill_value=0)
    sizes = counts.sum(axis=1).to_numpy()
    mixes = counts.to_numpy() / np.maximum(sizes, 1)[:, None]
    pooled = counts.to_numpy().sum(axis=0) / max(sizes.sum(), 1)
    per_client = 0.5 * np.abs(mixes - pooled).sum(axis=1)
    frames = (
        held.groupby("client")["num_frames"].sum().reindex(range(len(parts)), fill_value=0)
        if "num_frames" in held
        else []
    )
    return {
        "total_variation": float((sizes * per_client).sum() / max(sizes.sum(), 1)),
        "per_client": [float(distance) for distance in per_client],
        "sizes": [int(size) for size in sizes],
        "frames": [int(count) for count in frames],
        "size_imbalance": float(sizes.max() / sizes.mean()) if sizes.any() else 0.0,
        "counts": counts,
    }


def _check_request(table: pd.DataFrame, num_clients: int, scheme: str, alpha: float) -> None:
    if scheme not in PARTITIONS:
        raise ValueError(f"unknown partition scheme {scheme!r}: choose one of {', '.join(PARTITIONS)}")
    if not 1 <= num_clients <= len(table):
        raise ValueError(f"num_clients={num_clients} is not usable: give 1 to {len(table)}, the number of episodes")
    if scheme == "lab" and "lab" not in table:
        raise ValueError("scheme 'lab' needs a column lab: record with num-labs above 1, or choose another scheme")
    if not alpha > 0:
        raise ValueError(f"alpha={alpha} is not usable: give a number above 0")
    if table["episode_id"].duplicated().any():
        twice = table.loc[table["episode_id"].duplicated(), "episode_id"].iloc[0]
        raise ValueError(f"episode {twice} is in the table twice")


def _by_task(table: pd.DataFrame, num_clients: int) -> list[list[int]]:
    """flwr-datasets' pathological partitioner with one group of tasks per client."""
    tasks = sorted(table["task"].unique())
    # That partitioner gives each client the same number of labels and leaves out what is over, so with fewer clients
    # than tasks the label is the group of tasks that a client gets.
    labels = {task: place % num_clients for place, task in enumerate(tasks)}
    table = table.assign(label=table["task"].map(labels))
    groups = min(num_clients, len(tasks))
    scarce = table["label"].value_counts()
    for label in range(groups):
        sharing = len(range(label, num_clients, groups))
        if scarce[label] < sharing:
            names = ", ".join(task for task in tasks if labels[task] == label)
            raise ValueError(
                f"{sharing} clients cannot share the {scarce[label]} episodes of {names}: use fewer clients"
            )
    partitioner = PathologicalPartitioner(
        num_clients,
        partition_by="label",
        num_classes_per_partition=1,
        class_assignment_mode="deterministic",
        shuffle=False,
    )
    return _ids(partitioner, table, num_clients)


def _by_lab(table: pd.DataFrame, num_clients: int) -> list[list[int]]:
    groups = min(num_clients, table["lab"].nunique())
    parts: list[list[int]] = [[] for _ in range(num_clients)]
    for place, (_, episodes) in enumerate(table.groupby("lab", sort=True)):
        holders = range(place % groups, num_clients, groups)
        for turn, episode_id in enumerate(episodes["episode_id"]):
            parts[holders[turn % len(holders)]].append(episode_id)
    return parts


def _dirichlet(table: pd.DataFrame, num_clients: int, seed: int, alpha: float) -> list[list[int]]:
    """flwr-datasets' Dirichlet partitioner, with more patience than its own 11 draws."""
    for draw in range(MAX_DRAWS):
        generator_seed = int(np.random.SeedSequence([seed, draw]).generate_state(1)[0])
        partitioner = DirichletPartitioner(
            num_clients,
            partition_by="task",
            alpha=float(alpha),
            min_partition_size=1,
            shuffle=False,
            seed=generator_seed,
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


def _ids(partitioner: Partitioner, table: pd.DataFrame, num_clients: int) -> list[list[int]]:
    partitioner.dataset = Dataset.from_pandas(table, preserve_index=False)
    return [list(partitioner.load_partition(client)["episode_id"]) for client in range(num_clients)]
