"""A run on disk: settings, events, checkpoints, videos and a stamp, in one folder that is never overwritten.

::

    outputs/20260131_142501/
      config.json                 every setting
      metrics.jsonl               one event a line: round, who, kind, time, values
      stamp.json                  commit, config hash, versions, hardware, status, wall time
      global_model/round_3/       LeRobot pretrained_model folder
      evaluate/round_3/client_1/  rollout_<timestamp>.mp4

Whole files appear by rename, events by one append each, so a run that is killed leaves only complete things.
Who writes to a run holds a lock in its folder, which the system releases however that process ends.
"""

import json
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import pandas as pd
from filelock import FileLock, Timeout

from fedvla_lib import provenance
from fedvla_lib.config import Config, check
from fedvla_lib.files import as_json, write_atomically, write_json
from fedvla_lib.provenance import config_hash, first_stamp, now

STAMP_FORMAT = "%Y%m%d_%H%M%S"
GLOBAL = "global"
LOCK = ".lock"
PATIENCE_S = 1.0  # with a lock that another process may hold only to see whether it is free


@dataclass(frozen=True)
class RunFolder:
    """A run that is being written; `run_folder.start` makes one."""

    root: Path

    def log(self, round_number: int, who: str, kind: str, values: dict[str, Any]) -> None:
        """Append one event: `who` is ``global`` or a client's name, `kind` says what the values are."""
        event = {"round": round_number, "who": who, "kind": kind, "time": now(), "values": as_json(values)}
        with open(self.root / "metrics.jsonl", "ab", buffering=0) as file:
            file.write((json.dumps(event, allow_nan=False) + "\n").encode())

    def model_dir(self, round_number: int) -> Path:
        """Where the global model of a round belongs."""
        return self.root / "global_model" / f"round_{round_number}"

    def videos_dir(self, round_number: int, who: str) -> Path:
        """Where the videos of `who` (``global`` or ``client_K``) in a round belong."""
        return self.root / "evaluate" / f"round_{round_number}" / who

    def relative(self, path: str | Path | None) -> str | None:
        """Return `path` as seen from the run folder, so that the folder can be moved; None stays None."""
        return Path(path).relative_to(self.root).as_posix() if path else None


@contextmanager
def start(config: Config, *, engine: str) -> Iterator[RunFolder]:
    """Make ``<config.out>/<YYYYmmdd_HHMMSS>/``, or take ``config.resume``, yield it, and stamp how the run ended.

    Raises:
        ValueError: the folder cannot be written, or what is to be resumed is no such run, or is still going on.
    """
    began = time.perf_counter()
    root = _existing(Path(config.resume)) if config.resume else _make_folder(Path(config.out))
    with hold(root):
        stamp = first_stamp(config, engine)
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
            write_json(root / "stamp.json", {**stamp, "status": status, "wall_s": time.perf_counter() - began})


@contextmanager
def hold(root: Path) -> Iterator[None]:
    """Be the one process that writes to a run folder.

    Raises:
        ValueError: another one does.
    """
    lock = FileLock(root / LOCK, timeout=PATIENCE_S)
    try:
        lock.acquire()
    except Timeout as error:
        raise ValueError(f"{root} is in use: another process still writes to it") from error
    try:
        yield
    finally:
        lock.release()


def is_held(root: Path) -> bool:
    """Whether a process writes to a run, as far as can be seen: who may not write there cannot try the lock."""
    if not (root / LOCK).is_file():  # of an older version, or never started
        return False
    try:
        with FileLock(root / LOCK, timeout=PATIENCE_S / 5):
            return False
    except (Timeout, OSError):
        return True


def forget_after(root: Path, round_number: int) -> None:
    """Remove what a run has written of later rounds, which are about to be done again: events, models and videos."""
    kept = [event for event in read_events(root / "metrics.jsonl") if event["round"] <= round_number]
    write_atomically(root / "metrics.jsonl", b"".join((json.dumps(event) + "\n").encode() for event in kept))
    for folder in [*root.glob("global_model/round_*"), *root.glob("evaluate/round_*")]:
        if int(folder.name.removeprefix("round_")) > round_number:
            shutil.rmtree(folder)


def _existing(root: Path) -> Path:
    if not (root / "stamp.json").is_file():
        raise ValueError(f"resume={str(root)!r} is not a run folder: it has no stamp.json")
    return root


def resumable(root: Path, config: Config) -> dict[str, Any]:
    """Return the stamp of a run that these settings can go on with.

    Raises:
        ValueError: no run, a completed one, or one with other settings.
    """
    stamp, theirs = read_stamp(_existing(root)), read_config(root)
    if stamp["status"] == "completed":
        raise ValueError(f"resume={str(root)!r} is a completed run: there is nothing to go on with")
    if config_hash(theirs) != config_hash(config):
        other = [name for name, value in asdict(theirs).items() if value != getattr(config, name)]
        changed = sorted(set(other) - {"out", "num_threads", "resume"})
        raise ValueError(f"resume={str(root)!r} was run with another {changed[0].replace('_', '-')}: its settings stay")
    return stamp


def read_config(root: Path) -> Config:
    """Return the settings of a run."""
    return check(Config(**json.loads((Path(root) / "config.json").read_text())))


def read_stamp(root: Path) -> dict[str, Any]:
    """Return the stamp of a run: commit, versions, hardware, status, wall time.

    A process that was killed left ``running`` in the file. Where none writes to the run any more, that is returned as
    ``interrupted``.
    """
    stamp = json.loads((Path(root) / "stamp.json").read_text())
    if stamp.get("status") == "running" and not is_held(Path(root)):
        stamp["status"] = "interrupted"
    return stamp


def read_metrics(root: Path, kind: str | None = None) -> pd.DataFrame:
    """Return the events of a run, one row each: round, who, kind, time and a column per value.

    Args:
        kind: only events of this kind, with only the columns they use: ``train``, ``evaluate``, ``rollout``,
            ``replies`` or ``rejected``.

    Raises:
        ValueError: no run there, or a line of ``metrics.jsonl`` is not an event.
    """
    events = [event for event in read_events(Path(root) / "metrics.jsonl") if kind in (None, event["kind"])]
    fixed = ["round", "who", "kind", "time"]
    named = list(dict.fromkeys(key for event in events for key in event["values"] if key not in fixed))
    return pd.DataFrame([{**e["values"], **{key: e[key] for key in fixed}} for e in events], columns=fixed + named)


def counted_steps(root: Path) -> dict[str, int] | None:
    """Return the gradient steps behind a federated run's global model, as its clients counted them.

    ``in_all`` sums over all replies that were averaged; ``in_a_row`` over rounds, of each the client with the most,
    since the clients of a round train side by side. None where a reply has no count: such a run is older than counting.
    """
    trained = read_metrics(root, "train")
    if "steps" not in trained or trained.steps.isna().any():
        return None
    return {"in_all": int(trained.steps.sum()), "in_a_row": int(trained.groupby("round").steps.max().sum())}


def _make_folder(out: Path) -> Path:
    """Two runs in one second get two names: the later takes the next free second."""
    when = datetime.now()
    while True:
        path = out / when.strftime(STAMP_FORMAT)
        try:
            path.mkdir(parents=True)
            return path
        except FileExistsError:
            when += timedelta(seconds=1)
        except OSError as error:
            message = f"cannot make the run folder {path} ({error.strerror}): give a writable folder as out"
            raise ValueError(message) from error


def read_events(path: Path) -> list[dict[str, Any]]:
    """Return the complete events of a ``metrics.jsonl``.

    Raises:
        ValueError: no such file, or a line of it is not an event.
    """
    if not path.is_file():
        raise ValueError(f"{path.parent} is not a run folder: it has no {path.name}")
    lines = path.read_text().split("\n")[:-1]  # a line without its newline was cut off by a crash
    return [_event(path, number, line) for number, line in enumerate(lines, start=1)]


def _event(path: Path, number: int, line: str) -> dict[str, Any]:
    try:
        return json.loads(line)
    except json.JSONDecodeError as error:
        raise ValueError(f"{path} line {number} is not an event: {error.msg}") from error


def run_folders(config: Config) -> set[Path]:
    """Return the run folders there are where `config` writes."""
    return {stamp.parent for stamp in Path(config.out).glob("*/stamp.json")}


def own_run(config: Config, before: set[Path]) -> Path | None:
    """Return the folder that a run writes: the one to be resumed, or the newest with its settings not in `before`.

    Others may write to the same place meanwhile. None: it has not begun.
    """
    if config.resume:
        return Path(config.resume)
    wanted, new = provenance.config_hash(config), run_folders(config) - before
    return max((r for r in new if provenance.config_hash(read_config(r)) == wanted), default=None)
