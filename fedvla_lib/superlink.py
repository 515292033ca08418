"""Run the Flower app on Flower's simulation runtime: a local SuperLink, `flwr run`, and the run's real status.

These are the documented commands, wrapped because four of their habits trip a small machine: the SuperLink that
`flwr run` starts by itself gives up after 15 s, a client asks for two cores, a failed run still exits with 0, and Ray,
which runs the clients, allows a helper process of its own 15 s to start.
"""

import json
import os
import re
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

from fedvla_lib.config import Config, check, to_run_config

STARTUP_S = 120.0  # a cold two-core machine needs about 10 to 40 s
STATUS_TRIES, POLL_S = 6, 5.0
RUNTIME_TRIES = 3  # Ray's 15 s are fixed in its code; a busy machine misses them, seldom twice
NOT_STARTED = "Simulation Runtime crashed"  # what Flower says if Ray did not come up, before any client was asked
FIRST_ERROR = re.compile(r"Traceback \(most recent call last\):\n(?:[ \t].*\n|\n)*(\S.*)$", re.MULTILINE)
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
    log: Path  # what the run printed

    def submit(self, app: Path, *options: str, timeout_s: float) -> str:
        """Start a run of the app, follow its log until the run ends, and return its id.

        Following costs nothing, while each further `flwr` command costs seconds of computing time.

        Raises:
            FlowerRunError: the run was not accepted, or did not end in time.
        """
        command = [_program("flwr"), "run", str(app), CONNECTION, *options, "--stream"]
        with open(self.log, "wb") as log:
            process = subprocess.Popen(command, env=self.environment, stdout=log, stderr=subprocess.STDOUT)
            try:
                process.wait(timeout_s)
            except subprocess.TimeoutExpired as error:
                raise FlowerRunError(f"the run did not end within {timeout_s:.0f} s: {_reason(self.log)}") from error
            finally:
                process.kill()
        accepted = re.search(r"Successfully started run (\d+)", self.log.read_text(errors="replace"))
        if not accepted:
            raise FlowerRunError(f"flwr run failed: {_reason(self.log)}")
        return accepted[1]

    def status(self, run_id: str) -> tuple[str, str]:
        """Return a run's status, such as ``running`` or ``finished:completed``, and its details."""
        command = [_program("flwr"), "list", CONNECTION, "--run-id", run_id, "--format", "json"]
        done = subprocess.run(command, env=self.environment, capture_output=True, text=True)
        answer = json.loads(done.stdout[done.stdout.find("{\n") :]) if "{\n" in done.stdout else {}
        if not answer.get("runs"):
            raise FlowerRunError(f"flwr list failed: {_one_line(done.stderr or done.stdout)}")
        return answer["runs"][0]["status"], answer["runs"][0].get("status-details") or "no details"


def run_simulation(
    config: Config, *, cpus_per_client: int = 1, gpus_per_client: float = 0.0, timeout_s: float = 24 * 3600.0
) -> Path:
    """Run a federation on Flower's simulation runtime (Ray workers) and return its run folder.

    Raises:
        FlowerRunError: the run failed, or did not finish in time.
        ValueError: unusable settings, or no checkout with a pyproject.toml around this library.
    """
    out = Path(config.out).resolve()
    paths = {name: _absolute(getattr(config, name)) for name in ("data", "base")}
    config = check(replace(config, out=str(out), num_threads=config.num_threads or cpus_per_client, **paths))
    before = set(out.glob("*"))
    resources = f"client-resources-num-cpus={cpus_per_client} client-resources-num-gpus={gpus_per_client}"
    with tempfile.TemporaryDirectory(prefix="fedvla-flower-") as folder:
        app, settings = stage_app(Path(folder)), write_settings(Path(folder), config)
        with local_superlink(Path(folder)) as link:
            federation = f"num-supernodes={config.num_clients} {resources}"
            options = ["--federation-config", federation, "--run-config", str(settings)]
            _require_completed(link, _submit(link, app, options, timeout_s))
    return max(set(out.glob("*")) - before)


def _submit(link: SuperLink, app: Path, options: list[str], timeout_s: float) -> str:
    """Run the app, again if Flower's runtime did not come up, and return the id of the last run."""
    for _ in range(RUNTIME_TRIES):
        run_id = link.submit(app, *options, timeout_s=timeout_s)
        if NOT_STARTED not in link.log.read_text(errors="replace"):
            break
    return run_id


@contextmanager
def local_superlink(home: Path) -> Iterator[SuperLink]:
    """Start a SuperLink in simulation mode on a free port, with `home` as FLWR_HOME, and stop it at the end.

    Raises:
        FlowerRunError: it did not answer within two minutes.
    """
    port = _free_port()
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])  # Flower calls its programs
    environment = {**os.environ, **OFFLINE, "FLWR_HOME": str(home), "PATH": path}
    connection = f'[superlink.{CONNECTION}]\naddress = "127.0.0.1:{port}"\ninsecure = true\n'
    (home / "config.toml").write_text(f'[superlink]\ndefault = "{CONNECTION}"\n\n{connection}')
    log = home / "superlink.log"
    command = [_program("flower-superlink"), "--insecure", "--simulation", "--host", "127.0.0.1", "--port", str(port)]
    with open(log, "wb") as output:
        process = subprocess.Popen(command, env=environment, stdout=output, stderr=output, start_new_session=True)
    try:
        _wait_until_up(process, port, log)
        yield SuperLink(environment, home / "run.log")
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


def write_settings(folder: Path, config: Config) -> Path:
    """Write ``folder/settings.toml`` for ``--run-config`` and return it: JSON's scalars are TOML's."""
    path = folder / "settings.toml"
    path.write_text("".join(f"{key} = {json.dumps(value)}\n" for key, value in to_run_config(config).items()))
    return path


def _absolute(name: str) -> str:
    """Flower's processes choose their own working directory; a hub id stays as it is."""
    return str(Path(name).resolve()) if name and Path(name).exists() else name


def _require_completed(link: SuperLink, run_id: str) -> None:
    """`flwr run` exits with 0 for failed runs too, so ask; the status may lag behind the end of the log."""
    for _ in range(STATUS_TRIES):
        status, details = link.status(run_id)
        if status.startswith("finished"):
            break
        time.sleep(POLL_S)
    if status != "finished:completed":
        raise FlowerRunError(f"run {run_id} is {status} ({details}); {_reason(link.log)}")


def _wait_until_up(process: subprocess.Popen, port: int, log: Path) -> None:
    deadline = time.monotonic() + STARTUP_S
    while not _answers(port):
        if process.poll() is not None:
            raise FlowerRunError(f"the SuperLink ended with status {process.poll()}; {_reason(log)}")
        if time.monotonic() > deadline:
            raise FlowerRunError(f"the SuperLink did not answer within {STARTUP_S:.0f} s; {_reason(log)}")
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


def _reason(log: Path) -> str:
    """The first exception of a log, which is the cause of those after it, and how the log ends."""
    text = log.read_text(errors="replace")
    found = FIRST_ERROR.search(text)
    cause = f"it began with {_one_line(found[1])}; " if found else ""
    return f"{cause}its log ends: {_one_line(text)}"


def _one_line(text: str) -> str:
    return " ".join(text.split())[-800:]
