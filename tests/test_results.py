"""Checkpoints of stored runs: how held-out loss ranks them compared with success, and which pairs it misranks."""

import json
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from fedvla_book import tables
from fedvla_book.tables import results
from fedvla_lib.data import partition as partition_module

pytestmark = pytest.mark.unit
ROOT = Path(__file__).parents[1]


def rounds(*lines):
    """Checkpoints from (method, run, round, loss, successes, n)."""
    table = pd.DataFrame(lines, columns=["method", "run", "round", "loss", "successes", "n"]).assign(partition="task")
    return table.assign(success_rate=table.successes / table.n.where(table.n > 0))


def test_correlations_are_of_ranks_within_each_run_and_over_all():
    table = rounds(
        ("a", 0, 1, 9.0, 0, 10), ("a", 0, 2, 0.3, 1, 10), ("a", 0, 3, 0.2, 9, 10), ("a", 0, 4, 0.1, 0, 0),
        ("b", 0, 1, 0.5, 2, 10), ("b", 0, 2, 0.6, 3, 10), ("b", 1, 1, 0.7, 4, 10), ("b", 1, 2, 0.8, 4, 10),
    )  # fmt: skip
    found = tables.correlations(table)
    assert found[["method", "run"]].values.tolist() == [["a", 0], ["b", 0], ["b", 1], ["all", "all"]]
    assert found.n.tolist() == [3, 2, 2, 7]  # a checkpoint without a rollout is none
    np.testing.assert_allclose(found.rho[:3], [-1, 1, np.nan])  # all alike: no rank, and no warning
    seen = table[table.n > 0]
    assert found.rho.iloc[-1] == pytest.approx(seen.loss.rank().corr(seen.success_rate.rank()))
    assert tables.correlations(table, ["run"])[["method", "run", "n"]].values.tolist() == [
        ["all", 0, 5], ["all", 1, 2], ["all", "all", 7],
    ]  # fmt: skip


def test_clear_pairs_are_apart_and_disagreements_are_those_that_the_loss_misleads():
    table = rounds(
        ("a", 0, 1, 0.5, 0, 60), ("a", 0, 2, 0.2, 30, 60), ("b", 0, 1, 0.3, 58, 60), ("b", 1, 1, 0.1, 10, 60),
        ("b", 1, 2, 0.2, 60, 60), ("b", 1, 3, 0.05, 0, 0),
    )  # fmt: skip
    pairs = tables.clear_pairs(table)
    assert (pairs.loss < pairs.other_loss).all() and (pairs.gap > 0).all()
    apart = (pairs.low > pairs.other_high) | (pairs.high < pairs.other_low)
    assert apart.all() and len(pairs) == 8  # of 10: one has equal losses, in one the intervals overlap
    assert pairs.same_run.sum() == 2 and pairs.same_episodes.sum() == 4
    assert not pairs[pairs.same_run & (pairs.method == "a")].misled.any()

    found = tables.disagreements(table)
    assert (found.success_rate < found.other_success_rate).all() and found.gap.is_monotonic_decreasing
    named = found[["method", "run", "round", "other_method", "other_run", "other_round"]].values.tolist()
    assert named == [["b", 1, 1, "b", 1, 2], ["b", 1, 1, "b", 0, 1], ["a", 0, 2, "b", 0, 1], ["b", 1, 1, "a", 0, 2]]
    assert found.gap[0] == pytest.approx(found.other_low[0] - found.high[0])


def test_without_a_clear_pair_the_tables_are_empty():
    for table in (rounds(("a", 0, 1, 0.5, 1, 2), ("a", 0, 2, 0.2, 0, 2)), rounds(("a", 0, 1, 0.5, 0, 0))):
        assert len(tables.clear_pairs(table)) == len(tables.disagreements(table)) == 0
    assert np.isnan(tables.correlations(rounds(("a", 0, 1, 0.5, 0, 0))).rho.iloc[-1])


def rollouts(*cells):
    """Two rollouts of two training seeds for each (partition, method, kind, recording)."""
    return pd.DataFrame([
        {"partition": partition, "method": method, "kind": kind, "recording": recording, "run": run, "seed": seed,
         "success": place > 3}
        for place, (partition, method, kind, recording) in enumerate(cells) for run in (0, 1) for seed in (7, 8)
    ])  # fmt: skip


def test_partitions_with_too_few_seeds_are_filled_in_from_elsewhere():
    here = rollouts(*((part, "shared", "federated", "one") for part in ("task", "iid", "lab")))
    here = here[(here.partition != "iid") | (here.run == 0)]
    here.loc[here.partition == "lab", "method"] = "alone"
    there = rollouts(*((part, "shared", "federated", "one") for part in ("task", "iid", "uneven"))).assign(run=5)
    found = tables.fill_in(here, there, "shared")
    assert found.groupby("partition").run.unique().map(list).to_dict() == {"task": [0, 1], "iid": [5], "uneven": [5]}


def test_rates_compare_over_the_training_seeds_that_all_methods_have():
    rows = rollouts(*(("lab", method, "federated", "one") for method in ("first", "second", "third")))
    found = tables.shared_seeds(rows[(rows.method != "second") | (rows.run == 1)])
    assert set(found.run) == {1} and set(found.method) == {"first", "second", "third"}


COMPARISON = ROOT / "book" / "reference" / "comparison"


def test_steps_of_cells_without_counts_follow_from_settings_for_each_model_and_are_said_to():
    rows = results.read_results(COMPARISON)
    rows = rows[~rows.counted & (rows.partition == "task") & (rows.run == 0)]
    found = rows.groupby("method")[["gradient_steps", "steps_in_all", "steps_in_a_row"]].agg(
        lambda of: of.unique().item()
    )
    assert found.loc["local-only"].tolist() == [800, 80, 80]  # ten clients: the sum is no client's
    assert found.loc["fedavg-200x2x2"].tolist() == [800, 800, 400]
    assert found.loc["fedavg-10x4x20"].tolist() == [800, 800, 200]
    assert found.loc["centralized"].tolist() == [800, 800, 800] and found.loc["base"].tolist() == [0, 0, 0]


def test_counts_of_a_stamp_are_read_for_the_model_that_made_each_rollout(tmp_path):
    cell = Path(shutil.copytree(COMPARISON / "task_local-only_0", tmp_path / "task_local-only_0"))
    counts = {f"client_{k}": {"in_all": 100 + k, "in_a_row": 90 + k} for k in range(10)}
    stamp = json.loads((cell / "stamp.json").read_text())
    (cell / "stamp.json").write_text(json.dumps({**stamp, "steps": counts}))
    rows = results.read_results(tmp_path)
    assert rows.counted.all()
    assert (rows.steps_in_all == 100 + rows.client).all() and (rows.steps_in_a_row == 90 + rows.client).all()
    line = results.summary(rows).iloc[0]
    assert line.counted and line.steps_in_all == pytest.approx(rows.steps_in_all.mean())


def test_a_clients_own_task_is_the_one_that_partitions_deal_to_it():
    rows = results.read_results(COMPARISON)
    alone = rows[(rows.partition == "task") & (rows.method == "local-only") & (rows.run == 0)]
    episodes = [{"episode_id": number, "task": task} for number, task in enumerate(["push", "lift", "place"] * 40)]
    parts = partition_module.partition(pd.DataFrame(episodes), 10, "task")
    held = [{episodes[number]["task"] for number in part} for part in parts]
    assert [len(tasks) for tasks in held] == [1] * 10
    expected = [task in held[int(client)] for task, client in zip(alone.task, alone.client, strict=True)]
    assert tables.at_own_task(alone).tolist() == expected and sum(expected) == len(alone) / 3
    assert not tables.at_own_task(rows[rows.method == "centralized"]).any()
    assert not tables.at_own_task(rows[rows.method == "centralized"].drop(columns="client")).any()


def test_methods_are_named_by_their_steps_and_those_alone_split_by_whose_task_it_was():
    rows = results.read_results(COMPARISON)
    rows = rows[(rows.partition == "task") & (rows.run == 0)]
    named = tables.by_steps(rows)
    assert len(named) == len(rows) and named.success.sum() == rows.success.sum()
    names = list(dict.fromkeys(named.method))
    assert names[:3] == ["base, 0 steps", "local-only, own task, 80 steps", "local-only, other tasks, 80 steps"]
    assert {"centralized, 800 steps", "fedavg-200x2x2, 800 steps, 400 in a row"} <= set(names)
    own = rows[(rows.method == "local-only") & tables.at_own_task(rows)]
    assert named[named.method == names[1]].success.mean() == own.success.mean()


def test_a_folder_without_federated_cells_is_named(tmp_path):
    known = {"method": "pooled", "kind": "centralized", "partition": "task", "seed": 0, "gradient_steps": 1,
             "samples": 1, "bytes": 0, "train_s": None, "status": "completed", "engine": "inline", "started": "",
             "wall_s": None}  # fmt: skip
    (tmp_path / "task_pooled_0").mkdir()
    (tmp_path / "task_pooled_0" / "stamp.json").write_text(json.dumps(known))
    with pytest.raises(ValueError, match="no federated cell") as caught:
        tables.read_rounds(tmp_path)
    assert str(tmp_path) in str(caught.value) and len(str(caught.value).splitlines()) == 1
