"""What an experiment left on disk -> tables: every attempt, every measured round, arms, differences of arms."""

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import spearmanr

from fedvla_lib import run_folder
from fedvla_lib.config import Config
from fedvla_lib.evaluation import statistics
from fedvla_lib.run_folder import GLOBAL

OF_CELL = ("arm", "kind", "partition", "gradient_steps", "samples", "bytes", "train_s")
OF_RUN = ("partition", "arm", "run")
# Settings that decide what demonstrations there are and which of them are held out.
RECORDING = ("data", "tasks", "episodes_per_task", "image_size", "num_labs", "val_fraction")
BLIND = ("base", "centralized")  # kinds that do not see how a recording is dealt out
SIDE_BY_SIDE = ("federated", "clients")  # kinds whose clients train at the same time
ALONE = "local-only"  # the kind whose clients train for themselves
OWN, OTHER = "own task", "other tasks"
HELD_OUT = ("loss", "action_error")
P_VALUES = ["p_value", "mcnemar_p", "p_holm"]


def read_results(folder: Path) -> pd.DataFrame:
    """Return a row for each attempt with the last model of each cell in `folder`, with what is known of the cell.

    train_s is NaN where a cell's stamp has no time of its training. steps_in_all and steps_in_a_row are the gradient
    steps of the model that made the attempt. Where `counted` is True it counted them while it trained; cells of before
    models counted have no counts, and there the numbers follow from the settings: of clients that trained alone, each
    has its share of the total.

    Raises:
        ValueError: there is no result.
    """
    return pd.concat([_attempts(cell) for cell in _cells(folder)], ignore_index=True)


def _cells(folder: Path) -> Iterator[Path]:
    cells = sorted(stamp.parent for stamp in Path(folder).glob("[!.]*/stamp.json"))
    if not cells:
        raise ValueError(f"no results in {folder}: make some with fedvla experiment")
    yield from cells


def _known(cell: Path) -> dict[str, Any]:
    stamp = run_folder.read_stamp(cell)
    known = {key: stamp[key] for key in OF_CELL} | {"run": stamp["seed"]}
    return known | {"train_s": float("nan") if known["train_s"] is None else known["train_s"]}


def _attempts(cell: Path) -> pd.DataFrame:
    rows = run_folder.read_metrics(cell, "rollout")
    last = run_folder.read_metrics(cell, "evaluate").iloc[-1]
    measured = {name: float(last.get(name, "nan")) for name in HELD_OUT}
    config = run_folder.read_config(cell)
    recording = ", ".join(str(getattr(config, name)) for name in RECORDING)
    rows = rows[rows["round"] == last["round"]]
    steps = _steps(run_folder.read_stamp(cell), config, rows)
    return rows.assign(**_known(cell), **measured, **steps, recording=recording)


def _steps(stamp: dict[str, Any], config: Config, rows: pd.DataFrame) -> dict[str, Any]:
    """Columns counted, steps_in_all and steps_in_a_row: of the model that made each attempt."""
    counted = stamp.get("steps")
    each = counted or {GLOBAL: _planned(stamp, config)}
    alone = rows.client.map("client_{:.0f}".format) if "client" in rows else pd.Series(GLOBAL, rows.index)
    names = [name if name in each else GLOBAL for name in alone]
    of_model = {f"steps_{how}": [each[name][how] for name in names] for how in ("in_all", "in_a_row")}
    return {"counted": counted is not None, **of_model}


def _planned(stamp: dict[str, Any], config: Config) -> dict[str, int]:
    """The steps that the settings ask of each model of a cell that has no counts."""
    total = stamp["gradient_steps"]
    if stamp["kind"] == "local-only":
        total //= config.num_clients
    in_a_row = config.num_server_rounds * config.local_steps if stamp["kind"] in SIDE_BY_SIDE else total
    return {"in_all": total, "in_a_row": in_a_row}


def repeat_partition_free(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the rows, and those of arms that see no partition once more for each partition of the same recording.

    Base and centralized training come out the same however a recording is dealt out, so they are measured with one of
    its partitions; to the others they are lent, for the same seeds and attempts. A partition that has an arm itself is
    lent none of it, and no partition is lent anything of another recording, such as that of several laboratories.

    Args:
        rows: of `read_results`.
    """
    lent = []
    for _, there in rows.groupby("recording", sort=False):
        for _, measured in there[there.kind.isin(BLIND)].groupby("arm", sort=False):
            lender = measured[measured.partition == measured.partition.iloc[0]]
            lacking = [name for name in there.partition.unique() if name not in set(measured.partition)]
            lent += [lender.assign(partition=name) for name in lacking]
    return pd.concat([rows, *lent], ignore_index=True)


def fill_in(rows: pd.DataFrame, other: pd.DataFrame, arm: str) -> pd.DataFrame:
    """Return the partitions of `rows` in which `arm` has two training seeds or more, and those that only `other` has.

    Args:
        rows, other: of `read_results`, perhaps lent; partitions of one name are the same in both.
    """
    seeds = rows[rows.arm == arm].groupby("partition").run.nunique()
    kept = rows[rows.partition.isin(seeds.index[seeds > 1])]
    return pd.concat([kept, other[~other.partition.isin(kept.partition)]], ignore_index=True)


def read_rounds(folder: Path) -> pd.DataFrame:
    """Return a row for each measured round of each federated cell in `folder`: loss and success of that global model.

    Columns: partition, arm, run, round, steps (gradient steps of all clients up to there), loss, action_error, n,
    successes, success_rate. Rounds that made no attempt have n = 0 and no rate. The last round was
    measured with the attempts of `read_results`, earlier ones with those of the training itself.

    Raises:
        ValueError: there is no result, or none of a federated cell.
    """
    tables = []
    for cell in _cells(folder):
        known = _known(cell)
        if known["kind"] == "federated":
            measured = run_folder.read_metrics(cell, "evaluate").set_index("round")[["loss", "action_error"]]
            made = run_folder.read_metrics(cell, "rollout").groupby("round").success.agg(n="size", successes="sum")
            rounds = measured.join(made).fillna({"n": 0, "successes": 0}).astype({"n": int, "successes": int})
            steps = known["gradient_steps"] * rounds.index / rounds.index.max()
            named = {key: known[key] for key in OF_RUN}
            tables.append(rounds.assign(**named, steps=steps.astype(int)).reset_index())
    if not tables:
        raise ValueError(f"no federated cell in {folder}: only those have rounds")
    table = pd.concat(tables, ignore_index=True)
    return table.assign(success_rate=table.successes / table.n.where(table.n > 0))


def correlations(rounds: pd.DataFrame, by: Sequence[str] = OF_RUN) -> pd.DataFrame:
    """Return Spearman's correlation of held-out loss with success over the checkpoints of each group, and over all.

    Columns partition, arm, run ("all" where the line does not tell them apart; everywhere in the last line), n
    (checkpoints), rho: -1 if the loss ranks them as success does, NaN if all are alike or there is one only.

    Args:
        rounds: of `read_rounds`; what made no attempt is left out.
        by: columns that make a group, of partition, arm and run.
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

    Columns partition, arm, run, round, loss, n, successes, success_rate, low, high of the one with the lower loss, the
    same with `other_` in front of the other; gap: what lies between the intervals; misled: the lower loss succeeds
    less often; same_run, and same_episodes: partition and training seed are the same, so the held-out episodes are.

    Args:
        rounds: of `read_rounds`; what made no attempt is left out.
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
    same_run = shared & (pairs.arm == pairs.other_arm)
    return pairs.assign(misled=pairs.success_rate < pairs.other_success_rate, same_run=same_run, same_episodes=shared)


def disagreements(rounds: pd.DataFrame) -> pd.DataFrame:
    """Return those of `clear_pairs` whose lower loss succeeds less often, the widest gap first."""
    pairs = clear_pairs(rounds)
    return pairs[pairs.misled].sort_values("gap", ascending=False, kind="stable", ignore_index=True)


def summary(rows: pd.DataFrame, by: Sequence[str] = ("partition", "arm")) -> pd.DataFrame:
    """Return a line for each group: seeds, attempts, success with its interval, and what training took on average.

    steps_in_all and steps_in_a_row are those of one model; gradient_steps, samples, MB and train_s those of all models
    of a cell together, which are several where clients train alone.

    Args:
        rows: of `read_results`.
        by: columns that make a group; at least partition and arm.
    """
    lines = []
    for group, part in rows.groupby(list(by), sort=False):
        cells = part.groupby("run").first()
        low, high = statistics.success_interval(part)
        lines.append({
            **dict(zip(by, group, strict=True)), "seeds": len(cells), "attempts": len(part),
            "success_rate": part.success.mean(), "low": low, "high": high, "loss": cells.loss.mean(),
            "action_error": cells.action_error.mean(),
            "steps_in_all": part.steps_in_all.mean(), "steps_in_a_row": part.steps_in_a_row.mean(),
            "counted": bool(part.counted.all()), "gradient_steps": cells.gradient_steps.mean(),
            "samples": cells.samples.mean(), "MB": cells.bytes.mean() / 1e6, "train_s": cells.train_s.mean(),
        })  # fmt: skip
    return pd.DataFrame(lines)


def at_own_task(rows: pd.DataFrame) -> pd.Series:
    """Return for each attempt whether it was at the task of the client that trained alone and made it.

    Only with partition `task` has a client one task: client k number k of all in alphabetical order, in turn, as
    `partition.partition` deals them out. Attempts of other arms, which no client made, are at nobody's own task.

    Args:
        rows: of `read_results`, of partition `task`, each arm with all tasks.
    """
    if "client" not in rows:
        return pd.Series(False, rows.index)
    tasks = sorted(rows.task.unique())
    own = rows.client.map(lambda client: tasks[int(client) % len(tasks)], na_action="ignore")
    return (rows.kind == ALONE) & (rows.task == own)


def by_steps(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the rows with arms named by the gradient steps of a model of theirs, fewest first.

    The attempts of clients that trained alone are split: those at their own task, and those at the others' tasks.

    Args:
        rows: of `read_results`, of partition `task`.
    """
    part = np.where(rows.kind == ALONE, np.where(at_own_task(rows), f", {OWN}", f", {OTHER}"), "")
    taken = rows.groupby("arm")[["steps_in_all", "steps_in_a_row"]].transform("mean")
    steps = [f", {_in_words(*each)}" for each in taken.itertuples(index=False)]
    order = taken.assign(arm=rows.arm, part=part)
    order = order.sort_values(list(order), ascending=[True, True, True, False], kind="stable")
    return rows.assign(arm=rows.arm + part + steps).loc[order.index]


def _in_words(in_all: float, in_a_row: float) -> str:
    return f"{in_all:,.0f} steps" + (f", {in_a_row:,.0f} in a row" if in_a_row < in_all else "")


def beside_own_tasks(rows: pd.DataFrame, arm: str, other: str, *, seed: int) -> dict[str, Any]:
    """Hold clients that trained alone, at their own tasks, against another arm on the same attempts.

    Args:
        rows: of `read_results`, of partition `task`.
        arm: whose clients trained alone.
        other: an arm with the same attempts.
        seed: of the interval's bootstrap.

    Returns:
        `compare.paired_difference` of arm - other where both have one training seed in common, else
        `compare.difference_over_seeds`; also seeds, and for both arms success_rate and other_rate with low and high.
    """
    own = rows[(rows.arm == arm) & at_own_task(rows)]
    key = ["run", "task", "seed"]
    same = rows[rows.arm == other].merge(own[key], on=key)
    own = own[own.run.isin(same.run)]
    both, seeds = pd.concat([own, same], ignore_index=True), int(own.run.nunique())
    of = statistics.paired_difference if seeds == 1 else statistics.difference_over_seeds
    found = {"seeds": seeds, **of(both, arm, other, seed=seed)}
    for name, part in (("success", own), ("other", same)):
        low, high = statistics.success_interval(part)
        found |= {f"{name}_rate": float(part.success.mean()), f"{name}_low": low, f"{name}_high": high}
    return found


def differences(rows: pd.DataFrame, pairs: Iterable[tuple[str, str]], *, seed: int) -> pd.DataFrame:
    """Return a line for each partition and pair of arms that both have: `compare.difference_over_seeds` of success.

    Only training seeds that both arms have are used. `loss` and `action_error` are differences of held-out averages,
    with loss_low, loss_high and so on: Student's over training seeds. P-values come last; those of the table are one
    family, and `p_holm` are Holm's (1979).
    """
    lines = []
    for partition, part in rows.groupby("partition", sort=False):
        for arm, other in pairs:
            shared = set(part[part.arm == arm].run) & set(part[part.arm == other].run)
            if len(shared) > 1:
                both = part[part.run.isin(shared)]
                found = statistics.difference_over_seeds(both, arm, other, seed=seed)
                lines.append({"partition": partition, "seeds": len(shared), **found, **_held_out(both, arm, other)})
    if not lines:
        return pd.DataFrame()
    table = pd.DataFrame(lines)
    table = table.assign(p_holm=statistics.holm(table.p_value))
    return table[[name for name in table if name not in P_VALUES] + P_VALUES]


def _held_out(rows: pd.DataFrame, arm: str, other: str) -> dict[str, float]:
    found = {}
    for name in HELD_OUT:
        each = rows.groupby(["arm", "run"])[name].first()
        over = statistics.over_seeds((each[arm] - each[other]).to_frame())
        found |= {name: over["difference"], f"{name}_low": over["low"], f"{name}_high": over["high"]}
    return found
