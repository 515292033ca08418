"""Tables of stored grids: differences between methods, rounds, local-only clients next to the federation."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from fedvla_book.tables import intervals
from fedvla_book.tables.results import HELD_OUT, LOCAL_ONLY, cell_columns, cell_folders
from fedvla_lib import run_folder
from fedvla_lib.evaluation import statistics
from fedvla_lib.evaluation.statistics import CONFIDENCE, P_VALUES

OF_RUN = ("partition", "method", "run")
OWN, OTHER = "own task", "other tasks"


def fill_in(rows: pd.DataFrame, other: pd.DataFrame, method: str) -> pd.DataFrame:
    """Return the partitions of `rows` in which `method` has at least two training seeds, and the rest from `other`.

    Args:
        rows, other: of `results.read_results`; equal names are equal partitions.
    """
    seeds = rows[rows.method == method].groupby("partition").run.nunique()
    kept = rows[rows.partition.isin(seeds.index[seeds > 1])]
    return pd.concat([kept, other[~other.partition.isin(kept.partition)]], ignore_index=True)


def shared_seeds(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the rollouts of the training seeds that every method of `rows` has, so that success rates compare.

    Args:
        rows: of `results.read_results`.
    """
    methods = rows.groupby("run").method.nunique()
    return rows[rows.run.isin(methods.index[methods == rows.method.nunique()])]


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
    """Return `difference_over_seeds` of success for each partition and pair of methods, a row each.

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
                found = difference_over_seeds(both, method, other, seed=seed)
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
        over = intervals.over_seeds((each[method] - each[other]).to_frame())
        found |= {name: over["difference"], f"{name}_low": over["low"], f"{name}_high": over["high"]}
    return found


def at_own_task(rows: pd.DataFrame) -> pd.Series:
    """Return for each rollout whether a local-only client ran it on its own task.

    With partition `task` client k has task k in alphabetical order, modulo the number of tasks, as assigned by
    `data.partition.partition`. False for rollouts of other methods.

    Args:
        rows: of `results.read_results`, of partition `task`, each method with all tasks.
    """
    if "client" not in rows:
        return pd.Series(False, rows.index)
    tasks = sorted(rows.task.unique())
    own = rows.client.map(lambda client: tasks[int(client) % len(tasks)], na_action="ignore")
    return (rows.kind == LOCAL_ONLY) & (rows.task == own)


def by_steps(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the rows with the gradient steps of one model appended to the method's name, fewest steps first.

    Rollouts of local-only clients are split into those at their own task and those at other tasks.

    Args:
        rows: of `results.read_results`, of partition `task`.
    """
    part = np.where(rows.kind == LOCAL_ONLY, np.where(at_own_task(rows), f", {OWN}", f", {OTHER}"), "")
    taken = rows.groupby("method")[["steps_in_all", "steps_in_a_row"]].transform("mean")
    steps = [f", {_in_words(*each)}" for each in taken.itertuples(index=False)]
    order = taken.assign(method=rows.method, part=part)
    order = order.sort_values(list(order), ascending=[True, True, True, False], kind="stable")
    return rows.assign(method=rows.method + part + steps).loc[order.index]


def _in_words(in_all: float, in_a_row: float) -> str:
    return f"{in_all:,.0f} steps" + (f", {in_a_row:,.0f} in a row" if in_a_row < in_all else "")


def paired(rows: pd.DataFrame, method: str, other: str) -> pd.DataFrame:
    """Pair the rollouts of two methods: one row per (task, seed) with both outcomes.

    Raises:
        ValueError: unknown method, or the methods did not run the same tasks and seeds.
    """
    known = sorted(rows.method.unique())
    for name in (method, other):
        if name not in known:
            raise ValueError(f"unknown method {name!r}: choose one of {', '.join(known)}")
    outcomes = rows.set_index(["task", "seed"]).success.astype(bool)
    left, right = (outcomes[(rows.method == name).to_numpy()] for name in (method, other))
    if left.index.has_duplicates or right.index.has_duplicates:
        raise ValueError(f"{method!r} or {other!r} ran a (task, seed) twice: pairs must be unique")
    if set(left.index) != set(right.index):
        odd = sorted(set(left.index) ^ set(right.index))[0]
        raise ValueError(f"{method!r} and {other!r} did not run the same rollouts: {odd} is in one only")
    return pd.DataFrame({method: left, other: right.loc[left.index]})


def paired_difference(
    rows: pd.DataFrame, method: str, other: str, *, seed: int, confidence: float = CONFIDENCE
) -> dict[str, Any]:
    """Return `success_difference` of `method` - `other` over the same rollouts, with the names of both.

    `only_method` and `only_other` count the rollouts that only one of them solved.
    """
    outcomes = paired(rows, method, other)
    found = statistics.success_difference(outcomes[method], outcomes[other], seed=seed, confidence=confidence)
    named = {"only_left": "only_method", "only_right": "only_other"}
    return {"method": method, "other": other, **{named.get(key, key): value for key, value in found.items()}}


def difference_over_seeds(
    rows: pd.DataFrame, method: str, other: str, *, seed: int, confidence: float = CONFIDENCE
) -> dict[str, Any]:
    """Difference in success rate `method` - `other`, paired by training seed and rollout.

    Returns:
        `over_seeds` of the differences, which generalises to other training seeds and rollouts; boot_low, boot_high of
        `crossed_bootstrap`; and for these models only: n, only_left, only_right (rollouts that only one method solved)
        and McNemar's exact p-value (`mcnemar_p`).

    Raises:
        ValueError: the methods do not have the same training seeds and rollouts.
    """
    left, right = (intervals.by_run(rows[rows.method == name]) for name in (method, other))
    if not (left.index.equals(right.index) and left.columns.equals(right.columns)):
        raise ValueError(f"{method!r} and {other!r} differ in training seeds or rollouts: they cannot be paired")
    outcomes = (one.to_numpy().ravel() for one in (left, right))
    pairs = statistics.success_difference(*outcomes, seed=seed, confidence=confidence)
    low, high = crossed_bootstrap(left - right, seed=seed, confidence=confidence)
    counts = {key: pairs[key] for key in ("n", "only_left", "only_right")}
    found = intervals.over_seeds(left - right, confidence)
    p_values = {"p_value": found.pop("p_value"), "mcnemar_p": pairs["p_value"]}
    return {"method": method, "other": other, **found, "boot_low": low, "boot_high": high, **counts, **p_values}


def crossed_bootstrap(
    values: pd.DataFrame, *, seed: int, confidence: float = CONFIDENCE, resamples: int = 2000
) -> tuple[float, float]:
    """Percentile interval of the mean: resample training seeds, and rollouts within tasks, independently.

    Its simulated coverage with 5 training seeds is 99 % where seeds are alike and falls to 93 % where they differ much,
    so the book reports `over_seeds` and shows this next to it.

    Source: the pigeonhole bootstrap, Owen 2007, doi 10.1214/07-AOAS122.
    """
    means = resampled_means([values], seed=seed, resamples=resamples)
    low, high = np.quantile(means, [(1 - confidence) / 2, (1 + confidence) / 2])
    return float(low), float(high)


def resampled_means(tables: Sequence[pd.DataFrame], *, seed: int, resamples: int = 2000) -> np.ndarray:
    """Return the means of tables, (resamples, tables), with training seeds and rollouts resampled alike in all.

    Args:
        tables: each with a row for each training seed and a column for each rollout (task, seed), the same in all.
    """
    rng, arrays = np.random.default_rng(seed), [table.to_numpy(float) for table in tables]
    seeds, rollouts = arrays[0].shape
    rows = rng.multinomial(seeds, np.full(seeds, 1 / seeds), resamples)
    tasks = np.asarray(tables[0].columns.get_level_values(0))
    columns = np.zeros((resamples, rollouts), dtype=int)
    for task in np.unique(tasks):
        places = np.flatnonzero(tasks == task)
        columns[:, places] = rng.multinomial(len(places), np.full(len(places), 1 / len(places)), resamples)
    return np.stack([np.einsum("rs,sa,ra->r", rows, a, columns, optimize=True) / a.size for a in arrays], axis=1)
