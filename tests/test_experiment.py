"""A grid from a file: what is in it, what is kept, and what a cell knows of itself."""

import json
import tomllib
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import faulty
from conftest import short_rollouts
from fedvla_book import tables
from fedvla_book.tables import results
from fedvla_lib import run_folder
from fedvla_lib.cli.main import main
from fedvla_lib.config import from_profile, task_names
from fedvla_lib.data import recordings, splits
from fedvla_lib.data.batches import Batches, frame_rows
from fedvla_lib.data.record import MAX_ATTEMPTS, demonstration_seed
from fedvla_lib.engines import inline
from fedvla_lib.evaluation import compare_runs, measure
from fedvla_lib.evaluation.rollouts import FIRST_SEED
from fedvla_lib.experiments import experiment, methods
from fedvla_lib.experiments.experiment_file import QUIET, Cell, Plan, read_plan
from fedvla_lib.federation.client import CLIENT_SEEDS

REFERENCE = Path(__file__).parents[1] / "book" / "reference"

GRID = """
profile = "tiny"
seeds = [0, 1]
rollouts = 2

[settings]
tasks = "lift"
num_clients = 2
num_server_rounds = 1

[partitions.mixed]
partition = "modulo"

[partitions.by_task]
partition = "task"

[methods.averaged]

[methods.pooled]
kind = "centralized"

[[only]]
partition = "mixed"

[[only]]
method = "averaged"
seed = 0
"""


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "grid.toml"
    path.write_text(GRID)
    return path


@pytest.mark.unit
def test_cells_come_seed_by_seed_and_only_those_wanted(file):
    plan = read_plan(file)
    assert [cell.name for cell in plan.cells] == [
        "mixed_averaged_0", "mixed_pooled_0", "by_task_averaged_0", "mixed_averaged_1", "mixed_pooled_1",
    ]  # fmt: skip
    assert plan.rollout_seeds == [2_000_000, 2_000_001]
    assert all(cell.config.seed == cell.seed and cell.config.tasks == "lift" for cell in plan.cells)
    assert len({methods.total_steps(cell.config) for cell in plan.cells}) == 1


@pytest.mark.unit
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("[methods.pooled]", "[methods.pooled"), "line"),
        (("rollouts = 2", ""), "lacks 'rollouts'"),
        (("rollouts = 2", "rollouts = 2\nattempts = 3"), "unknown name 'attempts'"),
        (('kind = "centralized"', 'kind = "central"'), "'central'.*local-only"),
        (("num_clients = 2", "clients = 2"), "'clients'"),
        (("seeds = [0, 1]", "seeds = 3"), "seeds=3.*list of whole numbers"),
        (("rollouts = 2", "rollouts = 'two'"), "rollouts='two'.*above 0"),
        (('method = "averaged"', 'strategy = "averaged"'), "'strategy' under.*method"),
        (("[methods.pooled]", "[methods.'../pooled']"), "'../pooled'"),
        ((GRID[GRID.index("[[only]]") :], "[only]\nseed = 0"), "only={'seed': 0}.*tables"),
        (('profile = "tiny"', "profile = [1]"), r"profile=\[1\].*a name"),
        (("num_clients = 2", "num_clients = 2.5"), "num-clients=2.5 has type float: give int"),
    ],
)
def test_a_file_that_cannot_be_used_is_named_with_the_remedy(file, change, message, capsys):
    file.write_text(GRID.replace(*change))
    assert main(["experiment", str(file), "--out", str(file.parent / "out")]) == 2
    said = capsys.readouterr().err
    assert len(said.splitlines()) == 1
    with pytest.raises(ValueError, match=message):
        read_plan(file)
    assert not (file.parent / "out").exists()


def printed_table(said, column):
    """The printed table that has a column of this name, by method."""
    lines = said.splitlines()
    start = next(number for number, line in enumerate(lines) if column in line.split())
    names, rows = lines[start].split(), [line.split() for line in lines[start + 1 :]]
    table = pd.DataFrame([row for row in rows if len(row) == len(names)], columns=names).set_index("method")
    return table.drop(columns="partition").astype(float)


@pytest.mark.integration
def test_finished_cells_are_kept_and_say_what_they_cost(recording, tmp_path, capsys):
    grid = tomllib.loads(GRID)
    settings = {**grid["settings"], "tasks": "lift,push", "data": str(recording)}
    lines = ["profile = 'tiny'", "seeds = [0]", "rollouts = 2", "[settings]"]
    lines += [f"{key} = {json.dumps(value)}" for key, value in settings.items()]
    lines += ["[partitions.mixed]", "[methods.start]", "kind = 'base'", "[methods.averaged]", "[methods.pooled]",
              "kind = 'centralized'", "[methods.alone]", "kind = 'local-only'", "[methods.each]", "kind = 'clients'",
              "personal = 'projections'"]  # fmt: skip
    file, out = tmp_path / "grid.toml", tmp_path / "out"
    file.write_text("\n".join(lines))
    plan = read_plan(file)
    with short_rollouts():
        experiment.run_plan(Plan(plan.cells[:2], plan.rollout_seeds), out)
        before = {path.name: (path / "stamp.json").stat().st_mtime_ns for path in out.iterdir()}
        assert main(["experiment", str(file), "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "5 cells, 2 of them in" in said
    assert all((out / name / "stamp.json").stat().st_mtime_ns == time for name, time in before.items())

    rows = results.read_results(out)
    each, rows = rows[rows.method == "each"], rows[rows.method != "each"]
    assert set(rows.method) == {"start", "averaged", "pooled", "alone"} and len(rows) == 4 * 2 * 2
    assert len(each) == 2 * 2 and each.loss.notna().all()  # of every client its own rollouts
    pairs = rows.groupby("method")[["task", "seed"]].apply(lambda part: sorted(map(tuple, part.values)))
    assert all(pair == pairs.iloc[0] for pair in pairs)  # every method made the same rollouts
    steps = rows.groupby("method").gradient_steps.first()
    assert steps["start"] == 0 and steps["averaged"] == steps["pooled"] == steps["alone"] == 4
    models = {method: run_folder.read_stamp(out / f"mixed_{method}_0")["steps"] for method in steps.index}
    assert models == {
        "start": {"global": {"in_all": 0, "in_a_row": 0}}, "averaged": {"global": {"in_all": 4, "in_a_row": 2}},
        "pooled": {"global": {"in_all": 4, "in_a_row": 4}},
        "alone": {f"client_{k}": {"in_all": 2, "in_a_row": 2} for k in (0, 1)},
    }  # fmt: skip
    assert rows.counted.all() and (each.steps_in_all == 4).all()
    of_model = rows.groupby("method")[["steps_in_all", "steps_in_a_row"]].agg(["min", "max"])
    assert of_model.loc["alone"].tolist() == [2, 2, 2, 2] and of_model.loc["averaged"].tolist() == [4, 4, 2, 2]
    travelled = rows.groupby("method").bytes.first()
    assert travelled["averaged"] > 1e6 and travelled["pooled"] == travelled["start"] == 0
    assert rows.groupby("method").loss.first().nunique() == 4
    spent = printed_table(said, "gradient_steps")  # what is equal, and what is not, stands in the table at the end
    learned = ["averaged", "pooled", "alone"]
    assert spent.loc[learned, "gradient_steps"].tolist() == [steps["averaged"]] * 3
    assert spent.loc[learned, "samples"].tolist() == [steps["averaged"] * plan.cells[0].config.batch_size] * 3
    assert spent.MB["averaged"] == pytest.approx(travelled["averaged"] / 1e6, abs=1e-3) and spent.MB["pooled"] == 0
    assert (spent.loc[learned, "train_s"] > 0).all() and spent.loc["start", ["samples", "train_s"]].tolist() == [0, 0]
    stamp = run_folder.read_stamp(out / "mixed_averaged_0")
    assert stamp["status"] == "completed" and stamp["commit"] and stamp["code"] and stamp["wall_s"] > 0
    pooled = run_folder.read_stamp(out / "mixed_pooled_0")
    assert 0 < pooled["train_s"] < 0.95 * pooled["wall_s"]  # what measures a model is no part of its training
    alone = run_folder.read_metrics(out / "mixed_alone_0", "rollout")
    assert set(alone.client) == {0, 1} and len(alone) == 2 * 2  # the rollouts are dealt out over the clients
    with pytest.raises(ValueError, match="no results"):
        results.read_results(tmp_path / "nowhere")


@pytest.mark.integration
def test_a_cell_whose_clients_failed_is_stamped_with_the_steps_that_were_taken(recording, tmp_path, monkeypatch):
    """In round 1 client 0 fails, in round 2 client 1 is rejected: half of what the settings ask for is averaged."""
    monkeypatch.setattr(methods.inline, "run_inline", partial(inline.run_inline, clients_app=faulty.app))
    settings = {"tasks": "lift", "data": str(recording), "num_clients": 2, "num_server_rounds": 2, "local_steps": 3}
    config = from_profile("tiny", **QUIET, **settings)
    cell = Cell("averaged", "federated", "mixed", 0, config)
    experiment.measure_cell(cell, [2_000_000], tmp_path)
    stamp, asked = run_folder.read_stamp(tmp_path / cell.name), methods.total_steps(config)
    assert stamp["steps"] == {"global": {"in_all": asked // 2, "in_a_row": 6}} and asked == 12
    assert stamp["gradient_steps"] == asked // 2 and stamp["samples"] == asked // 2 * config.batch_size
    assert compare_runs.read_run(tmp_path / cell.name).gradient_steps == asked // 2
    rows = results.read_results(tmp_path)
    assert rows.counted.all() and set(rows.steps_in_all) == {asked // 2}


@pytest.mark.unit
@pytest.mark.parametrize("file", sorted({*REFERENCE.glob("*.toml")} - {REFERENCE / "notes.toml"}), ids=lambda f: f.stem)
def test_rollouts_start_where_no_demonstration_and_no_look_during_training_did(file):
    plan = read_plan(file)
    config = plan.cells[0].config
    episodes = range(config.episodes_per_task * len(task_names(config)))
    shown = {demonstration_seed(0, index, rollout) for index in episodes for rollout in range(MAX_ATTEMPTS)}
    during_training = range(FIRST_SEED, FIRST_SEED + CLIENT_SEEDS * (config.num_clients + 1))
    assert not set(plan.rollout_seeds) & (shown | set(during_training))


@pytest.fixture
def handed_out(monkeypatch):
    """The episodes behind each training batch that is drawn, whoever draws it."""
    episodes, rows_at = [], Batches.rows_at

    def noting(batches, step):
        rows = rows_at(batches, step)
        assert np.isin(rows, frame_rows(batches.store, batches.episode_ids)).all()
        episodes.append(sorted(batches.episode_ids))
        return rows

    monkeypatch.setattr(Batches, "rows_at", noting)
    return episodes


@pytest.mark.integration
@pytest.mark.parametrize("partition", ["task", "lab"])
def test_no_method_trains_on_a_held_out_episode_and_all_make_the_same_new_rollouts(partition, handed_out):
    """What training was handed, for each kind of method; the recording is the one of tests/test_labs.py."""
    settings = {"tasks": "lift,push", "num_labs": 3, "episodes_per_task": 6, "num_clients": 2, "num_server_rounds": 1}
    config = from_profile("tiny", **QUIET, **settings, partition=partition, videos=False)
    store, seeds = recordings.open_frames(config), [2_000_000, 2_000_001]
    held_out, shares = splits.held_out_episodes(store, config), splits.shares(store, config)
    own = sorted(sorted(share.train_ids) for share in shares)
    whole = sorted(store.episodes.episode_id[~store.episodes.episode_id.isin(held_out)])
    shown = {demonstration_seed(0, i, rollout) for i in range(len(store.episodes)) for rollout in range(MAX_ATTEMPTS)}
    for kind, expected in {"federated": own, "local-only": own, "centralized": [whole]}.items():
        handed_out.clear()
        with short_rollouts():
            found = experiment.MEASURES[kind](config, seeds)
        trained = sorted(map(list, set(map(tuple, handed_out))))
        assert trained == expected, kind
        assert not {episode for part in trained for episode in part} & set(held_out), kind
        assert sorted(row["episode_id"] for row in found.episodes) == sorted(held_out) and held_out, kind
        rollouts = sorted((row["task"], row["seed"]) for row in found.rows)
        assert rollouts == [(task, seed) for task in ("lift", "push") for seed in seeds], kind
        assert not {seed for _, seed in rollouts} & shown, kind


@pytest.mark.integration
def test_a_cell_is_a_run_that_can_be_compared_and_keeps_its_rounds(recording, tmp_path, capsys):
    lines = ["profile = 'tiny'", "seeds = [0]", "rollouts = 2", "[settings]", f"data = {json.dumps(str(recording))}",
             "tasks = 'lift,push'", "num_clients = 2", "[partitions.mixed]", "[methods.averaged]", "eval_every = 1",
             "eval_rollouts = 1", "[methods.pooled]", "kind = 'centralized'"]  # fmt: skip
    file, out = tmp_path / "grid.toml", tmp_path / "out"
    file.write_text("\n".join(lines))
    with short_rollouts():
        assert main(["experiment", str(file), "--out", str(out)]) == 0
    rounds = run_folder.read_metrics(out / "mixed_averaged_0", "evaluate")
    curve = tables.read_rounds(out)
    assert list(curve["round"]) == [0, 1, 2] and list(curve.n) == [2, 2, 4] and curve.steps.iloc[-1] == 8
    assert list(rounds["round"]) == [0, 1, 2] and rounds.success_rate[:2].notna().all() and rounds.loss.notna().all()
    cells = [str(out / name) for name in ("mixed_pooled_0", "mixed_averaged_0")]
    assert main(["compare", *cells, "--out", str(tmp_path / "compared")]) == 0
    assert "success_rate" in capsys.readouterr().out


@pytest.mark.integration
@pytest.mark.parametrize("choice", ["own", "held-out", "none"])
def test_a_wrong_choice_of_statistics_changes_the_model_or_how_it_acts(choice, recording):
    settings = {"tasks": "lift,push", "data": str(recording), "partition": "task", "num_clients": 2}
    right, wrong = from_profile("tiny", **settings), from_profile("tiny", **settings, normalisation=choice)
    trained, other = (methods.federated_policy(config) for config in (right, wrong))
    same = all((trained.shared_arrays()[name] == other.shared_arrays()[name]).all() for name in trained.shared_arrays())
    assert same == (choice == "held-out")  # the last leaves training as it is, and reads its result wrongly
    store = recordings.open_frames(right)
    ids = splits.held_out_episodes(store, right)
    left, right = (measure.measure(one, store, right, episode_ids=ids).averages for one in (trained, other))
    assert left != right


@pytest.mark.unit
def test_differences_use_the_seeds_that_both_methods_have_and_are_corrected_together():
    rng = np.random.default_rng(0)
    lines = [
        {"partition": partition, "method": method, "run": run, "task": "lift", "seed": seed,
         "loss": 0.1 * rate + 0.01 * run, "action_error": 10 * (1 - rate), "success": rng.random() < rate}
        for partition in ("iid", "task") for method, rate in (("pooled", 0.9), ("shared", 0.5)) for run in range(4)
        for seed in range(40) if not (method == "shared" and run == 3)
    ]  # fmt: skip
    found = tables.differences(pd.DataFrame(lines), [("shared", "pooled")], seed=0)
    assert list(found.partition) == ["iid", "task"] and list(found.seeds) == [3, 3] and list(found.n) == [120, 120]
    assert (found.high < 0).all() and (found.p_holm >= found.p_value).all()
    assert found.loss.tolist() == pytest.approx([-0.04, -0.04])
    assert (found.loss_low <= found.loss).all() and (found.loss <= found.loss_high).all()
    assert found.action_error.tolist() == found.action_error_high.tolist() == pytest.approx([4, 4])
    effect, rare = found.columns.get_loc("high"), found.columns.get_loc("p_value")
    assert effect < rare and list(found.columns[-3:]) == ["p_value", "mcnemar_p", "p_holm"]
