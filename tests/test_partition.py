"""Every scheme assigns each episode exactly once; the measure of heterogeneity follows its definition."""

import numpy as np
import pandas as pd
import pytest

from fedvla_book.tables import heterogeneity
from fedvla_lib.config import PARTITIONS
from fedvla_lib.data.partition import check_partition, partition

pytestmark = pytest.mark.unit
TASKS = ("lift", "place", "push")


def episode_table(per_task: int, tasks: tuple[str, ...] = TASKS) -> pd.DataFrame:
    """Return the table of a recording: the tasks alternate, episodes of a task have the same length."""
    count = per_task * len(tasks)
    names = [tasks[i % len(tasks)] for i in range(count)]
    frames, labs = [30 + len(name) for name in names], [i // len(tasks) % 4 for i in range(count)]
    return pd.DataFrame({"episode_id": range(count), "task": names, "num_frames": frames, "lab": labs})


@pytest.mark.parametrize("scheme", PARTITIONS)
@pytest.mark.parametrize("num_clients", [1, 2, 3, 4, 10])
@pytest.mark.parametrize("seed", range(3))
def test_every_episode_is_assigned_exactly_once(scheme, num_clients, seed):
    table = episode_table(20).iloc[3:]  # ids need not start at 0, tasks need not be balanced
    parts = partition(table, num_clients, scheme, seed=seed, alpha=0.5)
    assert len(parts) == num_clients and all(parts)
    assert sorted(episode_id for part in parts for episode_id in part) == list(table["episode_id"])
    assert all(part == sorted(part) and all(type(episode_id) is int for episode_id in part) for part in parts)
    assert parts == partition(table.sample(frac=1, random_state=1), num_clients, scheme, seed=seed, alpha=0.5)


@pytest.mark.parametrize("num_clients", [2, 3, 6, 9, 10])
def test_modulo_gives_every_client_the_same_mix(num_clients):
    table = episode_table(36)
    counts = heterogeneity(partition(table, num_clients, "modulo"), table)["counts"]
    assert (counts.max() - counts.min()).max() <= 1


def test_by_task_gives_each_client_one_task():
    table = episode_table(12)
    counts = heterogeneity(partition(table, 10, "task"), table)["counts"]
    assert ((counts > 0).sum(axis=1) == 1).all()
    assert counts.to_numpy().argmax(axis=1).tolist() == [client % 3 for client in range(10)]


def test_by_task_with_fewer_clients_than_tasks_keeps_tasks_whole():
    table = episode_table(5, ("a", "b", "c", "d", "e"))
    counts = heterogeneity(partition(table, 2, "task"), table)["counts"]
    assert counts.to_numpy().tolist() == [[5, 0, 5, 0, 5], [0, 5, 0, 5, 0]]


def test_dirichlet_follows_its_seed_and_concentration():
    table = episode_table(36)
    assert partition(table, 10, "dirichlet", seed=0) != partition(table, 10, "dirichlet", seed=1)

    def spread(alpha: float) -> float:
        parts = [partition(table, 4, "dirichlet", seed=seed, alpha=alpha) for seed in range(10)]
        return float(np.mean([heterogeneity(part, table)["total_variation"] for part in parts]))

    assert spread(0.1) > spread(1.0) > spread(100.0)
    assert spread(100.0) < 0.1


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"scheme": "random"}, "unknown partition scheme 'random': choose one of modulo, task, dirichlet, lab"),
        ({"num_clients": 0}, "num_clients=0 is not usable: give 1 to 9"),
        ({"num_clients": 10}, "num_clients=10 is not usable: give 1 to 9"),
        ({"scheme": "dirichlet", "alpha": 0.0}, "alpha=0.0"),
        ({"scheme": "dirichlet", "num_clients": 9}, "alpha=0.5 gives each of 9 clients one of 9 episodes"),
    ],
)
def test_impossible_requests_are_refused(settings, message):
    request = {"num_clients": 3, "scheme": "modulo", "alpha": 0.5, **settings}
    with pytest.raises(ValueError, match=message):
        partition(episode_table(3), **request)


def test_a_task_that_its_clients_cannot_share_is_named():
    table = episode_table(6)
    table = table[(table["task"] != "push") | (table["episode_id"] < 3)]
    with pytest.raises(ValueError, match="2 clients cannot share the 1 episodes of push"):
        partition(table, 6, "task")


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ([[0, 1], [1, 2]], "episode 1 is assigned to clients 0 and 1"),
        ([[0], [2]], "episode 1 is assigned to no client"),
        ([[0, 1], [2, 7]], "episode 7 of client 1 is not one of those"),
        ([[0, 1, 2], []], "client 1 has no episode"),
    ],
)
def test_a_wrong_partition_is_named(parts, message):
    with pytest.raises(ValueError, match=message):
        check_partition(parts, [0, 1, 2])


def test_heterogeneity_is_zero_for_equal_mixes_and_largest_for_one_task_each():
    table = episode_table(4)
    equal = heterogeneity([[0, 1, 2, 3, 4, 5], [6, 7, 8, 9, 10, 11]], table)
    assert equal["total_variation"] == 0 and equal["size_imbalance"] == 1
    apart = heterogeneity([[0, 3, 6, 9], [1, 4, 7, 10], [2, 5, 8, 11]], table)
    assert apart["total_variation"] == pytest.approx(2 / 3)
    assert apart["sizes"] == [4, 4, 4]
    assert apart["frames"] == [4 * 34, 4 * 35, 4 * 34]


def test_heterogeneity_by_hand():
    """4 lift and 2 place; client 0 holds 3 + 0, client 1 holds 1 + 2: distances 1/3 and 1/3."""
    table = pd.DataFrame({"episode_id": range(6), "task": ["lift"] * 4 + ["place"] * 2})
    found = heterogeneity([[0, 1, 2], [3, 4, 5]], table)
    assert found["per_client"] == pytest.approx([1 / 3, 1 / 3])
    assert found["total_variation"] == pytest.approx(1 / 3)
    assert found["counts"].to_numpy().tolist() == [[3, 0], [1, 2]]
