"""Tiny stored cells, one for each kind of method, come out the same when they are made again."""

import math
from pathlib import Path

import pytest

from fedvla_lib import run_folder
from fedvla_lib.experiments import experiment
from fedvla_lib.experiments.experiment_file import KINDS, read_plan

pytestmark = pytest.mark.integration
REFERENCE = Path(__file__).parents[1] / "book" / "reference"
PLAN = read_plan(REFERENCE / "replay.toml")
FLEETING = {"seconds", "video"}  # of an event: what differs from run to run
ROUNDING = 1e-3  # relative: other processors sum in another order, and a training carries that on


@pytest.fixture(scope="module")
def grid(tmp_path_factory):
    out = tmp_path_factory.mktemp("replay")
    experiment.run_plan(PLAN, out, say=lambda _: None)
    return out


def events(cell: Path) -> list[tuple]:
    """What a cell's events say, in order: round, who, kind, and values by name."""
    found = run_folder.read_events(cell)
    return [
        (event["round"], event["who"], event["kind"], {k: v for k, v in event["values"].items() if k not in FLEETING})
        for event in found
    ]


def differences(left: dict, right: dict) -> list[str]:
    """Names of values that are not the same: numbers up to rounding, all else exactly."""
    odd = sorted(left.keys() ^ right.keys())
    for name in left.keys() & right.keys():
        one, other = left[name], right[name]
        both_floats = isinstance(one, float) and isinstance(other, float)
        if not (math.isclose(one, other, rel_tol=ROUNDING, abs_tol=1e-6) if both_floats else one == other):
            odd.append(f"{name}: {one} and {other}")
    return odd


def test_there_is_a_cell_for_each_kind():
    assert {cell.kind for cell in PLAN.cells} == set(KINDS)


def test_the_stored_cells_are_those_of_the_plan():
    stored = {folder.name for folder in (REFERENCE / "replay").iterdir() if folder.is_dir()}
    assert stored == {cell.name for cell in PLAN.cells}


@pytest.mark.parametrize("cell", PLAN.cells, ids=lambda cell: cell.method)
def test_a_stored_cell_comes_out_the_same(grid, cell):
    stored, again = events(REFERENCE / "replay" / cell.name), events(grid / cell.name)
    assert [event[:3] for event in again] == [event[:3] for event in stored]
    odd = [(old[:3], found) for old, new in zip(stored, again, strict=True) if (found := differences(old[3], new[3]))]
    assert not odd
    stamps = [run_folder.read_stamp(folder / cell.name) for folder in (REFERENCE / "replay", grid)]
    assert stamps[0]["steps"] == stamps[1]["steps"] and stamps[0]["bytes"] == stamps[1]["bytes"]


def test_a_number_that_differs_is_found():
    assert differences({"loss": 1.0, "success": True}, {"loss": 1.01, "success": True}) == ["loss: 1.0 and 1.01"]
    assert differences({"success": True}, {"success": False}) and differences({"a": 1}, {})
    assert not differences({"loss": 1.0}, {"loss": 1.0000001})
