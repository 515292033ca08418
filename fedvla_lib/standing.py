"""A SuperLink that stays up between commands, for `flwr run . local-simulation` in a shell.

`flwr run` would start one by itself, and gives it 15 s, which a cold machine with two cores does not make. This one is
started first, waited for, and stopped by name; its connection file, `connections.toml`, comes with the package.
"""

import json
import shutil
import tomllib
from pathlib import Path

import psutil

from fedvla_lib import superlink
from fedvla_lib.run_folder import write_json
from fedvla_lib.superlink import FlowerRunError

CONNECTIONS = Path(__file__).resolve().parent / "connections.toml"


def up(home: Path) -> str:
    """Start the SuperLink of the connection file with `home` as FLWR_HOME, and say where it is once it answers.

    Raises:
        FlowerRunError: it did not answer within two minutes; nothing is left running.
        ValueError: something else uses its port.
    """
    if process := _running(home):
        return f"{_where()} is up already, process {process.pid}"
    port = int(_where().rsplit(":", 1)[1])
    if not superlink.is_free(port):
        raise ValueError(f"port {port} is used by another program: stop it, or change the port in {CONNECTIONS}")
    home.mkdir(parents=True, exist_ok=True)
    shutil.copy(CONNECTIONS, home / "config.toml")
    command = ["flower-superlink", "--insecure", "--simulation", "--host", "127.0.0.1", "--port", str(port)]
    process = superlink.start(command, superlink.flower_environment(home), log := home / "superlink.log")
    try:
        superlink.wait_until(lambda: superlink.answers(port), process, log, "the SuperLink")
    except FlowerRunError:
        superlink.stop(process)
        raise
    write_json(home / "superlink.json", {"pid": process.pid, "created": psutil.Process(process.pid).create_time()})
    return f"{_where()} is up, process {process.pid}; its log is {log}"


def down(home: Path) -> str:
    """Stop the SuperLink and all that it started, and say so."""
    if not (process := _running(home)):
        return f"{_where()} is not up"
    family = [*process.children(recursive=True), process]
    process.terminate()
    _, left = psutil.wait_procs(family, timeout=15)
    for survivor in left:
        survivor.kill()
    (home / "superlink.json").unlink()
    return f"{_where()} is down"


def status(home: Path) -> tuple[bool, str]:
    """Return whether the SuperLink is up, and words for it."""
    process = _running(home)
    return bool(process), f"{_where()} is {'up, process ' + str(process.pid) if process else 'not up'}"


def _running(home: Path) -> psutil.Process | None:
    """Return the process that `up` started, if it lives: the same number may belong to another one by now."""
    file = home / "superlink.json"
    known = json.loads(file.read_text()) if file.is_file() else {"pid": 0, "created": 0.0}
    try:
        process = psutil.Process(known["pid"])
        return process if process.create_time() == known["created"] and process.is_running() else None
    except psutil.NoSuchProcess:
        return None


def _where() -> str:
    return tomllib.loads(CONNECTIONS.read_text())["superlink"]["local-simulation"]["address"]
