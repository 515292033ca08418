"""The generated parts of the front page: a video of this build, and the result of the stored comparison."""

import re
import tempfile
from pathlib import Path

import nbformat
import pandas as pd

from execution import BookError
from fedvla_book import plots, tables
from fedvla_lib.evaluation import figures, statistics
from fedvla_lib.experiments import results

VIDEO_CHAPTER = "05_evaluation_videos"
COMPARISON = "book/reference/comparison"
OUTCOME = "book/_static/outcome.png"  # its figure
# Methods in the headline.
FEDERATED, POOLED, LOCAL, LOCAL_LONGER = "fedavg-200x2x2", "centralized", "local-only", "local-only-800"
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
        f"{max(by_round, key=by_round.get)}\n\nThe federated policy in this build, profile `{profile}`: overhead "
        "camera left, front camera right. {doc}`/notebooks/05_evaluation_videos` shows the others, failures included."
    )


def compared(folder: Path) -> pd.DataFrame:
    """Return the rollouts of the stored comparison; those of a method without partition stand in each partition."""
    return tables.repeat_partition_free(results.read_results(folder))


def headline(rows: pd.DataFrame) -> str:
    """The result of the stored comparison for the front page: one sentence per line, and a figure.

    Raises:
        BookError: federated and centralized training differ in total steps, which makes the first sentence wrong.
    """
    of_task = rows[rows.partition == "task"]
    of_method = results.summary(of_task).set_index("method")
    labs, tasks = of_task.client.nunique(), of_task.task.nunique()
    return "\n".join([
        f"**Result.** Each of {labs} labs holds demonstrations of one of {tasks} tasks.",
        *_at_equal_total(of_method), _gaps(rows), *_local_share(of_method), *_local_longer(of_task),
        _counting(of_method), "", _outcome_figure(of_method),
    ])  # fmt: skip


def _at_equal_total(of_method: pd.DataFrame) -> list[str]:
    federated, pooled = of_method.loc[FEDERATED], of_method.loc[POOLED]
    if federated.steps_in_all != pooled.steps_in_all or federated.rollouts != pooled.rollouts:
        raise BookError(f"{FEDERATED} and {POOLED} differ in total steps or rollouts, and the front page says equal")
    return [
        f"After {federated.steps_in_all:,.0f} gradient steps in total, the success rate of the federated model is "
        f"{_rate_of(federated)} and that of centralized training on all demonstrations {_rate_of(pooled)}, "
        f"each over {federated.rollouts:,} rollouts and {federated.seeds} training seeds.",
        f"The labs of a round train in parallel, so the federated model took {federated.steps_in_a_row:,.0f} "
        f"sequential steps, the centralized one {pooled.steps_in_a_row:,.0f}.",
    ]


def _gaps(rows: pd.DataFrame) -> str:
    found = tables.differences(rows, [(FEDERATED, POOLED)], seed=0).set_index("partition")
    gaps = [_gap(words, found.loc[name]) for name, words in DEALT.items() if name in found.index]
    return f"Federated minus centralized: {'; '.join(gaps)}."


def _local_share(of_method: pd.DataFrame) -> list[str]:
    local = of_method.loc[LOCAL]
    return [
        f"A lab that trains alone for its share of the steps, {local.steps_in_all:,.0f}, reaches {_rate_of(local)} "
        f"over {local.rollouts:,} rollouts and {local.seeds} training seeds.",
        "It was evaluated on all tasks, most of which it has no demonstrations of: "
        "this number does not measure what a lab can do alone.",
    ]


def _local_longer(of_task: pd.DataFrame) -> list[str]:
    """Labs alone with as many steps as the federation, at their own task, next to the federated model."""
    longer = of_task[of_task.method == LOCAL_LONGER]
    steps, elsewhere = longer.steps_in_all.mean(), longer[~tables.at_own_task(longer)]
    found = tables.beside_own_tasks(of_task, LOCAL_LONGER, FEDERATED, seed=0)
    rates = [_percent(*(found[f"{who}_{end}"] for end in ("rate", "low", "high"))) for who in ("success", "other")]
    gap = _points(*(-100 * found[end] for end in ("difference", "high", "low")), " points")
    others = _percent(elsewhere.success.mean(), *statistics.success_interval(elsewhere))
    once = "That is one training seed, so these intervals cover other rollouts, not other training seeds."
    easy = found["success_rate"] > NEARLY_SOLVED
    why = "few demonstrations nearly solve these tasks" if easy else "one lab has few demonstrations of few tasks"
    return [
        f"After {steps:,.0f} steps each, labs alone reach {rates[0]} over {found['n']:,} rollouts at their own "
        f"task, and the federated model {rates[1]} over the same rollouts: federated minus alone, {gap}.",
        f"At the other labs' tasks labs alone reach {others} over {len(elsewhere):,} rollouts; "
        "the federated model is one model for all tasks.",
        once if found["seeds"] == 1 else f"These are {found['seeds']} training seeds.",
        f"This grid does not answer whether federating is worth it: {why}.",
    ]


def _counting(of_method: pd.DataFrame) -> str:
    text = "Brackets are 95 % intervals; {doc}`/notebooks/06_federated_vs_centralized` explains them."
    planned = [f"`{method}`" for method, counted in of_method.counted.items() if not counted]
    if not planned:
        return text
    return f"{text}\nThe steps of {', '.join(planned)} are derived from settings: those runs did not count their steps."


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


def _percent(rate: float, low: float, high: float) -> str:
    return _points(100 * rate, 100 * low, 100 * high, " %")


def _gap(words: str, found: pd.Series) -> str:
    gap = _points(100 * found.difference, 100 * found.low, 100 * found.high, " points")
    return f"{words}, {gap}, {found.seeds} seeds"


def _points(value: float, low: float, high: float, unit: str) -> str:
    return f"{value:.1f}{unit} [{low:.1f}, {high:.1f}]"
