"""What a lab does: its task and its place, guessed from one update.

The attacker knows the code and the base model, and makes clients of its own, whose task and place it knows. A lab's
update is compared with theirs: the nearest kind of shadow client is the guess.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from fedvla_lib.policy.parameters import Arrays


def flat(update: Arrays) -> np.ndarray:
    """Return the numbers of an update, float64, in the order of names."""
    return np.concatenate([update[name].ravel() for name in sorted(update)]).astype(np.float64)


def guess(update: np.ndarray, shadows: Mapping[str, Sequence[np.ndarray]]) -> str:
    """Return the label whose shadow updates are nearest in direction, after the mean of all shadows is taken off.

    Args:
        update: flat, of the lab attacked.
        shadows: for each label, flat updates of the attacker's own clients.
    """
    common = np.mean([vector for vectors in shadows.values() for vector in vectors], axis=0)
    near = {label: _cosine(update - common, np.mean(vectors, axis=0) - common) for label, vectors in shadows.items()}
    return max(near, key=near.get)


def _cosine(left: np.ndarray, right: np.ndarray) -> float:
    return float(left @ right / (np.linalg.norm(left) * np.linalg.norm(right) or 1))
