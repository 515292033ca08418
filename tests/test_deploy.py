"""A deployment for real: SuperLink and SuperNodes as processes, TLS and keys, the same model, intruders refused."""

import re
import signal
import socket
import subprocess
import sys
import time
from dataclasses import replace
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
from safetensors.numpy import load_file

from fedvla_lib import credentials, deploy, engine, run_folder, superlink
from fedvla_lib.config import from_profile

pytestmark = [pytest.mark.integration, pytest.mark.slow]


@pytest.fixture
def tiny(recording, tmp_path):
    return from_profile(
        "tiny", base="nano", data=str(recording), num_clients=2, num_server_rounds=2, local_steps=1, eval_rollouts=0,
        client_rollouts=0, fraction_evaluate=0.0, num_threads=1, out=str(tmp_path / "outputs"),
    )  # fmt: skip


def test_a_deployment_gives_the_model_of_the_inline_engine_and_says_what_it_measures(tiny, recording, tmp_path):
    said = []
    root = deploy.run_deployed(tiny, tls=True, auth=True, data=[recording] * 2, timeout_s=540, say=said.append)
    assert run_folder.read_stamp(root)["status"] == "completed"
    assert run_folder.read_metrics(root, "rejected").empty
    assert any("round 2, client_1, train: loss" in line for line in said)
    inline = engine.run_inline(tiny, data=[recording] * 2, progress=False, raise_errors=True)
    left, right = (load_file(one / "global_model/round_2/model.safetensors") for one in (root, inline))
    assert max(np.abs(left[name] - right[name]).max() for name in left) <= 1e-6
    frames = run_folder.read_metrics(root, "train").num_examples
    assert frames.nunique() == 1  # each holds all of the data set that it was given


@pytest.fixture(scope="module")
def standing(tmp_path_factory):
    """A deployment of two clients that the tests below meet."""
    with deploy.deployment(tmp_path_factory.mktemp("deployment"), 2, tls=True, auth=True) as here:
        yield here


def test_a_node_with_an_unknown_key_is_refused(standing, tmp_path):
    stranger = credentials.make_node_key(tmp_path, "stranger")
    intruder = replace(standing, keys=[stranger, stranger], nodes={}, folder=tmp_path)
    with pytest.raises(superlink.FlowerRunError, match=r"SuperNode of client 0 ended with status [1-9]"):
        intruder.start_node(0)
    assert deploy.CONNECTED not in intruder.log(0).read_text()


def test_a_node_that_trusts_another_authority_does_not_talk_to_the_server(standing, tmp_path, monkeypatch):
    monkeypatch.setattr(superlink, "STARTUP_S", 15.0)
    elsewhere = credentials.make_server(tmp_path / "elsewhere")
    astray = replace(standing, link=replace(standing.link, files=elsewhere), nodes={}, folder=tmp_path)
    with pytest.raises(superlink.FlowerRunError, match="SuperNode of client 0"):
        astray.start_node(0)
    for node in astray.nodes.values():
        superlink.stop(node)
    assert "CERTIFICATE_VERIFY_FAILED" in astray.log(0).read_text()


def test_an_expired_certificate_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(superlink, "STARTUP_S", 15.0)
    expired = credentials.make_server(tmp_path / "server", until=datetime.now(UTC) - timedelta(hours=1))
    with pytest.raises(superlink.FlowerRunError, match="certificate has expired"):
        with superlink.local_superlink(tmp_path, files=expired):
            pass


def test_a_node_killed_during_a_run_is_left_out_and_comes_back(standing, tiny):
    """Ended without warning after round 1 and started again with its key: rounds go on, and a later one has it back."""
    config = replace(tiny, num_server_rounds=4, local_steps=2)
    seen = []

    def meddle():
        metrics = [folder / "metrics.jsonl" for folder in superlink.run_folders(config)]
        trained = [e for file in metrics if file.exists() for e in run_folder.read_events(file) if e["kind"] == "train"]
        if trained and not seen:
            seen.append("killed")
            standing.kill_node(1)
            time.sleep(5)
            standing.start_node(1)

    deploy.submit(standing, config, 900, meddle)
    root = max(superlink.run_folders(config))
    rejected, trained = (run_folder.read_metrics(root, kind) for kind in ("rejected", "train"))
    assert seen and run_folder.read_stamp(root)["status"] == "completed"
    assert set(trained[trained["round"] == 4].who) == {"client_0", "client_1"}
    assert set(rejected.who) <= {"client_1"}


def test_an_interrupt_stops_everything_that_was_started(tiny, tmp_path):
    command = [sys.executable, "-c", "import sys; from fedvla_lib.cli import main; sys.exit(main())", "deploy"]
    command += ["--profile", "tiny", "--clients", "2", "--data", tiny.data, "--tls", "--auth", "--out", str(tmp_path)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    said = process.stdout.readline()
    port = re.search(r"2 SuperNodes joined the SuperLink at 127.0.0.1:(\d+)", said)[1]
    process.send_signal(signal.SIGTERM)
    assert process.wait(60) == 130 and "interrupted" in process.stderr.read()
    with socket.socket() as probe:
        assert probe.connect_ex(("127.0.0.1", int(port))) != 0
    left = subprocess.run(["pgrep", "-f", f"127.0.0.1:{port}"], capture_output=True, text=True).stdout.split()
    deadline = time.monotonic() + 15  # Flower's helpers look every few seconds whether their parent lives
    while left and time.monotonic() < deadline:
        time.sleep(1)
        left = subprocess.run(["pgrep", "-f", f"127.0.0.1:{port}"], capture_output=True, text=True).stdout.split()
    assert not left


@pytest.mark.unit
def test_authentication_needs_encryption_and_data_a_folder_for_each_client(tmp_path):
    with pytest.raises(ValueError, match="auth=True needs tls=True"), deploy.deployment(tmp_path, 1, tls=False):
        pass
    with pytest.raises(ValueError, match="1 data folders for num-clients=2"):
        with deploy.deployment(tmp_path, 2, data=[tmp_path]):
            pass
    assert not list(tmp_path.iterdir())
