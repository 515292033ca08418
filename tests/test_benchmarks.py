"""The benchmarks run, and both sides of them compute the same thing; how fast they are is not tested."""

import json
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from fedvla_lib.config import from_profile
from fedvla_lib.policy import model

pytestmark = [pytest.mark.integration, pytest.mark.slow]
FOLDER = Path(__file__).resolve().parent.parent / "benchmarks"


@pytest.fixture
def run(warm_python, tmp_path) -> Callable[..., list[dict]]:
    """Call a benchmark, and return the rows that it wrote."""

    def call(name: str, *arguments: str) -> list[dict]:
        command = [warm_python, FOLDER / f"{name}.py", "--profile", "tiny", "--repeats", "1", "--out", tmp_path]
        done = subprocess.run([*command, *arguments], capture_output=True, text=True, timeout=600)
        assert done.returncode == 0, done.stderr[-2000:]
        return json.loads((tmp_path / f"{name}.json").read_text())["rows"]

    return call


def test_local_training_computes_what_lerobot_computes(run):
    for row in run("local_training", "--steps", "7", "--workers", "0", "1"):
        assert row["largest loss difference"] <= 1e-6
        assert row["ours [samples/s]"] > 0 < row["lerobot [samples/s]"]


@pytest.mark.parametrize("name", ["random_access", "control_steps"])
def test_a_ratio_is_reported(name, run):
    (row,) = run(name)
    assert row["ratio"] > 0


def test_the_floor_is_below_what_is_measured(run):
    kept, theirs, whole = run("floor")
    assert 0 < kept["operations [G]"] <= theirs["operations [G]"] < whole["operations [G]"]
    assert all(row["times the floor"] > 1 for row in (kept, theirs, whole))


def test_ours_is_measured_without_the_peers(run):
    (row,) = run("peers", "--peers")
    assert row["simulator"] == "this library" and row["ours is faster by"] == 1


def test_the_base_is_trained_and_acts(run):
    (row,) = run("fine_tuning", "--tasks", "lift", "--demonstrations", "2", "--steps", "2", "--rollouts", "1")
    assert row["demonstrations"] == 2 and row["rollouts"] == 1 and row["training [s]"] > 0


def test_secure_aggregation_is_measured_beside_the_clear(run):
    few, more = run("secure_aggregation", "--clients", "3", "5")
    assert few["masked [s]"] > few["in the clear [s]"] > 0 and few["added bytes of a client [kB]"] > 1
    assert more["clients"] == 5 and more["added bytes of a client [kB]"] > few["added bytes of a client [kB]"]


def test_bad_input_is_one_line_that_names_it(tmp_path, warm_python):
    command = [warm_python, FOLDER / "fine_tuning.py", "--tasks", "juggle", "--out", tmp_path]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode and "juggle" in done.stderr and "lift" in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1 and not list(tmp_path.iterdir())


def test_operations_are_those_that_are_stored(run):
    """They do not depend on the machine; the page on costs reads the stored ones."""
    assert run("operations") == json.loads((FOLDER / "results" / "operations.json").read_text())["rows"]


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a card to measure")
def test_without_a_card_nothing_is_measured_and_nothing_fails(tmp_path, warm_python):
    command = [warm_python, FOLDER / "gpu.py", "--out", tmp_path]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0 and done.stdout.startswith("no card") and not list(tmp_path.iterdir())


def test_a_federation_is_measured_against_its_clients(run, warm_python):
    (row,) = run("federation", "--clients", "2", "--rounds", "1", "--python", warm_python)
    assert row["wall time [s]"] >= row["clients' training and evaluation [s]"] > 0
    assert row["peak memory [MB]"] > 0


def test_a_long_run_is_measured_early_and_late(run):
    (row,) = run("soak", "--rounds", "8", "--clients", "3")
    assert row["away"] == 8 and row["clients away"] > 1  # one in each round, not always the same
    assert row["memory [MB] ratio"] < 1.5 and row["open files ratio"] < 1.5
    assert row["run folder [MB] ratio"] < 1.7  # of eight models three are kept


def test_an_attack_is_tried_with_the_limits_and_without(run):
    nobody, refused, long = run("attacks", "--only", "writes rows as the server's", "sends its update a thousand times")
    assert (
        nobody["as it is"] == "survived"
        and refused["as it is"] == "refused"
        and refused["named"] == "rollouts"
        and refused["median"] is None
    )
    assert (long["as it is"], long["without limits"], long["median"]) == ("survived", "lost", "survived")


def test_rounds_are_timed_for_each_number_of_clients(run):
    (before,) = run("scale", "--clients", "2", "--engines", "inline")
    rows = run("scale", "--clients", "13", "--engines", "inline")
    assert [row["clients"] for row in rows] == [2, 13]  # more than the recording has episodes
    assert rows[0] == before  # measured once, and kept
    assert all(row["later rounds [s]"] > 0 and row["peak memory [MB]"] > 100 for row in rows)
    few, many = (row["later, per client [ms]"] for row in rows)
    assert [row["against fewer clients"] for row in rows] == [None, pytest.approx(many / few)]


def test_rollouts_use_the_same_seeds_as_lerobot_eval(tmp_path, run, warm_python):
    model.save_policy(model.load_policy(from_profile("tiny")), tmp_path / "policy")
    arguments = ["--policy", str(tmp_path / "policy"), "--rollouts", "2", "--batch", "2"]
    for row in run("rollouts", *arguments, "--python", warm_python):
        assert row["rollouts"] == 2 and row["seeds that agree"] == 2
