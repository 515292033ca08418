"""A grid from a file: what is in it, what is kept, and what a cell knows of itself."""

import json
import tomllib

import pytest

from fedvla_lib import arms, experiment
from fedvla_lib.cli import main

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

[arms.averaged]

[arms.pooled]
kind = "centralized"

[[only]]
partition = "mixed"

[[only]]
arm = "averaged"
seed = 0
"""


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "grid.toml"
    path.write_text(GRID)
    return path


@pytest.mark.unit
def test_cells_come_seed_by_seed_and_only_those_wanted(file):
    plan = experiment.read_plan(file)
    assert [cell.name for cell in plan.cells] == [
        "mixed_averaged_0", "mixed_pooled_0", "by_task_averaged_0", "mixed_averaged_1", "mixed_pooled_1",
    ]  # fmt: skip
    assert plan.rollout_seeds == [2_000_000, 2_000_001]
    assert all(cell.config.seed == cell.seed and cell.config.tasks == "lift" for cell in plan.cells)
    assert len({arms.total_steps(cell.config) for cell in plan.cells}) == 1


@pytest.mark.unit
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("[arms.pooled]", "[arms.pooled"), "line"),
        (("rollouts = 2", ""), "lacks 'rollouts'"),
        (("rollouts = 2", "rollouts = 2\nattempts = 3"), "'attempts'"),
        (('kind = "centralized"', 'kind = "central"'), "'central'.*local-only"),
        (("num_clients = 2", "clients = 2"), "'clients'"),
        (("seeds = [0, 1]", "seeds = 3"), "seeds=3.*list of whole numbers"),
        (("rollouts = 2", "rollouts = 'two'"), "rollouts='two'.*above 0"),
        (('arm = "averaged"', 'strategy = "averaged"'), "'strategy' under.*arm"),
        (("[arms.pooled]", "[arms.'../pooled']"), "'../pooled'"),
    ],
)
def test_a_file_that_cannot_be_used_is_named_with_the_remedy(file, change, message, capsys):
    file.write_text(GRID.replace(*change))
    assert main(["experiment", str(file), "--out", str(file.parent / "out")]) == 2
    said = capsys.readouterr().err
    assert len(said.splitlines()) == 1
    with pytest.raises(ValueError, match=message):
        experiment.read_plan(file)
    assert not (file.parent / "out").exists()


@pytest.mark.integration
def test_finished_cells_are_kept_and_say_what_they_cost(recording, tmp_path, capsys):
    grid = tomllib.loads(GRID)
    settings = {**grid["settings"], "tasks": "lift,push", "data": str(recording)}
    lines = ["profile = 'tiny'", "seeds = [0]", "rollouts = 2", "[settings]"]
    lines += [f"{key} = {json.dumps(value)}" for key, value in settings.items()]
    lines += ["[partitions.mixed]", "[arms.start]", "kind = 'base'", "[arms.averaged]", "[arms.pooled]",
              "kind = 'centralized'", "[arms.alone]", "kind = 'local-only'", "[arms.each]", "kind = 'clients'",
              "personal = 'projections'"]  # fmt: skip
    file, out = tmp_path / "grid.toml", tmp_path / "out"
    file.write_text("\n".join(lines))
    plan = experiment.read_plan(file)
    experiment.run_plan(experiment.Plan(plan.cells[:2], plan.rollout_seeds), out)
    before = {path.name: path.stat().st_mtime_ns for path in out.iterdir()}
    assert main(["experiment", str(file), "--out", str(out)]) == 0
    assert "5 cells, 2 of them in" in capsys.readouterr().out
    assert all((out / name).stat().st_mtime_ns == time for name, time in before.items())

    rows = experiment.read_results(out)
    each, rows = rows[rows.arm == "each"], rows[rows.arm != "each"]
    assert set(rows.arm) == {"start", "averaged", "pooled", "alone"} and len(rows) == 4 * 2 * 2
    assert len(each) == 2 * 2 and each.loss.notna().all()  # of every client its own attempts
    pairs = rows.groupby("arm")[["task", "seed"]].apply(lambda part: sorted(map(tuple, part.values)))
    assert all(pair == pairs.iloc[0] for pair in pairs)  # every arm made the same attempts
    steps = rows.groupby("arm").gradient_steps.first()
    assert steps["start"] == 0 and steps["averaged"] == steps["pooled"] == 2 * steps["alone"]
    travelled = rows.groupby("arm").bytes.first()
    assert travelled["averaged"] > 1e6 and travelled["pooled"] == travelled["start"] == 0
    assert rows.groupby("arm").loss.first().nunique() == 4
    cell = json.loads((out / "mixed_averaged_0.json").read_text())
    assert cell["stamp"]["status"] == "completed" and cell["stamp"]["commit"]
    with pytest.raises(ValueError, match="no results"):
        experiment.read_results(tmp_path / "nowhere")
