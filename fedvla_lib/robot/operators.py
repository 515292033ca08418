"""Operators: who demonstrates, and with which habits. Lengths are metres.

A person who teleoperates an arm moves at a pace of their own, comes from one side, pauses, corrects a wrong aim. Each
habit is drawn for a lab's operator within its range in `HABITS`; the reference lab's operator, who also demonstrates
what the base is pretrained on, has none of them.
"""

from dataclasses import dataclass

import numpy as np

HABITS = {  # smallest and largest value of each habit
    "speed": (0.8, 1.25),
    "hover_m": (-0.010, 0.020),
    "side_m": (-0.025, 0.025),
    "grasp_m": (-0.002, 0.002),
    "hesitation": (0.0, 0.4),
    "correction": (0.0, 0.3),
    "imperfect": (0.0, 0.3),
}


@dataclass(frozen=True)
class Operator:
    """The habits of a demonstrator; the defaults are the reference operator's."""

    speed: float = 1.0  # relative to the reference operator's
    hover_m: float = 0.0  # added to the height from which a cube is approached
    side_m: float = 0.0  # the hand comes down from this far beside the cube, positive to the arm's left
    grasp_m: float = 0.0  # distance of the grasp from the cube's centre, along its face
    hesitation: float = 0.0  # probability of a pause before a descent
    correction: float = 0.0  # probability that a descent aims beside the cube first
    imperfect: float = 0.0  # share of demonstrations with a worse grasp and release; they succeed all the same


def draw_operator(rng: np.random.Generator) -> Operator:
    """Draw every habit uniformly within its range."""
    return Operator(**{habit: float(rng.uniform(*limits)) for habit, limits in HABITS.items()})
