"""A real deployment: SuperLink and SuperNodes as processes, TLS and keys, the same model, intruders rejected."""

import contextlib
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import psutil
import pytest
import yaml
from cryptography import x509
from cryptography.x509 import verification
from flwr.app import RecordDict
from safetensors.numpy import load_file

from conftest import IMAGE_SIZE, assert_faults_were_survived, heed_interrupts
from fedvla_lib import run_folder
from fedvla_lib.cli.commands import settings
from fedvla_lib.cli.main import main
from fedvla_lib.cli.parser import build_parser
from fedvla_lib.config import from_profile, to_run_config
from fedvla_lib.data import record
from fedvla_lib.engines import credentials, deployment, guard, processes, superlink
from fedvla_lib.engines.inline import run_inline
from fedvla_lib.federation import client, client_app
from fedvla_lib.files import write_json

ROOT = Path(__file__).parents[1]
pytestmark = [pytest.mark.integration, pytest.mark.slow]
# All state that a client keeps in Flower's Context: control variate, moments, rounding error, personal parts.
KEEPING = {"strategy": "scaffold", "keep_optimizer": True, "exchange": "int8", "personal": "projections"}


@pytest.fixture
def tiny(recording, tmp_path):
    return from_profile(
        "tiny", base="nano", data=str(recording), num_clients=2, num_server_rounds=2, local_steps=1, eval_rollouts=0,
        client_rollouts=0, fraction_evaluate=0.0, num_threads=1, out=str(tmp_path / "outputs"),
    )  # fmt: skip


def forget(message, context, call_next):
    """A mod for a client that keeps no state between messages."""
    context.state = RecordDict()
    return call_next(message, context)


def apart(left, right):
    return max(np.abs(left[name] - right[name]).max() for name in left)


STARTED = """
import sys, time
from pathlib import Path
from fedvla_lib.engines.deployment import running_deployment
with running_deployment(Path(sys.argv[1]), 1) as deployment:
    print("running", flush=True)
    time.sleep(600)
"""


def at_home(home):
    """Names of the processes with a FLWR_HOME in a folder."""
    found = []
    for process in psutil.process_iter():
        with contextlib.suppress(psutil.Error):
            if process.environ().get("FLWR_HOME", "").startswith(str(home)):
                found.append(" ".join(process.cmdline()))
    return found


def test_nothing_of_a_killed_deployment_is_left_running_and_no_key_is_left_behind(tmp_path):
    home = tmp_path / "a home"
    home.mkdir()
    with subprocess.Popen([sys.executable, "-c", STARTED, str(home)], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "running\n"
        running = " ".join(at_home(home))
        assert "flower-supernode" in running and "flower-superlink" in running and (home / "keys").exists()
        process.kill()
    deadline = time.monotonic() + 30
    while at_home(home) or (home / "keys").exists():
        assert time.monotonic() < deadline, at_home(home)
        time.sleep(0.2)
    assert not (home / "server").exists()


def test_a_home_that_nobody_uses_is_cleared_and_a_fresh_one_is_left(tmp_path, monkeypatch):
    monkeypatch.setattr(guard.tempfile, "gettempdir", lambda: str(tmp_path))
    old, fresh, used = (tmp_path / f"fedvla-test-{name}" for name in ("old", "fresh", "used"))
    for home in (old, fresh, used):
        home.mkdir()
    for home in (old, used):
        os.utime(home, (0, 0))
    environment = os.environ | {"FLWR_HOME": str(used / "node_0")}
    with subprocess.Popen(["sleep", "60"], env=environment) as process:
        guard.clear("fedvla-test-")
        process.kill()
    assert not old.exists() and fresh.exists() and used.exists()


def test_a_deployment_gives_the_model_of_the_inline_engine_and_each_node_learns_from_its_own_data(
    tiny, recording, tmp_path
):
    """With all state that a client keeps between rounds: without it the result would be another model."""
    tiny = replace(tiny, **KEEPING)
    other = record.record(["lift"], 3, tmp_path / "other", image_size=IMAGE_SIZE, seed=5, progress=False)
    own, said = [recording, other], []
    root = deployment.run_deployed(tiny, tls=True, auth=True, data=own, timeout_s=540, say=said.append)
    assert run_folder.read_stamp(root)["status"] == "completed"
    assert run_folder.read_metrics(root, "rejected").empty
    assert any("round 2, client_1, train: loss" in line for line in said)
    inline, forgetful = (
        run_inline(tiny, clients_app=app, data=own, progress=False, raise_errors=True)
        for app in (None, client_app.build(mods=dict.fromkeys(client_app.HANDLERS, [forget])))
    )
    deployed, kept, forgotten = (
        load_file(one / "global_model/round_2/model.safetensors") for one in (root, inline, forgetful)
    )
    assert apart(deployed, kept) <= 1e-6 and apart(deployed, forgotten) > 1e-4
    held = {f"client_{k}": client.open_client(tiny, k, own_data=str(path)).num_examples for k, path in enumerate(own)}
    trained = run_folder.read_metrics(root, "train")
    assert held["client_0"] != held["client_1"]  # all of the data set that each was given
    assert all(held[who] == frames for who, frames in zip(trained.who, trained.num_examples, strict=True))


@pytest.fixture(scope="module")
def standing(tmp_path_factory):
    """A deployment of two clients, shared by the tests below."""
    with deployment.running_deployment(tmp_path_factory.mktemp("deployment"), 2, tls=True, auth=True) as here:
        yield here


def test_a_node_with_an_unknown_key_is_refused(standing, tmp_path):
    stranger = credentials.make_node_key(tmp_path, "stranger")
    intruder = replace(standing, keys=[stranger, stranger], nodes={}, folder=tmp_path)
    with pytest.raises(processes.FlowerRunError, match=r"SuperNode of client 0 ended with status [1-9]"):
        intruder.launch_node(0)
        intruder.wait_for_node(0)
    assert deployment.CONNECTED not in intruder.log(0).read_text()


def refusal(node_of: deployment.Deployment) -> str:
    """Start a SuperNode of the deployment, which must reject the server at once, and return its log."""
    with pytest.raises(processes.FlowerRunError, match="the SuperNode of client 0 does not trust the SuperLink"):
        node_of.launch_node(0)
        node_of.wait_for_node(0)
    processes.stop(node_of.nodes[0])
    return node_of.log(0).read_text()


OFF = """
import sys
from datetime import timedelta
from flwr.supernode import node_auth_http_interceptor as signing
from flwr.supernode.cli import flower_supernode
right, off = signing.now, timedelta(seconds=float(sys.argv.pop(1)))
signing.now = lambda: right() + off
flower_supernode()
"""


@pytest.mark.parametrize(("ahead_s", "joins"), [(60, False), (-3600, False), (-240, True)])
def test_a_node_joins_unless_its_clock_is_ahead_or_minutes_behind(standing, tmp_path, monkeypatch, ahead_s, joins):
    key, usual = credentials.make_node_key(tmp_path, "late"), deployment.Deployment._command
    standing.link.ask("supernode", "register", str(key.public), superlink.CONNECTION)
    monkeypatch.setattr(
        deployment.Deployment, "_command",
        lambda here, k: [sys.executable, "-c", OFF, str(ahead_s), *usual(here, k)[1:]],
    )  # fmt: skip
    late = replace(standing, keys=[key, key], nodes={}, folder=tmp_path)
    late.launch_node(0)
    try:
        with contextlib.nullcontext() if joins else pytest.raises(processes.FlowerRunError, match="client 0 ended"):
            late.wait_for_node(0)
    finally:
        processes.stop(late.nodes[0])
    assert (deployment.CONNECTED in late.log(0).read_text()) == joins


def test_nodes_and_users_that_trust_another_authority_do_not_talk_to_the_server(standing, tmp_path):
    elsewhere = credentials.make_server(tmp_path / "elsewhere")
    astray = replace(standing, link=replace(standing.link, files=elsewhere), nodes={}, folder=tmp_path)
    assert deployment.CONNECTED not in refusal(astray)
    known = (standing.folder / "config.toml").read_text()
    assert str(standing.link.files.authority) in known
    (tmp_path / "config.toml").write_text(known.replace(str(standing.link.files.authority), str(elsewhere.authority)))
    user = replace(standing.link, environment=superlink.flower_environment(tmp_path))
    with pytest.raises(processes.FlowerRunError, match="flwr list failed"):
        user.ask("list", superlink.CONNECTION)
    assert "runs" in standing.link.ask("list", superlink.CONNECTION)  # of those who trust the right one


def test_a_server_whose_certificate_has_expired_is_refused_by_nodes_and_users(tmp_path, monkeypatch):
    """By this library too; its own check is limited to an open port here, so that the other programs can reject it."""
    expired = credentials.make_server(tmp_path / "server", until=datetime.now(UTC) - timedelta(hours=1))
    checked = superlink.answers
    monkeypatch.setattr(superlink, "answers", lambda port, files: not processes.is_free(port))
    with superlink.local_superlink(tmp_path, files=expired) as link:
        assert not checked(link.port, expired)
        said = refusal(deployment.Deployment(link, tmp_path, [], [], 1))
        assert "certificate has expired" in said and deployment.CONNECTED not in said
        with pytest.raises(processes.FlowerRunError, match="flwr list failed"):  # Flower's command does not say why
            link.ask("list", superlink.CONNECTION)


def test_a_client_that_raises_and_one_that_sends_nan_are_left_out_by_a_deployment_too(standing, tiny, faulty):
    standing.run(tiny, 540)
    assert (
        str(standing.folder / "keys") in (standing.folder / "app" / "pyproject.toml").read_text()
    )  # whose number is whose
    assert_faults_were_survived(max(run_folder.run_folders(tiny)), tiny)


def start_again(here: deployment.Deployment, partition_id: int) -> None:
    """Start a killed SuperNode, as a service manager would: its key is refused until the SuperLink misses the old."""
    deadline = time.monotonic() + processes.STARTUP_S
    while True:
        here.launch_node(partition_id)
        try:
            return here.wait_for_node(partition_id)
        except processes.FlowerRunError:
            if time.monotonic() > deadline:
                raise
            time.sleep(1)


def test_a_round_goes_on_without_a_killed_node_and_a_later_one_has_it_back(standing, tiny):
    """Killed after round 1 and restarted with its key once a round has run without it."""
    config = replace(tiny, num_server_rounds=5, local_steps=2)
    happened = []

    def meddle():
        begun = [folder for folder in run_folder.run_folders(config) if (folder / "metrics.jsonl").exists()]
        kinds = {event["kind"] for folder in begun for event in run_folder.read_events(folder)}
        if "train" in kinds and not happened:
            processes.stop(standing.nodes.pop(1), (signal.SIGKILL,))  # as a power cut would
            happened.append("killed")
        if "rejected" in kinds and happened == ["killed"]:
            happened.append("started again")
            start_again(standing, 1)

    standing.run(config, 900, meddle)
    root = max(run_folder.run_folders(config))
    assert happened == ["killed", "started again"] and run_folder.read_stamp(root)["status"] == "completed"
    rejected, trained, counted = (run_folder.read_metrics(root, kind) for kind in ("rejected", "train", "replies"))
    assert set(zip(rejected.who, rejected.reason, strict=True)) == {("client_1", "silent")}
    alone = counted.set_index("round").loc[2]
    assert (alone.good, alone.rejected, alone.rejected_silent) == (1, 1, 1)
    who = trained.groupby("round").who.agg(set)
    assert who[2] == {"client_0"} and who[5] == {"client_0", "client_1"}


def test_a_run_that_fails_is_status_2_and_a_line_with_the_reason(standing, tiny, monkeypatch, capsys):
    """On the running processes; stopping new ones is tested with the interrupt."""
    monkeypatch.setattr(deployment, "running_deployment", lambda *_, **__: contextlib.nullcontext(standing))
    flags = [f"--{name}={value}" for name, value in given(replace(tiny, min_replies=3)).items()]
    assert main(["deploy", "--profile", "tiny", "--tls", "--auth", *flags]) == 2
    said = capsys.readouterr().err
    assert said.startswith("fedvla deploy: run ") and "finished:failed" in said and said.count("\n") == 1
    (root,) = run_folder.run_folders(tiny)
    assert run_folder.read_stamp(root)["status"].startswith("failed: TooFewReplies")


def test_a_deployment_goes_on_with_a_run_that_another_engine_began(standing, tiny, tmp_path, monkeypatch, capsys):
    whole, begun = run_inline(tiny, progress=False), tmp_path / "begun"
    shutil.copytree(whole, begun)
    shutil.rmtree(begun / "checkpoints/round_2")
    write_json(begun / "stamp.json", {**run_folder.read_stamp(begun), "status": "interrupted"})
    monkeypatch.setattr(deployment, "running_deployment", lambda *_, **__: contextlib.nullcontext(standing))
    assert main(["deploy", "--resume", str(begun), "--tls", "--auth"]) == 0
    said = capsys.readouterr().out
    assert "round 2, client_1, train: loss" in said and "round 1, client_1" not in said and str(begun) in said
    resumed, at_once = (load_file(root / "global_model/round_2/model.safetensors") for root in (begun, whole))
    assert apart(resumed, at_once) <= 1e-6
    trained, wanted = (run_folder.read_metrics(root, "train")[["round", "who"]] for root in (begun, whole))
    assert trained.values.tolist() == wanted.values.tolist()
    monkeypatch.setattr(deployment, "running_deployment", None)  # nothing is started any more
    assert main(["deploy", "--resume", str(begun), "--tls", "--auth"]) == 2
    said = capsys.readouterr()
    assert "is a completed run" in said.err and said.err.count("\n") == 1 and not said.out


@pytest.mark.unit
def test_a_run_is_told_from_another_one_that_began_later_in_the_same_place(tiny):
    before = run_folder.run_folders(tiny)
    assert run_folder.own_run(tiny, before) is None
    another = replace(tiny, seed=7)
    with run_folder.start(tiny, engine="flower") as own, run_folder.start(another, engine="flower") as later:
        assert own.root < later.root and run_folder.own_run(tiny, before) == own.root
    assert run_folder.own_run(tiny, {own.root}) is None


def given(config):
    """Flags for the settings that differ from the profile."""
    usual = to_run_config(from_profile("tiny"))
    return {name: value for name, value in to_run_config(config).items() if value != usual[name]}


def test_ctrl_c_stops_everything_that_was_started_and_leaves_the_rounds_that_ended(tiny, tmp_path):
    """The signal goes to the whole process group, as from a terminal, during round 2."""
    config = replace(tiny, num_server_rounds=50)
    flags = [f"--{name}={value}" for name, value in given(config).items()]
    command = [sys.executable, "-m", "fedvla_lib.cli", "deploy", "--profile", "tiny", "--tls", "--auth", *flags]
    buffered = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    buffered["FEDVLA_MARK"] = mark = str(tmp_path)
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=buffered, start_new_session=True,
        preexec_fn=heed_interrupts,
    )  # fmt: skip
    port = re.search(r"2 SuperNodes joined the SuperLink at 127.0.0.1:(\d+)", process.stdout.readline())[1]
    deadline = time.monotonic() + 300
    while not list(Path(config.out).glob("*/checkpoints/round_1")):
        assert process.poll() is None and time.monotonic() < deadline, process.stderr.read()
        time.sleep(0.2)
    assert any("round 1, client_1, train: loss" in line for line in process.stdout)  # is told within a second
    os.killpg(process.pid, signal.SIGINT)
    warned = process.communicate(timeout=60)[1]
    assert process.returncode == 130 and "interrupted: every process is stopped" in warned
    assert processes.is_free(int(port)) and not left_over(mark)
    (root,) = run_folder.run_folders(config)
    assert run_folder.read_stamp(root)["status"] == "interrupted"
    assert load_file(root / "global_model/round_1/model.safetensors")
    assert set(run_folder.read_metrics(root, "train").query("round == 1").who) == {"client_0", "client_1"}


def left_over(mark: str) -> list[psutil.Process]:
    """Processes that inherited a mark; Flower's helpers check every few seconds whether their parent lives."""
    deadline = time.monotonic() + 15
    while True:
        running = psutil.process_iter(["environ"])
        found = [one for one in running if (one.info["environ"] or {}).get("FEDVLA_MARK") == mark]
        if not found or time.monotonic() > deadline:
            return found
        time.sleep(1)


@pytest.mark.unit
def test_a_deployment_has_as_many_clients_as_asked_for_or_as_its_profile():
    asked = [["deploy", "--profile", "tiny", *more] for more in ([], ["--clients", "5"], ["--num-clients", "5"])]
    found = [settings(build_parser().parse_args(words)).num_clients for words in asked]
    assert found == [from_profile("tiny").num_clients, 5, 5]


@pytest.mark.unit
def test_authentication_needs_encryption_and_data_a_folder_for_each_client(tmp_path):
    with (
        pytest.raises(ValueError, match="auth=True needs tls=True"),
        deployment.running_deployment(tmp_path, 1, tls=False),
    ):
        pass
    with pytest.raises(ValueError, match="1 data folders for num-clients=2"):
        with deployment.running_deployment(tmp_path, 2, data=[tmp_path]):
            pass
    with pytest.raises(ValueError, match=f"no data set at {tmp_path}/b: give the folder"):
        with deployment.running_deployment(tmp_path, 2, data=[tmp_path, tmp_path / "b"]):
            pass
    assert not list(tmp_path.iterdir())


def written_commands(program: str) -> list[list[str]]:
    """All calls of a program in the deployment page and the compose file, split into words."""
    page = "\n".join(re.findall(r"^```bash\n(.*?)^```", (ROOT / "book/deployment.md").read_text(), re.M | re.S))
    services = yaml.safe_load((ROOT / "flower/compose.yaml").read_text())["services"].values()
    lines = [*page.replace("\\\n", " ").splitlines(), *(service["command"] for service in services)]
    return [words for line in lines if (words := shlex.split(line, comments=True)) and words[0] == program]


@pytest.mark.unit
@pytest.mark.parametrize("program", ["flower-superlink", "flower-supernode"])
def test_flowers_programs_know_the_flags_of_the_recipe(program):
    command = [Path(sys.executable).with_name(program), "--help"]
    help_text = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    used = [{word for word in words if word.startswith("--")} for words in written_commands(program)]
    assert len(used) >= 2 and all(flags for flags in used)
    assert not set.union(*used) - set(re.findall(r"--[a-z-]+", help_text))


@pytest.mark.unit
def test_the_recipe_calls_commands_that_this_library_has():
    calls = written_commands("fedvla")
    assert {words[1] for words in calls} >= {"superlink", "deploy", "credentials", "config"}
    for words in calls:
        build_parser().parse_args([word for word in words[1:] if word not in (">", "labs.toml")])


@pytest.mark.unit
def test_a_servers_certificate_also_names_it_as_its_own_helper_calls_it(tmp_path, monkeypatch):
    """A SuperLink on all addresses starts a helper that connects to 127.0.0.1; without that name no run would start."""
    monkeypatch.chdir(tmp_path)
    (recipe,) = [words for words in written_commands("fedvla") if words[1] == "credentials"]
    assert main(recipe[1:]) == 0
    certificate = x509.load_pem_x509_certificate((tmp_path / "deployment/server/server.pem").read_bytes())
    named = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert named.get_values_for_type(x509.DNSName) == ["server.example.org", "localhost"]
    assert [str(address) for address in named.get_values_for_type(x509.IPAddress)] == ["127.0.0.1"]


@pytest.mark.unit
@pytest.mark.parametrize(("hours", "is_trusted"), [(-1, True), (1, True), (24 * 8, False), (-25, False)])
def test_a_clock_that_is_an_hour_off_still_trusts_the_server(tmp_path, hours, is_trusted):
    files = credentials.make_server(tmp_path, ["server.example.org"])
    authority, server = (
        x509.load_pem_x509_certificate(path.read_bytes()) for path in (files.authority, files.certificate)
    )
    clock = datetime.now(UTC) + timedelta(hours=hours)
    policy = verification.PolicyBuilder().store(verification.Store([authority])).time(clock)
    verifier = policy.build_server_verifier(x509.DNSName("server.example.org"))
    with contextlib.nullcontext() if is_trusted else pytest.raises(verification.VerificationError):
        assert verifier.verify(server, []) == [server, authority]


@pytest.mark.unit
def test_the_recipe_registers_a_node_before_it_starts():
    """A node whose key is not registered yet is rejected, and exits."""
    page = (ROOT / "book/deployment.md").read_text()
    assert page.index("flwr supernode register") < page.index("flower-supernode --root-certificates")


@pytest.mark.unit
def test_the_containers_mount_what_the_recipe_makes(tmp_path, monkeypatch, capsys):
    """The files mounted into containers come from the `fedvla credentials` call at the top of the compose file."""
    composed = (ROOT / "flower/compose.yaml").read_text()
    monkeypatch.chdir(tmp_path)
    assert main(shlex.split(re.search(r"fedvla (credentials .*)", composed)[1])) == 0
    for service in yaml.safe_load(composed)["services"].values():
        mounts = [volume.split(":")[:2] for volume in service["volumes"]]
        made = [tmp_path / "flower" / host for host, _ in mounts if "deployment" in host]
        assert made and all(path.resolve().exists() for path in made)
        places = [inside for _, inside in mounts]
        named = re.findall(r"(?<=[ \"])/[\w./]+", service["command"])
        assert named and all(any(path.startswith(place) for place in places) for path in named)
