"""Tables of stored hyperparameter searches."""

import json
from pathlib import Path
from typing import Any

import pandas as pd

from fedvla_lib.config import STRATEGIES
from fedvla_lib.evaluation.statistics import wilson

SEARCHED = ("lr", "local_steps", "fraction_train", "server_lr", "proximal_mu")
COMPARED = (
    "strategy", "settings", "trials", "diverged", *SEARCHED, "selection_loss", "loss", "n", "successes",
    "success_rate", "low", "high",
)  # fmt: skip


def read_searches(folder: Path) -> dict[str, dict[str, Any]]:
    """Return the contents of every ``*/search.json`` in `folder`, by strategy.

    Raises:
        ValueError: there is none, or two have the same strategy.
    """
    files = sorted(Path(folder).glob("*/search.json"))
    found = {one["config"]["strategy"]: one for one in (json.loads(file.read_text(encoding="utf-8")) for file in files)}
    if not files or len(found) < len(files):
        raise ValueError(f"{folder} has {len(files)} searches of {len(found)} strategies: one of each is read")
    return {name: found[name] for name in STRATEGIES if name in found}


def compared(searches: dict[str, dict[str, Any]]) -> pd.DataFrame:
    """Return two rows for each search: the settings that it started from, and its winner.

    Columns: strategy, settings ("start" or "winner"); trials and diverged (counts); the searched settings, NaN where a
    strategy lacks one; selection_loss, NaN for the start; loss, on episodes that selected nothing; n, successes,
    success_rate, low, high (Wilson interval).
    """
    lines = []
    for name, found in searches.items():
        diverged = sum(trial["selection_loss"] is None for trial in found["trials"])
        line = {"strategy": name, "trials": len(found["trials"]), "diverged": diverged}
        winner = found["winner"] | {"selection_loss": found["selection_loss"]}
        lines.append({**line, "settings": "start", **_started_from(found), **_measured(found["start"])})
        lines.append({**line, "settings": "winner", **winner, **_measured(found["best"])})
    return pd.DataFrame(lines, columns=COMPARED)


def _started_from(found: dict[str, Any]) -> dict[str, Any]:
    """The initial value of each searched setting; a server_lr of 0 means the strategy's default."""
    from fedvla_lib.federation.strategies.build import SERVER_LR  # loads torch and flwr

    given = {name: found["config"][name] for name in found["winner"]}
    if "server_lr" in given:
        given["server_lr"] = given["server_lr"] or SERVER_LR[found["config"]["strategy"]]
    return given


def _measured(one: dict[str, Any]) -> dict[str, Any]:
    low, high = wilson(one["successes"], one["n"])
    rate = {"success_rate": one["successes"] / one["n"], "low": low, "high": high}
    return {"loss": one["loss"], "n": one["n"], "successes": one["successes"], **rate}
