"""Cost of a chapter: of this run, shown at its end, and of stored builds of the book, shown at its top.

``python book/tools/keep_costs.py --profile laptop`` stores the costs of an executed build. Time is that of the whole
chapter; memory is the peak of its process without Flower's processes; exchanged is what server and clients of its
federations sent, in both directions. Reading is without exercises and quiz, at the speed of `reading.minutes`.
"""

import json
import os
import re
import sys
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from fedvla_book import reading
from fedvla_lib import run_folder
from fedvla_lib.config import PROFILES

KEPT = Path("../book/reference/costs")  # relative to notebooks/; a file per profile
CHAPTERS = Path("../notebooks")
MEASURED = "fedvla_cost"  # key in the metadata of the output


@dataclass(frozen=True)
class Spent:
    """Cost of one run of a chapter, shown as a sentence."""

    profile: str
    seed: int
    seconds: float
    memory_mb: float
    exchanged_mb: float

    def __repr__(self) -> str:
        sent = f"; its federations exchanged {self.exchanged_mb:,.1f} MB" if self.exchanged_mb else ""
        return (
            f"This run took {self.seconds:.0f} s and at most {self.memory_mb:,.0f} MB of memory{sent}. "
            f"Profile {self.profile}, seed {self.seed}."
        )

    def _repr_mimebundle_(self, **_: Any) -> tuple[dict[str, str], dict[str, Any]]:
        return {"text/plain": repr(self), "text/markdown": repr(self)}, {MEASURED: asdict(self)}


def spent(seconds: float, profile: str | None, seed: int, folders: Iterable[str | Path] = ()) -> Spent:
    """Return the cost of this process so far; `folders` contain the run folders of its federations, at any depth."""
    logs = {path.resolve() for folder in folders for path in Path(folder).rglob("metrics.jsonl")}
    exchanged = sum(_exchanged(path.parent) for path in logs)
    used = profile or os.environ.get("FEDVLA_PROFILE", "laptop")
    return Spent(used, seed, round(seconds, 1), round(peak_memory_mb(), 1), round(exchanged / 1e6, 2))


def _exchanged(run: Path) -> int:
    replies = run_folder.read_metrics(run, "replies")
    return int(replies[["sent_bytes", "received_bytes"]].to_numpy().sum()) if len(replies) else 0


def peak_memory_mb() -> float:
    """Return this process's peak memory in MB."""
    status = Path("/proc/self/status")
    if status.exists():  # Linux, whose getrusage includes the parent process before exec
        return int(re.search(r"VmHWM:\s*(\d+) kB", status.read_text())[1]) * 1024 / 1e6
    import resource  # not available on Windows

    unit = 1 if sys.platform == "darwin" else 1024  # bytes there, kibibytes on Linux
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6


def measured(chapter: str, folder: Path = KEPT, chapters: Path = CHAPTERS) -> pd.DataFrame:
    """Return the stored costs of a chapter such as ``01_data``, a row per profile; a dash is what was not measured."""
    read = {"reading [min]": reading.minutes(chapters / f"{chapter}.ipynb")}
    rows = {profile: read | _stored(folder / f"{profile}.json", chapter) for profile in PROFILES}
    return pd.DataFrame(rows).T.rename_axis(columns="this chapter takes")  # a named index would add a header row


def _stored(file: Path, chapter: str) -> dict[str, str]:
    stored = json.loads(file.read_text(encoding="utf-8")) if file.is_file() else {}
    costs = stored.get("chapters", {}).get(chapter, {})
    columns = {"time [s]": "seconds", "memory [MB]": "memory_mb", "exchanged [MB]": "exchanged_mb"}
    cells = {head: f"{costs[key]:,.0f}" if costs.get(key) is not None else "–" for head, key in columns.items()}
    return cells | {"on": f"{stored['cores']} cores, {stored['date']}" if costs else "–"}
