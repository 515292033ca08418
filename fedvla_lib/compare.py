"""Rollout rows -> intervals and paired tests. Intervals first, p-values after."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import bootstrap
from statsmodels.stats.contingency_tables import mcnemar
from statsmodels.stats.proportion import proportion_confint

CONFIDENCE = 0.95


def wilson(successes: int, trials: int, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Wilson score interval of a success rate (Wilson 1927), both ends in [0, 1].

    Raises:
        ValueError: no trials, or more successes than trials.
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


def paired(rows: pd.DataFrame, arm: str, other: str) -> pd.DataFrame:
    """Line up the rollouts of two arms: one line per (task, seed) with both outcomes.

    Raises:
        ValueError: an arm is unknown, or the arms did not run the same tasks and seeds.
    """
    known = sorted(rows.arm.unique())
    for name in (arm, other):
        if name not in known:
            raise ValueError(f"unknown arm {name!r}: choose one of {', '.join(known)}")
    left, right = (rows[rows.arm == name].set_index(["task", "seed"]).success.astype(bool) for name in (arm, other))
    if left.index.has_duplicates or right.index.has_duplicates:
        raise ValueError(f"{arm!r} or {other!r} ran a (task, seed) twice: pairs must be unique")
    if set(left.index) != set(right.index):
        odd = sorted(set(left.index) ^ set(right.index))[0]
        raise ValueError(f"{arm!r} and {other!r} did not run the same rollouts: {odd} is in one only")
    return pd.DataFrame({arm: left, other: right.loc[left.index]})


def paired_difference(
    rows: pd.DataFrame, arm: str, other: str, *, seed: int, confidence: float = CONFIDENCE
) -> dict[str, Any]:
    """Difference in success rate `arm` - `other` over the same rollouts, with a paired bootstrap interval.

    Also McNemar's exact test on the discordant pairs (McNemar 1947): `only_arm` and `only_other` are the rollouts that
    one arm alone solved.
    """
    outcomes = paired(rows, arm, other)
    both = outcomes.to_numpy()
    counts = [[int((both[:, 0] & both[:, 1]).sum()), int((both[:, 0] & ~both[:, 1]).sum())]]
    counts += [[int((~both[:, 0] & both[:, 1]).sum()), int((~both[:, 0] & ~both[:, 1]).sum())]]
    low, high = bootstrap_mean(both[:, 0].astype(float) - both[:, 1], seed=seed, confidence=confidence)
    return {
        "arm": arm,
        "other": other,
        "n": len(both),
        "difference": float(both[:, 0].mean() - both[:, 1].mean()),
        "low": low,
        "high": high,
        "only_arm": counts[0][1],
        "only_other": counts[1][0],
        "p_value": float(mcnemar(counts, exact=True).pvalue),
    }


def bootstrap_mean(values: np.ndarray, *, seed: int, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Percentile bootstrap interval of a mean (Efron 1979); a constant sample gives an interval of width zero."""
    values = np.asarray(values, float)
    if len(values) < 2 or np.ptp(values) == 0:
        return float(values.mean()), float(values.mean())
    rng = np.random.default_rng(seed)
    interval = bootstrap((values,), np.mean, confidence_level=confidence, method="percentile", rng=rng)
    return float(interval.confidence_interval.low), float(interval.confidence_interval.high)
