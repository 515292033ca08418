"""What the arm is asked to do: the instruction, the random layout, and when the request is fulfilled.

A task knows no simulator: it draws a `Layout` before an episode and judges a `Scene`, a handful of measured numbers,
after every control step. Lengths are metres in the world frame: the origin lies on the table under the arm's first
joint, x points away from the base, y to the arm's left, z up.
"""

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from fedvla_lib.robot.layout import (
    COLORS,
    CUBE_HALF_M,
    CUBES_APART_M,
    MAX_CUBE_YAW_RAD,
    ZONES_APART_M,
    Cube,
    Layout,
    Patch,
    Region,
    check_color,
    draw_apart,
)

LIFT_CLEARANCE_M = 0.04  # how far the cube must be above the table to count as lifted
CARRY_CLEARANCE_M = 0.02  # how far above the table a cube held by both jaws counts as carried
REST_CLEARANCE_M = 0.004  # a cube this close to its resting height stands on the table
SLIDE_CLEARANCE_M = 0.010  # a pushed cube may tip, but its centre must not rise more than this
REST_SPEED_MPS = 0.02  # below this the cube is at rest
AWAY_M = 0.04  # the grasp point must be this far from the cube to count as away


@dataclass(frozen=True)
class TaskState:
    """What a success predicate may look at, measured after a control step, from the view of one cube."""

    clearance_m: float  # height of the cube's centre above where it rests on the table
    peak_clearance_m: float  # the largest clearance so far in this episode
    speed_mps: float  # speed of the cube's centre
    zone_offset_m: tuple[float, float]  # cube centre minus its zone's centre, x and y; infinite where there is no zone
    held: bool  # both jaws touch the cube
    touched: bool  # any part of the arm touches the cube
    carried: bool  # in this episode both jaws have held the cube clear of the table
    flung: bool  # in this episode the cube has moved over the table with nothing touching it
    hand_distance_m: float  # from the grasp point between the jaws to the cube's centre
    cube_m: tuple[float, float, float] = (0.0, 0.0, 0.0)  # the cube's centre
    start_m: tuple[float, float, float] = (0.0, 0.0, 0.0)  # the cube's centre when the episode began
    hand_m: tuple[float, float, float] = (0.0, 0.0, 0.0)  # the grasp point
    hand_zone_offset_m: tuple[float, float] = (np.inf, np.inf)  # grasp point minus the zone's centre
    others: tuple["TaskState", ...] = ()  # the same measurements for every further cube, each with its own zone


@dataclass(frozen=True)
class Task:
    """A request in words, where it starts, how long it may take, and when it is fulfilled."""

    name: str
    wordings: tuple[str, ...]  # the instruction, with {color} and, of the second cube, {other}; one is drawn
    success: Callable[[TaskState], bool]  # must hold for `hold_steps` control steps in a row
    hold_steps: int
    horizon_steps: int
    cube: Region
    other: Region | None = None  # where a second cube of another colour stands
    other_share: float = 1.0  # share of episodes in which it is there
    zones: tuple[Patch, ...] = ()


def _lifted(scene: TaskState) -> bool:
    return scene.held and scene.clearance_m > LIFT_CLEARANCE_M


def _placed(scene: TaskState) -> bool:
    inside = max(abs(offset) for offset in scene.zone_offset_m) < PLACE_HALF_M - CUBE_HALF_M
    return scene.carried and inside and _released(scene) and _at_rest(scene)


def _pushed(scene: TaskState) -> bool:
    inside = float(np.hypot(*scene.zone_offset_m)) < PUSH_RADIUS_M - CUBE_HALF_M
    slid = scene.peak_clearance_m < SLIDE_CLEARANCE_M and not scene.carried and not scene.flung
    return inside and slid and _at_rest(scene)


def _stacked(scene: TaskState) -> bool:
    below = scene.others[0]
    x, y, z = np.subtract(scene.cube_m, below.cube_m)
    on_top = np.hypot(x, y) < CUBE_HALF_M and abs(z - 2 * CUBE_HALF_M) < REST_CLEARANCE_M
    still = scene.speed_mps < REST_SPEED_MPS and _at_rest(below) and not below.touched
    return bool(scene.carried and on_top and _released(scene) and still)


def _sorted(scene: TaskState) -> bool:
    return _placed(scene) and all(_placed(other) for other in scene.others)


def _released(scene: TaskState) -> bool:
    return not scene.touched and scene.hand_distance_m > AWAY_M


def _at_rest(scene: TaskState) -> bool:
    return scene.speed_mps < REST_SPEED_MPS and abs(scene.clearance_m) < REST_CLEARANCE_M


PLACE_HALF_M = 0.040
PUSH_RADIUS_M = 0.045
# What clients learn.
TASKS: dict[str, Task] = {
    "lift": Task(
        name="lift",
        wordings=("Lift the {color} cube.",),
        success=_lifted,
        hold_steps=5,
        horizon_steps=80,
        cube=Region(radius_m=(0.19, 0.225), bearing_deg=(-20.0, 20.0)),
    ),
    "place": Task(
        name="place",
        wordings=("Put the {color} cube in the yellow square.",),
        success=_placed,
        hold_steps=4,
        horizon_steps=120,
        cube=Region(radius_m=(0.19, 0.225), bearing_deg=(-20.0, 0.0)),
        zones=(Patch(Region(radius_m=(0.19, 0.22), bearing_deg=(28.0, 40.0)), "square", PLACE_HALF_M),),
    ),
    "push": Task(
        name="push",
        wordings=("Push the {color} cube into the white circle.",),
        success=_pushed,
        hold_steps=4,
        horizon_steps=100,
        cube=Region(radius_m=(0.19, 0.225), bearing_deg=(-20.0, -2.0)),
        zones=(Patch(Region(radius_m=(0.195, 0.215), bearing_deg=(30.0, 42.0)), "disc", PUSH_RADIUS_M),),
    ),
    "stack": Task(
        name="stack",
        wordings=("Stack the {color} cube on the {other} cube.",),
        success=_stacked,
        hold_steps=4,
        horizon_steps=120,
        cube=Region(radius_m=(0.19, 0.225), bearing_deg=(-25.0, -5.0)),
        other=Region(radius_m=(0.19, 0.22), bearing_deg=(15.0, 30.0)),
    ),
    "sort": Task(
        name="sort",
        wordings=("Put the {color} cube in the yellow square and the {other} cube in the white circle.",),
        success=_sorted,
        hold_steps=4,
        horizon_steps=220,
        cube=Region(radius_m=(0.19, 0.225), bearing_deg=(-16.0, 16.0)),
        other=Region(radius_m=(0.19, 0.225), bearing_deg=(-16.0, 16.0)),
        zones=(
            Patch(Region(radius_m=(0.19, 0.21), bearing_deg=(36.0, 46.0)), "square", PLACE_HALF_M),
            Patch(Region(radius_m=(0.19, 0.21), bearing_deg=(-46.0, -36.0)), "disc", PUSH_RADIUS_M),
        ),
    ),
}


def _reached(scene: TaskState) -> bool:
    x, y, z = np.subtract(scene.hand_m, scene.cube_m)
    return bool(np.hypot(x, y) < REACH_M and REACH_HEIGHT_M[0] < z < REACH_HEIGHT_M[1] and _slid(scene))


def _pointed(scene: TaskState) -> bool:
    over = float(np.hypot(*scene.hand_zone_offset_m)) < POINT_M
    return over and POINT_HEIGHT_M[0] < scene.hand_m[2] < POINT_HEIGHT_M[1]


def _gripped(scene: TaskState) -> bool:
    return scene.held and _slid(scene)


def _dragged(scene: TaskState) -> bool:
    return scene.held and _slid(scene) and _turn_deg(scene) < -DRAG_DEG


def _pulled(scene: TaskState) -> bool:
    nearer_m = float(np.hypot(*scene.start_m[:2]) - np.hypot(*scene.cube_m[:2]))
    return scene.held and _slid(scene) and nearer_m > PULL_M


def _nudged(scene: TaskState) -> bool:
    untouched = not scene.carried and not scene.flung
    return untouched and _slid(scene) and _at_rest(scene) and _turn_deg(scene) < -NUDGE_DEG


def _slid(scene: TaskState) -> bool:
    return scene.peak_clearance_m < SLIDE_CLEARANCE_M


def _turn_deg(scene: TaskState) -> float:
    """How far the cube has moved around the base, in degrees; positive to the arm's left."""
    start, now = (np.arctan2(point[1], point[0]) for point in (scene.start_m, scene.cube_m))
    return float(np.rad2deg(now - start))


REACH_M = 0.012  # how far beside the cube's centre the hand may be
REACH_HEIGHT_M = (0.020, 0.050)  # how far above it
POINT_M = 0.020
POINT_HEIGHT_M = (0.035, 0.075)
DRAG_DEG, NUDGE_DEG = 12.0, 10.0
PULL_M = 0.025
ANYWHERE = Region(radius_m=(0.185, 0.23), bearing_deg=(-30.0, 30.0))
ON_THE_LEFT = Region(radius_m=(0.185, 0.23), bearing_deg=(-8.0, 34.0))  # what then moves to the right
FAR = Region(radius_m=(0.205, 0.235), bearing_deg=(-30.0, 30.0))
ZONES_ANYWHERE = {shape: Patch(Region((0.18, 0.23), (-45.0, 45.0)), shape, half_m)
                  for shape, half_m in (("square", PLACE_HALF_M), ("disc", PUSH_RADIUS_M))}  # fmt: skip
# What the nano base has seen before any client trains: none of the tasks above and none of their goals.
PRETRAINING_TASKS: dict[str, Task] = {
    "reach": Task(
        name="reach",
        wordings=("Reach for the {color} cube.", "Go to the {color} cube.", "Move the hand above the {color} cube."),
        success=_reached,
        hold_steps=4,
        horizon_steps=60,
        cube=ANYWHERE,
        other=ANYWHERE,
        other_share=0.7,
    ),
    "grip": Task(
        name="grip",
        wordings=("Grip the {color} cube.", "Grasp the {color} cube.", "Take hold of the {color} cube."),
        success=_gripped,
        hold_steps=5,
        horizon_steps=70,
        cube=ANYWHERE,
        other=ANYWHERE,
        other_share=0.5,
    ),
    "drag": Task(
        name="drag",
        wordings=("Drag the {color} cube to the right.", "Pull the {color} cube to the right."),
        success=_dragged,
        hold_steps=3,
        horizon_steps=90,
        cube=ON_THE_LEFT,
    ),
    "pull": Task(
        name="pull",
        wordings=("Pull the {color} cube closer.", "Bring the {color} cube nearer."),
        success=_pulled,
        hold_steps=3,
        horizon_steps=80,
        cube=FAR,
        other=FAR,
        other_share=0.5,
    ),
    "nudge": Task(
        name="nudge",
        wordings=("Nudge the {color} cube to the right.", "Slide the {color} cube to the right."),
        success=_nudged,
        hold_steps=4,
        horizon_steps=90,
        cube=ON_THE_LEFT,
    ),
    "point_square": Task(
        name="point_square",
        wordings=("Point at the yellow square.", "Go to the yellow square."),
        success=_pointed,
        hold_steps=4,
        horizon_steps=60,
        cube=ANYWHERE,
        zones=(ZONES_ANYWHERE["square"], ZONES_ANYWHERE["disc"]),
    ),
    "point_circle": Task(
        name="point_circle",
        wordings=("Point at the white circle.", "Go to the white circle."),
        success=_pointed,
        hold_steps=4,
        horizon_steps=60,
        cube=ANYWHERE,
        zones=(ZONES_ANYWHERE["disc"], ZONES_ANYWHERE["square"]),
    ),
}
ALL_TASKS = TASKS | PRETRAINING_TASKS


def task_of(text: str) -> str:
    """Return the task whose wording `text` is, in any colours, else `text` itself: another data set's task."""
    words = "|".join(COLORS)
    for task in ALL_TASKS.values():
        for wording in task.wordings:
            pattern = re.sub(r"\\\{(color|other)\\\}", f"({words})", re.escape(wording))
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
        if name not in ALL_TASKS:
            raise ValueError(f"unknown task {name!r}: choose one of {', '.join(ALL_TASKS)}")
    return names


def draw_layout(task: Task, rng: np.random.Generator, color: str | None = None) -> Layout:
    """Draw where cubes and zones stand, and the wording. The same generator state gives the same layout.

    Args:
        task: the task whose regions to draw from.
        rng: the only source of chance.
        color: colour of the first cube; None draws one. The positions do not depend on it.

    Raises:
        ValueError: unknown colour.
    """
    drawn = [str(name) for name in rng.permutation(list(COLORS))]
    colors = [check_color(color), *(name for name in drawn if name != color)] if color is not None else drawn
    regions = [task.cube, *([task.other] if task.other and rng.random() < task.other_share else [])]
    cubes = []
    for name, (xy_m, bearing_rad) in zip(colors, draw_apart(regions, CUBES_APART_M, rng), strict=False):
        yaw_rad = bearing_rad + rng.uniform(-MAX_CUBE_YAW_RAD, MAX_CUBE_YAW_RAD)
        cubes.append(Cube(name, xy_m, float(yaw_rad)))
    zones = draw_apart([zone.region for zone in task.zones], ZONES_APART_M, rng)
    wording = task.wordings[rng.integers(len(task.wordings))]
    text = wording.format(color=colors[0], other=colors[1])
    return Layout(text, tuple(cubes), tuple(xy_m for xy_m, _ in zones))
