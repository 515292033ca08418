"""A SuperLink that runs as a service between commands, for `flwr run . local-simulation` in a shell.

`flwr run` can start one by itself, but gives it only 15 s, too little for a two-core machine just after a boot. The
connections it serves are in `connections.toml`.
"""

import re
import tomllib
from pathlib import Path
from typing import TypedDict

import psutil

from fedvla_lib.engines import processes, superlink
from fedvla_lib.files import read_json, write_atomically, write_json

CONNECTIONS = Path(__file__).resolve().parent / "connections.toml"
NAME = "local-simulation"
SECTION = re.compile(r"^(?=\[superlink\.)", re.MULTILINE)  # start of a connection's table


def up(home: Path) -> str:
    """Start the SuperLink with `home` as FLWR_HOME, wait until it answers, and return a status message.

    If it does not answer or the call is interrupted, no process is left running.

    Raises:
        FlowerRunError: the SuperLink did not answer within two minutes.
        ValueError: its port is in use, or the user's own connections conflict with this project's.
    """
    if process := _running(home):
        return f"{_address()} is already up, process {process.pid}"
    port = int(_address().rsplit(":", 1)[1])
    if not processes.is_free(port):
        raise ValueError(f"port {port} is used by another program: stop it, or change the port in {CONNECTIONS}")
    home.mkdir(parents=True, exist_ok=True)
    add_connections(home / "config.toml")
    command = ["flower-superlink", "--insecure", "--simulation", "--host", "127.0.0.1", "--port", str(port)]
    process = processes.start(command, superlink.flower_environment(home), log := home / "superlink.log")
    try:
        processes.wait_until(lambda: superlink.answers(port), process, log, "the SuperLink")
        write_json(home / "superlink.json", {"pid": process.pid, "created": psutil.Process(process.pid).create_time()})
    except BaseException:  # Ctrl-C does not reach the new session of the process
        processes.stop(process)
        raise
    return f"{_address()} is up, process {process.pid}; its log is {log}"


def add_connections(file: Path) -> None:
    """Add this project's connections to Flower's config.toml, leaving everything else in it unchanged.

    Raises:
        ValueError: the file is not valid TOML, or has a different connection with the same name.
    """
    ours = CONNECTIONS.read_text()
    text = file.read_text() if file.exists() else ours
    try:
        existing = tomllib.loads(text).get("superlink", {})
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"{file} is not valid TOML ({error}): correct it, or move it away") from error
    for section in SECTION.split(ours)[1:]:
        ((name, connection),) = tomllib.loads(section)["superlink"].items()
        if existing.get(name, connection) != connection:
            raise ValueError(f"{file} has a different [superlink.{name}] than this project: rename or remove it there")
        if name not in existing:
            text = f"{text.rstrip()}\n\n{section}"
    write_atomically(file, text.encode())


def down(home: Path) -> str:
    """Stop the SuperLink and its child processes, and return a status message."""
    if not (process := _running(home)):
        return f"{_address()} is not up"
    processes.stop(process)
    (home / "superlink.json").unlink()
    return f"{_address()} is down"


def status(home: Path) -> tuple[bool, str]:
    """Return whether the SuperLink is up, and a status message."""
    process = _running(home)
    return bool(process), f"{_address()} is {f'up, process {process.pid}' if process else 'not up'}"


def last(home: Path) -> tuple[bool, str]:
    """Return whether the newest run on the SuperLink completed, and a message; `flwr run` exits with 0 either way.

    Raises:
        FlowerRunError: Flower does not answer.
        ValueError: the SuperLink is not up, or has had no runs yet.
    """
    if not _running(home):
        raise ValueError(f"{_address()} is not up, and it keeps no record of runs after it stops")
    link = superlink.SuperLink(superlink.flower_environment(home), home / "superlink.log", connection=NAME)
    if not (runs := link.ask("list", NAME, "--limit", "1").get("runs")):
        raise ValueError(f"{_address()} has had no runs yet: flwr run . {NAME} --stream")
    status, details = superlink.last_status(link, runs[0]["run-id"])
    return status == superlink.COMPLETED, f"run {runs[0]['run-id']} is {status} ({details})"


class Service(TypedDict):
    """Which process `up` started; ``created`` in seconds, as psutil says it."""

    pid: int
    created: float


def _running(home: Path) -> psutil.Process | None:
    """Return the process that `up` started, if it still runs; start times are compared, as ids are reused."""
    try:
        saved = read_json(home / "superlink.json", Service)
        process = psutil.Process(saved["pid"])
        return process if process.create_time() == saved["created"] and process.is_running() else None
    except (FileNotFoundError, psutil.NoSuchProcess):
        return None


def _address() -> str:
    return tomllib.loads(CONNECTIONS.read_text())["superlink"][NAME]["address"]
