"""How well a score tells members from strangers: the area under the ROC curve."""

import numpy as np
from scipy.stats import mannwhitneyu, rankdata


def auc(members: np.ndarray, strangers: np.ndarray) -> float:
    """Return the area under the ROC curve: how often a member scores above a stranger; chance is 0.5."""
    return float(mannwhitneyu(members, strangers).statistic / (len(members) * len(strangers)))


def auc_interval(members: np.ndarray, strangers: np.ndarray) -> tuple[float, float]:
    """Return a 95 % interval of the AUC (DeLong et al. 1988)."""
    m, n = len(members), len(strangers)
    ranks = rankdata([*members, *strangers])
    above = (ranks[:m] - rankdata(members)) / n  # for each member: the share of strangers below it
    below = 1 - (ranks[m:] - rankdata(strangers)) / m
    error = np.sqrt(above.var(ddof=1) / m + below.var(ddof=1) / n)
    middle = auc(members, strangers)
    return max(0.0, middle - 1.96 * error), min(1.0, middle + 1.96 * error)
