"""Tables of stored grids: differences between methods, rounds, labs alone beside the federation."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from statsmodels.stats.proportion import confint_proportions_2indep

from fedvla_lib import run_folder
from fedvla_lib.evaluation import statistics
from fedvla_lib.evaluation.statistics import CONFIDENCE
from fedvla_lib.experiments.results import HELD_OUT, LOCAL_ONLY, P_VALUES, cell_columns, cell_folders

OF_RUN = ("partition", "method", "run")
BLIND = ("base", "centralized")  # kinds that do not see how a recording is dealt out
OWN, OTHER = "own task", "other tasks"


def repeat_partition_free(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the rows, and those of methods that see no partition once more for each partition of the same recording.

    Base and centralized training come out the same however a recording is dealt out, so they are measured with one of
    its partitions; to the others they are lent, for the same seeds and rollouts. A partition that has a method itself is
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


def read_rounds(folder: Path) -> pd.DataFrame:
    """Return a row for each measured round of each federated cell in `folder`: loss and success of that global model.

    Columns: partition, method, run, round, steps (gradient steps of all clients so far), loss, action_error, n,
    successes, success_rate. Rounds without rollouts have n = 0 and a NaN rate. The last round has the rollouts of
    `read_results`, earlier rounds those that the run made while training.

    Raises:
        ValueError: there is no result, or no federated cell.
    """
    tables = []
    for cell in cell_folders(folder):
        columns = cell_columns(cell)
        if columns["kind"] == "federated":
            measured = run_folder.read_metrics(cell, "evaluate").set_index("round")[["loss", "action_error"]]
            counts = run_folder.read_metrics(cell, "rollout").groupby("round").success.agg(n="size", successes="sum")
            rounds = measured.join(counts).fillna({"n": 0, "successes": 0}).astype({"n": int, "successes": int})
            steps = columns["gradient_steps"] * rounds.index / rounds.index.max()
            of_run = {key: columns[key] for key in OF_RUN}
            tables.append(rounds.assign(**of_run, steps=steps.astype(int)).reset_index())
    if not tables:
        raise ValueError(f"no federated cell in {folder}: only those have rounds")
    table = pd.concat(tables, ignore_index=True)
    return table.assign(success_rate=table.successes / table.n.where(table.n > 0))


def differences(rows: pd.DataFrame, pairs: Iterable[tuple[str, str]], *, seed: int) -> pd.DataFrame:
    """Return `statistics.difference_over_seeds` of success for each partition and pair of methods, a row each.

    Only training seeds that both methods have are used. `loss` and `action_error` are differences of held-out averages
    with Student's intervals over training seeds (loss_low, loss_high, ...). P-values come last; `p_holm` is corrected
    over the table (Holm 1979).
    """
    lines = []
    for partition, part in rows.groupby("partition", sort=False):
        for method, other in pairs:
            shared = set(part[part.method == method].run) & set(part[part.method == other].run)
            if len(shared) > 1:
                both = part[part.run.isin(shared)]
                found = statistics.difference_over_seeds(both, method, other, seed=seed)
                lines.append({"partition": partition, "seeds": len(shared), **found, **_held_out(both, method, other)})
    if not lines:
        return pd.DataFrame()
    table = pd.DataFrame(lines)
    table = table.assign(p_holm=statistics.holm(table.p_value))
    return table[[name for name in table if name not in P_VALUES] + P_VALUES]


def _held_out(rows: pd.DataFrame, method: str, other: str) -> dict[str, float]:
    found = {}
    for name in HELD_OUT:
        each = rows.groupby(["method", "run"])[name].first()
        over = statistics.over_seeds((each[method] - each[other]).to_frame())
        found |= {name: over["difference"], f"{name}_low": over["low"], f"{name}_high": over["high"]}
    return found


def unpaired_difference(
    left: tuple[int, int], right: tuple[int, int], confidence: float = CONFIDENCE
) -> tuple[float, float]:
    """Interval of left - right, two success rates of which only (successes, rollouts) are known.

    If both made the same rollouts, `paired_difference` is usually narrower, but needs the outcome of each.

    Source: Newcombe 1998, Statistics in Medicine 17, 873-890, method 10 (combines Wilson's intervals).
    """
    low, high = confint_proportions_2indep(*left, *right, method="newcomb", alpha=1 - confidence)
    return float(low), float(high)


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
    return (rows.kind == LOCAL_ONLY) & (rows.task == own)


def by_steps(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the rows with methods named by the gradient steps of a model of theirs, fewest first.

    The rollouts of clients that trained alone are split: those at their own task, and those at the others' tasks.

    Args:
        rows: of `read_results`, of partition `task`.
    """
    part = np.where(rows.kind == LOCAL_ONLY, np.where(at_own_task(rows), f", {OWN}", f", {OTHER}"), "")
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
        other: a method with the same rollouts.
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
