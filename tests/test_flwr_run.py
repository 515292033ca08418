"""`flwr run` for real: a SuperLink, Flower's simulation runtime with its Ray workers, and this app."""

import contextlib
import os
import re
import shutil
import subprocess
import sys
import tomllib
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from zipfile import ZipFile

import numpy as np
import pytest
from flwr.app import RecordDict
from flwr.cli.build import build_fab_from_disk
from flwr.cli.config_utils import load_and_validate
from safetensors.numpy import load_file

from conftest import assert_faults_were_survived
from fedvla_lib import run_folder
from fedvla_lib.cli.main import main
from fedvla_lib.config import from_profile, from_run_config
from fedvla_lib.engines import app_bundle, simulation, superlink
from fedvla_lib.engines.inline import run_inline
from fedvla_lib.federation import client_app

pytestmark = [pytest.mark.integration, pytest.mark.slow]
PYPROJECT = Path(__file__).parents[1] / "pyproject.toml"


@pytest.fixture
def tiny(recording, tmp_path):
    return from_profile(
        "tiny",
        base="nano",
        data=str(recording),
        num_server_rounds=1,
        local_steps=1,
        eval_rollouts=0,
        client_rollouts=1,
        num_threads=1,
        out=str(tmp_path / "outputs"),
    )


@pytest.fixture(scope="module", autouse=True)
def shared_link(tmp_path_factory):
    """All simulations of this file run on one SuperLink, instead of one each."""
    with (
        superlink.local_superlink(tmp_path_factory.mktemp("link"), "--simulation") as link,
        pytest.MonkeyPatch.context() as patch,
    ):
        patch.setattr(simulation, "local_superlink", lambda *_: contextlib.nullcontext(link))
        yield


def forget(message, context, call_next):
    """A mod for a client that keeps no state between messages."""
    context.state = RecordDict()
    return call_next(message, context)


def test_the_simulation_runtime_gives_the_model_of_the_inline_engine(tiny):
    """Two rounds with all that a client keeps between rounds: control variate, optimiser state, rounding error."""
    tiny = replace(tiny, num_server_rounds=2, strategy="scaffold", keep_optimizer=True, exchange="int8")
    before = PYPROJECT.read_bytes()
    root = simulation.run_simulation(tiny, timeout_s=540)
    stamp = run_folder.read_stamp(root)
    assert (stamp["status"], stamp["engine"]) == ("completed", "flower")
    assert run_folder.read_config(root) == tiny
    assert set(run_folder.read_metrics(root, "train").who) == {"client_0", "client_1", "client_2"}
    assert run_folder.read_metrics(root, "rejected").empty
    assert (root / "global_model/round_1/model.safetensors").is_file()
    videos = run_folder.read_metrics(root, "rollout").set_index("who").video
    assert sorted(videos.index) == ["client_0", "client_1", "client_2"]
    assert all((root / video).stat().st_size > 1000 for video in videos)
    assert PYPROJECT.read_bytes() == before
    inline, forgetful = (
        run_inline(replace(tiny, client_rollouts=0), clients_app=app, progress=False, raise_errors=True)
        for app in (None, client_app.build(mods=dict.fromkeys(client_app.HANDLERS, [forget])))
    )
    left, right, other = (
        load_file(one / "global_model/round_2/model.safetensors") for one in (root, inline, forgetful)
    )
    assert left.keys() == right.keys()
    assert max(np.abs(left[name] - right[name]).max() for name in left) <= 1e-6
    assert max(np.abs(left[name] - other[name]).max() for name in left) > 1e-4  # what workers without state would give
    ledgers = [run_folder.read_metrics(one, "replies").query("to == 'train'") for one in (root, inline)]
    columns = ["round", "good", "sent_bytes", "received_bytes"]
    np.testing.assert_allclose(*(ledger[columns].astype(float) for ledger in ledgers), rtol=1e-4)


def test_a_client_that_raises_and_one_that_sends_nan_are_left_out_by_the_simulation_too(tiny, faulty):
    config = replace(tiny, num_server_rounds=2, client_rollouts=0, fraction_evaluate=0.0)
    assert_faults_were_survived(simulation.run_simulation(config, timeout_s=540), config)


def test_a_run_that_fails_is_status_2_and_a_line_with_flowers_reason(tiny, capsys):
    flags = ["--profile", "tiny", "--data", "nowhere/at/all", "--out", tiny.out]
    assert main(["run", "--engine", "simulation", *flags]) == 2
    said = capsys.readouterr().err
    assert re.search("finished:failed.*no data set at", said) and said.count("\n") == 1


@pytest.mark.unit
def test_the_staged_app_holds_the_library_and_the_settings_of_the_run(tiny, tmp_path):
    app = app_bundle.stage_app(tmp_path / "stage", tiny)
    assert (app / "fedvla_lib/federation/server_app.py").is_file()
    assert not list(app.rglob("__pycache__"))
    project = tomllib.loads((app / "pyproject.toml").read_text())
    assert from_run_config(project["tool"]["flwr"]["app"]["config"]) == tiny


@pytest.mark.unit
def test_an_installed_library_stages_the_same_app_without_a_checkout(tmp_path):
    """As from a wheel: only the folder of the package; a stranger's project file beside it is not taken."""
    package = PYPROJECT.parent / "fedvla_lib"
    alone = shutil.copytree(package, tmp_path / "site/fedvla_lib", ignore=shutil.ignore_patterns("__pycache__"))
    (alone.parent / "pyproject.toml").write_text('[project]\nname = "another"\n')
    code = "import pathlib, sys; from fedvla_lib import config; from fedvla_lib.engines import app_bundle\n"
    code += "print(app_bundle.stage_app(pathlib.Path(sys.argv[1]), config.Config()))"
    environment = {**os.environ, "PYTHONPATH": str(alone.parent)}
    command = [sys.executable, "-c", code, str(tmp_path / "stage")]
    said = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True).stdout
    app = Path(said.strip())
    project, warnings = load_and_validate(app / "pyproject.toml")
    ours = tomllib.loads(PYPROJECT.read_text())["tool"]["flwr"]["app"]
    assert {**project["tool"]["flwr"]["app"], "fab-include": 0} == {**ours, "fab-include": 0} and not warnings
    with ZipFile(BytesIO(build_fab_from_disk(app))) as bundle:
        wanted = {f"fedvla_lib/{path.relative_to(package)}" for path in package.rglob("*.py")}
        assert wanted <= set(bundle.namelist())
