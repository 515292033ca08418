"""Run the Flower app on Flower's simulation runtime: a local SuperLink, `flwr run`, and the run's real status.

These are the documented commands, wrapped because three of their defaults trip a small machine: the SuperLink that
`flwr run` starts by itself gives up after 15 s, a client asks for two cores, and a failed run still exits with 0.
"""

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from fedvla_lib.config import Config, check, to_run_config

STARTUP_S = 120.0  # a cold two-core machine needs about 10 to 40 s
POLL_S = 3.0
OFFLINE = {  # Flower and Ray ask the network nothing
    "FLWR_TELEMETRY_ENABLED": "0",
    "FLWR_DISABLE_UPDATE_CHECK": "1",
    "FLWR_DISABLE_RUNTIME_DEPENDENCY_INSTALLATION": "1",
    "RAY_USAGE_STATS_ENABLED": "0",
}
CONNECTION = "book"


class FlowerRunError(RuntimeError):
    """The SuperLink did not start, or the run did not complete; the message holds Flower's own words."""


@dataclass(frozen=True)
class SuperLink:
    """A SuperLink that is up, and the environment in which `flwr` finds it."""

    environment: dict[str, str]
    log: Path

    def flwr(self, *arguments: str) -> dict[str, Any]:
        """Run a `flwr` command against this SuperLink and return its JSON answer.

        Raises:
            FlowerRunError: the command failed.
        """
        command = [_program("flwr"), *arguments, "--format", "json"]
        done = subprocess.run(command, env=self.environment, capture_output=True, text=True)
        start = done.stdout.find("{\n")
        answer = json.loads(done.stdout[start:]) if start >= 0 else {}
        if done.returncode or not answer.get("success"):
            said = answer.get("error-message") or done.stderr or done.stdout
            raise FlowerRunError(f"flwr {arguments[0]} failed: {' '.join(str(said).split())[-800:]}")
        return answer

    def status(self, run_id: str) -> tuple[str, str]:
        """Return a run's status, such as ``running`` or ``finished:completed``, and its details."""
        run = self.flwr("list", CONNECTION, "--run-id", run_id)["runs"][0]
        return run["status"], run.get("status-details") or ""


def run_simulation(
    config: Config, *, cpus_per_client: int = 1, gpus_per_client: float = 0.0, timeout_s: float = 24 * 3600.0
) -> Path:
    """Run a federation on Flower's simulation runtime (Ray workers) and return its run folder.

    Raises:
        FlowerRunError: the run failed, or did not finish in time.
        ValueError: unusable settings, or no checkout with a pyproject.toml around this library.
    """
    out = Path(config.out).resolve()
    config = check(replace(config, out=str(out), num_threads=config.num_threads or cpus_per_client))
    before = set(out.glob("*"))
    resources = f"client-resources-num-cpus={cpus_per_client} client-resources-num-gpus={gpus_per_client}"
    with tempfile.TemporaryDirectory(prefix="fedvla-flower-") as folder:
        app, settings = stage_app(Path(folder)), _write_settings(Path(folder), config)
        with local_superlink(Path(folder)) as link:
            federation = f"num-supernodes={config.num_clients} {resources}"
            options = ["--federation-config", federation, "--run-config", str(settings)]
            run_id = link.flwr("run", str(app), CONNECTION, *options)["run-id"]
            _wait_for_end(link, run_id, timeout_s)
    return max(set(out.glob("*")) - before)


@contextmanager
def local_superlink(home: Path) -> Iterator[SuperLink]:
    """Start a SuperLink in simulation mode on a free port, with `home` as FLWR_HOME, and stop it at the end.

    Raises:
        FlowerRunError: it did not answer within two minutes.
    """
    port = _free_port()
    environment = {**os.environ, **OFFLINE, "FLWR_HOME": str(home)}
    connection = f'[superlink.{CONNECTION}]\naddress = "127.0.0.1:{port}"\ninsecure = true\n'
    (home / "config.toml").write_text(f'[superlink]\ndefault = "{CONNECTION}"\n\n{connection}')
    log = home / "superlink.log"
    command = [_program("flower-superlink"), "--insecure", "--simulation", "--host", "127.0.0.1", "--port", str(port)]
    with open(log, "wb") as output:
        process = subprocess.Popen(command, env=environment, stdout=output, stderr=output, start_new_session=True)
    try:
        _wait_until_up(process, port, log)
        yield SuperLink(environment, log)
    finally:
        _stop(process)


def stage_app(folder: Path) -> Path:
    """Copy what the Flower app needs into ``folder/app`` and return it: `flwr` would search the whole checkout."""
    package = Path(__file__).resolve().parent
    project = package.parent / "pyproject.toml"
    if not project.is_file():
        raise ValueError(f"no {project}: run Flower's engines from a checkout of the book")
    app = folder / "app"
    shutil.copytree(package, app / package.name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(package.parent / name, app / name)
    return app


def _write_settings(folder: Path, config: Config) -> Path:
    """Write the settings as a TOML file for ``--run-config``: JSON's strings, numbers and booleans are TOML's."""
    path = folder / "settings.toml"
    path.write_text("".join(f"{key} = {json.dumps(value)}\n" for key, value in to_run_config(config).items()))
    return path


def _wait_for_end(link: SuperLink, run_id: str, timeout_s: float) -> None:
    deadline = time.monotonic() + timeout_s
    status, details = link.status(run_id)
    while not status.startswith("finished") and time.monotonic() < deadline:
        time.sleep(POLL_S)
        status, details = link.status(run_id)
    if status != "finished:completed":
        raise FlowerRunError(f"run {run_id} is {status} ({details}); the SuperLink's log ends: {_tail(link.log)}")


def _wait_until_up(process: subprocess.Popen, port: int, log: Path) -> None:
    deadline = time.monotonic() + STARTUP_S
    while not _answers(port):
        if process.poll() is not None or time.monotonic() > deadline:
            raise FlowerRunError(f"the SuperLink did not start within {STARTUP_S:.0f} s; its log ends: {_tail(log)}")
        time.sleep(0.5)


def _answers(port: int) -> bool:
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/health", timeout=2) as response:
            return response.status == 200
    except (urllib.error.URLError, OSError):
        return False


def _stop(process: subprocess.Popen) -> None:
    """End the SuperLink and the processes it started: they share its session."""
    for sign in (signal.SIGTERM, signal.SIGKILL):
        try:
            os.killpg(process.pid, sign)
            process.wait(timeout=15)
            return
        except ProcessLookupError:
            return
        except subprocess.TimeoutExpired:
            continue


def _program(name: str) -> str:
    """Return a command of this interpreter's environment, whether or not that is on PATH."""
    beside = Path(sys.executable).parent / name
    return str(beside) if beside.exists() else name


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def _tail(log: Path) -> str:
    return " | ".join(log.read_text(errors="replace").splitlines()[-8:])
