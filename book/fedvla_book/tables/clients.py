"""How different the clients' episodes are."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import pandas as pd


def heterogeneity(parts: Sequence[Sequence[int]], table: pd.DataFrame, by: str = "task") -> dict[str, Any]:
    """Measure how much the clients' task distributions differ, or their lab distributions with ``by="lab"``.

    Client k holds n_k of n episodes, a fraction p_k(t) of them of task t; p(t) is the fraction among all. The total
    variation distance of client k is ``d_k = 1/2 * sum_t |p_k(t) - p(t)|``: the fraction of its episodes to replace so
    that its distribution is p. The measure is ``sum_k (n_k / n) * d_k``: 0 if all clients have the same distribution
    (IID), ``1 - sum_t p(t)^2`` if each has one task only (2/3 for three equal tasks).

    Returns:
        ``total_variation`` (the measure), ``per_client`` (d_k), ``sizes`` (n_k), ``frames`` (per client; empty if
        `table` has no num_frames), ``size_imbalance`` (largest n_k over mean n_k) and ``counts`` (DataFrame: client x
        task or lab, episodes).
    """
    client_of = {episode_id: client for client, part in enumerate(parts) for episode_id in part}
    held = table[table["episode_id"].isin(client_of.keys())]
    held = held.assign(client=held["episode_id"].map(client_of))
    counts = pd.crosstab(held["client"], held[by]).reindex(range(len(parts)), fill_value=0)
    sizes = counts.sum(axis=1).to_numpy()
    mixes = counts.to_numpy() / np.maximum(sizes, 1)[:, None]
    pooled = counts.to_numpy().sum(axis=0) / max(sizes.sum(), 1)
    per_client = 0.5 * np.abs(mixes - pooled).sum(axis=1)
    frames: Iterable[int] = []
    if "num_frames" in held:
        frames = held.groupby("client")["num_frames"].sum().reindex(range(len(parts)), fill_value=0)
    return {
        "total_variation": float((sizes * per_client).sum() / max(sizes.sum(), 1)),
        "per_client": [float(distance) for distance in per_client],
        "sizes": [int(size) for size in sizes],
        "frames": [int(count) for count in frames],
        "size_imbalance": float(sizes.max() / sizes.mean()) if sizes.any() else 0.0,
        "counts": counts,
    }
