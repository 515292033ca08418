"""Nothing of a SuperLink outlives the process that started it, even if that is killed.

Flower's programs start others in sessions of their own, so no signal reaches them all. They inherit FLWR_HOME, by which
this module finds them. Run as a program, it waits until the pipe from its parent closes, however the parent ended.
"""

import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import psutil

SECRETS = ("keys", "server")  # folders with private keys in the home of a deployment
ENDED = b"ended"  # the parent stopped everything itself
TRIES = 3
FRESH_S = 60.0  # a home without processes may be of a deployment that just starts


@contextmanager
def guarded(home: Path) -> Iterator[None]:
    """End all processes with a FLWR_HOME in `home`, and delete their keys, if this process is killed in the block."""
    command = [sys.executable, "-m", __name__, str(home)]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    watcher = subprocess.Popen(command, stdin=subprocess.PIPE, start_new_session=True, **quiet)
    try:
        yield
    finally:
        watcher.communicate(ENDED)


def clear(prefix: str) -> None:
    """Delete temporary homes with names that begin with `prefix` and that no process uses any more."""
    for home in Path(tempfile.gettempdir()).glob(f"{prefix}*"):
        with suppress(OSError):  # another user's, or deleted meanwhile
            if time.time() - home.stat().st_mtime > FRESH_S and not _processes(home):
                shutil.rmtree(home)


def _processes(home: Path) -> list[psutil.Process]:
    """Return the processes of a home, this one aside."""
    found = []
    for process in psutil.process_iter():
        with suppress(psutil.Error):
            used = process.environ().get("FLWR_HOME")
            if used and Path(used).is_relative_to(home) and process.pid != psutil.Process().pid:
                found.append(process)
    return found


def _end(home: Path) -> None:
    for _ in range(TRIES):  # killed ones may just have started others
        found = _processes(home)
        for process in found:
            with suppress(psutil.NoSuchProcess):
                process.kill()
        psutil.wait_procs(found, timeout=5)
    for name in SECRETS:
        shutil.rmtree(home / name, ignore_errors=True)


if __name__ == "__main__":
    if sys.stdin.buffer.read() != ENDED:
        _end(Path(sys.argv[1]))
