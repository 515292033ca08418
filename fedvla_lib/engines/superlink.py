"""Wrappers of Flower's programs: a local SuperLink, `flwr run`, and the final status of a run.

Flower's own `flwr run` gives the SuperLink that it starts only 15 s, and exits with 0 even if the run failed.
"""

import json
import os
import re
import ssl
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fedvla_lib.engines.credentials import ServerFiles
from fedvla_lib.engines.guard import guarded
from fedvla_lib.engines.processes import FlowerRunError, free_port, one_line, reason, start, stop, wait_until
from fedvla_lib.engines.warm_start import ray_python, warm_start

STATUS_TRIES, POLL_S = 30, 1.0
COMPLETED = "finished:completed"
OFFLINE = {  # no telemetry or update checks
    "FLWR_TELEMETRY_ENABLED": "0",
    "FLWR_DISABLE_UPDATE_CHECK": "1",
    "FLWR_DISABLE_RUNTIME_DEPENDENCY_INSTALLATION": "1",
    "RAY_USAGE_STATS_ENABLED": "0",
}
PROMPT = {"FLWR_SUPEREXEC_TASK_POLL_INTERVAL": "0.25"}  # seconds until Flower sees that a process is to be started
CONNECTION = "book"


@dataclass(frozen=True)
class SuperLink:
    """A running SuperLink and the environment in which `flwr` finds it."""

    environment: dict[str, str]
    log: Path  # output of `flwr run`
    port: int = 0
    files: ServerFiles | None = None  # certificates, with TLS
    connection: str = CONNECTION  # its name in Flower's config.toml

    def submit(self, app: Path, *options: str, timeout_s: float, watch: Callable[[], None] = lambda: None) -> str:
        """Start a run of the app, follow its log until the run ends, and return its id; call `watch` every second.

        The log is followed because polling with `flwr` would cost seconds of CPU time per call.

        Raises:
            FlowerRunError: the run was not accepted or timed out.
        """
        command = ["flwr", "run", str(app), self.connection, *options, "--stream"]
        deadline = time.monotonic() + timeout_s
        with open(self.log, "wb") as log:
            process = subprocess.Popen(command, env=self.environment, stdout=log, stderr=subprocess.STDOUT)
            try:
                while process.poll() is None:
                    if time.monotonic() > deadline:
                        raise FlowerRunError(f"the run did not end within {timeout_s:.0f} s: {reason(self.log)}")
                    watch()
                    time.sleep(POLL_S)
                watch()
            finally:
                process.kill()
        accepted = re.search(r"Successfully started run (\d+)", self.log.read_text(errors="replace"))
        if not accepted:
            raise FlowerRunError(f"flwr run failed: {reason(self.log)}")
        return accepted[1]

    def ask(self, *command: str) -> dict[str, Any]:
        """Run a `flwr` command and return its JSON output.

        Raises:
            FlowerRunError: the command failed.
        """
        arguments = ["flwr", *command, "--format", "json"]
        done = subprocess.run(arguments, env=self.environment, capture_output=True, text=True)
        if "{\n" not in done.stdout:
            raise FlowerRunError(f"flwr {command[0]} failed: {one_line(done.stderr or done.stdout)}")
        answer = json.loads(done.stdout[done.stdout.find("{\n") :])
        if not answer.get("success", True):
            raise FlowerRunError(f"flwr {command[0]} failed: {one_line(answer.get('error-message', done.stdout))}")
        return answer


@contextmanager
def local_superlink(
    home: Path, *options: str, files: ServerFiles | None = None, host: str = "127.0.0.1"
) -> Iterator[SuperLink]:
    """Start a SuperLink on a free port of this machine, with `home` as FLWR_HOME, and stop it at the end.

    If this process is killed, all that was started with that home ends too.

    Args:
        options: of ``flower-superlink``, such as ``--simulation``.
        files: certificates; without them the connection is not encrypted.
        host: address on which it listens.

    Raises:
        FlowerRunError: the SuperLink did not answer within two minutes.
    """
    port = free_port()
    secure = f"root-certificates = {json.dumps(str(files.authority))}" if files else "insecure = true"
    connection = f'[superlink.{CONNECTION}]\naddress = "127.0.0.1:{port}"\n{secure}\n'
    (home / "config.toml").write_text(f'[superlink]\ndefault = "{CONNECTION}"\n\n{connection}')
    protection = ["--insecure"]
    if files:
        protection = ["--ssl-ca-certfile", str(files.authority), "--ssl-certfile", str(files.certificate)]
        protection += ["--ssl-keyfile", str(files.key)]
    command = ["flower-superlink", *protection, *options, "--host", host, "--port", str(port)]
    with guarded(home), warm_start(flower_environment(home), home / "fork_server.log") as environment:
        process = start(command, environment, log := home / "superlink.log")
        try:
            wait_until(lambda: answers(port, files), process, log, "the SuperLink")
            yield SuperLink(environment, home / "run.log", port, files)
        finally:
            stop(process)


def flower_environment(home: Path) -> dict[str, str]:
    """Return the environment of Flower's programs, with `home` as FLWR_HOME and without telemetry.

    Colours are switched off: Jupyter forces them on, and they would corrupt the JSON that `ask` reads.
    """
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])  # they call each other
    plain = {key: value for key, value in os.environ.items() if key not in ("FORCE_COLOR", "CLICOLOR_FORCE")}
    ray = ray_python(sys.executable)
    return {**plain, **OFFLINE, **PROMPT, **ray, "NO_COLOR": "1", "FLWR_HOME": str(home), "PATH": path}


def require_completed(link: SuperLink, run_id: str) -> None:
    """Check how a run ended, since `flwr run` exits with 0 also for failed runs.

    Raises:
        FlowerRunError: the run did not complete.
    """
    status, details = last_status(link, run_id)
    if status != COMPLETED:
        raise FlowerRunError(f"run {run_id} is {status} ({details}); {reason(link.log)}")


def last_status(link: SuperLink, run_id: str) -> tuple[str, str]:
    """Return the status, such as ``finished:completed``, and details of a run whose log has ended.

    The status is polled for up to half a minute, since it may lag behind the log.
    """
    for _ in range(STATUS_TRIES):
        runs = link.ask("list", link.connection, "--run-id", run_id).get("runs")
        if not runs:
            raise FlowerRunError(f"flwr list does not know run {run_id}")
        if runs[0]["status"].startswith("finished"):
            break
        time.sleep(POLL_S)
    return runs[0]["status"], runs[0].get("status-details") or "no details"


def answers(port: int, files: ServerFiles | None = None) -> bool:
    """Return whether a SuperLink on this machine reports that it is healthy."""
    scheme, trust = ("https", ssl.create_default_context(cafile=files.authority)) if files else ("http", None)
    try:
        with urllib.request.urlopen(f"{scheme}://127.0.0.1:{port}/health", timeout=2, context=trust) as response:
            return response.status == 200
    except OSError:
        return False
