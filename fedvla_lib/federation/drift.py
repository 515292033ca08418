"""Client drift: norms of the clients' updates in a round, and angles between them."""

from collections.abc import Mapping

import numpy as np

from fedvla_lib.policy.parameters import Arrays, layer_of

WHOLE = "all"
MOST_COMPARED = 50  # clients of a round that are compared pairwise; with more, only to the mean


def geometry(start: Arrays, ends: Mapping[str, Arrays]) -> dict[str, dict[str, float]]:
    """Measure each client's update: its arrays after local training minus `start`.

    Layers are processed one by one and products summed, so that memory is that of the largest layer and time linear in
    the number of clients.

    Args:
        start: the global arrays that all clients started from.
        ends: arrays after training, by client.

    Returns:
        For each client: ``norm.<part>``, the L2 norm of its update in the whole model and in each layer;
        ``cosine.<part>``, its cosine to the unweighted mean update; and ``toward.<client>``, its cosine to each other
        client's update, for at most `MOST_COMPARED` clients. The cosine to an update of norm 0 is 0.
    """
    names_of: dict[str, list[str]] = {}
    for name in start:
        names_of.setdefault(layer_of(name), []).append(name)
    products = {layer: _products(start, ends, names) for layer, names in names_of.items()}
    whole = {key: sum(of[key] for of in products.values()) for key in next(iter(products.values()))}
    products = {WHOLE: whole} | products
    measured: dict[str, dict[str, float]] = {who: {} for who in ends}
    for part, of in products.items():
        lengths = np.sqrt(of["square"])
        cosines = _cosines(of["with mean"], lengths, np.sqrt(of["mean square"]))
        for who, length, cosine in zip(ends, lengths, cosines, strict=True):
            measured[who] |= {f"norm.{part}": float(length), f"cosine.{part}": float(cosine)}
    lengths = np.sqrt(whole["square"])
    for who, row in zip(ends, _cosines(whole["pairs"], lengths[:, None], lengths), strict=False):
        measured[who] |= {f"toward.{other}": float(c) for other, c in zip(ends, row, strict=True) if other != who}
    return measured


def _products(start: Arrays, ends: Mapping[str, Arrays], names: list[str]) -> dict[str, np.ndarray]:
    """Squared norms of the updates in these arrays, and their products with the mean and with each other."""
    moved = np.stack([np.concatenate([(end[n] - start[n]).ravel() for n in names]) for end in ends.values()])
    mean = moved.mean(axis=0)
    compared = moved if len(moved) <= MOST_COMPARED else moved[:0]
    return {
        "square": np.square(moved).sum(axis=1), "with mean": moved @ mean, "mean square": mean @ mean,
        "pairs": compared @ compared.T,
    }  # fmt: skip


def _cosines(products: np.ndarray, left: np.ndarray, right: np.ndarray) -> np.ndarray:
    if products.size == 0:
        return products
    scale = np.broadcast_to(left * right, products.shape)
    return np.divide(products, scale, out=np.zeros_like(products), where=scale > 0)
