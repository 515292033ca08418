"""Stored results: complete, stamped, of today's code or with a note; and no result typed into prose by hand."""

import json
import re
import tomllib
from dataclasses import asdict
from pathlib import Path

import pytest

from fedvla_book.tables import results
from fedvla_lib import run_folder
from fedvla_lib.config import Config
from fedvla_lib.experiments import methods
from fedvla_lib.experiments.experiment_file import read_plan

pytestmark = pytest.mark.unit
ROOT = Path(__file__).parents[1]
REFERENCE = ROOT / "book" / "reference"
REPLAYED = "replay"  # tiny cells that tests/test_replay.py makes again, so that they are of today's code
CELLS = sorted(stamp.parent for stamp in REFERENCE.glob("*/*/stamp.json") if stamp.parts[-3] != REPLAYED)
# Not results: the customary confidence, level and power, and the differences that examples set out to find.
CUSTOMARY = {"95 %", "80 %", "5 %", "10 points"}
RESULT = re.compile(r"\d[\d.,]*\s?(?:%|percent\b|points\b)")


def stale(stamp, notes, code):
    """Whether a stamp tells of other code than `code` and no note says why its result still holds."""
    return stamp["code"] != code and not notes.get(stamp["code"], "").strip()


def typed_results(text):
    """Return what looks like a measured rate in prose, outside code, formulas and HTML."""
    for no_prose in (r"```.*?```", r"~~~.*?~~~", r"`[^`]*`", r"\$[^$]*\$", r"<[^>]*>", r"^:\w+:.*$"):
        text = re.sub(no_prose, "", text, flags=re.DOTALL | re.MULTILINE)
    return [found for found in RESULT.findall(text) if found not in CUSTOMARY]


def prose():
    """Yield (where, text) of every page and every markdown cell."""
    for page in [ROOT / "README.md", *sorted((ROOT / "book").glob("*.md"))]:
        yield page.name, page.read_text()
    for notebook in sorted((ROOT / "notebooks").glob("*.ipynb")):
        for cell in json.loads(notebook.read_text())["cells"]:
            if cell["cell_type"] == "markdown":
                yield f"{notebook.name} {cell['id']}", "".join(cell["source"])


def test_each_stored_cell_is_complete_and_stamped():
    assert CELLS
    for cell in CELLS:
        stamp = run_folder.read_stamp(cell)
        assert stamp["status"] == "completed" and stamp["commit"] and stamp["config_hash"], cell
        assert len(run_folder.read_metrics(cell, "rollout")) and len(run_folder.read_metrics(cell, "evaluate")), cell
        # Less is what it takes to find a trained model in the cache.
        assert stamp["kind"] == "base" or stamp["train_s"] is None or stamp["train_s"] > 1, cell


def test_each_stored_cell_is_one_that_its_file_asks_for():
    for file in sorted(REFERENCE.glob("*.toml")):
        if file.name != "notes.toml":
            asked = {cell.name for cell in read_plan(file).cells}
            stored = {cell.name for cell in CELLS if cell.parent.name == file.stem}
            assert stored <= asked, f"{file.name}: {sorted(stored - asked)}"


def acting(settings):
    """The settings, without one whose default changed and that acts in one strategy alone."""
    return {k: v for k, v in settings.items() if k != "server_momentum" or settings["strategy"] == "fedavgm"}


def test_each_stored_cell_was_run_with_the_settings_that_its_file_plans():
    """Settings that came after a cell was run have no place in its file; the plan has to leave them at the default."""
    default = asdict(Config())
    for file in sorted(REFERENCE.glob("*.toml")):
        if file.name == "notes.toml":
            continue
        plan = read_plan(file)
        planned = {cell.name: cell for cell in plan.cells}
        for folder in (cell for cell in CELLS if cell.parent.name == file.stem):
            cell, stamp = planned[folder.name], run_folder.read_stamp(folder)
            stored, asked = json.loads((folder / "config.json").read_text()), asdict(cell.config)
            assert acting(stored) == acting({name: asked[name] for name in stored}), folder
            assert all(asked[name] == default[name] for name in asked.keys() - stored.keys()), folder
            assert [stamp[key] for key in ("method", "kind", "partition", "seed")] == [
                cell.method, cell.kind, cell.partition, cell.seed,
            ], folder  # fmt: skip
            rollouts = run_folder.read_metrics(folder, "rollout")
            last = rollouts[rollouts["round"] == rollouts["round"].max()]
            if cell.kind != "clients":  # each of those has seeds of its own
                assert set(last.seed) == set(plan.rollout_seeds), folder


@pytest.mark.parametrize("name", ["strategies", "communication", "multitask"])
def test_cells_of_a_grid_spend_equal_steps_and_have_three_seeds_and_fifty_rollouts_at_each_task(name):
    rows = results.read_results(REFERENCE / name)
    assert rows.gradient_steps.nunique() == 1
    assert (rows.groupby(["partition", "method"]).run.nunique() >= 3).all()
    runs = rows.groupby(["partition", "method", "run"])
    assert (runs.task.nunique() == rows.task.nunique()).all()
    assert (rows.groupby([*runs.keys, "task"]).seed.nunique() >= 50).all()


def test_results_of_other_code_carry_a_note():
    notes, code = tomllib.loads((REFERENCE / "notes.toml").read_text())["code"], methods.trained_by()
    stamps = [run_folder.read_stamp(cell) for cell in CELLS]
    found = {stamp["code"] for stamp in stamps if stale(stamp, notes, code)}
    assert not found, f"results of code {sorted(found)}, today's is {code}: run them again or add a note"


def test_a_stale_stamp_without_a_note_is_found():
    assert stale({"code": "old"}, {}, "new") and stale({"code": "old"}, {"old": " "}, "new")
    assert not stale({"code": "old"}, {"old": "same arithmetic"}, "new") and not stale({"code": "new"}, {}, "new")


def test_no_result_is_typed_into_prose():
    found = [f"{where}: {typed}" for where, text in prose() for typed in typed_results(text)]
    assert not found, found


@pytest.mark.parametrize("text", ["FedAvg reaches 83 % here.", "It is 12.5 points ahead", "three in four: 75%"])
def test_a_typed_result_is_found(text):
    assert typed_results(f"Before. {text} After `5 %` and $p = 90\\%$.")


def test_customary_numbers_and_code_are_no_results():
    assert not typed_results("A 95 % interval; `x = 83 %`; $83\\%$; <img width='50%'>\n:width: 100%\n```\n12 %\n```")
