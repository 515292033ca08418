"""Start Flower's app processes by forking a process that has already loaded the heavy libraries.

Flower starts a process for every message to a SuperNode, and Ray one for every worker. Each would import PyTorch and
LeRobot, which takes eight seconds. Nothing depends on this module: without it, each process does just that.
"""

import json
import os
import shlex
import shutil
import socket
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

from fedvla_lib.engines import processes

FORK_SERVER = Path(__file__).with_name("fork_server.py")
# What two fork servers load, and the programs that they run: Flower's own need not wait for the libraries of an app.
# Not this library: an app that is sent to clients has its own copy, and that is the one to run. Not Ray and MuJoCo,
# which read the environment when they are imported.
FLOWER = ("flwr.cli.app", "flwr.supercore.cli", "flwr.superlink.cli", "flwr.supernode.cli", "flwr.simulation.app")
APP = ("lerobot.policies.smolvla", "lerobot.datasets", "flwr.serverapp.strategy")
SERVERS = {
    ("flwr", "flower-superexec"): FLOWER,
    ("flwr-clientapp", "flwr-serverapp", "flwr-simulation", PYTHON := "python-of-ray"): FLOWER + APP,
}
LONGEST_FOLDER = 98  # bytes: the path of a Unix socket may have 107


@contextmanager
def warm_start(environment: dict[str, str], log: Path) -> Iterator[dict[str, str]]:
    """Start the fork servers, yield the environment in which Flower's programs use them, and stop them at the end.

    Only on Linux: macOS has libraries that do not survive a fork. Elsewhere the environment is yielded as it is.
    """
    with tempfile.TemporaryDirectory(prefix="fedvla-fork-") as folder, ExitStack() as running:  # for its owner only
        if sys.platform != "linux" or len(os.fsencode(folder)) > LONGEST_FOLDER:
            yield environment
            return
        for number, (programs, modules) in enumerate(SERVERS.items()):
            address = os.path.join(folder, f"socket-{number}")
            command = [sys.executable, "-P", str(FORK_SERVER), "serve", *modules]
            with socket.socket(socket.AF_UNIX) as listener:  # calls wait in its queue until the modules are loaded
                listener.bind(address)
                listener.listen(128)
                running.callback(processes.stop, processes.start(command, environment, log, listener))
            _write_stand_ins(Path(folder), programs, address, environment["PATH"])
        path = os.pathsep.join([folder, environment["PATH"]])
        yield {**environment, **ray_python(os.path.join(folder, PYTHON)), "PATH": path}


def ray_python(python: str) -> dict[str, str]:
    """Return the environment with which Ray starts its workers with an interpreter."""
    # Ray pastes the path into a shell command unquoted, which fails if a folder's name has a space.
    return {"RAY_JOB_CONFIG_JSON_ENV_VAR": json.dumps({"runtime_env": {"py_executable": shlex.quote(python)}})}


def _write_stand_ins(folder: Path, programs: Sequence[str], address: str, path: str) -> None:
    """Write a script for each program on `path` that has a fork server run it."""
    call = [sys.executable, "-IS", str(FORK_SERVER), "call", address]  # without site-packages: faster
    for name in programs:
        command = shlex.join(call if name == PYTHON else [*call, shutil.which(name, path=path) or name])
        (folder / name).write_text(f'#!/bin/sh\nexec {command} "$@"\n')
        (folder / name).chmod(0o700)
