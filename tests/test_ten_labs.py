"""The benchmark "ten labs": one task a lab, measured at home, in an eleventh lab and at the others' tasks."""

import json
from collections import Counter

import numpy as np
import pytest

from conftest import short_rollouts
from fedvla_book.tables.results import read_results, summary
from fedvla_lib import run_folder
from fedvla_lib.cli.main import main
from fedvla_lib.config import from_profile
from fedvla_lib.data import recordings, splits
from fedvla_lib.federation.nodes import Roster
from fedvla_lib.robot.labs import labs

pytestmark = pytest.mark.integration
TASKS = "square,tower"
SETTINGS = {"tasks": TASKS, "num_labs": 4, "one_task_per_lab": True, "episodes_per_task": 4, "partition": "lab",
            "num_clients": 4, "val_fraction": 0.0, "num_threads": 1}  # fmt: skip


def test_each_lab_records_its_own_task():
    config = from_profile("tiny", **SETTINGS)
    store = recordings.open_frames(config)
    shares = splits.shares(store, config)
    table = store.episodes.set_index("episode_id")
    for k, share in enumerate(shares):
        assert set(table.lab[share.train_ids]) == {k}
        assert set(table.task[share.train_ids]) == {TASKS.split(",")[k % 2]} and len(share.train_ids) == 2


def test_labs_that_cannot_share_the_tasks_evenly_are_refused():
    with pytest.raises(ValueError, match="num-labs=3 is not usable: give a multiple of the number of tasks"):
        from_profile("tiny", **SETTINGS | {"num_labs": 3})


def test_every_seed_of_an_experiment_has_its_own_recording():
    one, other = (recordings.open_frames(from_profile("tiny", **SETTINGS, seed=seed)) for seed in (0, 1))
    assert len(one.states) != len(other.states) or (one.states != other.states).any()


GRID = """
profile = "tiny"
seeds = [0]
rollouts = 16
[settings]
%s
[partitions.lab]
[methods.averaged]
[methods.alone]
kind = "local-only"
alone_steps = 3
[methods.pooled]
kind = "centralized"
alone_steps = 5
"""


@pytest.fixture(scope="module")
def grid(tmp_path_factory):
    root = tmp_path_factory.mktemp("ten labs")
    lines = [f"{name} = {json.dumps(value)}" for name, value in (SETTINGS | {"fraction_train": 1.0}).items()]
    (root / "grid.toml").write_text(GRID % "\n".join(lines))
    for seed in (0, 10_000):  # of the labs' demonstrations and of fresh ones
        recordings.open_frames(from_profile("tiny", **SETTINGS, seed=seed))
    with short_rollouts():
        assert main(["experiment", str(root / "grid.toml"), "--out", str(root / "out")]) == 0
    return root


def rollouts(grid, method):
    return run_folder.read_metrics(grid / "out" / f"lab_{method}_0", "rollout")


@pytest.mark.parametrize("method", ["averaged", "pooled"])
def test_a_global_model_is_measured_at_every_lab_s_task_at_home_and_in_the_unseen_lab(grid, method):
    rows, there = rollouts(grid, method), labs(5)
    own, unseen = rows[rows.place == "own"], rows[rows.place == "unseen"]
    assert len(own) == len(unseen) == 16 and len(rows) == 32
    assert Counter(own.lab) == {lab.name: 4 for lab in there[:4]} and set(unseen.lab) == {there[4].name}
    task = {lab.name: TASKS.split(",")[k % 2] for k, lab in enumerate(there)}
    assert (own.lab.map(task) == own.task).all() and Counter(unseen.task) == {"square": 8, "tower": 8}


def test_a_lab_alone_is_measured_on_the_same_rollouts_and_at_the_others_tasks(grid):
    alone, pooled, there = rollouts(grid, "alone"), rollouts(grid, "pooled"), labs(5)
    for place in ("own", "unseen"):
        made = [
            set(zip(of.task, of.lab, of.seed, strict=True))
            for of in (alone[alone.place == place], pooled[pooled.place == place])
        ]
        assert made[0] == made[1] and len(made[0]) == 16
    others = alone[alone.place == "others"]
    assert Counter(others.client) == dict.fromkeys(range(4), 1)
    for row in others.itertuples():
        assert row.task != TASKS.split(",")[int(row.client) % 2] and row.lab in {lab.name for lab in there[:4]}


def test_the_book_reads_demonstrations_place_and_time(grid):
    rows = read_results(grid / "out")
    assert set(rows.demonstrations) == {2} and set(rows.place) == {"own", "unseen", "others"}
    found = summary(rows, ["partition", "method", "place"]).set_index(["method", "place"])
    assert found.rollouts[("alone", "own")] == found.rollouts[("pooled", "unseen")] == 16
    assert (found.in_a_row_s > 0).all() and (found.in_a_row_s <= found.train_s).all()


def test_the_loss_is_of_fresh_demonstrations_of_the_same_labs(grid):
    fresh = recordings.open_frames(from_profile("tiny", **SETTINGS, seed=10_000))
    pooled, alone = (
        run_folder.read_metrics(grid / "out" / f"lab_{name}_0", "held-out") for name in ("pooled", "alone")
    )
    assert len(fresh.episodes) == 8  # two for each lab
    for measured in (pooled, alone):
        assert sorted(measured.episode_id) == sorted(fresh.episodes.episode_id) and (measured.loss > 0).all()
    assert (pooled.num_examples == alone.num_examples).all()
    assert read_results(grid / "out").loss.notna().all()


def test_steps_and_times_are_counted(grid):
    stamps = {name: run_folder.read_stamp(grid / "out" / f"lab_{name}_0") for name in ("averaged", "alone", "pooled")}
    assert stamps["averaged"]["steps"]["global"] == {"in_all": 16, "in_a_row": 4}  # 2 rounds, 4 labs, 2 local steps
    assert stamps["alone"]["steps"]["client_3"] == {"in_all": 3, "in_a_row": 3}
    assert stamps["pooled"]["steps"]["global"] == {"in_all": 5, "in_a_row": 5}
    for stamp in stamps.values():
        assert 0 < stamp["in_a_row_s"] <= stamp["train_s"]
    assert stamps["alone"]["in_a_row_s"] < stamps["alone"]["train_s"]


@pytest.mark.parametrize(
    ("before", "after", "named"),
    [
        ("alone_steps = 5", "alone_steps = 6", "alone-steps=5, not 6"),
        ("rollouts = 16", "rollouts = 20", "rollout-seeds="),
        ('kind = "local-only"', 'kind = "base"', "kind='local-only', not 'base'"),
    ],
)
def test_a_stored_cell_of_another_plan_is_refused_by_name(grid, before, after, named, capsys):
    text = (grid / "grid.toml").read_text()
    (grid / "other.toml").write_text(text.replace(before, after))
    assert main(["experiment", str(grid / "other.toml"), "--out", str(grid / "out")]) == 2
    assert named in capsys.readouterr().err
    assert len(list((grid / "out").glob("*/stamp.json"))) == 3


def test_a_stored_cell_of_other_code_is_refused(grid, capsys):
    file = grid / "out" / "lab_pooled_0" / "stamp.json"
    kept = file.read_text()
    file.write_text(json.dumps(json.loads(kept) | {"code": "0123456789ab"}))
    assert main(["experiment", str(grid / "grid.toml"), "--out", str(grid / "out")]) == 2
    assert "lab_pooled_0 was made with code='0123456789ab'" in capsys.readouterr().err
    file.write_text(kept)
    assert main(["experiment", str(grid / "grid.toml"), "--out", str(grid / "out")]) == 0  # taken up again


@pytest.mark.unit
def test_sampling_by_task_misses_no_task_that_has_a_place():
    roster = Roster({node: node for node in range(10)}, tasks_of={node: (f"task {node % 5}",) for node in range(10)})
    rng = np.random.default_rng(0)
    drawn = [roster.sample(0.5, rng, by_task=True) for _ in range(200)]
    assert all(sorted(node % 5 for node in nodes) == list(range(5)) for nodes in drawn)
    assert all(nodes == sorted(nodes) for nodes in drawn)
    counts = Counter(node for nodes in drawn for node in nodes)
    assert min(counts.values()) > 70 and len(counts) == 10
    few = [roster.sample(0.3, rng, by_task=True) for _ in range(50)]
    assert all(len({node % 5 for node in nodes}) == 3 for nodes in few)
