"""Start, wait for and stop local programs, and extract the reason of a failure from their logs."""

import os
import re
import signal
import socket
import subprocess
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

import psutil

STARTUP_S = 120.0  # a two-core machine needs 10 to 40 s just after a boot
FIRST_ERROR = re.compile(r"Traceback \(most recent call last\):\n(?:[ \t].*\n|\n)*(\S.*)$", re.MULTILINE)


class FlowerRunError(RuntimeError):
    """The SuperLink did not start, or the run did not complete; the message quotes Flower's log."""


def start(
    command: list[str], environment: dict[str, str], log: Path, stdin: socket.socket | None = None
) -> subprocess.Popen:
    """Start a program of the environment's PATH in a new session, so that `stop` also ends its child processes."""
    with open(log, "ab") as output:
        return subprocess.Popen(
            command, env=environment, stdin=stdin, stdout=output, stderr=output, start_new_session=True
        )


def wait_until(is_up: Callable[[], bool], process: subprocess.Popen, log: Path, what: str) -> None:
    """Wait until a program is ready.

    Raises:
        FlowerRunError: the program ended or was not ready within two minutes; with the reason from its log.
    """
    deadline = time.monotonic() + STARTUP_S
    while not is_up():
        if process.poll() is not None:
            raise FlowerRunError(f"{what} ended with status {process.poll()}; {reason(log)}")
        if time.monotonic() > deadline:
            raise FlowerRunError(f"{what} was not ready within {STARTUP_S:.0f} s; {reason(log)}")
        time.sleep(0.1)


def stop(
    process: subprocess.Popen | psutil.Process,
    signals: Sequence[signal.Signals] = (signal.SIGTERM, signal.SIGKILL),
) -> None:
    """Send each signal in turn to a program and its process group until it has ended, then kill its descendants.

    Flower starts helpers in sessions of their own, and its server app outlives a SIGTERM when its SuperLink is gone.
    """
    try:
        leader = psutil.Process(process.pid)
        descendants = leader.children(recursive=True)
    except psutil.NoSuchProcess:
        return
    for number in signals:
        with suppress(ProcessLookupError, psutil.TimeoutExpired):
            os.killpg(process.pid, number)
            leader.wait(timeout=15)
            break
    for descendant in descendants:
        with suppress(psutil.NoSuchProcess):
            descendant.kill()


def is_free(port: int) -> bool:
    """Return whether no program on this machine listens on a port."""
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) != 0


def free_port() -> int:
    """Return a free port."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def reason(log: Path) -> str:
    """Return the first exception in a log, which caused any later ones, and the end of the log."""
    text = log.read_text(errors="replace")
    first = FIRST_ERROR.search(text)
    return (f"it began with {one_line(first[1])}; " if first else "") + f"its log ends: {one_line(text)}"


def one_line(text: str) -> str:
    return " ".join(text.split())[-800:]
