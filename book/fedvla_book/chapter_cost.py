"""What a chapter costs, measured: of this run at its end, and of the book's own builds in the box at its top.

``python book/tools/keep_costs.py --profile laptop`` takes the measurements out of the chapters that a build executed. Time is
that of the whole chapter; memory the most that its process held at once, without the processes that Flower starts;
exchanged is what server and clients of its federations sent each other, in both directions.
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

from fedvla_lib import run_folder
from fedvla_lib.config import PROFILES

KEPT = Path("../book/reference/costs")  # as seen from a chapter; a file for each profile
MEASURED = "fedvla_cost"  # in the metadata of an output, beside its sentence


@dataclass(frozen=True)
class Spent:
    """The cost of one run of a chapter; a notebook shows it as a sentence."""

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
    """Return what this process has cost so far; `folders` hold the run folders of its federations, at any depth."""
    logs = {path.resolve() for folder in folders for path in Path(folder).rglob("metrics.jsonl")}
    exchanged = sum(_exchanged(path.parent) for path in logs)
    used = profile or os.environ.get("FEDVLA_PROFILE", "laptop")
    return Spent(used, seed, round(seconds, 1), round(_peak_memory_mb(), 1), round(exchanged / 1e6, 2))


def _exchanged(run: Path) -> int:
    replies = run_folder.read_metrics(run, "replies")
    return int(replies[["sent_bytes", "received_bytes"]].to_numpy().sum()) if len(replies) else 0


def _peak_memory_mb() -> float:
    status = Path("/proc/self/status")
    if status.exists():  # Linux, whose getrusage also counts what the process held that started this one
        return int(re.search(r"VmHWM:\s*(\d+) kB", status.read_text())[1]) * 1024 / 1e6
    import resource  # not on Windows, where the rest of this module is still of use

    unit = 1 if sys.platform == "darwin" else 1024  # bytes there, kibibytes on Linux
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6


def measured(chapter: str, folder: Path = KEPT) -> pd.DataFrame:
    """Return what builds of the book measured of a chapter such as ``01_data``: a row for each profile.

    A dash stands for what no build has measured.
    """
    rows = {profile: _kept(folder / f"{profile}.json", chapter) for profile in PROFILES}
    return pd.DataFrame(rows).T.rename_axis(columns="this chapter takes")  # a named index would be a row of its own


def _kept(file: Path, chapter: str) -> dict[str, str]:
    kept = json.loads(file.read_text(encoding="utf-8")) if file.is_file() else {}
    found = kept.get("chapters", {}).get(chapter, {})
    shown = {"time [s]": "seconds", "memory [MB]": "memory_mb", "exchanged [MB]": "exchanged_mb"}
    cells = {head: f"{found[key]:,.0f}" if found.get(key) is not None else "–" for head, key in shown.items()}
    return cells | {"on": f"{kept['cores']} cores, {kept['date']}" if found else "–"}
