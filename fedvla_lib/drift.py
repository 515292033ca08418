"""How far, and how differently, clients move from the same start: norms and angles of their updates."""

from collections.abc import Mapping

import numpy as np

from fedvla_lib.params import Arrays, layer_of

WHOLE = "all"


def geometry(start: Arrays, ends: Mapping[str, Arrays]) -> dict[str, dict[str, float]]:
    """Measure each client's update, its arrays after local training minus `start`.

    Args:
        start: the global arrays that all clients started from.
        ends: for each client its arrays afterwards.

    Returns:
        for each client: ``norm.<part>``, the length of its update in all of the model and in each layer;
        ``cosine.<part>``, the cosine of the angle to the plain mean of all updates; and ``toward.<client>``, the cosine
        to each other client's update. A cosine with an update of length 0 is 0.
    """
    updates = {who: {name: arrays[name] - start[name] for name in start} for who, arrays in ends.items()}
    parts = {WHOLE: list(start)} | {layer: [n for n in start if layer_of(n) == layer] for layer in map(layer_of, start)}
    flat = {part: np.stack([_flat(update, names) for update in updates.values()]) for part, names in parts.items()}
    measured = {}
    for row, who in enumerate(updates):
        lengths = {f"norm.{part}": float(np.linalg.norm(vectors[row])) for part, vectors in flat.items()}
        angles = {f"cosine.{part}": _cosine(vectors[row], vectors.mean(axis=0)) for part, vectors in flat.items()}
        others = {f"toward.{o}": _cosine(flat[WHOLE][row], flat[WHOLE][i]) for i, o in enumerate(updates) if o != who}
        measured[who] = lengths | angles | others
    return measured


def _flat(arrays: Arrays, names: list[str]) -> np.ndarray:
    return np.concatenate([arrays[name].ravel() for name in names])


def _cosine(left: np.ndarray, right: np.ndarray) -> float:
    scale = float(np.linalg.norm(left)) * float(np.linalg.norm(right))
    return float(left @ right) / scale if scale else 0.0
