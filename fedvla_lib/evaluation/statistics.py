"""Confidence intervals and paired tests of success rates and held-out metrics."""

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import norm, permutation_test, t
from statsmodels.stats.contingency_tables import mcnemar
from statsmodels.stats.multitest import multipletests
from statsmodels.stats.proportion import proportion_confint

CONFIDENCE = 0.95
POWER = 0.8
P_VALUES = ["p_value", "mcnemar_p", "p_holm"]  # columns of tables
SMALLEST_P = 0.001  # smaller p-values are printed as "< 0.001"
DISTINCT = 8  # distinct values that the bootstrap of a mean needs


def check_metrics(metrics: Sequence[str], known: Collection[str]) -> list[str]:
    """Return the metrics; raise ValueError if one of them is not in `known`."""
    for metric in metrics or [""]:  # an empty list is not a choice either
        if metric not in known:
            raise ValueError(f"unknown metric {metric!r}: choose from {', '.join(known)}")
    return list(metrics)


def wilson(successes: int, trials: int, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Wilson score interval of a success rate (Wilson 1927), both ends in [0, 1].

    Raises:
        ValueError: no trials, or a number of successes that is not from 0 to `trials`.
    """
    if trials < 1 or not 0 <= successes <= trials:
        raise ValueError(f"successes={successes} of trials={trials}: give 0 <= successes <= trials, trials > 0")
    low, high = proportion_confint(successes, trials, alpha=1 - confidence, method="wilson")
    return float(low), float(high)


def success_table(rows: pd.DataFrame, by: Sequence[str], confidence: float = CONFIDENCE) -> pd.DataFrame:
    """Count rollouts per group: columns `by`, n, successes, success_rate, low, high (Wilson interval)."""
    table = rows.groupby(list(by), sort=False)["success"].agg(n="size", successes="sum").reset_index()
    table["success_rate"] = table.successes / table.n
    ends = [wilson(int(k), int(n), confidence) for k, n in zip(table.successes, table.n, strict=True)]
    table["low"], table["high"] = zip(*ends, strict=True)
    return table


def mean_with_interval(
    values: np.ndarray, *, of_success: bool, seed: int, confidence: float = CONFIDENCE
) -> dict[str, float]:
    """Return n, value (the mean), low and high: `wilson` for outcomes, else `mean_interval`; NaN without values."""
    if not len(values):
        return {"n": 0, "value": np.nan, "low": np.nan, "high": np.nan}
    if of_success:
        low, high = wilson(int(values.sum()), len(values), confidence)
    else:
        low, high = mean_interval(values, seed=seed, confidence=confidence)
    return {"n": len(values), "value": float(values.mean()), "low": low, "high": high}


def success_difference(
    left: Sequence[bool], right: Sequence[bool], *, seed: int, confidence: float = CONFIDENCE
) -> dict[str, Any]:
    """Difference of two success rates over the same rollouts: left - right, Student's interval, McNemar's exact test.

    The interval is for independent rollouts of one pair of models; with few discordant pairs it is rough.

    Returns:
        n: pairs; difference, low, high; visible: the smallest difference that n pairs with this standard deviation
        detect with a power of 80 %, NaN if all pairs agree; only_left, only_right: rollouts that only one of them
        solved; p_value of McNemar's exact test (McNemar 1947).
    """
    left, right = np.asarray(left, bool), np.asarray(right, bool)
    only_left, only_right = int((left & ~right).sum()), int((right & ~left).sum())  # all that McNemar's test counts
    each = left.astype(float) - right
    low, high = mean_interval(each, seed=seed, confidence=confidence)
    p_value = float(mcnemar([[0, only_left], [only_right, 0]], exact=True).pvalue)
    return {
        "n": len(left), "difference": float(each.mean()), "low": low, "high": high,
        "visible": _visible(each, confidence),
        "only_left": only_left, "only_right": only_right, "p_value": p_value,
    }  # fmt: skip


def mean_difference(
    left: np.ndarray, right: np.ndarray, *, seed: int, confidence: float = CONFIDENCE
) -> dict[str, Any]:
    """Difference of two means over the same units: left - right, paired bootstrap, sign-flip permutation test.

    Returns:
        n: pairs; difference, low, high, in the metric's unit; visible: the smallest difference that n pairs with this
        standard deviation detect with a power of 80 %; p_value of the permutation test (Fisher 1935).
    """
    each = np.asarray(left, float) - np.asarray(right, float)
    low, high = mean_interval(each, seed=seed, confidence=confidence)
    return {
        "n": len(each), "difference": float(each.mean()), "low": low, "high": high,
        "visible": _visible(each, confidence), "p_value": _sign_test(each, seed),
    }  # fmt: skip


def _visible(each: np.ndarray, confidence: float) -> float:
    spread = float(each.std(ddof=1)) if len(each) > 1 else np.nan
    return float(sum(norm.ppf([(1 + confidence) / 2, POWER])) * (spread or np.nan) / np.sqrt(len(each)))


def _sign_test(each: np.ndarray, seed: int) -> float:
    if len(each) < 2 or not each.any():
        return 1.0
    rng = np.random.default_rng(seed)
    return float(permutation_test((each,), np.mean, permutation_type="samples", n_resamples=9999, rng=rng).pvalue)


def holm(p_values: Sequence[float]) -> np.ndarray:
    """Return p-values corrected for multiple comparisons (Holm 1979)."""
    return multipletests(p_values, method="holm")[1]


def p_text(value: float, equals: str = "") -> str:
    """Return a p-value as the book prints it: `equals` and three digits, or "< 0.001"."""
    return f"< {SMALLEST_P:g}" if value < SMALLEST_P else f"{equals}{value:.3f}"


def mean_interval(
    values: np.ndarray, *, seed: int, confidence: float = CONFIDENCE, resamples: int = 9999
) -> tuple[float, float]:
    """Interval of a mean of independent values: studentised bootstrap (Efron 1979; Hall 1988), or Student's.

    Each resample's deviation from the mean is divided by its own standard error, which handles skewed samples better
    than other bootstraps. Simulated coverage with 12 values: 95 % if normal, 94 % if exponential, 91 % if lognormal
    with sigma 1; the percentile bootstrap 91, 87 and 82 %, BCa 91, 88 and 84 %. Samples with fewer than `DISTINCT`
    distinct values, such as successes, have too few distinct resamples and get Student's interval, which covers 94 to
    96 % for 39 or more differences of paired outcomes. A constant sample gives a width of zero.
    """
    values = np.asarray(values, float)
    count, mean = len(values), float(np.mean(values))
    if count < 2 or np.ptp(values) == 0:
        return mean, mean
    ends, error = [(1 + confidence) / 2, (1 - confidence) / 2], values.std(ddof=1) / np.sqrt(count)
    if len(np.unique(values)) < DISTINCT:
        quantiles = t.ppf(ends, count - 1)
    else:
        drawn = np.random.default_rng(seed).choice(values, (resamples, count))
        spread = drawn.std(axis=1, ddof=1)
        deviations = (drawn.mean(axis=1) - mean)[spread > 0] / spread[spread > 0]
        quantiles = np.sqrt(count) * np.quantile(deviations, ends)
    return mean - float(quantiles[0] * error), mean - float(quantiles[1] * error)
