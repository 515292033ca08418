"""A run on disk: settings, events, models, videos and a stamp in one folder, which is never overwritten.

::

    outputs/20260131_142501/
      config.json                 every setting
      metrics.jsonl               one event per line: round, who, kind, time, values
      stamp.json                  commit, config hash, versions, hardware, status, wall time
      global_model/round_3/       LeRobot pretrained_model folder
      evaluate/round_3/client_1/  rollout_<timestamp>.mp4

Files are written atomically and each event is one append, so a killed run leaves no partial files. The process that
writes to a run holds a lock file in its folder; the operating system releases the lock when the process ends.
"""

import json
import shutil
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import asdict, dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any, NotRequired, TypedDict

import pandas as pd
from filelock import FileLock, Timeout

from fedvla_lib.config import Config, from_run_config
from fedvla_lib.files import as_json, checked, parse_json, read_json, write_atomically, write_json
from fedvla_lib.provenance import config_hash, deciding, first_stamp, now

STAMP_FORMAT = "%Y%m%d_%H%M%S"
GLOBAL, LOCK, METRICS_FILE = "global", ".lock", "metrics.jsonl"
LOCK_TIMEOUT_S = 1.0  # longer than another process holds the lock just to test it


class Stamp(TypedDict):
    """What readers of ``stamp.json`` rely on. In this and the other types there may be more."""

    status: str
    engine: str
    started: str
    seed: int
    wall_s: float | None
    resumed: NotRequired[list[str]]


class Event(TypedDict):
    """A line of ``metrics.jsonl``."""

    round: int
    who: str
    kind: str
    time: str
    values: dict[str, Any]


class Trained(TypedDict):
    """The values that every event ``train`` has."""

    steps: int


class Rollout(TypedDict):
    """The values that every event ``rollout`` has."""

    task: str
    lab: str
    seed: int
    success: bool
    steps: int


class HeldOut(TypedDict):
    """The values that every event ``held-out`` has: an episode's."""

    episode_id: int
    num_examples: float
    loss: float | None
    action_error: float | None


VALUES = {"train": Trained, "rollout": Rollout, "held-out": HeldOut}  # by kind of event; others may hold anything


@dataclass(frozen=True)
class RunFolder:
    """A run that is being written; made by `start`."""

    root: Path

    def log(self, round_number: int, who: str, kind: str, values: dict[str, Any]) -> None:
        """Append an event of `kind`; `who` is ``global`` or ``client_K``."""
        event = {"round": round_number, "who": who, "kind": kind, "time": now(), "values": as_json(values)}
        with open(self.root / METRICS_FILE, "ab", buffering=0) as file:
            file.write((json.dumps(event, allow_nan=False) + "\n").encode())

    def model_dir(self, round_number: int) -> Path:
        """Return the folder of the global model of a round."""
        return self.root / "global_model" / f"round_{round_number}"

    def remove_models(self, keep_last: int, keep_every: int) -> None:
        """Remove global models but the last `keep_last` (0: none is removed) and those of every `keep_every` rounds."""
        names = (folder.name.removeprefix("round_") for folder in self.root.glob("global_model/round_*"))
        rounds = sorted(int(name) for name in names if name.isdecimal())
        for number in rounds[:-keep_last] if keep_last else ():
            if not keep_every or number % keep_every:
                shutil.rmtree(self.model_dir(number), ignore_errors=True)  # what cannot be removed stays

    def videos_dir(self, round_number: int, who: str) -> Path:
        """Return the folder of the videos of `who` (``global`` or ``client_K``) in a round."""
        return self.root / "evaluate" / f"round_{round_number}" / who


@contextmanager
def start(config: Config, *, engine: str, **beside: Any) -> Iterator[RunFolder]:
    """Create ``<config.out>/<YYYYmmdd_HHMMSS>/`` or reopen ``config.resume``; stamp how the run ended on exit.

    Args:
        beside: what decides the result beside the settings, for the stamp.

    Raises:
        ValueError: the folder cannot be written, or the run to be resumed cannot be, or is still running.
    """
    began = time.perf_counter()
    root = _existing(Path(config.resume)) if config.resume else _make_folder(Path(config.out))
    with hold(root):
        stamp = first_stamp(config, engine) | beside
        if config.resume:
            earlier = resumable(root, config)
            stamp |= {"started": earlier["started"], "resumed": [*earlier.get("resumed", []), stamp["started"]]}
        else:
            write_json(root / "config.json", asdict(config))
        write_json(root / "stamp.json", stamp)
        status = "interrupted"
        try:
            yield RunFolder(root)
            status = "completed"
        except Exception as error:
            status = f"failed: {type(error).__name__}: {error}"
            raise
        finally:
            ended = {"status": status, "wall_s": time.perf_counter() - began, "disk_bytes": disk_bytes(root)}
            write_json(root / "stamp.json", stamp | ended)


def disk_bytes(root: Path) -> int:
    """Return how many bytes the files below a folder have; those that others remove meanwhile do not count."""
    total = 0
    for path in root.rglob("*"):
        with suppress(OSError):
            total += path.stat().st_size if path.is_file() else 0
    return total


def hold(root: Path) -> AbstractContextManager:
    """Lock a run folder for writing until the end of a block; raise ValueError if another process holds the lock."""
    try:
        return FileLock(root / LOCK, timeout=LOCK_TIMEOUT_S).acquire()
    except Timeout as error:
        raise ValueError(f"{root} is in use: another process still writes to it") from error


def is_held(root: Path) -> bool:
    """Return whether a process writes to a run; assumed so where this process may not open the lock file."""
    if not (root / LOCK).is_file():  # a run of an older version, or one that never started
        return False
    try:
        with FileLock(root / LOCK, timeout=LOCK_TIMEOUT_S / 5):
            return False
    except (Timeout, OSError):
        return True


def forget_after(root: Path, round_number: int) -> None:
    """Delete the events, models and videos of rounds after `round_number`, which are about to be repeated."""
    events = read_events(root) if (root / METRICS_FILE).is_file() else []  # a run may end before its first
    kept = [event for event in events if event["round"] <= round_number]
    write_atomically(root / METRICS_FILE, b"".join((json.dumps(event) + "\n").encode() for event in kept))
    for folder in [*root.glob("global_model/round_*"), *root.glob("evaluate/round_*")]:
        if int(folder.name.removeprefix("round_")) > round_number:
            shutil.rmtree(folder)


def _existing(root: Path) -> Path:
    if not (root / "stamp.json").is_file():
        raise ValueError(f"resume={str(root)!r} is not a run folder: it has no stamp.json")
    return root


def resumable(root: Path, config: Config) -> dict[str, Any]:
    """Return the stamp of a run that can be resumed with these settings.

    Raises:
        ValueError: not a run folder, a completed run, or a run with other settings.
    """
    stamp, saved, asked = read_stamp(_existing(root)), deciding(read_config(root)), deciding(config)
    if stamp["status"] == "completed":
        raise ValueError(f"resume={str(root)!r} is a completed run: there is nothing to resume")
    if other := [name for name in asked if saved[name] != asked[name]]:
        name = other[0].replace("_", "-")
        raise ValueError(f"resume={str(root)!r} was run with another {name}: resume it with its own settings")
    return stamp


def read_config(root: Path) -> Config:
    """Return the settings of a run; raise ValueError if they cannot be read."""
    return from_run_config(read_json(Path(root) / "config.json"))


def read_stamp(root: Path) -> dict[str, Any]:
    """Return the stamp of a run: commit, versions, hardware, status, wall time.

    A killed process leaves ``running`` in the file; if no process writes to the run, the status is ``interrupted``.

    Raises:
        ValueError: it cannot be read.
    """
    stamp = read_json(Path(root) / "stamp.json", Stamp)
    if stamp["status"] == "running" and not is_held(Path(root)):
        stamp["status"] = "interrupted"
    return stamp


def read_metrics(root: Path, kind: str | None = None) -> pd.DataFrame:
    """Return the events of a run, one row each: round, who, kind, time and one column per value.

    Args:
        kind: return only events of this kind, and only the columns they use: ``train``, ``evaluate``, ``rollout``,
            ``replies``, ``rejected`` or ``note``.

    Raises:
        ValueError: not a run folder, or a line of ``metrics.jsonl`` is not an event.
    """
    events = [event for event in read_events(root) if kind in (None, event["kind"])]
    fixed = ["round", "who", "kind", "time"]
    named = list(dict.fromkeys(key for event in events for key in event["values"] if key not in fixed))
    return pd.DataFrame([{**e["values"], **{key: e[key] for key in fixed}} for e in events], columns=fixed + named)


def counted_steps(root: Path) -> dict[str, int]:
    """Return the gradient steps that went into a federated run's global model, as counted by its clients.

    ``in_all`` sums over all averaged replies; ``in_a_row`` sums the largest count of each round, since the clients of a
    round train in parallel.

    Raises:
        ValueError: not a run folder, or its clients counted none.
    """
    trained = read_metrics(root, "train")
    if trained.empty:
        raise ValueError(f"{root} has no event of a client's training")
    return {"in_all": int(trained.steps.sum()), "in_a_row": int(trained.groupby("round").steps.max().sum())}


def _make_folder(out: Path) -> Path:
    """If two runs start in the same second, the later one gets the next free second as its name."""
    named = datetime.now()
    while True:
        path = out / named.strftime(STAMP_FORMAT)
        try:
            path.mkdir(parents=True)
            return path
        except FileExistsError:
            named += timedelta(seconds=1)
        except OSError as error:
            reason = f"cannot make the run folder {path} ({error.strerror})"
            raise ValueError(f"{reason}: give a writable folder as out") from error


def read_events(root: Path) -> list[dict[str, Any]]:
    """Return the complete events of a run; raise ValueError if it is not a run folder, or a line is not an event."""
    path = Path(root) / METRICS_FILE
    if not path.is_file():
        raise ValueError(f"{root} is not a run folder: it has no {METRICS_FILE}")
    lines = path.read_bytes().split(b"\n")[:-1]  # a crash cuts off the last line
    return [_read_event(line, f"{path} line {number}") for number, line in enumerate(lines, start=1)]


def _read_event(line: bytes, name: str) -> dict[str, Any]:
    event = parse_json(line, Event, name)
    if shape := VALUES.get(event["kind"]):
        checked(event["values"], shape, f"{name} ({event['kind']})")
    return event


def run_folders(config: Config) -> set[Path]:
    """Return the existing run folders in `config.out`."""
    return {stamp.parent for stamp in Path(config.out).glob("*/stamp.json")}


def own_run(config: Config, before: set[Path]) -> Path | None:
    """Return the folder of a run just started: the resumed one, or the newest with its settings not in `before`.

    Other runs may be writing to the same parent folder. None if the run has not started yet.
    """
    if config.resume:
        return Path(config.resume)
    wanted, new = config_hash(config), run_folders(config) - before
    return max((root for root in new if config_hash(read_config(root)) == wanted), default=None)
