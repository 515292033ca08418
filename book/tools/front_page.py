"""The generated parts of the front page: a video of this build, and what the stored runs of the ten labs found."""

import re
import tempfile
from pathlib import Path

import nbformat
import numpy as np
import pandas as pd

import status
from execution import BookError
from fedvla_book import plots, tables
from fedvla_book.sentences import corrected, interval, is_clear, rate, verdict
from fedvla_book.tables import results
from fedvla_book.tables.worth import alone_at_best, worth
from fedvla_book.video_player import AT_ONCE, CONTROLS
from fedvla_lib.evaluation import figures

VIDEO_CHAPTER = "05_evaluation_videos"
COMPARISON = "book/reference/ten_labs"
OUTCOME = "book/_static/outcome.png"  # its figure
LONE, LONGER = "local-only-400", "local-only-800"  # the first is that of the plan's main comparison
ALONE, FEDERATED, POOLED = METHODS = ("local-only", "federated", "centralized")  # of `alone_at_best`
MAIN = (4, 8)  # demonstrations a lab in the main comparison, as the plan says
IN_WORDS = {
    ALONE: "a lab alone, with the number of steps, of those measured, that served it best", FEDERATED: "the federation",
    POOLED: "pooled training",
}  # fmt: skip
UNBROKEN = "\N{NO-BREAK SPACE}"
BY = ["partition", "method", "demonstrations", "place"]


def video(chapter: Path, profile: str) -> str:
    """The first video of the last evaluated round in a chapter, success or failure."""
    outputs = [output for cell in nbformat.read(chapter, as_version=4).cells for output in cell.get("outputs", [])]
    pages = [output.get("data", {}).get("text/html", "") for output in outputs]
    figures = [figure for page in pages for figure in re.findall(r"<figure.*?</figure>", page, flags=re.DOTALL)]
    by_round = {one: int(label[1]) for one in figures if (label := re.search(r'aria-label="Round (\d+)\.', one))}
    if not by_round:
        raise BookError(f"{chapter.name} shows no video of a round, which the front page needs")
    figure = max(by_round, key=by_round.get).replace(f"<video {CONTROLS} ", f"<video {AT_ONCE} ")
    return (
        f"{figure}\n\nThe federated policy that chapter 4 trained in this build, profile `{profile}` (not one of those "
        "in the result below): overhead camera on the left, front on the right; a click or the space bar stops it. "
        "{doc}`/notebooks/05_evaluation_videos` shows the others, failures included."
    )


def compared(folder: Path) -> pd.DataFrame:
    """Return the rollouts of the stored runs that the front page shows, fewest demonstrations first."""
    rows = results.read_results(folder).sort_values("demonstrations", kind="stable")
    return rows[rows.kind != "base"]


def headline(rows: pd.DataFrame) -> str:
    """What the stored runs found, for the front page: a figure, a table and statements.

    Raises:
        BookError: federated and centralized training differ in samples or in steps in a row, and the text says equal.
    """
    planned, fair = rows[rows.place == results.OWN], alone_at_best(rows)
    home, away = (fair[fair.place == place] for place in (results.OWN, "unseen"))
    labs, tasks = home.lab.nunique(), home.task.nunique()
    statements = (main_comparison(planned), _away(away), behind(home), _paid(planned, labs), _open(rows, fair, labs))
    return "\n".join([
        f"**Is it worth federating?** {labs} labs, one of {tasks} tasks in each; nano model, simulation.\n",
        _outcome_figure(), "", gain(home),
        "*Worth* is the number of demonstrations with which a lab alone does as well as in the federation. Brackets "
        "are 95 % intervals over training seeds, each with a recording of its own, and over rollouts, one by one; the "
        "statements below correct for several comparisons. {doc}`/notebooks/06_federated_vs_centralized` explains "
        f"both.{_measured_once(planned)}\n",
        *(f"- {said}" for said in statements),
    ])  # fmt: skip


def gain(home: pd.DataFrame) -> str:
    """A table of success on a lab's own task, in its own place, by demonstrations, whoever is ahead.

    The figure has the intervals of the rates; with them the table would be too wide for a page.

    Args:
        home: of `alone_at_best`, in a lab's own place.
    """
    rates = results.summary(home, BY).set_index(["method", "demonstrations"])
    alone, pooled = gaps(home, FEDERATED, ALONE), gaps(home, FEDERATED, POOLED)
    value = worth(home, FEDERATED, ALONE, seed=0).set_index("demonstrations")
    head = ["demonstrations", "alone", "federation", "pooled", "minus alone [points]", "minus pooled [points]", "worth"]
    lines = [
        [f"{count:.0f}", *(f"{rates.success_rate[name, count]:.0%}" for name in METHODS),
         alone.get(count, ""), pooled.get(count, ""), _worth(value.loc[count], max(value.index))]
        for count in value.index
    ]  # fmt: skip
    return status.table(head, [[cell.replace(" ", UNBROKEN) for cell in line] for line in lines])


def _measured_once(home: pd.DataFrame) -> str:
    """For how many demonstrations labs alone were measured with one number of steps, so that no best was chosen."""
    alone = home[home.kind == results.LOCAL_ONLY].groupby("demonstrations").steps_in_a_row.agg(["nunique", "first"])
    once = alone[alone["nunique"] == 1]
    counts = ", ".join(f"{count:.0f}" for count in once.index)
    return f" With {counts} demonstrations labs alone took {once['first'].iloc[0]:,.0f} steps only." if counts else ""


def gaps(rows: pd.DataFrame, method: str, other: str) -> dict[float, str]:
    """The difference of two methods in whole points, by demonstrations."""
    found = _differences(rows, method, other).itertuples()
    return {row.demonstrations: f"{100 * row.difference:+.0f} {interval(row.low, row.high, '+.0f')}" for row in found}


def _worth(row: pd.Series, most: float) -> str:
    needed, low, high = (f"{n:.1f}" if np.isfinite(n) else f"over {most:.0f}" for n in row[["needed", "low", "high"]])
    low = "1 or less" if low == "1.0" else low  # fewer were not measured
    return f"{needed} [{low}, {high}]"


def main_comparison(home: pd.DataFrame) -> str:
    """Who is ahead in the comparison that was planned."""
    found = _differences(home[home.demonstrations.isin(MAIN)], FEDERATED, LONE)
    rates = results.summary(home, BY).set_index(["demonstrations", "method"])
    said = [
        f"with {count} demonstrations a lab, in {rate(rates.loc[(count, LONE)])} alone and in "
        f"{rate(rates.loc[(count, FEDERATED)])} with the federation's model: {_gap(found.loc[f'demos-{count}'])}"
        for count in MAIN
    ]
    steps = results.summary(home[home.method == LONE]).steps_in_a_row.iloc[0]
    return (
        f"The comparison that was planned, with a lab alone that takes {steps:,.0f} steps (in the table it takes what "
        f"served it best): on a lab's own task, in its own place, the arm succeeds {'; '.join(said)}."
    )


def _away(away: pd.DataFrame) -> str:
    found = _differences(away, FEDERATED, ALONE)
    said = [f"with {count}, {_gap(found.loc[f'demos-{count}'])}" for count in MAIN]
    return f"In an eleventh lab, where nobody recorded, the federation compared with a lab alone: {'; '.join(said)}."


def behind(home: pd.DataFrame) -> str:
    """Where the federation falls behind pooled training and labs alone; `home` is of `alone_at_best`."""
    both = tables.differences(home, [(FEDERATED, POOLED), (FEDERATED, ALONE)], seed=0)
    found = dict(list(both.groupby("other")))
    behind = {
        other: sum(is_clear(row) and row.difference < 0 for row in table.itertuples()) for other, table in found.items()
    }
    taken = results.summary(home, BY).pivot(index="demonstrations", columns="method", values="steps_in_a_row")
    longer = [
        f"{row[ALONE]:,.0f} against {row[FEDERATED]:,.0f} with {count:.0f} demonstrations"
        for count, row in taken.iterrows() if row[ALONE] > row[FEDERATED]
    ]  # fmt: skip
    worst = found[ALONE].loc[found[ALONE].difference.idxmin()]
    return (
        f"The federation is behind pooled training with {behind[POOLED]} of {len(found[POOLED])} numbers of "
        f"demonstrations, and behind labs alone with {behind[ALONE]} of {len(found[ALONE])}; the least favourable "
        f"difference from labs alone is that with {worst.partition.removeprefix('demos-')}: {corrected(worst)}."
        + (f" Labs alone took more steps in a row than the federation: {'; '.join(longer)}." if longer else "")
    )


def _paid(home: pd.DataFrame, labs: int) -> str:
    spent = results.summary(home[home.demonstrations == MAIN[-1]], BY).set_index("method")
    federated, pooled, lone = (spent.loc[name] for name in (FEDERATED, POOLED, LONE))
    longer = _differences(home, LONGER, LONE).loc[f"demos-{MAIN[-1]}"]
    for what in ("samples", "steps_in_a_row"):
        if federated[what] != pooled[what]:
            raise BookError(f"{FEDERATED} and {POOLED} differ in {what}, and the front page says that they are equal")
    return (
        f"Counted while training, with {MAIN[-1]} demonstrations: {federated.steps_in_a_row:,.0f} gradient steps in a "
        f"row and {federated.samples:,.0f} samples for the federation and for pooled training alike, and "
        f"{federated.MB:,.0f} MB sent for the first, {federated.MB / labs:,.1f} a lab. "
        f"A lab alone took {lone.steps_in_a_row:,.0f} steps; {spent.steps_in_a_row[LONGER]:,.0f} steps instead: "
        f"{_gap(longer)}."
    )


def _open(rows: pd.DataFrame, fair: pd.DataFrame, labs: int) -> str:
    seeds = fair[fair.method.isin(METHODS)].groupby(["method", "demonstrations"]).run.nunique()
    drawn = results.summary(rows[rows.place == results.OWN], BY).groupby("method").samples.first()
    return (
        "**What this does not show**: other models, real arms, another ten labs, more than "
        f"{rows.task.nunique()} tasks, labs that differ more than we chose. "
        f"A lab alone drew {drawn[LONE] / labs:,.0f} samples in {LONE.rpartition('-')[2]} steps and the federation "
        f"{drawn[FEDERATED]:,.0f}: how much of its lead is due to samples, and not to partners, is open. "
        "And the benchmark was chosen among several: with one table for both tasks, where only the instruction tells "
        "what to do, a pilot had federations behind labs alone (chapter 6). "
        f"At least {seeds.min()} training seeds for each point, {len(rows):,} rollouts."
    )


def _differences(rows: pd.DataFrame, method: str, other: str) -> pd.DataFrame:
    found = tables.differences(rows, [(method, other)], seed=0).set_index("partition")
    return found.assign(demonstrations=rows.groupby("partition").demonstrations.first())


def _outcome_figure() -> str:
    names = "; ".join(f"`{method}`: {words}" for method, words in IN_WORDS.items())
    return (
        f"```{{figure}} {Path(OUTCOME).relative_to('book').as_posix()}\n"
        ":alt: Success rate against demonstrations per lab, with intervals: a line each for labs alone, for the "
        "federation and for pooled training.\n"
        ":width: 100%\n\n"
        f"Success at a lab's own task, in its own place. {names}.\n```"
    )


def outcome(rows: pd.DataFrame) -> bytes:
    """The figure below the headline, as PNG."""
    plots.use_style()
    fair = alone_at_best(rows)
    shown = fair[(fair.place == results.OWN) & fair.method.isin(METHODS)]
    axes = plots.success_by_demonstrations(results.summary(shown, BY))
    with tempfile.TemporaryDirectory() as folder:
        figures.save(axes, Path(folder) / "outcome.png")
        return (Path(folder) / "outcome.png").read_bytes()


def _gap(found: pd.Series) -> str:
    """A difference in words that its corrected p-value supports."""
    words = {"ahead of": "ahead", "behind": "**behind**"}.get(verdict(found), "not shown to differ")
    return f"{words}, {corrected(found)}"
