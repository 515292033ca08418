"""Intervals and paired tests against cases worked out by hand or by exact enumeration."""

from itertools import product
from math import comb, sqrt

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from fedvla_book.tables import grids, intervals
from fedvla_lib.evaluation import statistics

pytestmark = pytest.mark.unit


def rows(**methods):
    return pd.DataFrame(
        [
            {"method": method, "task": "lift", "seed": seed, "success": bool(ok)}
            for method, outcomes in methods.items()
            for seed, ok in enumerate(outcomes)
        ]
    )


@pytest.mark.parametrize(("k", "n"), [(0, 10), (3, 10), (10, 10), (41, 50)])
def test_wilson_solves_its_defining_equation(k, n):
    z = 1.959963984540054
    for end in statistics.wilson(k, n):
        if 0 < end < 1:
            assert abs(k / n - end) == pytest.approx(z * sqrt(end * (1 - end) / n), abs=1e-7)


@pytest.mark.parametrize(("k", "n"), [(1, 0), (3, 2), (-1, 4)])
def test_wilson_refuses_impossible_counts(k, n):
    with pytest.raises(ValueError, match=f"successes={k} of trials={n}"):
        statistics.wilson(k, n)


@pytest.mark.parametrize(("n", "lowest"), [(20, 0.92), (60, 0.93), (100, 0.93), (300, 0.94)])
def test_wilson_covers_the_truth_as_often_as_it_says(n, lowest):
    """Exact, over rates from 5 to 95 %: on average 95 %; at a single rate counts are whole, and 20 may fall to 92 %."""
    counts, rates = np.arange(n + 1), np.linspace(0.05, 0.95, 91)
    low, high = np.array([statistics.wilson(int(k), n) for k in counts]).T
    inside = (low <= rates[:, None]) & (rates[:, None] <= high)
    covered = (stats.binom.pmf(counts, n, rates[:, None]) * inside).sum(axis=1)
    assert 0.945 <= covered.mean() <= 0.955 and covered.min() >= lowest


def test_success_table_counts_per_group():
    table = statistics.success_table(rows(a=[1, 1, 0, 0], b=[1, 1, 1, 1]), by=["method"])
    assert list(table.success_rate) == [0.5, 1.0]
    assert list(table.n) == [4, 4]
    assert (table.low <= table.success_rate).all() and (table.success_rate <= table.high).all()


def test_mcnemar_equals_the_exact_binomial():
    left, right = [1] * 9 + [0] * 3 + [1] * 5, [0] * 9 + [1] * 3 + [1] * 5
    result = grids.paired_difference(rows(a=left, b=right), "a", "b", seed=0)
    tail = sum(comb(12, k) for k in range(4)) / 2**12
    assert result["p_value"] == pytest.approx(2 * tail)
    assert (result["only_method"], result["only_other"], result["n"]) == (9, 3, 17)
    assert result["difference"] == pytest.approx(6 / 17)


def test_the_interval_of_a_mean_is_the_studentised_bootstrap_in_full():
    """Against resamples drawn and studentised here, and wider to the side of the tail than the percentiles."""
    values = np.array([0.1, 0.2, 0.25, 0.3, 0.4, 0.5, 0.9, 2.0])
    drawn = values[np.random.default_rng(9).integers(0, 8, (200_000, 8))]
    distances = (drawn.mean(axis=1) - values.mean()) / stats.sem(drawn, axis=1)
    expected = values.mean() - np.quantile(distances, [0.975, 0.025]) * stats.sem(values)
    low, high = statistics.mean_interval(values, seed=3, resamples=100_000)
    assert (low, high) == pytest.approx(tuple(expected), rel=0.03)
    assert high - values.mean() > 2 * (values.mean() - low)


def test_few_different_values_get_students_interval():
    values = np.array([1.0, 0, 0, -1, 1, 1, 0, 1, 0, 0, 1, 0])
    expected = stats.ttest_1samp(values, 0).confidence_interval()
    assert statistics.mean_interval(values, seed=0) == pytest.approx(tuple(expected))
    assert statistics.mean_interval(np.ones(5), seed=0) == statistics.mean_interval(np.ones(1), seed=0) == (1, 1)


@pytest.mark.parametrize(
    ("draw", "truth", "least"),
    [
        (lambda rng, shape: rng.normal(0.5, 1, shape), 0.5, 0.93),
        (lambda rng, shape: rng.exponential(1, shape), 1.0, 0.93),
        (lambda rng, shape: rng.gamma(2, 1, shape) - 0.7 * rng.gamma(2, 1, shape), 0.6, 0.93),
        (lambda rng, shape: rng.lognormal(0, 1, shape), np.exp(0.5), 0.88),  # a tail this heavy is beyond it
    ],
    ids=["normal", "skewed", "paired difference", "heavy tail"],
)
def test_the_interval_of_a_loss_or_of_its_difference_covers_the_truth(draw, truth, least):
    """Twelve held-out episodes, as the laptop profile has, simulated 2,000 times."""
    samples = draw(np.random.default_rng(5), (2000, 12))
    ends = np.array([statistics.mean_interval(each, seed=k, resamples=999) for k, each in enumerate(samples)])
    covered = np.mean((ends[:, 0] <= truth) & (truth <= ends[:, 1]))
    assert least <= covered <= (0.97 if least >= 0.93 else 0.93)


def test_equal_methods_show_no_difference():
    result = grids.paired_difference(rows(a=[1, 0, 1], b=[1, 0, 1]), "a", "b", seed=0)
    assert (result["difference"], result["low"], result["high"], result["p_value"]) == (0, 0, 0, 1)


def test_unpaired_rollouts_are_refused():
    with pytest.raises(ValueError, match="unknown method 'c': choose one of a, b"):
        grids.paired(rows(a=[1], b=[1]), "a", "c")
    with pytest.raises(ValueError, match="did not run the same rollouts"):
        grids.paired(rows(a=[1, 0], b=[1]), "a", "b")
    with pytest.raises(ValueError, match="twice"):
        grids.paired(pd.concat([rows(a=[1]), rows(a=[1], b=[1])]), "a", "b")


def test_mean_difference_equals_the_enumeration_of_all_signs():
    left, right = np.array([1.0, 2.0, 4.0, 3.0]), np.array([0.5, 2.5, 2.0, 1.0])
    each = left - right
    means = [np.mean(each * signs) for signs in product((1, -1), repeat=4)]
    found = statistics.mean_difference(left, right, seed=0)
    assert found["p_value"] == pytest.approx(np.mean(np.abs(means) >= abs(each.mean()) - 1e-12))
    assert found["difference"] == pytest.approx(1.0) and found["low"] <= 1.0 <= found["high"]


def test_holm_by_hand():
    assert statistics.holm([0.01, 0.04, 0.03]).tolist() == pytest.approx([0.03, 0.06, 0.06])


@pytest.mark.parametrize(("value", "text"), [(1.0, "1.000"), (0.0123, "0.012"), (0.001, "0.001")])
def test_a_p_value_has_three_digits(value, text):
    assert statistics.p_text(value) == text and statistics.p_text(value, "= ") == f"= {text}"


def test_a_p_value_is_never_printed_as_zero():
    assert statistics.p_text(0.0009) == statistics.p_text(3e-9) == statistics.p_text(3e-9, "= ") == "< 0.001"


def test_the_smallest_visible_difference_is_seen_about_four_times_in_five():
    """Pairs drawn with just that difference are found significant with the power that was asked for."""
    n, discordant = 200, 0.3
    d = intervals.smallest_difference(n, discordant)
    rng = np.random.default_rng(0)
    pairs = rng.choice(3, size=(2000, n), p=[(discordant + d) / 2, (discordant - d) / 2, 1 - discordant])
    only_left, only_right = (pairs == 0).sum(axis=1), (pairs == 1).sum(axis=1)
    statistic = (only_left - only_right) / np.sqrt(np.maximum(only_left + only_right, 1))
    assert np.mean(np.abs(statistic) > 1.96) == pytest.approx(0.8, abs=0.03)
    assert np.isnan(intervals.smallest_difference(5, 0.1))  # five pairs, half a disagreement: nothing can be seen


@pytest.mark.parametrize("n", [39, 60, 300])
@pytest.mark.parametrize(("discordant", "truth"), [(0.3, 0.0), (0.3, 0.1), (0.4, 0.2), (0.5, -0.05)])
def test_the_paired_interval_covers_a_known_difference(n, discordant, truth):
    """From 39 pairs on, as the laptop profile has: simulated 2,000 times, each split of outcomes looked at once."""
    share = [discordant / 2 + truth / 2, discordant / 2 - truth / 2, 1 - discordant]
    splits, times = np.unique(np.random.default_rng(1).multinomial(n, share, 2000), axis=0, return_counts=True)
    covered = 0
    for (only_left, only_right, _), count in zip(splits, times, strict=True):
        each = np.repeat([1.0, -1.0, 0.0], [only_left, only_right, n - only_left - only_right])
        low, high = statistics.mean_interval(each, seed=0)
        covered += count * (low <= truth <= high)
    assert 0.93 <= covered / 2000 <= 0.97
    left, right = each > 0, each < 0
    found = statistics.success_difference(left, right, seed=0)
    assert (found["low"], found["high"]) == (low, high)  # that interval is the one reported


def outcomes(values, tasks=2):
    """A line for each training seed, a column for each rollout, half of them at each task."""
    values = np.asarray(values, float)
    columns = [(f"task {k * tasks // values.shape[1]}", k) for k in range(values.shape[1])]
    return pd.DataFrame(values, columns=pd.MultiIndex.from_tuples(columns, names=["task", "seed"]))


def test_with_one_rollout_a_seed_the_interval_is_students():
    each = np.array([0.1, 0.4, 0.3, 0.25, 0.6])
    found = intervals.over_seeds(outcomes(each[:, None], tasks=1))
    expected = stats.ttest_1samp(each, 0)
    assert found["p_value"] == pytest.approx(expected.pvalue) and found["df"] == 4
    assert (found["low"], found["high"]) == pytest.approx(tuple(expected.confidence_interval()))


def test_the_parts_of_the_variance_are_those_of_a_case_worked_out_by_hand():
    # Four seeds, two rollouts at one task: seeds are off the mean by 0.5, 0.5, 0 and 0, rollouts by 0.
    found = intervals.over_seeds(outcomes([[1, 1], [0, 0], [1, 0], [0, 1]], tasks=1))
    # Sums of squares: seeds 2 (0.25 + 0.25), rollouts 0, rest 4 x 0.25. Mean squares: 1/3, 0, 1/3.
    # Their sum MS_seeds + MS_rollouts - MS_rest is 0, so half the rest counts, with the seeds' degrees of freedom.
    reach = stats.t.ppf(0.975, 3) * sqrt(1 / 6 / 8)
    assert (found["low"], found["high"]) == pytest.approx((0.5 - reach, 0.5 + reach))


def test_several_rollouts_need_several_training_seeds():
    with pytest.raises(ValueError, match="at least 2"):
        intervals.over_seeds(outcomes([[1, 0, 1, 1]]))


@pytest.mark.parametrize(
    ("of_seeds", "of_rollouts", "bootstrap"),
    [(0, 0, (0.98, 1)), (0, 1, (0.98, 1)), (0.1, 0.5, (0.97, 1)), (0.3, 0.5, (0.88, 0.95))],
)
def test_intervals_over_seeds_and_rollouts_cover_the_truth_as_often_as_they_say(of_seeds, of_rollouts, bootstrap):
    """Two methods of known success: 5 training seeds x 2 tasks x 50 rollouts, simulated 800 times.

    The difference and the rate of one method keep their word; the bootstrap of so few seeds does not, and says so.
    """
    rng, seeds, easy = np.random.default_rng(7), 5, np.repeat([1.0, 0.3], 50)
    spread = sqrt(1 + of_seeds**2 + of_rollouts**2)
    rates = [stats.norm.cdf((np.array([1.0, 0.3]) - shift) / spread).mean() for shift in (0.0, 0.3)]
    columns, covered = outcomes(np.zeros((1, 100))).columns, {"difference": [], "rate": [], "bootstrap": []}
    for k in range(800):
        shared = of_rollouts * rng.normal(size=100)  # a rollout that is hard is hard for both methods
        left, right = (
            easy - shift + shared + of_seeds * rng.normal(size=(seeds, 1)) + rng.normal(size=(seeds, 100)) > 0
            for shift in (0.0, 0.3)
        )
        difference = pd.DataFrame(left.astype(float) - right, columns=columns)
        found = intervals.over_seeds(difference)
        covered["difference"].append(found["low"] <= rates[0] - rates[1] <= found["high"])
        found = intervals.over_seeds(pd.DataFrame(left.astype(float), columns=columns))
        covered["rate"].append(found["low"] <= rates[0] <= found["high"])
        if k % 4 == 0:
            low, high = grids.crossed_bootstrap(difference, seed=k, resamples=400)
            covered["bootstrap"].append(low <= rates[0] - rates[1] <= high)
    share = {name: np.mean(each) for name, each in covered.items()}
    assert 0.93 <= share["difference"] <= 0.97 and 0.93 <= share["rate"] <= 0.97
    assert bootstrap[0] <= share["bootstrap"] <= bootstrap[1]


def test_methods_are_paired_by_training_seed_and_rollout():
    methods = {"a": [[1, 1, 1, 0], [1, 1, 0, 1]], "b": [[1, 0, 1, 0], [0, 1, 0, 1]]}
    lines = [
        {"method": method, "run": run, "task": "lift", "seed": seed, "success": ok}
        for method, each in methods.items() for run, outcome in enumerate(each) for seed, ok in enumerate(outcome)
    ]  # fmt: skip
    table = pd.DataFrame(lines)
    found = grids.difference_over_seeds(table, "a", "b", seed=0)
    assert found["difference"] == pytest.approx(0.25) and (found["only_left"], found["only_right"]) == (2, 0)
    assert found["mcnemar_p"] == pytest.approx(0.5) and found["low"] < 0.25 < found["high"]
    assert found["boot_low"] <= 0.25 <= found["boot_high"]
    with pytest.raises(ValueError, match="cannot be paired"):
        grids.difference_over_seeds(table.drop(index=[3, 7]), "a", "b", seed=0)
    with pytest.raises(ValueError, match="lack rollouts"):
        intervals.by_run(table[table.method == "a"].drop(index=3))
    with pytest.raises(ValueError, match="twice"):
        intervals.by_run(table)


def test_the_crossed_bootstrap_is_as_wide_as_the_spread_of_seeds_when_only_they_differ():
    each = np.array([0.0, 0.2, 0.4, 0.6, 0.8])
    low, high = grids.crossed_bootstrap(outcomes(np.repeat(each[:, None], 10, axis=1)), seed=0, resamples=20_000)
    draws = np.random.default_rng(1).choice(each, (20_000, 5)).mean(axis=1)
    assert (low, high) == pytest.approx(tuple(np.quantile(draws, [0.025, 0.975])), abs=0.021)


def test_the_order_in_which_rollouts_were_made_does_not_matter():
    rng = np.random.default_rng(0)
    rows = [{"method": method, "run": run, "task": "lift", "seed": seed, "success": rng.random() < 0.5}
            for method in "ab" for run in (0, 1, 2) for seed in range(12)]  # fmt: skip
    table = pd.DataFrame(rows)
    dealt_out = pd.concat([table[table.method == "a"], table[table.method == "b"].sort_values("seed", ascending=False)])
    there, here = (grids.difference_over_seeds(of, "a", "b", seed=0) for of in (table, dealt_out))
    assert there == here


@pytest.mark.parametrize("ending", [False, True])
def test_rollouts_that_all_end_alike_leave_room_for_doubt(ending):
    rows = [{"run": run, "task": "lift", "seed": seed, "success": ending} for run in (0, 1) for seed in range(30)]
    low, high = intervals.success_interval(pd.DataFrame(rows))
    assert (low, high) == pytest.approx(statistics.wilson(30 * ending, 30)) and high - low > 0.05
