"""Processes that are forked instead of started: they behave as if started, and end with whoever asked for them."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from conftest import heed_interrupts
from fedvla_lib.engines import processes, superlink, warm_start

SCRIPT = """
import json, os, signal, sys, time
print(json.dumps([sys.argv[1:], os.getcwd(), os.environ["COLOUR"], os.getpid(), "tabnanny" in sys.modules]), flush=True)
if "wait" in sys.argv:
    import subprocess
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    signal.signal(signal.SIGTERM, lambda *_: (child.kill(), sys.exit(9)))
    print(child.pid, flush=True)
    time.sleep(60)
sys.exit(input())
"""


@pytest.fixture
def calls(tmp_path, monkeypatch):
    """A function that calls a script, through a fork server that has loaded one small module; and the server."""
    monkeypatch.setattr(warm_start, "SERVERS", {(warm_start.PYTHON,): ("tabnanny",)})
    (tmp_path / "its script.py").write_text(SCRIPT)
    plain = superlink.flower_environment(tmp_path)
    with warm_start.warm_start(plain, tmp_path / "log") as environment:
        server = the_server()

        def call(*arguments):
            command = [stand_in(environment, warm_start.PYTHON), str(tmp_path / "its script.py"), *arguments]
            piped = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True, "cwd": tmp_path}
            return subprocess.Popen(command, env={**environment, "COLOUR": "blue"}, **piped)

        yield call, server
    assert not server.is_running() or server.status() == psutil.STATUS_ZOMBIE
    assert not list(Path(stand_in(environment, warm_start.PYTHON)).parent.glob("*"))


def the_server(within_s=10):
    """The only fork server that this process started; for a moment after its start a process has no command line."""
    deadline = time.monotonic() + within_s
    found = []
    while not found and time.monotonic() < deadline:
        found = [child for child in psutil.Process().children() if str(warm_start.FORK_SERVER) in child.cmdline()]
    (server,) = found
    return server


def stand_in(environment, name):
    return os.path.join(environment["PATH"].split(os.pathsep)[0], name)


def gone(pid, within_s=10):
    """Whether a process has ended, or soon does."""
    deadline = time.monotonic() + within_s
    while psutil.pid_exists(pid) and psutil.Process(pid).status() != psutil.STATUS_ZOMBIE:
        if time.monotonic() > deadline:
            return False
        time.sleep(0.05)
    return True


def test_a_fork_has_the_callers_arguments_folder_environment_and_files_and_reports_its_status(calls, tmp_path):
    call, server = calls
    process = call("two words", "ü")
    said, _ = process.communicate("7\n")  # `sys.exit` of text prints it and is status 1
    assert json.loads(said)[:3] == [["two words", "ü"], str(tmp_path), "blue"]
    assert json.loads(said)[4] is True and process.returncode == 1 and server.is_running()


def test_without_its_server_a_call_is_an_ordinary_process(calls):
    call, server = calls
    server.kill()
    server.wait()
    process = call()
    arguments, _, colour, pid, loaded = json.loads(process.communicate("\n")[0])
    assert (arguments, colour, pid, loaded) == ([], "blue", process.pid, False)


def test_a_signal_reaches_the_fork(calls):
    process = calls[0]("wait")
    child = [process.stdout.readline(), int(process.stdout.readline())][1]
    process.terminate()
    assert process.wait(10) == 9 and gone(child)


@pytest.fixture
def without_interrupts():
    """As a shell starts what it runs in the background: the fork server inherits it."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize("heeds", [True, False])
def test_a_fork_ignores_an_interrupt_if_its_caller_does_whatever_the_server_does(without_interrupts, calls, heeds):
    with pytest.MonkeyPatch.context() as patch:
        started = subprocess.Popen
        patch.setattr(subprocess, "Popen", lambda *words, **rest: started(
            *words, **rest, preexec_fn=heed_interrupts if heeds else None
        ))  # fmt: skip
        process = calls[0]()
    assert json.loads(process.stdout.readline())
    process.send_signal(signal.SIGINT)
    if heeds:
        assert process.wait(10) == 128 + signal.SIGINT
    else:
        assert process.communicate("\n", timeout=10) and process.returncode == 1


def test_a_fork_and_its_children_end_with_the_call_also_when_the_server_is_gone(calls):
    call, server = calls
    process = call("wait")
    pids = [json.loads(process.stdout.readline())[3], int(process.stdout.readline())]
    server.kill()
    server.wait()
    other = call()  # does not wait for a server that is no more
    assert json.loads(other.communicate("\n", timeout=30)[0])[3] == other.pid
    assert not any(gone(pid, 0) for pid in pids)
    process.kill()
    assert all(gone(pid) for pid in pids)


def test_a_fork_that_is_killed_is_reported_as_a_shell_would(calls):
    process = calls[0]("wait")
    os.kill(json.loads(process.stdout.readline())[3], signal.SIGKILL)
    assert process.wait(10) == 128 + signal.SIGKILL


def test_nothing_is_left_of_the_forks_when_the_servers_are_stopped(tmp_path, monkeypatch):
    monkeypatch.setattr(warm_start, "SERVERS", {(warm_start.PYTHON,): ()})
    (tmp_path / "script.py").write_text("import os, time; print(os.getpid(), flush=True); time.sleep(60)")
    with warm_start.warm_start(superlink.flower_environment(tmp_path), tmp_path / "log") as environment:
        command = [stand_in(environment, warm_start.PYTHON), str(tmp_path / "script.py")]
        process = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)
        pid = int(process.stdout.readline())
    assert gone(pid) and process.wait(10)


def test_other_systems_and_long_paths_start_processes_in_the_ordinary_way(tmp_path, monkeypatch):
    plain = superlink.flower_environment(tmp_path)
    for module, name, value in ((sys, "platform", "darwin"), (warm_start, "LONGEST_FOLDER", 5)):
        with monkeypatch.context() as changed:
            changed.setattr(module, name, value)
            changed.setattr(processes, "start", None)
            with warm_start.warm_start(plain, tmp_path / "log") as environment:
                assert environment == plain


@pytest.mark.integration
@pytest.mark.slow
def test_the_servers_load_pytorch_but_not_this_library_and_are_safe_to_fork_and_to_kill(tmp_path):
    """An app brings its own copy of the library, which a copy in memory would hide."""
    (tmp_path / "script.py").write_text(
        "import sys, threading, torch\n"
        "ours = [name for name in sys.modules if name.split('.')[0] in ('fedvla_lib', 'ray', 'mujoco')]\n"
        "loaded = 'lerobot.policies.smolvla' in sys.modules and 'flwr.clientapp' in sys.modules\n"
        "print(ours, loaded, threading.active_count(), torch.cuda._is_in_bad_fork())"
    )
    with warm_start.warm_start(superlink.flower_environment(tmp_path), tmp_path / "log") as environment:
        command = [stand_in(environment, warm_start.PYTHON), str(tmp_path / "script.py")]
        said = subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout
        assert said == "[] True 1 False\n"
        programs = {"flwr", "flwr-clientapp", "flwr-serverapp", "flwr-simulation", "flower-superexec"}
        assert set(os.listdir(Path(command[0]).parent)) >= programs
        servers = [one for one in psutil.Process().children() if str(warm_start.FORK_SERVER) in one.cmdline()]
        for server in servers:
            server.kill()
        assert len(servers) == 2 and not psutil.wait_procs(servers, timeout=10)[1]
        for name in programs:  # each is then started in the ordinary way
            command = [stand_in(environment, name), "--help"]
            done = subprocess.run(command, env=environment, capture_output=True, text=True)
            assert done.returncode == 0 and "usage" in done.stdout.lower(), done.stderr
