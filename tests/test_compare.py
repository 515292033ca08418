"""Intervals and paired tests against cases worked out by hand or by exact enumeration."""

from itertools import product
from math import comb, sqrt

import numpy as np
import pandas as pd
import pytest

from fedvla_lib import compare

pytestmark = pytest.mark.unit


def rows(**arms):
    return pd.DataFrame(
        [
            {"arm": arm, "task": "lift", "seed": seed, "success": bool(ok)}
            for arm, outcomes in arms.items()
            for seed, ok in enumerate(outcomes)
        ]
    )


@pytest.mark.parametrize(("k", "n"), [(0, 10), (3, 10), (10, 10), (41, 50)])
def test_wilson_solves_its_defining_equation(k, n):
    z = 1.959963984540054
    for end in compare.wilson(k, n):
        if 0 < end < 1:
            assert abs(k / n - end) == pytest.approx(z * sqrt(end * (1 - end) / n), abs=1e-7)


@pytest.mark.parametrize(("k", "n"), [(1, 0), (3, 2), (-1, 4)])
def test_wilson_refuses_impossible_counts(k, n):
    with pytest.raises(ValueError, match=f"successes={k} of trials={n}"):
        compare.wilson(k, n)


def test_wilson_covers_the_truth_about_as_often_as_it_says():
    truth, n = 0.3, 20
    covered = sum(
        comb(n, k) * truth**k * (1 - truth) ** (n - k)
        for k in range(n + 1)
        if compare.wilson(k, n)[0] <= truth <= compare.wilson(k, n)[1]
    )
    assert covered > 0.93


def test_success_table_counts_per_group():
    table = compare.success_table(rows(a=[1, 1, 0, 0], b=[1, 1, 1, 1]), by=["arm"])
    assert list(table.success_rate) == [0.5, 1.0]
    assert list(table.n) == [4, 4]
    assert (table.low <= table.success_rate).all() and (table.success_rate <= table.high).all()


def test_mcnemar_equals_the_exact_binomial():
    left, right = [1] * 9 + [0] * 3 + [1] * 5, [0] * 9 + [1] * 3 + [1] * 5
    result = compare.paired_difference(rows(a=left, b=right), "a", "b", seed=0)
    tail = sum(comb(12, k) for k in range(4)) / 2**12
    assert result["p_value"] == pytest.approx(2 * tail)
    assert (result["only_arm"], result["only_other"], result["n"]) == (9, 3, 17)
    assert result["difference"] == pytest.approx(6 / 17)


def test_bootstrap_interval_equals_full_enumeration():
    values = np.array([-1.0, 0.0, 0.0, 1.0, 1.0, 1.0])
    means = np.sort([np.mean(values[list(pick)]) for pick in product(range(6), repeat=6)])
    low, high = compare.bootstrap_mean(values, seed=3)
    assert low == pytest.approx(np.quantile(means, 0.025), abs=0.09)
    assert high == pytest.approx(np.quantile(means, 0.975), abs=0.09)


def test_equal_arms_show_no_difference():
    result = compare.paired_difference(rows(a=[1, 0, 1], b=[1, 0, 1]), "a", "b", seed=0)
    assert (result["difference"], result["low"], result["high"], result["p_value"]) == (0, 0, 0, 1)


def test_unpaired_rollouts_are_refused():
    with pytest.raises(ValueError, match="unknown arm 'c': choose one of a, b"):
        compare.paired(rows(a=[1], b=[1]), "a", "c")
    with pytest.raises(ValueError, match="did not run the same rollouts"):
        compare.paired(rows(a=[1, 0], b=[1]), "a", "b")
    with pytest.raises(ValueError, match="twice"):
        compare.paired(pd.concat([rows(a=[1]), rows(a=[1], b=[1])]), "a", "b")


def test_mean_difference_equals_the_enumeration_of_all_signs():
    left, right = np.array([1.0, 2.0, 4.0, 3.0]), np.array([0.5, 2.5, 2.0, 1.0])
    each = left - right
    means = [np.mean(each * signs) for signs in product((1, -1), repeat=4)]
    found = compare.mean_difference(left, right, seed=0)
    assert found["p_value"] == pytest.approx(np.mean(np.abs(means) >= abs(each.mean()) - 1e-12))
    assert found["difference"] == pytest.approx(1.0) and found["low"] <= 1.0 <= found["high"]
    assert found["effect"] == pytest.approx(1.0 / np.std(each, ddof=1))


def test_holm_by_hand():
    assert compare.holm([0.01, 0.04, 0.03]).tolist() == pytest.approx([0.03, 0.06, 0.06])


def test_the_smallest_visible_difference_is_seen_about_four_times_in_five():
    """Pairs drawn with just that difference are found significant with the power that was asked for."""
    n, discordant = 200, 0.3
    d = compare.smallest_difference(n, discordant)
    rng = np.random.default_rng(0)
    pairs = rng.choice(3, size=(2000, n), p=[(discordant + d) / 2, (discordant - d) / 2, 1 - discordant])
    only_left, only_right = (pairs == 0).sum(axis=1), (pairs == 1).sum(axis=1)
    statistic = (only_left - only_right) / np.sqrt(np.maximum(only_left + only_right, 1))
    assert np.mean(np.abs(statistic) > 1.96) == pytest.approx(0.8, abs=0.03)
    assert np.isnan(compare.smallest_difference(5, 0.1))  # five pairs, half a disagreement: nothing can be seen


@pytest.mark.parametrize("truth", [0.2, -0.05])
def test_the_paired_interval_covers_a_known_difference(truth):
    rng = np.random.default_rng(1)
    n, covered = 150, 0
    for k in range(300):
        outcome = rng.choice(3, size=n, p=[0.2 + truth / 2, 0.2 - truth / 2, 0.6])  # only left, only right, alike
        alike = rng.random(n) < 0.5
        left, right = np.where(outcome == 2, alike, outcome == 0), np.where(outcome == 2, alike, outcome == 1)
        found = compare.success_difference(left, right, seed=k)
        covered += found["low"] <= truth <= found["high"]
    assert 0.92 <= covered / 300 <= 0.98
