"""Loss against success over the checkpoints of stored runs."""

from collections.abc import Sequence

import numpy as np
import pandas as pd
from scipy.stats import spearmanr

from fedvla_book.tables.grids import OF_RUN
from fedvla_lib.evaluation import statistics


def correlations(rounds: pd.DataFrame, by: Sequence[str] = OF_RUN) -> pd.DataFrame:
    """Return Spearman's correlation of held-out loss with success over the checkpoints of each group, and over all.

    Columns partition, method, run ("all" where not grouped by it; the last row is over all), n (checkpoints), rho: -1
    if loss and success rank checkpoints alike, NaN if all are equal or there is only one.

    Args:
        rounds: of `grids.read_rounds`; rounds without rollouts are ignored.
        by: grouping columns, from partition, method and run.
    """
    measured = rounds.dropna(subset=["loss", "success_rate"])
    groups = [(dict(zip(by, key, strict=True)), part) for key, part in measured.groupby(list(by), sort=False)]
    return pd.DataFrame([
        {**dict.fromkeys(OF_RUN, "all"), **group, "n": len(part), "rho": _spearman(part)}
        for group, part in [*groups, ({}, measured)]
    ])  # fmt: skip


def _spearman(part: pd.DataFrame) -> float:
    if min(part.loss.nunique(), part.success_rate.nunique()) < 2:
        return float("nan")  # nothing to rank
    return float(spearmanr(part.loss, part.success_rate).statistic)


def clear_pairs(rounds: pd.DataFrame) -> pd.DataFrame:
    """Return the pairs of checkpoints that differ in loss and whose success intervals (Wilson) do not overlap.

    Columns partition, method, run, round, loss, n, successes, success_rate, low, high of the checkpoint with the lower
    loss, and with the prefix `other_` of the other; gap: distance between the intervals; misled: the lower loss has the
    lower success rate; same_run; same_episodes: same partition and training seed, hence same held-out episodes.

    Args:
        rounds: of `grids.read_rounds`; rounds without rollouts are ignored.
    """
    table = rounds.dropna(subset=["loss", "success_rate"]).sort_values("loss", kind="stable", ignore_index=True)
    ends = [statistics.wilson(int(k), int(n)) for k, n in zip(table.successes, table.n, strict=True)]
    table["low"], table["high"] = np.array(ends, dtype=float).reshape(-1, 2).T
    one, other = np.triu_indices(len(table), k=1)
    low, high = table.low.to_numpy(), table.high.to_numpy()
    gap = np.maximum(low[one] - high[other], low[other] - high[one])
    kept = (gap > 0) & (table.loss.to_numpy()[one] < table.loss.to_numpy()[other])
    of = [*OF_RUN, "round", "loss", "n", "successes", "success_rate", "low", "high"]
    sides = [table.loc[places[kept], of].reset_index(drop=True) for places in (one, other)]
    pairs = sides[0].join(sides[1].add_prefix("other_")).assign(gap=gap[kept])
    shared = (pairs.partition == pairs.other_partition) & (pairs.run == pairs.other_run)
    same_run = shared & (pairs.method == pairs.other_method)
    return pairs.assign(misled=pairs.success_rate < pairs.other_success_rate, same_run=same_run, same_episodes=shared)


def disagreements(rounds: pd.DataFrame) -> pd.DataFrame:
    """Return the `clear_pairs` whose lower loss has the lower success rate, widest gap first."""
    pairs = clear_pairs(rounds)
    return pairs[pairs.misled].sort_values("gap", ascending=False, kind="stable", ignore_index=True)
