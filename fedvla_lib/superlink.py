"""Flower's own programs as this library starts them: a local SuperLink, `flwr run`, and the run's real status.

`run_simulation` runs the app on Flower's simulation runtime; `deploy` adds SuperNodes to a SuperLink from here.

These are the documented commands, wrapped because four of their habits trip a small machine: the SuperLink that
`flwr run` starts by itself gives up after 15 s, a client asks for two cores, a failed run still exits with 0, and Ray,
which runs the clients, gives up if its own processes take long to start.
"""

import json
import os
import re
import shutil
import signal
import socket
import ssl
import subprocess
import sys
import tempfile
import time
import tomllib
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from fedvla_lib import run_folder
from fedvla_lib.config import Config, check, to_run_config
from fedvla_lib.credentials import ServerFiles

STARTUP_S = 120.0  # a cold two-core machine needs about 10 to 40 s
STATUS_TRIES, POLL_S = 6, 5.0
COMPLETED = "finished:completed"
# Ray 2.55 gives its server and its raylet 30 s each to come up, and each of the raylet's helpers 15 s. All of that is
# fixed in its code; a busy machine misses it, seldom twice.
RUNTIME_TRIES = 3
NOT_STARTED = "Simulation Runtime crashed"  # what Flower says if Ray did not come up, before any client was asked
FIRST_ERROR = re.compile(r"Traceback \(most recent call last\):\n(?:[ \t].*\n|\n)*(\S.*)$", re.MULTILINE)
OFFLINE = {  # Flower and Ray ask the network nothing
    "FLWR_TELEMETRY_ENABLED": "0",
    "FLWR_DISABLE_UPDATE_CHECK": "1",
    "FLWR_DISABLE_RUNTIME_DEPENDENCY_INSTALLATION": "1",
    "RAY_USAGE_STATS_ENABLED": "0",
}
CONNECTION = "book"
PROJECT = "fedvla-lib"  # as pyproject.toml and the installed package name it


class FlowerRunError(RuntimeError):
    """The SuperLink did not start, or the run did not complete; the message holds Flower's own words."""


@dataclass(frozen=True)
class SuperLink:
    """A SuperLink that is up, and the environment in which `flwr` finds it."""

    environment: dict[str, str]
    log: Path  # what the run printed
    port: int = 0
    files: ServerFiles | None = None  # of a SuperLink with TLS
    connection: str = CONNECTION  # its name in Flower's file of them

    def submit(self, app: Path, *options: str, timeout_s: float, watch: Callable[[], None] = lambda: None) -> str:
        """Start a run of the app, follow its log until the run ends, and return its id.

        Following costs nothing, while each further `flwr` command costs seconds of computing time. Meanwhile `watch` is
        called every second.

        Raises:
            FlowerRunError: the run was not accepted, or did not end in time.
        """
        command = [program("flwr"), "run", str(app), self.connection, *options, "--stream"]
        with open(self.log, "wb") as log:
            process = subprocess.Popen(command, env=self.environment, stdout=log, stderr=subprocess.STDOUT)
            try:
                _follow(process, timeout_s, watch)
            except subprocess.TimeoutExpired as error:
                raise FlowerRunError(f"the run did not end within {timeout_s:.0f} s: {reason(self.log)}") from error
            finally:
                process.kill()
        accepted = re.search(r"Successfully started run (\d+)", self.log.read_text(errors="replace"))
        if not accepted:
            raise FlowerRunError(f"flwr run failed: {reason(self.log)}")
        return accepted[1]

    def status(self, run_id: str) -> tuple[str, str]:
        """Return a run's status, such as ``running`` or ``finished:completed``, and its details."""
        answer = self.ask("list", self.connection, "--run-id", run_id)
        if not answer.get("runs"):
            raise FlowerRunError(f"flwr list knows no run {run_id}")
        return answer["runs"][0]["status"], answer["runs"][0].get("status-details") or "no details"

    def ask(self, *command: str) -> dict[str, Any]:
        """Return the JSON that a `flwr` command answers.

        Raises:
            FlowerRunError: the command failed.
        """
        whole = [program("flwr"), *command, "--format", "json"]
        done = subprocess.run(whole, env=self.environment, capture_output=True, text=True)
        if "{\n" not in done.stdout:
            raise FlowerRunError(f"flwr {command[0]} failed: {_one_line(done.stderr or done.stdout)}")
        answer = json.loads(done.stdout[done.stdout.find("{\n") :])
        if not answer.get("success", True):
            raise FlowerRunError(f"flwr {command[0]} failed: {_one_line(answer.get('error-message', done.stdout))}")
        return answer


def run_simulation(
    config: Config, *, cpus_per_client: int = 1, gpus_per_client: float = 0.0, timeout_s: float = 24 * 3600.0
) -> Path:
    """Run a federation on Flower's simulation runtime (Ray workers) and return its run folder.

    Raises:
        FlowerRunError: the run failed, or did not finish in time.
        ValueError: unusable settings.
    """
    config = check(replace(absolute(config), num_threads=config.num_threads or cpus_per_client))
    before = run_folders(config)
    resources = f"client-resources-num-cpus={cpus_per_client} client-resources-num-gpus={gpus_per_client}"
    with tempfile.TemporaryDirectory(prefix="fedvla-flower-") as folder:
        app, settings = stage_app(Path(folder)), write_settings(Path(folder), config)
        with local_superlink(Path(folder), "--simulation") as link:
            federation = f"num-supernodes={config.num_clients} {resources}"
            options = ["--federation-config", federation, "--run-config", str(settings)]
            require_completed(link, _submit(link, app, options, timeout_s))
    return own_run(config, before)


def _submit(link: SuperLink, app: Path, options: list[str], timeout_s: float) -> str:
    """Run the app, again if Flower's runtime did not come up, and return the id of the last run."""
    for _ in range(RUNTIME_TRIES):
        run_id = link.submit(app, *options, timeout_s=timeout_s)
        if NOT_STARTED not in link.log.read_text(errors="replace"):
            break
    return run_id


@contextmanager
def local_superlink(home: Path, *options: str, files: ServerFiles | None = None) -> Iterator[SuperLink]:
    """Start a SuperLink on a free port of this machine, with `home` as FLWR_HOME, and stop it at the end.

    Args:
        options: for ``flower-superlink``, such as ``--simulation``.
        files: certificates; without them the connection is not encrypted.

    Raises:
        FlowerRunError: it did not answer within two minutes.
    """
    port = free_port()
    environment = flower_environment(home)
    secure = f"root-certificates = {json.dumps(str(files.authority))}" if files else "insecure = true"
    connection = f'[superlink.{CONNECTION}]\naddress = "127.0.0.1:{port}"\n{secure}\n'
    (home / "config.toml").write_text(f'[superlink]\ndefault = "{CONNECTION}"\n\n{connection}')
    protection = ["--insecure"]
    if files:
        protection = ["--ssl-ca-certfile", str(files.authority), "--ssl-certfile", str(files.certificate)]
        protection += ["--ssl-keyfile", str(files.key)]
    command = ["flower-superlink", *protection, *options, "--host", "127.0.0.1", "--port", str(port)]
    process = start(command, environment, log := home / "superlink.log")
    try:
        wait_until(lambda: answers(port, files), process, log, "the SuperLink")
        yield SuperLink(environment, home / "run.log", port, files)
    finally:
        stop(process)


def flower_environment(home: Path) -> dict[str, str]:
    """Return the environment of Flower's programs: their files in `home`, no network but what they are told.

    Notebooks ask every program for colours, which would stand inside the JSON that `ask` reads.
    """
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])  # they call each other
    plain = {key: value for key, value in os.environ.items() if key not in ("FORCE_COLOR", "CLICOLOR_FORCE")}
    return {**plain, **OFFLINE, "NO_COLOR": "1", "FLWR_HOME": str(home), "PATH": path}


def start(command: list[str], environment: dict[str, str], log: Path) -> subprocess.Popen:
    """Start one of Flower's programs in a session of its own, which `stop` ends whole."""
    command = [program(command[0]), *command[1:]]
    with open(log, "ab") as output:
        return subprocess.Popen(command, env=environment, stdout=output, stderr=output, start_new_session=True)


def stage_app(folder: Path) -> Path:
    """Copy what the Flower app needs into ``folder/app`` and return it: `flwr` would search the whole checkout.

    A library that was installed from its wheel has no project file beside it; the app then gets one of its own.
    """
    package = Path(__file__).resolve().parent
    app = folder / "app"
    shutil.copytree(package, app / package.name, ignore=shutil.ignore_patterns("__pycache__"), dirs_exist_ok=True)
    if _is_checkout(package.parent):
        for name in ("pyproject.toml", "README.md", "LICENSE"):
            shutil.copy(package.parent / name, app / name)
    else:
        (app / "pyproject.toml").write_text(_project_file(package.name))
    return app


def _is_checkout(folder: Path) -> bool:
    """Whether this is the project's own folder: a stranger's pyproject.toml may lie in site-packages."""
    project = folder / "pyproject.toml"
    return project.is_file() and tomllib.loads(project.read_text()).get("project", {}).get("name") == PROJECT


def _project_file(package: str) -> str:
    """Return the least that `flwr` takes as a project: a name, the two apps, the settings and what to bundle."""
    try:
        release = version(PROJECT)
    except PackageNotFoundError:  # a copied folder
        release = "0"
    tables = {
        "project": {"name": PROJECT, "version": release, "description": "", "license": "Apache-2.0"},
        "tool.flwr.app": {"publisher": "fedvla", "fab-include": [f"{package}/**/*.py"]},
        "tool.flwr.app.components": {
            "serverapp": f"{package}.server_app:app", "clientapp": f"{package}.client_app:app",
        },
        "tool.flwr.app.config": to_run_config(Config()),
    }  # fmt: skip
    return "\n".join(f"[{name}]\n{_toml(values)}" for name, values in tables.items())


def write_settings(folder: Path, config: Config) -> Path:
    """Write ``folder/settings.toml`` for ``--run-config`` and return it."""
    path = folder / "settings.toml"
    path.write_text(_toml(to_run_config(config)))
    return path


def _toml(values: dict[str, Any]) -> str:
    """Return the lines of a table: JSON's scalars and lists of them are TOML's."""
    return "".join(f"{key} = {json.dumps(value)}\n" for key, value in values.items())


def absolute(config: Config) -> Config:
    """Return settings with absolute paths: Flower's processes choose their own working directory. Hub ids stay."""
    paths = {name: getattr(config, name) for name in ("data", "base", "resume")}
    found = {name: str(Path(path).resolve()) for name, path in paths.items() if path and Path(path).exists()}
    return replace(config, out=str(Path(config.out).resolve()), **found)


def run_folders(config: Config) -> set[Path]:
    """Return the run folders there are where `config` writes."""
    return {stamp.parent for stamp in Path(config.out).glob("*/stamp.json")}


def own_run(config: Config, before: set[Path]) -> Path | None:
    """Return the folder that a run writes: the one to be resumed, or the newest with its settings not in `before`.

    Others may write to the same place meanwhile. None: it has not begun.
    """
    if config.resume:
        return Path(config.resume)
    wanted, new = run_folder.config_hash(config), run_folders(config) - before
    return max((r for r in new if run_folder.config_hash(run_folder.read_config(r)) == wanted), default=None)


def require_completed(link: SuperLink, run_id: str) -> None:
    """Ask how a run ended: `flwr run` exits with 0 for failed runs too, and the status may lag behind the log's end.

    Raises:
        FlowerRunError: it did not complete.
    """
    status, details = last_status(link, run_id)
    if status != COMPLETED:
        raise FlowerRunError(f"run {run_id} is {status} ({details}); {reason(link.log)}")


def last_status(link: SuperLink, run_id: str) -> tuple[str, str]:
    """Return status and details of a run whose log has ended, once they say so, or after half a minute."""
    for _ in range(STATUS_TRIES):
        status, details = link.status(run_id)
        if status.startswith("finished"):
            break
        time.sleep(POLL_S)
    return status, details


def wait_until(is_up: Callable[[], bool], process: subprocess.Popen, log: Path, what: str) -> None:
    """Wait for a program to be ready.

    Raises:
        FlowerRunError: it ended, or was not ready within two minutes; with the reason from its log.
    """
    deadline = time.monotonic() + STARTUP_S
    while not is_up():
        if process.poll() is not None:
            raise FlowerRunError(f"{what} ended with status {process.poll()}; {reason(log)}")
        if time.monotonic() > deadline:
            raise FlowerRunError(f"{what} was not ready within {STARTUP_S:.0f} s; {reason(log)}")
        time.sleep(0.5)


def answers(port: int, files: ServerFiles | None = None) -> bool:
    """Whether a SuperLink on this machine says that it is well."""
    scheme, trust = ("https", ssl.create_default_context(cafile=files.authority)) if files else ("http", None)
    try:
        with urllib.request.urlopen(f"{scheme}://127.0.0.1:{port}/health", timeout=2, context=trust) as response:
            return response.status == 200
    except (urllib.error.URLError, OSError):
        return False


def _follow(process: subprocess.Popen, timeout_s: float, watch: Callable[[], None]) -> None:
    """Wait for a process, calling `watch` every second and once at the end."""
    deadline = time.monotonic() + timeout_s
    while True:
        try:
            process.wait(min(1.0, max(0.0, deadline - time.monotonic())))
            return watch()
        except subprocess.TimeoutExpired:
            watch()
            if time.monotonic() > deadline:
                raise


def stop(process: subprocess.Popen, signs: Sequence[signal.Signals] = (signal.SIGTERM, signal.SIGKILL)) -> None:
    """End a program and the processes it started, which share its session: politely, then by force."""
    for sign in signs:
        try:
            os.killpg(process.pid, sign)
            process.wait(timeout=15)
        except ProcessLookupError:
            return
        except subprocess.TimeoutExpired:
            continue


def program(name: str) -> str:
    """Return a command of this interpreter's environment, whether or not that is on PATH."""
    beside = Path(sys.executable).parent / name
    return str(beside) if beside.exists() else name


def is_free(port: int) -> bool:
    """Whether nothing on this machine listens on a port."""
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) != 0


def free_port() -> int:
    """Return a port that nothing listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def reason(log: Path) -> str:
    """Return the first exception of a log, which is the cause of those after it, and how the log ends."""
    text = log.read_text(errors="replace")
    found = FIRST_ERROR.search(text)
    cause = f"it began with {_one_line(found[1])}; " if found else ""
    return f"{cause}its log ends: {_one_line(text)}"


def _one_line(text: str) -> str:
    return " ".join(text.split())[-800:]
