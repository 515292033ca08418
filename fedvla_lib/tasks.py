"""What the arm is asked to do: the instruction, the random layout, and when the request is fulfilled.

A task knows no simulator: it draws a `Layout` before an episode and judges a `Scene`, a handful of measured numbers,
after every control step. Lengths are metres in the world frame: the origin lies on the table under the arm's first
joint, x points away from the base, y to the arm's left, z up.
"""

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

COLORS = {  # name in the instruction -> red, green, blue in [0, 1]
    "red": (0.86, 0.12, 0.10),
    "green": (0.10, 0.60, 0.20),
    "blue": (0.10, 0.25, 0.85),
}
CUBE_HALF_M = 0.014  # half the edge of the cube
LIFT_CLEARANCE_M = 0.04  # how far the cube must be above the table to count as lifted
CARRY_CLEARANCE_M = 0.02  # how far above the table a cube held by both jaws counts as carried
REST_CLEARANCE_M = 0.004  # a cube this close to its resting height stands on the table
SLIDE_CLEARANCE_M = 0.010  # a pushed cube may tip, but its centre must not rise more than this
REST_SPEED_MPS = 0.02  # below this the cube is at rest
AWAY_M = 0.04  # the grasp point must be this far from the cube to count as away


@dataclass(frozen=True)
class Region:
    """Part of the table in polar coordinates around the arm's first joint."""

    radius_m: tuple[float, float]
    bearing_deg: tuple[float, float]  # 0 is straight ahead, positive to the arm's left


@dataclass(frozen=True)
class Layout:
    """Where things stand at the start of an episode."""

    color: str
    cube_xy_m: tuple[float, float]
    cube_yaw_rad: float
    zone_xy_m: tuple[float, float] | None


@dataclass(frozen=True)
class Scene:
    """What a success predicate may look at, measured after a control step."""

    clearance_m: float  # height of the cube's centre above where it rests on the table
    peak_clearance_m: float  # the largest clearance so far in this episode
    speed_mps: float  # speed of the cube's centre
    zone_offset_m: tuple[float, float]  # cube centre minus zone centre, x and y; infinite where there is no zone
    held: bool  # both jaws touch the cube
    touched: bool  # any part of the arm touches the cube
    carried: bool  # in this episode both jaws have held the cube clear of the table
    flung: bool  # in this episode the cube has moved over the table with nothing touching it
    hand_distance_m: float  # from the grasp point between the jaws to the cube's centre


@dataclass(frozen=True)
class Task:
    """A request in words, where it starts, how long it may take, and when it is fulfilled."""

    name: str
    template: str  # the instruction, with {color}
    success: Callable[[Scene], bool]  # must hold for `hold_steps` control steps in a row
    hold_steps: int
    horizon_steps: int
    cube: Region
    zone: Region | None = None
    zone_shape: str = ""  # "square" or "disc"
    zone_half_m: float = 0.0  # half the side of the square, or the radius of the disc


def _lifted(scene: Scene) -> bool:
    return scene.held and scene.clearance_m > LIFT_CLEARANCE_M


def _placed(scene: Scene) -> bool:
    inside = max(abs(offset) for offset in scene.zone_offset_m) < PLACE_HALF_M - CUBE_HALF_M
    released = not scene.touched and scene.hand_distance_m > AWAY_M
    return scene.carried and inside and released and _at_rest(scene)


def _pushed(scene: Scene) -> bool:
    inside = float(np.hypot(*scene.zone_offset_m)) < PUSH_RADIUS_M - CUBE_HALF_M
    slid = scene.peak_clearance_m < SLIDE_CLEARANCE_M and not scene.carried and not scene.flung
    return inside and slid and _at_rest(scene)


def _at_rest(scene: Scene) -> bool:
    return scene.speed_mps < REST_SPEED_MPS and abs(scene.clearance_m) < REST_CLEARANCE_M


PLACE_HALF_M = 0.040
PUSH_RADIUS_M = 0.045
TASKS: dict[str, Task] = {
    "lift": Task(
        name="lift",
        template="Lift the {color} cube.",
        success=_lifted,
        hold_steps=5,
        horizon_steps=80,
        cube=Region(radius_m=(0.19, 0.225), bearing_deg=(-20.0, 20.0)),
    ),
    "place": Task(
        name="place",
        template="Put the {color} cube in the yellow square.",
        success=_placed,
        hold_steps=4,
        horizon_steps=120,
        cube=Region(radius_m=(0.19, 0.225), bearing_deg=(-20.0, 0.0)),
        zone=Region(radius_m=(0.19, 0.22), bearing_deg=(28.0, 40.0)),
        zone_shape="square",
        zone_half_m=PLACE_HALF_M,
    ),
    "push": Task(
        name="push",
        template="Push the {color} cube into the white circle.",
        success=_pushed,
        hold_steps=4,
        horizon_steps=100,
        cube=Region(radius_m=(0.19, 0.225), bearing_deg=(-20.0, -2.0)),
        zone=Region(radius_m=(0.195, 0.215), bearing_deg=(30.0, 42.0)),
        zone_shape="disc",
        zone_half_m=PUSH_RADIUS_M,
    ),
}
MAX_CUBE_YAW_RAD = np.deg2rad(25.0)  # cube faces turn at most this much from the arm's direction


def instruction(task_name: str, color: str) -> str:
    """Return the request in words: ``("lift", "red")`` -> ``"Lift the red cube."``.

    Raises:
        ValueError: unknown task or colour; the message lists the valid ones.
    """
    check_tasks([task_name])
    return TASKS[task_name].template.format(color=check_color(color))


def task_of(text: str) -> str:
    """Return the task whose wording `text` is, in any colour, else `text` itself: another data set's task."""
    words = "|".join(COLORS)
    for task in TASKS.values():
        pattern = re.escape(task.template).replace(re.escape("{color}"), f"({words})")
        if re.fullmatch(pattern, text.strip(), flags=re.IGNORECASE):
            return task.name
    return text


def check_tasks(names: Iterable[str]) -> list[str]:
    """Return `names` as a list if each is a task.

    Raises:
        ValueError: an unknown task; the message lists the valid ones.
    """
    names = list(names)
    for name in names:
        if name not in TASKS:
            raise ValueError(f"unknown task {name!r}: choose one of {', '.join(TASKS)}")
    return names


def check_color(color: str) -> str:
    """Return `color` if a cube can have it, else raise ValueError listing the valid ones."""
    if color not in COLORS:
        raise ValueError(f"unknown colour {color!r}: choose one of {', '.join(COLORS)}")
    return color


def draw_layout(task: Task, rng: np.random.Generator, color: str | None = None) -> Layout:
    """Draw where the cube and the zone stand. The same generator state gives the same layout.

    Args:
        task: the task whose regions to draw from.
        rng: the only source of chance.
        color: colour of the cube; None draws one. The positions do not depend on it.

    Raises:
        ValueError: unknown colour.
    """
    drawn = str(rng.choice(list(COLORS)))
    cube_xy, bearing_rad = _draw_point(task.cube, rng)
    yaw_rad = bearing_rad + rng.uniform(-MAX_CUBE_YAW_RAD, MAX_CUBE_YAW_RAD)
    zone_xy = _draw_point(task.zone, rng)[0] if task.zone else None
    return Layout(check_color(color) if color is not None else drawn, cube_xy, float(yaw_rad), zone_xy)


def _draw_point(region: Region, rng: np.random.Generator) -> tuple[tuple[float, float], float]:
    radius_m = rng.uniform(*region.radius_m)
    bearing_rad = np.deg2rad(rng.uniform(*region.bearing_deg))
    return (float(radius_m * np.cos(bearing_rad)), float(radius_m * np.sin(bearing_rad))), float(bearing_rad)
