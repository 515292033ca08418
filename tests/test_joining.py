"""The page on whether a lab should join says what the stored runs found."""

from pathlib import Path

import pytest

import joining
from fedvla_book import tables
from fedvla_book.tables import results

pytestmark = pytest.mark.unit
ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def said():
    return {mark.decode(): text() for mark, text in joining.parts(ROOT).items()}


def rows_of(table):
    lines = [line.strip() for line in table.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line[1:-1].split("|")] for line in lines][2:]


def test_every_part_has_its_mark_on_the_page(said):
    page = (ROOT / "book" / "joining.md").read_text()
    assert all(page.count(mark) == 1 for mark in said) and page.count("<!--") == len(said)


def test_gains_are_those_of_the_stored_runs_whoever_is_ahead(said):
    home = results.read_results(ROOT / joining.COMPARISON).query("place == 'own'")
    counts = sorted(home.demonstrations.unique())
    for table, column in ((said["<!-- gain -->"], 4), (said["<!-- elsewhere -->"], 3)):
        assert [float(row[0]) for row in rows_of(table)] == counts
        assert all("[" in row[column] for row in rows_of(table))
    gaps = tables.differences(home.sort_values("demonstrations"), [("federated", "centralized")], seed=0)
    found = [row[5].split("\N{NO-BREAK SPACE}")[0] for row in rows_of(said["<!-- gain -->"])]
    assert found == [f"{100 * gap:+.0f}" for gap in gaps.difference]


def test_a_lab_alone_is_compared_at_equal_steps_and_the_seeds_run_are_stated(said):
    assert "steps in a row for both" in said["<!-- equal -->"] and said["<!-- equal -->"].count("[") == 5
    for mark in ("<!-- mix -->", "<!-- strategies -->"):
        assert "of 5 planned training seeds have been run" in said[mark]


def test_the_strategies_are_ranked_with_their_cost_and_their_difference_from_fedavg(said):
    ranked = rows_of(said["<!-- strategies -->"])
    rates = [float(row[3].split("%")[0]) for row in ranked]
    assert rates == sorted(rates, reverse=True) and {"`fedavg`", "`federated`"} <= {row[0] for row in ranked}
    assert [row[0] for row in ranked if not row[4]] == ["`fedavg`"]
    assert all((float(row[2]) > 0) == (not row[0].startswith(("`centralized", "`local-only"))) for row in ranked)


def test_the_mix_has_a_row_for_each_cadence_and_what_heterogeneity_costs_at_it(said):
    rows = rows_of(said["<!-- mix -->"])
    assert {row[0] for row in rows} == {"80x10x5", "20x10x20", "5x10x80"}
    assert all(row[1] and row[4] and "points [" in row[5] for row in rows)
