"""Searches for settings, side by side."""

import json
from pathlib import Path
from typing import Any

import pandas as pd

from fedvla_lib.config import STRATEGIES
from fedvla_lib.evaluation.statistics import wilson
from fedvla_lib.federation.strategies.build import SERVER_LR

SEARCHED = ("lr", "local_steps", "fraction_train", "server_lr", "proximal_mu")
COMPARED = (
    "strategy", "settings", "trials", "diverged", *SEARCHED, "selection_loss", "loss", "n", "successes",
    "success_rate", "low", "high",
)  # fmt: skip


def read_searches(folder: Path) -> dict[str, dict[str, Any]]:
    """Return what each search in a folder of its own below `folder` has found, by strategy.

    Raises:
        ValueError: there is none, or two are of one strategy.
    """
    files = sorted(Path(folder).glob("*/search.json"))
    found = {one["config"]["strategy"]: one for one in (json.loads(file.read_text(encoding="utf-8")) for file in files)}
    if not files or len(found) < len(files):
        raise ValueError(f"{folder} has {len(files)} searches of {len(found)} strategies: one of each is read")
    return {name: found[name] for name in STRATEGIES if name in found}


def compared(searches: dict[str, dict[str, Any]]) -> pd.DataFrame:
    """Return two lines for each of `searches`: the settings that it started from, and its winner.

    Columns: strategy, settings ("start" or "winner"); trials, and how many of them diverged; what was searched for, NaN
    where a strategy has no such setting; selection_loss, NaN for the start, which is no trial; loss, on the episodes
    that chose nothing; n, successes, success_rate, low, high (Wilson interval).
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
    """The given value of each setting that was searched for; a server-lr of 0 stands for the strategy's own."""
    given = {name: found["config"][name] for name in found["winner"]}
    if "server_lr" in given:
        given["server_lr"] = given["server_lr"] or SERVER_LR[found["config"]["strategy"]]
    return given


def _measured(one: dict[str, Any]) -> dict[str, Any]:
    low, high = wilson(one["successes"], one["n"])
    rate = {"success_rate": one["successes"] / one["n"], "low": low, "high": high}
    return {"loss": one["loss"], "n": one["n"], "successes": one["successes"], **rate}
