"""Compare run folders: check that they are comparable, then tabulate values and paired differences.

Each run is read at its last measured round. Runs are paired by held-out episode and by rollout; the first run is the
reference.
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
SINGLE_MODEL = (run_folder.GLOBAL, "local")  # values of `who` in measurements of a run's one model
ROLLOUT_KEY = ["task", "lab", "seed"]
LAST = ["p_value", "p_holm", "mismatch"]  # columns after the effect and its interval
# Settings that decide what is measured, or where training starts.
MUST_MATCH = ("data", "tasks", "episodes_per_task", "image_size", "num_labs", "val_fraction", "base", "chunk_size",
              "batch_size", "action_tolerance_deg")  # fmt: skip
LOSS_UNIT = ("normalisation",)  # sets the unit of the loss; must match only where losses are compared


@dataclass(frozen=True)
class Run:
    """A run's settings and the measurements of its last model."""

    name: str
    config: Config
    gradient_steps: int
    episodes: pd.DataFrame  # by episode_id: num_examples, loss, action_error, action_accuracy
    rollouts: pd.DataFrame  # task, lab, seed, success


def read_run(folder: Path) -> Run:
    """Read from a run folder what is compared; raise ValueError if it is not one, or holds no measurements."""
    if not (folder / "config.json").is_file():
        raise ValueError(f"{folder} is not a run folder: it has no config.json")
    config = run_folder.read_config(folder)
    held_out = _last(run_folder.read_metrics(folder, "held-out"))
    if held_out.empty:
        raise ValueError(f"{folder} measured no held-out episode: let the run end, with val-fraction above 0")
    rollouts, columns = _last(run_folder.read_metrics(folder, "rollout")), [*ROLLOUT_KEY, "success"]
    rollouts = rollouts[columns] if len(rollouts) else pd.DataFrame(columns=columns)
    return Run(folder.name, config, _gradient_steps(folder), held_out.set_index("episode_id"), rollouts)


def _last(rows: pd.DataFrame) -> pd.DataFrame:
    rows = rows[rows.who.isin(SINGLE_MODEL)]
    return rows[rows["round"] == rows["round"].max()]


def _gradient_steps(folder: Path) -> int:
    """Gradient steps as counted while training."""
    evaluated = run_folder.read_metrics(folder, "evaluate")
    if "gradient_steps" in evaluated:
        return int(evaluated.gradient_steps.dropna().iloc[-1])
    return run_folder.counted_steps(folder)["in_all"]


def mismatches(runs: Sequence[Run], metrics: Sequence[str]) -> list[str]:
    """Return what makes runs incomparable with the first, one line each; none if they can be compared."""
    return [
        f"{runs[0].name} and {run.name} differ in {what}: {how}"
        for run in runs[1:]
        for what, how in _mismatches(runs[0], run, metrics).items()
    ]


def _mismatches(first: Run, other: Run, metrics: Sequence[str]) -> dict[str, str]:
    names = MUST_MATCH + LOSS_UNIT * ("loss" in metrics)
    pairs = [(name.replace("_", "-"), getattr(first.config, name), getattr(other.config, name)) for name in names]
    pairs.append(("gradient steps", first.gradient_steps, other.gradient_steps))
    found = {name: f"{left!r} and {right!r}" for name, left, right in pairs if left != right}
    if set(metrics) - {SUCCESS} and set(first.episodes.index) != set(other.episodes.index):
        found["held-out episodes"] = f"{list(first.episodes.index)} and {list(other.episodes.index)}"
    if SUCCESS in metrics and (left := _rollout_keys(first)) != (right := _rollout_keys(other)):
        found["rollouts"] = f"{len(left)} and {len(right)}, of which {len(left & right)} are common"
    return found


def _rollout_keys(run: Run) -> set[tuple[Any, ...]]:
    return set(run.rollouts[ROLLOUT_KEY].itertuples(index=False, name=None))


def values(runs: Sequence[Run], metrics: Sequence[str], *, seed: int, confidence: float) -> pd.DataFrame:
    """Return a row for each run and metric: n, value, low, high (Wilson for success, else bootstrap over episodes).

    The column mismatch names what makes the value incomparable with the first run's.
    """
    return pd.DataFrame([
        {"run": run.name, "gradient_steps": run.gradient_steps, "metric": metric,
         **_value(run, metric, seed, confidence), "mismatch": ", ".join(_mismatches(runs[0], run, [metric]))}
        for run in runs for metric in metrics
    ])  # fmt: skip


def _value(run: Run, metric: str, seed: int, confidence: float) -> dict[str, float]:
    if (of_success := metric == SUCCESS) and run.rollouts.empty:
        raise ValueError(f"{run.name} made no rollout: run it with eval-rollouts above 0, or leave out {SUCCESS}")
    each = (run.rollouts.success if of_success else run.episodes[metric]).to_numpy(float)
    return statistics.mean_with_interval(each, of_success=of_success, seed=seed, confidence=confidence)


def differences(runs: Sequence[Run], metrics: Sequence[str], *, seed: int, confidence: float) -> pd.DataFrame:
    """Return a row for each metric and each run but the first: run minus first, over what both measured.

    Columns: the difference in the metric's unit with low and high, paired over held-out episodes or rollouts;
    `visible`, the smallest difference that this many pairs detect with a power of 80 %; p_value, and `p_holm`,
    corrected over the table (Holm 1979); `mismatch`, which names what makes the two runs incomparable.
    """
    first = runs[0]
    table = pd.DataFrame([
        {"run": run.name, "against": first.name, "metric": metric,
         **_difference(run, first, metric, seed, confidence), "mismatch": ", ".join(_mismatches(first, run, [metric]))}
        for metric in metrics for run in runs[1:]
    ])  # fmt: skip
    table = table.assign(p_holm=statistics.holm(table.p_value))
    return table[[name for name in table if name not in LAST] + LAST]


def _difference(run: Run, first: Run, metric: str, seed: int, confidence: float) -> dict[str, Any]:
    if metric == SUCCESS:
        what, compare = "rollout", statistics.success_difference
        pairs = run.rollouts.merge(first.rollouts, on=ROLLOUT_KEY, suffixes=("", "_first"))
        left, right = pairs.success, pairs.success_first
    else:
        what, compare = "held-out episode", statistics.mean_difference
        left, right = run.episodes[metric].align(first.episodes[metric], join="inner")
    if left.empty:
        raise ValueError(f"{run.name} and {first.name} share no {what}: there is nothing to compare")
    return compare(left.to_numpy(), right.to_numpy(), seed=seed, confidence=confidence)


def write(out: Path, runs: Sequence[Run], tables: dict[str, pd.DataFrame], differ: Sequence[str]) -> None:
    """Write the tables as JSON and CSV and a figure of the differences into `out`."""
    settings = {run.name: asdict(run.config) for run in runs}
    content = {name: table.to_dict("records") for name, table in tables.items()}
    files.write_json(out / "comparison.json", {"mismatches": list(differ), **content, "settings": settings})
    for name, table in tables.items():
        files.write_atomically(out / f"{name}.csv", table.to_csv(index=False).encode())
    figures.save(figures.run_differences(tables["differences"], note="; ".join(differ)), out / "differences.png")
