"""Intervals over training seeds and rollouts, and what a comparison can see."""

import numpy as np
import pandas as pd
from scipy.optimize import brentq
from scipy.stats import norm, t

from fedvla_lib.evaluation.statistics import CONFIDENCE, POWER, wilson


def by_run(rows: pd.DataFrame) -> pd.DataFrame:
    """Pivot the rollouts of one method: a row for each training seed (`run`), a column for each (task, seed), 0 or 1.

    Raises:
        ValueError: a rollout occurs twice, or the training seeds did not run the same rollouts.
    """
    if rows.duplicated(["run", "task", "seed"]).any():
        raise ValueError("a training seed ran a (task, seed) twice: give the rollouts of one method and partition")
    table = rows.astype({"success": float}).pivot(index="run", columns=["task", "seed"], values="success")
    table = table.sort_index(axis=1)
    if table.isna().any(axis=None):
        raise ValueError(f"training seeds {list(table.index[table.isna().any(axis=1)])} lack rollouts of the others")
    return table


def success_interval(rows: pd.DataFrame, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Interval of a method's success rate: Wilson's for one training seed, `over_seeds` for several.

    If all rollouts have the same outcome the variance is zero: Wilson's for the rollouts of one seed.
    """
    if rows.run.nunique() == 1 or rows.success.nunique() == 1:
        one = rows[rows.run == rows.run.iloc[0]]
        return wilson(int(one.success.sum()), len(one), confidence)
    found = over_seeds(by_run(rows), confidence)
    return max(found["low"], 0.0), min(found["high"], 1.0)


def over_seeds(values: pd.DataFrame, confidence: float = CONFIDENCE) -> dict[str, float]:
    """Mean of outcomes (or paired differences) with Student's interval over training seeds and rollouts.

    Every seed runs every rollout (crossed random effects). With S seeds and n rollouts the variance of the mean is
    (MS_seeds + MS_rollouts - MS_rest) / (S n), with Satterthwaite's degrees of freedom (1946). Simulated coverage with
    5 seeds and 100 rollouts is 93 to 97 %; a bootstrap over so few seeds is too narrow where seeds matter and too wide
    where they do not.

    Args:
        values: a row for each training seed, a column for each rollout (task, seed), or one column.

    Returns:
        difference (the mean), low, high, p_value (of a mean of 0), df, and visible: the smallest mean that is
        distinguished from 0 with a power of 80 %, NaN if all values are equal.

    Raises:
        ValueError: fewer than two training seeds.
    """
    seeds, rollouts = values.shape
    if seeds < 2:
        raise ValueError(f"training seeds={list(values.index)}: give at least 2 to estimate their variance")
    mean, (parts, freedom) = values.to_numpy(float).mean(), _mean_squares(values)
    variance = max(parts[0] + parts[1] - parts[2], parts[2] / 2)  # an estimate near or below 0 is chance
    if variance == 0:
        certain = {"difference": mean, "low": mean, "high": mean, "p_value": float(mean == 0)}
        return certain | {"df": np.inf, "visible": np.nan}
    df = max(variance**2 / np.divide(parts**2, freedom, out=np.zeros(3), where=freedom > 0).sum(), seeds - 1)
    error, reach = np.sqrt(variance / (seeds * rollouts)), t.ppf(1 - (1 - confidence) / 2, df)
    return {
        "difference": mean, "low": mean - reach * error, "high": mean + reach * error,
        "p_value": 2 * t.sf(abs(mean) / error, df), "df": df, "visible": (reach + t.ppf(POWER, df)) * error,
    }  # fmt: skip


def _mean_squares(values: pd.DataFrame) -> tuple[np.ndarray, np.ndarray]:
    """Mean squares and degrees of freedom: between seeds, between rollouts of a task, and the rest."""
    seeds, rollouts = values.shape
    array, tasks = values.to_numpy(float), values.columns.get_level_values(0)
    mean, by_seed, by_rollout = array.mean(), array.mean(axis=1), array.mean(axis=0)
    of_task = pd.Series(by_rollout).groupby(np.asarray(tasks)).transform("mean").to_numpy()
    freedom = np.array([seeds - 1, rollouts - tasks.nunique(), (seeds - 1) * (rollouts - 1)])
    squares = np.array([
        rollouts * np.square(by_seed - mean).sum(), seeds * np.square(by_rollout - of_task).sum(),
        np.square(array - by_seed[:, None] - by_rollout + mean).sum(),
    ])  # fmt: skip
    return np.divide(squares, freedom, out=np.zeros(3), where=freedom > 0), freedom


def smallest_difference(n: int, discordant: float, confidence: float = CONFIDENCE) -> float:
    """Smallest difference of two success rates that `n` pairs detect with a power of 80 %; NaN if there is none.

    Args:
        discordant: share of pairs with different outcomes.

    Source: Connor 1987, Biometrics 43, eq. 2, solved for the difference d of McNemar's test:
    sqrt(n) d = z_a sqrt(discordant) + z_b sqrt(discordant - d²).
    """
    z_a, z_b = norm.ppf([1 - (1 - confidence) / 2, POWER])

    def short(d: float) -> float:
        return z_a * np.sqrt(discordant) + z_b * np.sqrt(max(discordant - d * d, 0)) - np.sqrt(n) * d

    if discordant <= 0 or short(discordant) > 0:  # a difference cannot exceed the share of discordant pairs
        return float("nan")
    return float(brentq(short, 0, discordant))
