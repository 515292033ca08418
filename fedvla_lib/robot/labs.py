"""A laboratory: what differs between two places that do the same task with the same kind of arm.

Cameras are mounted by hand, light and table are what the room has, paint is never the same red, and two arms of one
make are calibrated a degree apart. A `Lab` holds one such place; lengths are metres and angles degrees.
"""

from dataclasses import dataclass

import numpy as np

from fedvla_lib.robot.spec import CAMERAS, NUM_JOINTS

CAMERA_SHIFT_M, LOOK_SHIFT_M = 0.010, 0.006  # standard deviation of a camera's place, and of the point it looks at
BRIGHTNESS = (0.8, 1.2)  # range of the light, as a share of the reference's
TABLE_CHANGE, PAINT_CHANGE = 0.08, 0.05  # largest change of a colour, of full scale
OFFSET_DEG = 1.0  # standard deviation of a joint's calibration error

Vector = tuple[float, float, float]
STILL = ((0.0, 0.0, 0.0),) * len(CAMERAS)


@dataclass(frozen=True)
class Lab:
    """How a place differs from the reference laboratory, whose differences are all zero."""

    name: str = "reference"
    camera_shift_m: tuple[Vector, ...] = STILL  # of each camera, in the order of `spec.CAMERAS`
    look_shift_m: tuple[Vector, ...] = STILL  # of the points they look at
    brightness: float = 1.0
    table_change: Vector = (0.0, 0.0, 0.0)  # added to red, green and blue in [0, 1]
    paint_change: Vector = (0.0, 0.0, 0.0)  # the same for the cubes
    joint_offset_deg: tuple[float, ...] = (0.0,) * (NUM_JOINTS - 1)  # what the arm reports minus what is true


REFERENCE = Lab()


def labs(count: int, seed: int = 0) -> list[Lab]:
    """Return laboratories: the reference, then others; lab k is the same however many there are.

    Runs leave `seed` at 0, so that a recording and whoever trains on it later, with seeds of their own, mean the same
    places.
    """
    return [REFERENCE, *(draw_lab(f"lab_{k}", np.random.default_rng([seed, k])) for k in range(1, count))]


def draw_lab(name: str, rng: np.random.Generator, spread: float = 1.0, offsets: bool = True) -> Lab:
    """Draw a laboratory.

    Args:
        spread: scales every difference; 0 gives the reference.
        offsets: whether the arm's calibration differs too.
    """
    offset_deg = spread * rng.normal(0, OFFSET_DEG, NUM_JOINTS - 1)
    return Lab(
        name,
        camera_shift_m=_rows(spread * rng.normal(0, CAMERA_SHIFT_M, (len(CAMERAS), 3))),
        look_shift_m=_rows(spread * rng.normal(0, LOOK_SHIFT_M, (len(CAMERAS), 3))),
        brightness=float(1 + spread * (rng.uniform(*BRIGHTNESS) - 1)),
        table_change=_row(spread * rng.uniform(-TABLE_CHANGE, TABLE_CHANGE, 3)),
        paint_change=_row(spread * rng.uniform(-PAINT_CHANGE, PAINT_CHANGE, 3)),
        joint_offset_deg=_row(offset_deg if offsets else 0 * offset_deg),
    )


def _rows(values: np.ndarray) -> tuple[Vector, ...]:
    return tuple(_row(row) for row in values)


def _row(values: np.ndarray) -> tuple[float, ...]:
    return tuple(float(value) for value in values)
