"""Start Flower's app processes by forking a process that has already loaded the heavy libraries.

Flower starts a process for every message to a SuperNode, and Ray one for every worker. Each would import PyTorch and
LeRobot, which takes eight seconds. Nothing depends on this module: without it, each process does just that.
"""

import json
import os
import shlex
import socket
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from fedvla_lib.engines import processes

FORK_SERVER = Path(__file__).with_name("fork_server.py")
PROGRAMS = ("flwr-clientapp", "flwr-serverapp", "flwr-simulation")
# Not this library: the app that is sent to clients has its own copy, and that is the one to run. Not Ray and MuJoCo,
# which read the environment when they are imported.
MODULES = (
    "lerobot.policies.smolvla", "lerobot.datasets", "flwr.serverapp.strategy", "flwr.supernode.cli",
    "flwr.superlink.cli", "flwr.simulation.app",
)  # fmt: skip
LONGEST_ADDRESS = 107  # bytes in the path of a Unix socket


@contextmanager
def warm_start(environment: dict[str, str], log: Path) -> Iterator[dict[str, str]]:
    """Start a fork server, yield the environment in which Flower's programs use it, and stop it at the end.

    Only on Linux: macOS has libraries that do not survive a fork. Elsewhere the environment is yielded as it is.
    """
    with tempfile.TemporaryDirectory(prefix="fedvla-fork-") as folder:  # only its owner can read it
        address = os.path.join(folder, "socket")
        if sys.platform != "linux" or len(os.fsencode(address)) > LONGEST_ADDRESS:
            yield environment
            return
        with socket.socket(socket.AF_UNIX) as listener:
            listener.bind(address)
            listener.listen(128)  # calls wait here until the server has loaded its modules
            command = [sys.executable, "-P", str(FORK_SERVER), "serve", *MODULES]
            server = processes.start(command, environment, log, listener)
        try:
            python = _write_stand_ins(Path(folder), address)
            path = os.pathsep.join([folder, environment["PATH"]])
            yield {**environment, **ray_python(python), "PATH": path}
        finally:
            processes.stop(server)


def ray_python(python: str | Path) -> dict[str, str]:
    """Return the environment with which Ray starts its workers with an interpreter."""
    # Ray pastes the path into a shell command unquoted, which fails if a folder's name has a space.
    return {"RAY_JOB_CONFIG_JSON_ENV_VAR": json.dumps({"runtime_env": {"py_executable": shlex.quote(str(python))}})}


def _write_stand_ins(folder: Path, address: str) -> Path:
    """Write a script for each program that calls the fork server, and return the one for the interpreter."""
    call = shlex.join([sys.executable, "-IS", str(FORK_SERVER), "call", address])  # without site-packages: faster
    scripts = {name: [processes.program(name)] for name in PROGRAMS}
    for name, command in {**scripts, "python": []}.items():
        script = folder / name
        script.write_text(f'#!/bin/sh\nexec {call} {shlex.join(command)} "$@"\n')
        script.chmod(0o700)
    return folder / "python"
