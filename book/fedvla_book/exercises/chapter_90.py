"""Checks of the exercises in the appendix on comparing policies."""

from collections.abc import Callable

import numpy as np
from scipy.stats import binom, binomtest

from fedvla_book.exercises import close, expect


def two_errors(errors: Callable[[np.ndarray, np.ndarray], tuple[float, float]]) -> None:
    """``errors(left, right)``: standard errors of the difference in success, from pairs and as if there were none."""
    rng = np.random.default_rng(6)
    for noise in (0.3, 1.0):
        ease = rng.normal(size=400)  # of the initial state, for both methods
        left, right = (1 * (ease + shift > noise * rng.normal(size=400)) for shift in (0.2, -0.1))
        given, root = errors(left, right), np.sqrt(len(left))
        expect(np.shape(given) == (2,), "Return two numbers: from pairs, then as if there were none.")
        together, apart = (left - right).std() / root, np.hypot(left.std(), right.std()) / root
        expect(not _near(given[0], together * root), "That is the spread of one rollout, not the error of a mean.")
        swapped = _near(given[0], apart) and _near(given[1], together)
        expect(not swapped, "The two are swapped: first the one from pairs.")
        expect(not _near(given[0], apart), "The first ignores the pairs: subtract rollout by rollout first.")
        expect(_near(given[0], together), "The first is the spread of the differences over the root of n.")
        expect(_near(given[1], apart), "For the second, the variances of both success rates add up.")


def _near(given: float, right: float) -> bool:
    return close(given / right, 1.0, 0.005)  # n and n - 1 in a standard deviation are both accepted


def exact_p(p_value: Callable[[int, int], float]) -> None:
    """``p_value(only_left, only_right)`` is that of McNemar's exact test, two-sided."""
    for only_left, only_right in ((1, 9), (12, 4), (0, 5)):
        given, pairs = p_value(only_left, only_right), only_left + only_right
        right = binomtest(only_left, pairs).pvalue
        expect(not close(given, right / 2), "That is one side: an equally uneven split the other way counts as well.")
        alone = 2 * binom.pmf(only_left, pairs, 0.5)
        expect(not close(given, alone) or only_left == 0, "More uneven splits count too: add up their probabilities.")
        fair = f"toss a fair coin {pairs} times: how often is the split at least that uneven?"
        expect(close(given, right), f"For {only_left} to {only_right}, {fair}")
    expect(close(p_value(7, 7), 1.0), "A split of 7 to 7 has p = 1, and no probability is above 1.")
    expect(close(p_value(0, 0), 1.0), "Without discordant pairs there is no evidence of a difference: p = 1.")


def pairs_needed(needed: Callable[[float, int, int, int], int]) -> None:
    """``needed(points, only_left, only_right, n)``: pairs to find that difference, from n pairs of a first run."""
    for points, only_left, only_right, n in ((5, 18, 12, 100), (10, 9, 3, 60)):
        given, share = needed(points, only_left, only_right, n), points / 100
        expect(np.shape(given) == (), "Expected one number.")
        discordant = (only_left + only_right) / n
        right = 2.8**2 * discordant / share**2
        expect(given > 2, "Points are hundredths: 5 points are 0.05.")
        expect(not close(given, right * n, 0.01), "The share of discordant pairs is wanted, not their number.")
        lead = abs(only_left - only_right) / (only_left + only_right)
        expect(
            not close(given, right * lead, 0.01), "Both kinds of discordant pairs count, whichever method they favour."
        )
        expect(
            not close(given, right / discordant, 0.01),
            "Pairs that agree carry no information: use the discordant share.",
        )
        expect(close(given, right, 0.01), f"Solve {share} = 2.8 √(δ/n) for n, with δ = {discordant:g}.")
        expect(given >= right and float(given).is_integer(), "Pairs are whole numbers: round up.")


def error_over_seeds(error: Callable[[np.ndarray], float]) -> None:
    """``error(values)``, training seeds x rollouts, is the standard error of the mean over both."""
    rng = np.random.default_rng(7)
    for seeds, rollouts, luck in ((5, 60, 0.25), (3, 40, 0.4)):
        by_seed, by_rollout = luck * rng.normal(size=(seeds, 1)), 0.5 * rng.normal(size=rollouts)
        values = by_seed + by_rollout + 0.5 * rng.normal(size=(seeds, rollouts))
        given = error(values)
        expect(np.shape(given) == (), "Expected one number.")
        of_seeds = rollouts * values.mean(axis=1).var(ddof=1)
        of_rollouts = seeds * values.mean(axis=0).var(ddof=1)
        both = (seeds - 1) * of_seeds + (rollouts - 1) * of_rollouts
        rest = (values.var() * values.size - both) / ((seeds - 1) * (rollouts - 1))
        right = (of_seeds + of_rollouts - rest) / values.size
        flat = values.std() / np.sqrt(values.size)
        expect(not _near(given, flat), "That counts every rollout as independent; those of one seed are not.")
        expect(not close(given, np.sqrt(of_seeds / values.size)), "That is for other seeds with these same rollouts.")
        expect(not close(given, right), "That is the variance: take the root.")
        expect(not close(given**2, (of_seeds + of_rollouts) / values.size), "The rest is in both parts: subtract it.")
        expect(close(given, np.sqrt(right)), "Check the degrees of freedom: S - 1, n - 1, and their product.")
