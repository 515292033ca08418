"""The generated parts of the front page: a video of this build, and the result of the stored comparison."""

import re
import tempfile
from pathlib import Path
from typing import Any

import nbformat
import pandas as pd

from execution import BookError
from fedvla_book import plots, tables
from fedvla_book.tables import intervals, results
from fedvla_lib.evaluation import figures

VIDEO_CHAPTER = "05_evaluation_videos"
COMPARISON = "book/reference/comparison"
OUTCOME = "book/_static/outcome.png"  # its figure
# Methods in the headline.
FEDERATED, SELDOM, POOLED = "fedavg-200x2x2", "fedavg-10x4x20", "centralized"
LOCAL, LOCAL_LONGER = "local-only", "local-only-800"
NEARLY_SOLVED = 0.8  # success rate of local-only labs above which federating can add little
DEALT = {"iid": "the same mix of tasks in every lab", "dirichlet-0_5": "uneven mixes (Dirichlet, 0.5)",
         "dirichlet-0_1": "very uneven mixes (Dirichlet, 0.1)", "task": "one task per lab",
         "lab": "labs that differ in camera, light and calibration"}  # fmt: skip


def video(chapter: Path, profile: str) -> str:
    """The first video of the last evaluated round in a chapter, success or failure."""
    outputs = [output for cell in nbformat.read(chapter, as_version=4).cells for output in cell.get("outputs", [])]
    pages = [output.get("data", {}).get("text/html", "") for output in outputs]
    figures = [figure for page in pages for figure in re.findall(r"<figure.*?</figure>", page, flags=re.DOTALL)]
    by_round = {one: int(label[1]) for one in figures if (label := re.search(r'aria-label="Round (\d+)\.', one))}
    if not by_round:
        raise BookError(f"{chapter.name} shows no video of a round, which the front page needs")
    return (
        f"{max(by_round, key=by_round.get)}\n\nThe federated policy that chapter 4 trained in this build, profile "
        f"`{profile}` (not one of those in the result below): overhead camera left, front camera right. "
        "{doc}`/notebooks/05_evaluation_videos` shows the others, failures included."
    )


def compared(folder: Path) -> pd.DataFrame:
    """Return the rollouts of the stored comparison; those of a method without partition stand in each partition."""
    return tables.repeat_partition_free(results.read_results(folder))


def headline(rows: pd.DataFrame) -> str:
    """The result of the stored comparison for the front page: a list of statements, and a figure.

    Raises:
        BookError: federated and centralized training differ in total steps, which makes the first statement wrong.
    """
    of_task = rows[rows.partition == "task"]
    of_method = results.summary(of_task).set_index("method")
    labs, tasks = of_task.client.nunique(), of_task.task.nunique()
    at_own = tables.beside_own_tasks(of_task, LOCAL_LONGER, FEDERATED, seed=0)
    return "\n".join([
        f"**Result.** Each of {labs} labs holds demonstrations of one of {tasks} tasks. "
        "Brackets are 95 % intervals, each on its own; {doc}`/notebooks/06_federated_vs_centralized` explains them.\n",
        *(f"- {said}" for said in (_at_equal_total(of_method), _cadences(of_method), _gaps(rows),
                                   _local_share(of_task), _local_longer(of_task, at_own, labs), _open(rows, at_own))),
        "", _outcome_figure(of_method),
    ])  # fmt: skip


def _at_equal_total(of_method: pd.DataFrame) -> str:
    federated, pooled = of_method.loc[FEDERATED], of_method.loc[POOLED]
    if federated.steps_in_all != pooled.steps_in_all or federated.rollouts != pooled.rollouts:
        raise BookError(f"{FEDERATED} and {POOLED} differ in total steps or rollouts, and the front page says equal")
    by = "" if federated.counted and pooled.counted else " (by their settings: these runs did not count them)"
    return (
        f"After {federated.steps_in_all:,.0f} gradient steps in total{by}, the success rate of the federated model is "
        f"{_rate_of(federated)} and that of centralized training on all demonstrations {_rate_of(pooled)}, "
        f"each over {federated.rollouts:,} rollouts and {federated.seeds} training seeds."
    )


def _cadences(of_method: pd.DataFrame) -> str:
    federated, seldom, pooled = (of_method.loc[name] for name in (FEDERATED, SELDOM, POOLED))
    return (
        f"That federation averages often: {_cadence(FEDERATED)}. With {_cadence(SELDOM)}, as in chapters 4 to 6, "
        f"the same total gives {_rate_of(seldom)}. The labs of a round train in parallel, so the two federated models "
        f"took {federated.steps_in_a_row:,.0f} and {seldom.steps_in_a_row:,.0f} steps in a row, "
        f"the centralized one {pooled.steps_in_a_row:,.0f}."
    )


def _cadence(method: str) -> str:
    rounds, labs, steps = method.rsplit("-", 1)[1].split("x")
    return f"{rounds} rounds of {labs} labs with {steps} steps each"


def _gaps(rows: pd.DataFrame) -> str:
    found = tables.differences(rows, [(FEDERATED, POOLED)], seed=0).set_index("partition")
    gaps = [_gap(words, found.loc[name]) for name, words in DEALT.items() if name in found.index]
    return (
        f"The first minus centralized, over the same rollouts: {'; '.join(gaps)}. "
        "All of them share the same centralized models."
    )


def _local_share(of_task: pd.DataFrame) -> str:
    """Labs alone with their share of the steps, apart for their own task and for those they have never seen."""
    share, federated = (of_task[of_task.method == name] for name in (LOCAL, FEDERATED))
    own = tables.at_own_task(share)
    times = federated.steps_in_all.mean() / share.steps_in_all.mean()
    return (
        f"Labs alone with their share of the steps, {share.steps_in_all.mean():,.0f} each, reach {_rate(share[own])} "
        f"at their own task and {_rate(share[~own])} at the others'. "
        f"The federated model took {times:.0f} times as many steps, so this is not what a lab can do alone."
    )


def _local_longer(of_task: pd.DataFrame, found: dict[str, Any], labs: int) -> str:
    """Labs alone with as many steps as the federation, at their own task, next to the federated model."""
    longer = of_task[of_task.method == LOCAL_LONGER]
    steps, elsewhere = longer.steps_in_all.mean(), longer[~tables.at_own_task(longer)]
    rates = [_percent(*(found[f"{who}_{end}"] for end in ("rate", "low", "high"))) for who in ("success", "other")]
    gap = _points(*(-100 * found[end] for end in ("difference", "high", "low")), " points")
    seeds = "one training seed" if found["seeds"] == 1 else f"{found['seeds']} training seeds"
    once = " These intervals do not cover other training seeds." if found["seeds"] == 1 else ""
    return (
        f"Labs alone with {steps:,.0f} steps each, {labs * steps:,.0f} together and all at their own task, reach "
        f"{rates[0]} there, and the federated model {rates[1]} over the same {found['n']:,} rollouts of {seeds}: "
        f"federated minus alone, {gap}.{once} At the others' tasks they reach {_rate(elsewhere)}; "
        "the federated model is one model for all tasks."
    )


def _open(rows: pd.DataFrame, found: dict[str, Any]) -> str:
    """What this grid leaves open, and why."""
    missing = [words for name, words in DEALT.items()
               if not (rows[rows.partition == name].method == FEDERATED).any()]  # fmt: skip
    solved = found["success_rate"] > NEARLY_SOLVED
    easy = "a lab's own demonstrations nearly solve its task" if solved else "a lab has few demonstrations of one task"
    measured = f" Planned, and not measured here: federated with {'; '.join(missing)}." if missing else ""
    return f"**Whether federating is worth it, this does not answer**: {easy}.{measured}"


def _outcome_figure(of_method: pd.DataFrame) -> str:
    few = [f"`{method}`" for method, seeds in of_method.seeds.items() if seeds == 1]
    once = f" With one training seed, hence intervals over rollouts only: {', '.join(few)}." if few else ""
    return (
        f"```{{figure}} {Path(OUTCOME).relative_to('book').as_posix()}\n"
        ":alt: Points with intervals, a row per method with the gradient steps of its model: success rates of the "
        "base, of labs alone at their own task and at other tasks, of two federations and of centralized training.\n"
        ":width: 100%\n\n"
        "Success rate of each method with one task per lab, and the gradient steps of one model. For labs alone, "
        f"rollouts at their own task and at other tasks are shown separately.{once}\n```"
    )


def outcome(rows: pd.DataFrame) -> bytes:
    """The figure below the headline, as PNG."""
    plots.use_style()
    axes = plots.success_intervals(results.summary(tables.by_steps(rows[rows.partition == "task"])), ylabel="method")
    with tempfile.TemporaryDirectory() as folder:
        figures.save(axes, Path(folder) / "outcome.png")
        return (Path(folder) / "outcome.png").read_bytes()


def _rate_of(found: pd.Series) -> str:
    return _percent(found.success_rate, found.low, found.high)


def _rate(rows: pd.DataFrame) -> str:
    return f"{_percent(rows.success.mean(), *intervals.success_interval(rows))} over {len(rows):,} rollouts"


def _percent(rate: float, low: float, high: float) -> str:
    return _points(100 * rate, 100 * low, 100 * high, " %")


def _gap(words: str, found: pd.Series) -> str:
    gap = _points(100 * found.difference, 100 * found.low, 100 * found.high, " points")
    return f"{words}, {gap}, {found.seeds} seeds, {found.n:,} pairs"


def _points(value: float, low: float, high: float, unit: str) -> str:
    return f"{value:.1f}{unit} [{low:.1f}, {high:.1f}]"
