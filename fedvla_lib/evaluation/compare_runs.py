"""Run folders -> one table of differences, after a check that the runs can be compared at all.

Each run is read at its last measured round: its held-out episodes one by one, and its rollouts one by one, so that
two runs are compared episode by episode and rollout by rollout. The first run is the one the others are held against.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from fedvla_lib import files, run_folder
from fedvla_lib.config import Config
from fedvla_lib.evaluation import figures, statistics

SUCCESS = "success_rate"
METRICS = ("loss", "action_error", "action_accuracy", SUCCESS)
WHOLE = ("global", "local")  # whose measurements are of a run's one model
ATTEMPT = ["task", "lab", "seed"]
LAST = ["p_value", "p_holm", "mismatch"]  # columns after the effect and its interval
# Settings that decide what is measured, or from where training starts.
ALIKE = ("data", "tasks", "episodes_per_task", "image_size", "num_labs", "val_fraction", "base", "chunk_size",
         "batch_size", "action_tolerance_deg")  # fmt: skip
IN_LOSS = ("normalisation",)  # decides the unit of the loss, though not of what the method does


@dataclass(frozen=True)
class Run:
    """What a run folder says of its last model."""

    name: str
    config: Config
    gradient_steps: int
    episodes: pd.DataFrame  # by episode_id: num_examples, loss, action_error, action_accuracy
    rollouts: pd.DataFrame  # task, lab, seed, success


def read_run(folder: Path) -> Run:
    """Read what is to be compared of a run.

    Raises:
        ValueError: not a run folder, or a run that measured nothing.
    """
    folder = Path(folder)
    if not (folder / "config.json").is_file():
        raise ValueError(f"{folder} is not a run folder: it has no config.json")
    config = run_folder.read_config(folder)
    held_out = _last(run_folder.read_metrics(folder, "held-out"))
    if held_out.empty:
        raise ValueError(f"{folder} measured no held-out episode: let the run end, with val-fraction above 0")
    rollouts = _last(run_folder.read_metrics(folder, "rollout"))
    rollouts = rollouts[[*ATTEMPT, "success"]] if len(rollouts) else pd.DataFrame(columns=[*ATTEMPT, "success"])
    return Run(folder.name, config, _gradient_steps(folder, config), held_out.set_index("episode_id"), rollouts)


def _last(rows: pd.DataFrame) -> pd.DataFrame:
    rows = rows[rows.who.isin(WHOLE)]
    return rows[rows["round"] == rows["round"].max()]


def _gradient_steps(folder: Path, config: Config) -> int:
    """Steps that were done: what a training in one place counted, or what the clients did.

    Of runs from before clients counted, local steps times the replies that were averaged.
    """
    evaluated = run_folder.read_metrics(folder, "evaluate")
    if "gradient_steps" in evaluated:
        return int(evaluated.gradient_steps.dropna().iloc[-1])
    if counted := run_folder.counted_steps(folder):
        return counted["in_all"]
    return len(run_folder.read_metrics(folder, "train")) * config.local_steps


def mismatches(runs: Sequence[Run], metrics: Sequence[str]) -> list[str]:
    """Return what makes runs incomparable with the first, one line each; none if they can be compared."""
    return [
        f"{runs[0].name} and {run.name} differ in {what}: {how}"
        for run in runs[1:]
        for what, how in _mismatches(runs[0], run, metrics).items()
    ]


def _mismatches(first: Run, other: Run, metrics: Sequence[str]) -> dict[str, str]:
    """What differs, and how."""
    alike = ALIKE + IN_LOSS * ("loss" in metrics)
    pairs = [(name.replace("_", "-"), getattr(first.config, name), getattr(other.config, name)) for name in alike]
    pairs.append(("gradient steps", first.gradient_steps, other.gradient_steps))
    found = {name: f"{left!r} and {right!r}" for name, left, right in pairs if left != right}
    if set(metrics) - {SUCCESS} and set(first.episodes.index) != set(other.episodes.index):
        found["held-out episodes"] = f"{list(first.episodes.index)} and {list(other.episodes.index)}"
    if SUCCESS in metrics and _keys(first) != _keys(other):
        ours, theirs = _keys(first), _keys(other)
        found["rollouts"] = f"{len(ours)} and {len(theirs)}, of which {len(ours & theirs)} are common"
    return found


def _label(first: Run, other: Run, metric: str) -> str:
    """Name what makes a line of a table incomparable, for whoever sees the table alone; empty if nothing does."""
    return ", ".join(_mismatches(first, other, [metric]))


def _keys(run: Run) -> set[tuple[Any, ...]]:
    return set(run.rollouts[ATTEMPT].itertuples(index=False, name=None))


def values(runs: Sequence[Run], metrics: Sequence[str], *, seed: int, confidence: float) -> pd.DataFrame:
    """Return a row for each run and metric: n, value, low, high (Wilson for success, else bootstrap over episodes).

    The column mismatch names what makes the value incomparable with the first run's.
    """
    rows = []
    for run in runs:
        for metric in metrics:
            known = {"run": run.name, "gradient_steps": run.gradient_steps, "metric": metric}
            found = _value(run, metric, seed, confidence)
            rows.append({**known, **found, "mismatch": _label(runs[0], run, metric)})
    return pd.DataFrame(rows)


def _value(run: Run, metric: str, seed: int, confidence: float) -> dict[str, float]:
    if metric != SUCCESS:
        each = run.episodes[metric].to_numpy()
        low, high = statistics.mean_interval(each, seed=seed, confidence=confidence)
        return {"n": len(each), "value": float(each.mean()), "low": low, "high": high}
    if run.rollouts.empty:
        raise ValueError(f"{run.name} made no rollout: run it with eval-rollouts above 0, or leave out {SUCCESS}")
    n, successes = len(run.rollouts), int(run.rollouts.success.sum())
    low, high = statistics.wilson(successes, n, confidence)
    return {"n": n, "value": successes / n, "low": low, "high": high}


def differences(runs: Sequence[Run], metrics: Sequence[str], *, seed: int, confidence: float) -> pd.DataFrame:
    """Return a row for each metric and each run but the first, that run minus the first, over what both measured.

    The effect comes first: the difference in the metric's own unit with its interval, a paired bootstrap over held-out
    episodes or rollouts, and `visible`, the smallest difference that so many pairs would have shown with a power of
    80 %. Then p-values: those of the table are one family, and `p_holm` are Holm's (1979). `mismatch` names what makes
    the two incomparable.
    """
    rows, first = [], runs[0]
    for metric in metrics:
        for run in runs[1:]:
            found = _difference(run, first, metric, seed, confidence)
            label = {"mismatch": _label(first, run, metric)}
            rows.append({"run": run.name, "against": first.name, "metric": metric, **found, **label})
    table = pd.DataFrame(rows)
    table = table.assign(p_holm=statistics.holm(table.p_value))
    return table[[name for name in table if name not in LAST] + LAST]


def _difference(run: Run, first: Run, metric: str, seed: int, confidence: float) -> dict[str, Any]:
    if metric == SUCCESS:
        pairs = run.rollouts.merge(first.rollouts, on=ATTEMPT, suffixes=("", "_first"))
        _require_pairs(run, first, len(pairs), "rollout")
        return statistics.success_difference(pairs.success, pairs.success_first, seed=seed, confidence=confidence)
    both = run.episodes.index.intersection(first.episodes.index)
    _require_pairs(run, first, len(both), "held-out episode")
    left, right = run.episodes.loc[both, metric], first.episodes.loc[both, metric]
    return statistics.mean_difference(left.to_numpy(), right.to_numpy(), seed=seed, confidence=confidence)


def _require_pairs(run: Run, first: Run, count: int, what: str) -> None:
    if not count:
        raise ValueError(f"{run.name} and {first.name} share no {what}: there is nothing to compare")


def check_metrics(metrics: Sequence[str]) -> list[str]:
    """Return the metrics.

    Raises:
        ValueError: one of them is unknown.
    """
    for metric in metrics:
        if metric not in METRICS:
            raise ValueError(f"unknown metric {metric!r}: choose from {', '.join(METRICS)}")
    return list(metrics)


def write(out: Path, runs: Sequence[Run], tables: dict[str, pd.DataFrame], differ: Sequence[str]) -> None:
    """Write the tables as JSON and CSV and a figure of the differences into `out`."""
    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    settings = {run.name: asdict(run.config) for run in runs}
    content = {name: table.to_dict("records") for name, table in tables.items()}
    files.write_json(out / "comparison.json", {"mismatches": list(differ), **content, "settings": settings})
    for name, table in tables.items():
        files.write_atomically(out / f"{name}.csv", table.to_csv(index=False).encode())
    figures.save(figures.run_differences(tables["differences"], note="; ".join(differ)), out / "differences.png")
