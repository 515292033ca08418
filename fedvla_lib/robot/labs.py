"""Labs: the differences between places that do the same tasks with the same kind of arm.

Camera mounting, light, the colours of table and cubes, the arm's calibration, and who operates it (`operators`).
Lengths are metres, angles degrees.
"""

from dataclasses import dataclass, replace

import numpy as np

from fedvla_lib.robot.operators import Operator, draw_operator
from fedvla_lib.robot.spec import CAMERAS, NUM_JOINTS

CAMERA_SHIFT_M, LOOK_SHIFT_M = 0.010, 0.006  # standard deviations of camera position and of its target point
BRIGHTNESS = (0.8, 1.2)  # range, relative to the reference lab
TABLE_CHANGE, PAINT_CHANGE = 0.08, 0.05  # largest change of a colour channel in [0, 1]
OFFSET_DEG = 1.0  # standard deviation of a joint's calibration error
SPREAD = 0.5  # of the labs that record, which differ less than the scenes that the base is pretrained on

Vector = tuple[float, float, float]
STILL = ((0.0, 0.0, 0.0),) * len(CAMERAS)


@dataclass(frozen=True)
class Lab:
    """How a lab differs from the reference lab."""

    name: str = "reference"
    camera_shift_m: tuple[Vector, ...] = STILL  # per camera, in the order of `spec.CAMERAS`
    look_shift_m: tuple[Vector, ...] = STILL  # of the cameras' target points
    brightness: float = 1.0
    table_change: Vector = (0.0, 0.0, 0.0)  # added to red, green and blue in [0, 1]
    paint_change: Vector = (0.0, 0.0, 0.0)  # the same for the cubes
    joint_offset_deg: tuple[float, ...] = (0.0,) * (NUM_JOINTS - 1)  # reported minus true joint angle
    operator: Operator = Operator()


REFERENCE = Lab()


def labs(count: int) -> list[Lab]:
    """Return the reference lab and `count - 1` others, each with an operator of its own; lab k depends on k only.

    So a recording and later runs, whatever their seed, use the same labs.
    """
    return [REFERENCE, *(_with_operator(k) for k in range(1, count))]


def _with_operator(k: int) -> Lab:
    rng = np.random.default_rng([0, k])
    lab = draw_lab(f"lab_{k}", rng, SPREAD)
    return replace(lab, operator=draw_operator(rng))


def draw_lab(name: str, rng: np.random.Generator, spread: float = 1.0, offsets: bool = True) -> Lab:
    """Draw a lab.

    Args:
        spread: scales every difference; 0 gives the reference lab.
        offsets: whether to draw calibration offsets too.
    """
    offset_deg = spread * rng.normal(0, OFFSET_DEG, NUM_JOINTS - 1)
    shifts = (spread * rng.normal(0, sigma_m, (len(CAMERAS), 3)) for sigma_m in (CAMERA_SHIFT_M, LOOK_SHIFT_M))
    camera_shift_m, look_shift_m = (tuple(map(tuple, shift_m.tolist())) for shift_m in shifts)
    return Lab(
        name, camera_shift_m, look_shift_m,
        brightness=float(1 + spread * (rng.uniform(*BRIGHTNESS) - 1)),
        table_change=tuple((spread * rng.uniform(-TABLE_CHANGE, TABLE_CHANGE, 3)).tolist()),
        paint_change=tuple((spread * rng.uniform(-PAINT_CHANGE, PAINT_CHANGE, 3)).tolist()),
        joint_offset_deg=tuple((offset_deg if offsets else 0 * offset_deg).tolist()),
    )  # fmt: skip
