"""Start, wait for and stop programs of this machine, and read from their logs why they failed."""

import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

STARTUP_S = 120.0  # a cold two-core machine needs about 10 to 40 s
FIRST_ERROR = re.compile(r"Traceback \(most recent call last\):\n(?:[ \t].*\n|\n)*(\S.*)$", re.MULTILINE)


class FlowerRunError(RuntimeError):
    """The SuperLink did not start, or the run did not complete; the message holds Flower's own words."""


def start(command: list[str], environment: dict[str, str], log: Path) -> subprocess.Popen:
    """Start one of Flower's programs in a session of its own, which `stop` ends whole."""
    command = [program(command[0]), *command[1:]]
    with open(log, "ab") as output:
        return subprocess.Popen(command, env=environment, stdout=output, stderr=output, start_new_session=True)


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
