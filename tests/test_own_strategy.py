"""The page on adding a strategy: its code runs, in a copy of the library, as a reader would follow it."""

import json
import os
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from fedvla_lib import run_folder
from fedvla_lib.config import from_profile
from fedvla_lib.engines import inline

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "book" / "own_strategy.md").read_text()


def blocks(language):
    return re.findall(rf"^```{language}\n(.*?)^```", PAGE, flags=re.DOTALL | re.MULTILINE)


def follow(root):
    """Do what the page says to the library under `root`: the new file, then the lines of its diff."""
    (root / "fedvla_lib" / "federation" / "strategies" / "clipped_mean.py").write_text(blocks("python")[0])
    (diff,) = blocks("diff")
    for name, changes in re.findall(r"^\+\+\+ b/(\S+)\n(.*?)(?=^---|\Z)", diff, flags=re.DOTALL | re.MULTILINE):
        text = (root / name).read_text()
        for change in changes.split("@@\n")[1:]:
            old, new = (
                "".join(line[1:] for line in change.splitlines(keepends=True) if line[0] == sign) for sign in "-+"
            )
            assert text.count(old) == 1, f"{name} has no line {old!r}"
            text = text.replace(old, new)
        (root / name).write_text(text)


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    root = tmp_path_factory.mktemp("library")
    shutil.copytree(ROOT / "fedvla_lib", root / "fedvla_lib", ignore=shutil.ignore_patterns("__pycache__"))
    follow(root)
    return root


# In one process: PyTorch, LeRobot and the copy of the library are loaded once.
STEPS = """
import json, sys
from fedvla_lib.cli.main import main
for code in json.loads(sys.argv[1]):
    try:
        exec(code, {})
    except AssertionError:
        print("the oracle failed")
    else:
        print("the oracle held")
for command in json.loads(sys.argv[2]):
    if status := main(command):
        sys.exit(status)
"""


@pytest.mark.integration
def test_the_oracle_test_of_the_page_holds_and_its_run_and_experiment_give_a_row_each(library, recording, tmp_path):
    strategy, oracle = blocks("python")[:2]
    lazy = strategy.replace("np.minimum(1.0, limit / np.maximum(norms, 1e-12))", "np.ones(len(norms))")
    assert lazy != strategy
    plan, data = blocks("toml")[0], f"data = {json.dumps(str(recording))}"
    once = plan.replace("seeds = [0, 1]", "seeds = [0]").replace("[settings]", f"[settings]\n{data}")
    assert len(once) > len(plan)
    (tmp_path / "clipped.toml").write_text(once)
    run = ["run", "--profile", "tiny", "--strategy", "clipped-mean", "--data", str(recording)]
    grid = ["experiment", str(tmp_path / "clipped.toml"), "--out", str(tmp_path / "clipped"), "--jobs", "1"]
    codes, commands = [strategy + oracle, lazy + oracle], [[*run, "--out", str(tmp_path / "runs")], grid]
    told = subprocess.run(
        [sys.executable, "-c", STEPS, json.dumps(codes), json.dumps(commands)], cwd=library,
        env={**os.environ, "PYTHONPATH": str(library)}, check=True, capture_output=True, text=True,
    ).stdout  # fmt: skip
    assert told.startswith("the oracle held\nthe oracle failed\n")
    (run,) = (tmp_path / "runs").iterdir()
    assert run_folder.read_stamp(run)["status"] == "completed"
    assert {"fedavg", "clipped-mean"} <= set(told.split())


@pytest.mark.integration
def test_the_classes_and_mods_of_the_page_work_without_editing_the_library(recording, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").write_text(blocks("python")[2])
    space = {}
    for block in (blocks("python")[1].split("start = np.array")[0], blocks("python")[3]):
        exec(compile(block, "own_strategy.md", "exec"), space)
    config = from_profile(
        "tiny", base="nano", data=str(recording), out=str(tmp_path / "runs"), num_server_rounds=1, local_steps=1,
        eval_rollouts=0, client_rollouts=0,
    )  # fmt: skip
    for strategy, app in (("mine:Trimmed", "watched"), ("mine:Private", "rounding")):
        run = inline.run_inline(replace(config, strategy=strategy), clients_app=space[app], progress=False)
        assert run_folder.read_metrics(run, "rejected").empty
        assert len(run_folder.read_metrics(run, "evaluate").query("round == 1")) == 4  # clients, and the server
