"""What a federation is worth to a lab: how many demonstrations it would need alone to reach the same success rate."""

from collections.abc import Sequence

import numpy as np
import pandas as pd

from fedvla_book.tables.grids import resampled_means, shared_seeds
from fedvla_book.tables.intervals import by_run
from fedvla_book.tables.results import FEDERATED, LOCAL_ONLY, OWN
from fedvla_lib.evaluation.statistics import CONFIDENCE


def demonstrations_to_match(counts: Sequence[int], rates: Sequence[float], wanted: float) -> float:
    """Return how many demonstrations a lab alone needs for a success rate.

    Between the measured counts the rate is linear in the logarithm of the count; where the measured rate falls, the
    highest one so far counts.

    Args:
        counts: demonstrations, ascending.
        rates: success rates of labs alone with so many.
        wanted: the success rate to reach.

    Returns:
        The smallest count if that suffices, infinity if the largest does not.
    """
    best = np.maximum.accumulate(rates)
    if wanted > best[-1]:
        return float("inf")
    reached = int(np.argmax(best >= wanted))
    if reached == 0:
        return float(counts[0])
    logs = np.log2(counts)
    share = (wanted - best[reached - 1]) / (best[reached] - best[reached - 1])
    return float(2 ** (logs[reached - 1] + share * (logs[reached] - logs[reached - 1])))


def alone_at_best(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the rows with one method of labs alone, `local-only`: the number of steps that served them best.

    For each number of demonstrations these are the labs alone that succeeded most on their own task and place, of the
    numbers of steps measured with it; more might help still where that is the largest. The other rows of labs alone are
    left out. Choosing the best slightly favours labs alone.

    Args:
        rows: of `results.read_results`.
    """
    alone = rows[rows.kind == LOCAL_ONLY]
    rates = alone[alone.place == OWN].groupby(["demonstrations", "method"]).success.mean().unstack()
    best = rates.idxmax(axis=1)
    kept = alone[alone.method == alone.demonstrations.map(best)].assign(method=LOCAL_ONLY)
    return pd.concat([rows[rows.kind != LOCAL_ONLY], kept], ignore_index=True)


def ranking(methods: pd.DataFrame, headline: pd.DataFrame) -> pd.DataFrame:
    """Return the rollouts at home of all methods that are ranked, of the training seeds that every method has.

    These are the rows of `methods`, and from `headline` those of the same partition whose models took as many steps in
    a row as its federation.

    Args:
        methods: of `results.read_results`.
        headline: of `results.read_results`.
    """
    steps = headline[headline.kind == FEDERATED].steps_in_a_row.iloc[0]
    repeated = headline[headline.partition.isin(methods.partition) & (headline.steps_in_a_row == steps)]
    rows = pd.concat([methods, repeated], ignore_index=True)
    return shared_seeds(rows[rows.place == OWN])


def worth(
    rows: pd.DataFrame, method: str, alone: str, *, seed: int, confidence: float = CONFIDENCE, resamples: int = 2000
) -> pd.DataFrame:
    """Return a row for each number of demonstrations that `method` was trained with.

    Args:
        rows: rollouts with columns demonstrations (per lab), method, run, task, seed and success. Training seeds that
            one of the two methods lacks with some number of demonstrations are left out.
        method: the federation's method.
        alone: the method of labs alone.
        seed: of the bootstrap.

    Returns:
        demonstrations, success_rate, needed (demonstrations that a lab alone would need), low and high of needed.

    The interval is that of the crossed bootstrap (Owen 2007, see `grids.crossed_bootstrap`), with the same training
    seeds and rollouts drawn for both methods; infinity means more than was measured.
    """
    groups = rows[rows.method.isin((method, alone))].groupby(["method", "demonstrations"])
    shared = set.intersection(*(set(part.run) for _, part in groups))
    outcomes = {key: by_run(part[part.run.isin(shared)]) for key, part in groups}
    counts = sorted(count for name, count in outcomes if name == alone)
    names = [(alone, count) for count in counts] + sorted(key for key in outcomes if key[0] == method)
    means = resampled_means([outcomes[name] for name in names], seed=seed, resamples=resamples)
    means = np.vstack([[outcomes[name].to_numpy().mean() for name in names], means])  # the measured ones first
    curves, reached = means[:, : len(counts)], means[:, len(counts) :]
    lines, ends = [], [(1 - confidence) / 2, (1 + confidence) / 2]
    for (_, count), rates in zip(names[len(counts) :], reached.T, strict=True):
        needed = [demonstrations_to_match(counts, *each) for each in zip(curves, rates, strict=True)]
        low, high = np.quantile(needed[1:], ends, method="inverted_cdf")  # does not interpolate towards infinity
        lines.append({"demonstrations": count, "success_rate": rates[0], "needed": needed[0], "low": low, "high": high})
    return pd.DataFrame(lines)
