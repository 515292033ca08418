"""The SuperLink service: started, found, used by `flwr run`, and stopped with its child processes."""

import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
import tomllib
from dataclasses import replace
from pathlib import Path

import psutil
import pytest
import torch

from conftest import heed_interrupts, wait_for_interrupted
from fedvla_lib import run_folder
from fedvla_lib.cli.main import main
from fedvla_lib.config import from_profile, to_run_config
from fedvla_lib.engines import processes, superlink, superlink_service
from fedvla_lib.federation import client_app

ROOT = Path(__file__).parents[1]


@pytest.mark.integration
@pytest.mark.slow
def test_the_readmes_commands_run_a_federation(recording, tmp_path, monkeypatch, capsys):
    """As a reader types them: up, interrupted; up again, `flwr run . local-simulation --stream ...`; last; down."""
    home = tmp_path / "flwr"
    monkeypatch.setenv("FLWR_HOME", str(home))
    before = (ROOT / "pyproject.toml").read_bytes()
    tiny = from_profile(
        "tiny", base="nano", data=str(recording), num_server_rounds=1, fraction_train=0.5, local_steps=1,
        eval_rollouts=0, client_rollouts=0, num_threads=1, out=str(tmp_path / "outputs"),
    )  # fmt: skip
    assert main(["superlink", "status"]) == 3
    for sign in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        interrupt_while_starting(home, sign)
        assert main(["superlink", "status"]) == 3 and not processes_of(home)
    try:
        assert main(["superlink", "up"]) == 0
        assert main(["superlink", "up"]) == 0 and "is already up" in capsys.readouterr().out
        assert main(["superlink", "last"]) == 2 and "has had no runs yet" in capsys.readouterr().err
        run_app("local-simulation", tiny, "--federation-config", "num-supernodes=3 client-resources-num-cpus=1")
        (root,) = run_folder.run_folders(tiny)
        assert run_folder.read_stamp(root)["status"] == "completed"
        assert run_folder.read_config(root) == tiny
        assert len(run_folder.read_metrics(root, "train")) == 2  # half of three clients
        assert main(["superlink", "last"]) == 0 and "is finished:completed" in capsys.readouterr().out
        if torch.cuda.is_available():
            run_app("local-simulation", replace(tiny, data="nowhere/at/all"))
        else:
            assert "ActorPool is empty" in run_app("local-simulation-gpu", tiny)
            wait_for_interrupted(max(run_folder.run_folders(tiny)))
        assert main(["superlink", "last"]) == 2 and "is finished:failed" in capsys.readouterr().out
    finally:
        assert main(["superlink", "down"]) == 0
    assert main(["superlink", "status"]) == 3 and main(["superlink", "last"]) == 2
    assert (ROOT / "pyproject.toml").read_bytes() == before


def run_app(connection, config, *options):
    """Call `flwr run` as in the README, with changed settings on the command line, and return its output.

    It exits with 0 whether or not the run completed.
    """
    usual = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["flwr"]["app"]["config"]
    told = {name: value for name, value in to_run_config(config).items() if value != usual[name]}
    words = " ".join(f"{name}={json.dumps(value)}" for name, value in told.items())
    command = ["flwr", "run", str(ROOT), connection, "--stream", "--run-config", words, *options]
    environment = superlink.flower_environment(Path(os.environ["FLWR_HOME"]))
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=540)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def interrupt_while_starting(home, sign):
    """Start `fedvla superlink up` and interrupt it before it is up, as Ctrl-C, `kill` or a closed terminal does."""
    command = [sys.executable, "-m", "fedvla_lib.cli", "superlink", "up"]
    options = {"stderr": subprocess.PIPE, "text": True, "start_new_session": True, "preexec_fn": heed_interrupts}
    process = subprocess.Popen(command, **options)
    log = home / "superlink.log"
    log.unlink(missing_ok=True)
    while not (log.exists() and log.stat().st_size):  # Flower has started
        assert process.poll() is None, process.stderr.read()
        time.sleep(0.05)
    os.killpg(process.pid, sign)
    said = process.communicate(timeout=60)[1]
    assert process.returncode == 130 and said.strip() == "interrupted: nothing was started", said


def processes_of(home):
    """Return the processes with this FLWR_HOME that still run after 15 s."""
    found = []
    for process in psutil.process_iter():
        try:
            if process.environ().get("FLWR_HOME") == str(home) and process.pid != os.getpid():
                found.append(process)
        except psutil.Error:
            continue
    return psutil.wait_procs(found, timeout=15)[1]


@pytest.mark.unit
def test_connections_of_ones_own_stay_and_one_in_the_way_is_named(tmp_path):
    file, ours = tmp_path / "config.toml", tomllib.loads(superlink_service.CONNECTIONS.read_text())["superlink"]
    own = '# mine\n[superlink]\ndefault = "labs"\n\n[superlink.labs]\naddress = "server.example.org:9493"\n'
    file.write_text(own)
    superlink_service.add_connections(file)
    assert file.read_text().startswith(own)
    merged = tomllib.loads(file.read_text())["superlink"]
    assert merged == {**ours, "default": "labs", "labs": {"address": "server.example.org:9493"}}
    once = file.read_text()
    superlink_service.add_connections(file)
    assert file.read_text() == once
    other = own.replace("labs]", "local-simulation]")
    for text, words in (
        (other, "has a different \\[superlink.local-simulation\\]"),
        ("default = ", "is not valid TOML"),
    ):
        file.write_text(text)
        with pytest.raises(ValueError, match=words):
            superlink_service.add_connections(file)
        assert file.read_text() == text
    file.unlink()
    superlink_service.add_connections(file)
    assert file.read_text() == superlink_service.CONNECTIONS.read_text()


@pytest.mark.unit
@pytest.mark.parametrize(
    ("device", "cards", "chosen"), [("cpu", [], "cpu"), ("cpu", ["0"], "cuda"), ("mps", ["0"], "mps")]
)
def test_a_client_computes_on_the_card_that_is_reserved_for_it(device, cards, chosen):
    assert client_app.on_reserved_gpu(from_profile("tiny", device=device), cards).device == chosen


@pytest.mark.unit
def test_what_a_reader_types_names_connections_and_settings_that_there_are():
    pages = [(ROOT / name).read_text() for name in ("README.md", "book/deployment.md")]
    told = [line for page in pages for line in re.findall(r"flwr run \. [^\n`]*", page)]
    known = {
        *tomllib.loads(superlink_service.CONNECTIONS.read_text())["superlink"],
        "labs",
    }  # the last is the page's own
    assert "[superlink.labs]" in pages[1] and {line.split()[3] for line in told} == known - {"default"}
    overrides = re.findall(r"""--run-config (?:"([^"]+)"|'([^']+)')""", "\n".join(pages))
    given = [word.split("=") for pair in overrides for word in "".join(pair).split()]
    usual = to_run_config(from_profile("tiny"))
    assert len(given) >= 5 and all(type(json.loads(value)) is type(usual[name]) for name, value in given)


@pytest.mark.unit
def test_a_port_that_another_program_uses_is_named(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("FLWR_HOME", str(tmp_path / "flwr"))
    with socket.socket() as other:
        other.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # a SuperLink may just have closed it
        if processes.is_free(9493):  # no other program uses it
            other.bind(("127.0.0.1", 9493))
            other.listen()
        assert main(["superlink", "up"]) == 2
    assert "port 9493 is used by another program" in capsys.readouterr().err
    assert not (tmp_path / "flwr").exists()


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
    said = subprocess.run(["sh", "-c", command], cwd=ROOT, env=clean, capture_output=True, text=True)
    said = said.stdout.splitlines()  # a folder's name may have a space
    assert said[-1] == str(ROOT / ".cache/flwr")
    assert not (ROOT / ".venv").exists() or str(ROOT / ".venv/bin/fedvla") in said
