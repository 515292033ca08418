"""Mistakes that readers make in the appendix on comparing policies, and a word of the hint that each gets."""

ERRORS = """import numpy as np


def two_errors(left, right):
    n = len(left)
    pairs, apart = (left - right).std(), np.sqrt(left.var() + right.var())
    return {errors}
"""
EXACT = """from math import comb


def exact_p(a, b):
    n = a + b
    tail = sum(comb(n, k) for k in range(min(a, b) + 1)) / 2**n
    return {p}
"""
NEEDED = """import numpy as np


def pairs_needed(points, only_left, only_right, n):
    return {needed}
"""
PARTS = """import numpy as np


def error_over_seeds(values):
    seeds, rollouts = values.shape
    of_seeds = rollouts * values.mean(axis=1).var(ddof=1)
    of_rollouts = seeds * values.mean(axis=0).var(ddof=1)
    left = values - values.mean(axis=1, keepdims=True) - values.mean(axis=0) + values.mean()
    rest = (left**2).sum() / ((seeds - 1) * (rollouts - 1))
    return {error}
"""

WRONG = {
    "two_errors": [
        (ERRORS.format(errors="np.array([apart, apart]) / n**0.5"), "ignores the pairs"),
        (ERRORS.format(errors="apart / n**0.5, pairs / n**0.5"), "swapped"),
        (ERRORS.format(errors="pairs, apart"), "one rollout"),
        (ERRORS.format(errors="pairs / n, apart / n"), "over the root of n"),
        (ERRORS.format(errors="pairs / n**0.5, (left.std() + right.std()) / n**0.5"), "variances"),
        (ERRORS.format(errors="pairs / n**0.5"), "two numbers"),
    ],
    "exact_p": [
        (EXACT.format(p="tail"), "one side"),
        (EXACT.format(p="2 * tail"), "above 1"),
        (EXACT.format(p="min(1, 2 * tail) if n else 0.0"), "p = 1"),
        (EXACT.format(p="min(1, 2 * comb(n, a) / 2**n)"), "More uneven splits"),
        (
            "from scipy.stats import chi2\n\n\ndef exact_p(a, b):\n    return chi2.sf((a - b) ** 2 / (a + b), 1)",
            "toss a fair coin",
        ),
    ],
    "pairs_needed": [
        (NEEDED.format(needed="int(np.ceil((2.8 / points) ** 2 * (only_left + only_right) / n))"), "hundredths"),
        (NEEDED.format(needed="int(np.ceil((280 / points) ** 2 * (only_left + only_right)))"), "not their number"),
        (NEEDED.format(needed="int(np.ceil((280 / points) ** 2 * (only_left - only_right) / n))"), "Both kinds"),
        (NEEDED.format(needed="int(np.ceil((280 / points) ** 2))"), "Pairs that agree"),
        (NEEDED.format(needed="(280 / points) ** 2 * (only_left + only_right) / n"), "round up"),
        (NEEDED.format(needed="int((280 / points) ** 2 * (only_left + only_right) / n)"), "round up"),
        (NEEDED.format(needed="int(np.ceil((196 / points) ** 2 * (only_left + only_right) / n))"), "Solve"),
    ],
    "error_over_seeds": [
        (PARTS.format(error="values.std() / values.size**0.5"), "counts every rollout"),
        (PARTS.format(error="values.mean(axis=1).std(ddof=1) / seeds**0.5"), "same rollouts"),
        (PARTS.format(error="np.sqrt((of_seeds + of_rollouts) / values.size)"), "subtract it"),
        (PARTS.format(error="(of_seeds + of_rollouts - rest) / values.size"), "take the root"),
        (
            PARTS.format(error="np.sqrt((of_seeds + of_rollouts - (left**2).mean()) / values.size)"),
            "degrees of freedom",
        ),
        (PARTS.format(error="values.std(axis=0)"), "one number"),
    ],
}
