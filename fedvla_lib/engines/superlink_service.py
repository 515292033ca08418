"""A SuperLink that stays up between commands, for `flwr run . local-simulation` in a shell.

`flwr run` would start one by itself, and gives it 15 s, which a cold machine with two cores does not make. This one is
started first, waited for, and stopped by name; its connection file, `connections.toml`, comes with the package.
"""

import json
import re
import tomllib
from pathlib import Path

import psutil

from fedvla_lib.engines import processes, superlink
from fedvla_lib.files import write_atomically, write_json

CONNECTIONS = Path(__file__).resolve().parent / "connections.toml"
NAME = "local-simulation"
SECTION = re.compile(r"^(?=\[superlink\.)", re.MULTILINE)  # where the table of a connection begins


def up(home: Path) -> str:
    """Start the SuperLink of the connection file with `home` as FLWR_HOME, and say where it is once it answers.

    However it ends without an answer, also by Ctrl-C, nothing is left running.

    Raises:
        FlowerRunError: it did not answer within two minutes.
        ValueError: something else uses its port, or the user's own connections are in the way.
    """
    if process := _running(home):
        return f"{_where()} is up already, process {process.pid}"
    port = int(_where().rsplit(":", 1)[1])
    if not processes.is_free(port):
        raise ValueError(f"port {port} is used by another program: stop it, or change the port in {CONNECTIONS}")
    home.mkdir(parents=True, exist_ok=True)
    add_connections(home / "config.toml")
    command = ["flower-superlink", "--insecure", "--simulation", "--host", "127.0.0.1", "--port", str(port)]
    process = processes.start(command, superlink.flower_environment(home), log := home / "superlink.log")
    try:
        processes.wait_until(lambda: superlink.answers(port), process, log, "the SuperLink")
        write_json(home / "superlink.json", {"pid": process.pid, "created": psutil.Process(process.pid).create_time()})
    except BaseException:  # it has a session of its own, which Ctrl-C in this one does not reach
        processes.stop(process)
        raise
    return f"{_where()} is up, process {process.pid}; its log is {log}"


def add_connections(file: Path) -> None:
    """Add this project's connections to Flower's file of them; what else stands there stays as it is.

    Raises:
        ValueError: the file is no TOML, or has another connection of the same name.
    """
    ours = CONNECTIONS.read_text()
    if not file.exists():
        return write_atomically(file, ours.encode())
    text = file.read_text()
    try:
        there = tomllib.loads(text).get("superlink", {})
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"{file} is no TOML ({error}): mend it, or move it away") from error
    for section in SECTION.split(ours)[1:]:
        ((name, connection),) = tomllib.loads(section)["superlink"].items()
        if there.get(name, connection) != connection:
            raise ValueError(f"{file} has another [superlink.{name}] than this project: rename or remove it there")
        if name not in there:
            text = f"{text.rstrip()}\n\n{section}"
    write_atomically(file, text.encode())


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


def last(home: Path) -> tuple[bool, str]:
    """Return whether the newest run on the SuperLink completed, and words for it: `flwr run` exits with 0 either way.

    Raises:
        FlowerRunError: Flower does not answer.
        ValueError: the SuperLink is not up, or has had no run yet.
    """
    if not _running(home):
        raise ValueError(f"{_where()} is not up, and what it knew of runs ended with it")
    link = superlink.SuperLink(superlink.flower_environment(home), home / "superlink.log", connection=NAME)
    if not (runs := link.ask("list", NAME, "--limit", "1").get("runs")):
        raise ValueError(f"{_where()} has had no run yet: flwr run . {NAME} --stream")
    ended, details = superlink.last_status(link, runs[0]["run-id"])
    return ended == superlink.COMPLETED, f"run {runs[0]['run-id']} is {ended} ({details})"


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
    return tomllib.loads(CONNECTIONS.read_text())["superlink"][NAME]["address"]
