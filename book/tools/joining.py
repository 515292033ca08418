"""The generated parts of the page on whether a lab should join: tables from the stored runs of the ten labs."""

from collections.abc import Callable
from pathlib import Path

import pandas as pd

import status
from fedvla_book import tables
from fedvla_book.sentences import interval, points
from fedvla_book.tables import results
from fedvla_book.tables.worth import alone_at_best, ranking
from fedvla_lib.experiments.experiment_file import read_plan
from front_page import ALONE, BY, COMPARISON, FEDERATED, LONE, gain, gaps

METHODS, CADENCES = "book/reference/ten_labs_methods", "book/reference/ten_labs_cadence"
FEDAVG, EVEN = "fedavg", "iid"
MIXES = {EVEN: "dealt evenly", "dirichlet": "dealt unevenly", "task": "one task each", "lab": "one task and lab each"}


def parts(root: Path) -> dict[bytes, Callable[[], str]]:
    """Return what replaces each mark of the page."""
    headline, cadences, methods = (results.read_results(root / folder) for folder in (COMPARISON, CADENCES, METHODS))
    at = dict(list(alone_at_best(headline).groupby("place")))
    return {
        b"<!-- gain -->": lambda: gain(at[results.OWN]),
        b"<!-- elsewhere -->": lambda: elsewhere(at["unseen"], at["others"]),
        b"<!-- equal -->": lambda: equal_steps(headline[headline.place == results.OWN]),
        b"<!-- mix -->": lambda: mix(cadences) + _seeds(root / CADENCES, cadences),
        b"<!-- strategies -->": lambda: strategies(ranking(methods, headline)) + _seeds(root / METHODS, methods),
    }


def elsewhere(unseen: pd.DataFrame, others: pd.DataFrame) -> str:
    """The same in a lab that recorded nothing, and a lab alone at the task of the others."""
    rates = results.summary(unseen, BY).set_index(["method", "demonstrations"])
    other = results.summary(others[others.method == ALONE], BY).set_index("demonstrations")
    found = gaps(unseen, FEDERATED, ALONE)
    head = ["demonstrations", "alone, eleventh lab", "among ten, there", "difference [points]", "alone, others' task"]
    lines = [
        [f"{count:.0f}", _percent(rates.loc[(ALONE, count)]), _percent(rates.loc[(FEDERATED, count)]), found[count],
         _percent(other.loc[count])]
        for count in sorted(found)
    ]  # fmt: skip
    return status.table(head, lines)


def equal_steps(home: pd.DataFrame) -> str:
    """What the federation gains over a lab alone that takes as many steps in a row."""
    found = [f"{gap} with {count:.0f}" for count, gap in sorted(gaps(home, FEDERATED, LONE).items())]
    steps = results.summary(home[home.method == LONE]).steps_in_a_row.iloc[0]
    return (
        f"With {steps:,.0f} steps in a row for both, the differences in points are {', '.join(found)} demonstrations."
    )


def mix(rows: pd.DataFrame) -> str:
    """Success by cadence and by how the episodes are dealt, and what one task and lab each costs."""
    home = rows[(rows.place == results.OWN) & (rows.kind == results.FEDERATED)]
    rates = results.summary(home).set_index(["method", "partition"])
    lines = []
    for method, part in home.groupby("method", sort=False):
        dealt = [_percent(rates.loc[(method, name)]) if name in set(part.partition) else "" for name in MIXES]
        outcome = part[part.partition.isin((EVEN, "lab"))].assign(method=lambda of: of.partition, partition=method)
        (gap,) = tables.differences(outcome, [("lab", EVEN)], seed=0).itertuples()
        lines.append([method.removeprefix("fedavg-"), *dealt, points(gap)])
    return status.table(["rounds x clients x steps", *MIXES.values(), "last minus first"], lines)


def strategies(home: pd.DataFrame) -> str:
    """Methods by success, with what they cost a lab and how they compare with federated averaging."""
    rates = results.summary(home).sort_values("success_rate", ascending=False)
    labs, lines = home.lab.nunique(), []
    for row in rates.itertuples():
        found = gaps(home, row.method, FEDAVG) if row.method != FEDAVG else {}
        cost = [f"{row.steps_in_a_row:,.0f}", f"{row.MB / labs:,.1f}"]
        lines.append([f"`{row.method}`", *cost, _percent(row), next(iter(found.values()), "")])
    return status.table(["method", "steps in a row", "MB a lab", "success", "minus `fedavg` [points]"], lines)


def _seeds(folder: Path, rows: pd.DataFrame) -> str:
    """How many of the planned training seeds have been run, below a table."""
    planned = {cell.seed for cell in read_plan(folder.with_suffix(".toml")).cells}
    run = rows.groupby(["method", "partition"]).run.nunique().min()
    wide = (
        "" if run == len(planned) else " An interval from few seeds can come out far too wide or too narrow, and rates "
        "over other seeds than those of question 2 differ from those there: draw no conclusion yet."
    )  # fmt: skip
    return f"\n\nAt least {run} of {len(planned)} planned training seeds have been run.{wide}"


def _percent(row: pd.Series) -> str:
    return f"{row.success_rate:.0%} {interval(row.low, row.high)}"
