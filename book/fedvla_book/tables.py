"""Tables that the pages of the book show, made from stored results: loss against success, labs alone, searches."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import spearmanr

from fedvla_lib.config import STRATEGIES
from fedvla_lib.evaluation import statistics
from fedvla_lib.evaluation.statistics import wilson
from fedvla_lib.experiments.results import ALONE, OF_RUN
from fedvla_lib.federation.strategies.build import SERVER_LR

SEARCHED = ("lr", "local_steps", "fraction_train", "server_lr", "proximal_mu")
COMPARED = (
    "strategy", "settings", "trials", "diverged", *SEARCHED, "selection_loss", "loss", "n", "successes",
    "success_rate", "low", "high",
)  # fmt: skip
BLIND = ("base", "centralized")  # kinds that do not see how a recording is dealt out
OWN, OTHER = "own task", "other tasks"


def repeat_partition_free(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the rows, and those of methods that see no partition once more for each partition of the same recording.

    Base and centralized training come out the same however a recording is dealt out, so they are measured with one of
    its partitions; to the others they are lent, for the same seeds and rollouts. A partition that has an method itself is
    lent none of it, and no partition is lent anything of another recording, such as that of several laboratories.

    Args:
        rows: of `read_results`.
    """
    lent = []
    for _, there in rows.groupby("recording", sort=False):
        for _, measured in there[there.kind.isin(BLIND)].groupby("method", sort=False):
            lender = measured[measured.partition == measured.partition.iloc[0]]
            lacking = [name for name in there.partition.unique() if name not in set(measured.partition)]
            lent += [lender.assign(partition=name) for name in lacking]
    return pd.concat([rows, *lent], ignore_index=True)


def fill_in(rows: pd.DataFrame, other: pd.DataFrame, method: str) -> pd.DataFrame:
    """Return the partitions of `rows` in which `method` has two training seeds or more, and those that only `other` has.

    Args:
        rows, other: of `read_results`, perhaps lent; partitions of one name are the same in both.
    """
    seeds = rows[rows.method == method].groupby("partition").run.nunique()
    kept = rows[rows.partition.isin(seeds.index[seeds > 1])]
    return pd.concat([kept, other[~other.partition.isin(kept.partition)]], ignore_index=True)


def correlations(rounds: pd.DataFrame, by: Sequence[str] = OF_RUN) -> pd.DataFrame:
    """Return Spearman's correlation of held-out loss with success over the checkpoints of each group, and over all.

    Columns partition, method, run ("all" where the line does not tell them apart; everywhere in the last line), n
    (checkpoints), rho: -1 if the loss ranks them as success does, NaN if all are alike or there is one only.

    Args:
        rounds: of `read_rounds`; what made no rollout is left out.
        by: columns that make a group, of partition, method and run.
    """
    measured = rounds.dropna(subset=["loss", "success_rate"])
    groups = [(dict(zip(by, key, strict=True)), part) for key, part in measured.groupby(list(by), sort=False)]
    return pd.DataFrame([
        {**dict.fromkeys(OF_RUN, "all"), **group, "n": len(part), "rho": _spearman(part)}
        for group, part in [*groups, ({}, measured)]
    ])  # fmt: skip


def _spearman(part: pd.DataFrame) -> float:
    if min(part.loss.nunique(), part.success_rate.nunique()) < 2:
        return float("nan")  # nothing to rank
    return float(spearmanr(part.loss, part.success_rate).statistic)


def clear_pairs(rounds: pd.DataFrame) -> pd.DataFrame:
    """Return the pairs of checkpoints that differ in loss and whose intervals of success (Wilson's) are apart.

    Columns partition, method, run, round, loss, n, successes, success_rate, low, high of the one with the lower loss, the
    same with `other_` in front of the other; gap: what lies between the intervals; misled: the lower loss succeeds
    less often; same_run, and same_episodes: partition and training seed are the same, so the held-out episodes are.

    Args:
        rounds: of `read_rounds`; what made no rollout is left out.
    """
    table = rounds.dropna(subset=["loss", "success_rate"]).sort_values("loss", kind="stable", ignore_index=True)
    ends = [statistics.wilson(int(k), int(n)) for k, n in zip(table.successes, table.n, strict=True)]
    table["low"], table["high"] = np.array(ends, dtype=float).reshape(-1, 2).T
    one, other = np.triu_indices(len(table), k=1)
    low, high = table.low.to_numpy(), table.high.to_numpy()
    gap = np.maximum(low[one] - high[other], low[other] - high[one])
    kept = (gap > 0) & (table.loss.to_numpy()[one] < table.loss.to_numpy()[other])
    of = [*OF_RUN, "round", "loss", "n", "successes", "success_rate", "low", "high"]
    sides = [table.loc[places[kept], of].reset_index(drop=True) for places in (one, other)]
    pairs = sides[0].join(sides[1].add_prefix("other_")).assign(gap=gap[kept])
    shared = (pairs.partition == pairs.other_partition) & (pairs.run == pairs.other_run)
    same_run = shared & (pairs.method == pairs.other_method)
    return pairs.assign(misled=pairs.success_rate < pairs.other_success_rate, same_run=same_run, same_episodes=shared)


def disagreements(rounds: pd.DataFrame) -> pd.DataFrame:
    """Return those of `clear_pairs` whose lower loss succeeds less often, the widest gap first."""
    pairs = clear_pairs(rounds)
    return pairs[pairs.misled].sort_values("gap", ascending=False, kind="stable", ignore_index=True)


def at_own_task(rows: pd.DataFrame) -> pd.Series:
    """Return for each rollout whether it was at the task of the client that trained alone and made it.

    Only with partition `task` has a client one task: client k number k of all in alphabetical order, in turn, as
    `partition.partition` deals them out. Rollouts of other methods, which no client made, are at nobody's own task.

    Args:
        rows: of `read_results`, of partition `task`, each method with all tasks.
    """
    if "client" not in rows:
        return pd.Series(False, rows.index)
    tasks = sorted(rows.task.unique())
    own = rows.client.map(lambda client: tasks[int(client) % len(tasks)], na_action="ignore")
    return (rows.kind == ALONE) & (rows.task == own)


def by_steps(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the rows with methods named by the gradient steps of a model of theirs, fewest first.

    The rollouts of clients that trained alone are split: those at their own task, and those at the others' tasks.

    Args:
        rows: of `read_results`, of partition `task`.
    """
    part = np.where(rows.kind == ALONE, np.where(at_own_task(rows), f", {OWN}", f", {OTHER}"), "")
    taken = rows.groupby("method")[["steps_in_all", "steps_in_a_row"]].transform("mean")
    steps = [f", {_in_words(*each)}" for each in taken.itertuples(index=False)]
    order = taken.assign(method=rows.method, part=part)
    order = order.sort_values(list(order), ascending=[True, True, True, False], kind="stable")
    return rows.assign(method=rows.method + part + steps).loc[order.index]


def _in_words(in_all: float, in_a_row: float) -> str:
    return f"{in_all:,.0f} steps" + (f", {in_a_row:,.0f} in a row" if in_a_row < in_all else "")


def beside_own_tasks(rows: pd.DataFrame, method: str, other: str, *, seed: int) -> dict[str, Any]:
    """Hold clients that trained alone, at their own tasks, against another method on the same rollouts.

    Args:
        rows: of `read_results`, of partition `task`.
        method: whose clients trained alone.
        other: an method with the same rollouts.
        seed: of the interval's bootstrap.

    Returns:
        `compare.paired_difference` of method - other where both have one training seed in common, else
        `compare.difference_over_seeds`; also seeds, and for both methods success_rate and other_rate with low and high.
    """
    own = rows[(rows.method == method) & at_own_task(rows)]
    key = ["run", "task", "seed"]
    same = rows[rows.method == other].merge(own[key], on=key)
    own = own[own.run.isin(same.run)]
    both, seeds = pd.concat([own, same], ignore_index=True), int(own.run.nunique())
    of = statistics.paired_difference if seeds == 1 else statistics.difference_over_seeds
    found = {"seeds": seeds, **of(both, method, other, seed=seed)}
    for name, part in (("success", own), ("other", same)):
        low, high = statistics.success_interval(part)
        found |= {f"{name}_rate": float(part.success.mean()), f"{name}_low": low, f"{name}_high": high}
    return found


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
