"""The SuperLink that stays up: started, found, used by Flower's own command, and stopped with all it started."""

import os
import subprocess
from pathlib import Path

import pytest

from fedvla_lib import run_folder, superlink
from fedvla_lib.cli import main
from fedvla_lib.config import from_profile

ROOT = Path(__file__).parents[1]


@pytest.mark.integration
@pytest.mark.slow
def test_the_readmes_commands_run_a_federation(recording, tmp_path, monkeypatch, capsys):
    """As a reader types them: up, `flwr run . local-simulation --stream --run-config ...`, down."""
    monkeypatch.setenv("FLWR_HOME", str(tmp_path / "flwr"))
    before = (ROOT / "pyproject.toml").read_bytes()
    tiny = from_profile(
        "tiny", base="nano", data=str(recording), num_server_rounds=1, local_steps=1, eval_rollouts=0,
        client_rollouts=0, num_threads=1, out=str(tmp_path / "outputs"),
    )  # fmt: skip
    assert main(["superlink", "status"]) == 3
    try:
        assert main(["superlink", "up"]) == 0
        assert main(["superlink", "up"]) == 0 and "is up already" in capsys.readouterr().out
        settings = superlink.write_settings(tmp_path, tiny)
        command = [superlink.program("flwr"), "run", str(ROOT), "local-simulation", "--stream"]
        command += ["--run-config", str(settings)]
        command += ["--federation-config", "num-supernodes=3 client-resources-num-cpus=1"]
        environment = superlink.flower_environment(tmp_path / "flwr")
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=540)
        assert done.returncode == 0, done.stdout + done.stderr
        (root,) = superlink.run_folders(tiny)
        assert run_folder.read_stamp(root)["status"] == "completed"
    finally:
        assert main(["superlink", "down"]) == 0
    assert main(["superlink", "status"]) == 3
    assert (ROOT / "pyproject.toml").read_bytes() == before


@pytest.mark.unit
def test_a_shell_without_a_place_of_its_own_is_told_what_to_do(monkeypatch, capsys):
    monkeypatch.delenv("FLWR_HOME", raising=False)
    assert main(["superlink", "up"]) == 2
    said = capsys.readouterr().err
    assert ". flower/env.sh" in said and len(said.splitlines()) == 1


@pytest.mark.unit
def test_the_shells_settings_find_this_projects_programs():
    command = ". flower/env.sh && command -v fedvla flwr && echo $FLWR_HOME"
    clean = {key: value for key, value in os.environ.items() if not key.startswith(("FLWR_", "FEDVLA_"))}
    said = subprocess.run(["sh", "-c", command], cwd=ROOT, env=clean, capture_output=True, text=True).stdout.split()
    assert said[-1] == str(ROOT / ".cache/flwr")
    assert not (ROOT / ".venv").exists() or str(ROOT / ".venv/bin/fedvla") in said
