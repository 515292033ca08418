"""The tasks: instruction, random layout and success predicate.

A task does not know the simulator: `draw_layout` draws a `Layout` before an episode, and the success predicate checks a
`TaskState`, a few measured numbers, after every control step. Lengths are metres in the world frame: the origin is on
the table under the arm's first joint, x points away from the base, y to the arm's left, z up.
"""

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from fedvla_lib.robot.layout import COLORS, CUBE_HALF_M, Layout, Patch, Region, draw_cubes, draw_zones

LIFT_CLEARANCE_M = 0.04  # a held cube higher above the table than this is lifted
CARRY_CLEARANCE_M = 0.02  # a held cube higher above the table than this is carried
REST_CLEARANCE_M = 0.004  # tolerance on the resting height
SLIDE_CLEARANCE_M = 0.010  # a pushed cube may tip, but its centre must not rise more than this
REST_SPEED_MPS = 0.02  # below this the cube is at rest
AWAY_M = 0.04  # minimum distance from grasp point to cube once the cube is released
PLACE_HALF_M = 0.040  # half the side of the square
PUSH_RADIUS_M = 0.045  # radius of the circle
REACH_M = 0.012  # maximum horizontal distance from grasp point to cube centre
REACH_HEIGHT_M = (0.020, 0.050)  # range of the vertical distance
POINT_M = 0.020  # maximum horizontal distance from grasp point to zone centre
POINT_HEIGHT_M = (0.035, 0.075)
DRAG_DEG, NUDGE_DEG = 12.0, 10.0  # minimum rotation of the cube around the base
PULL_M = 0.025


@dataclass(frozen=True)
class TaskState:
    """Input of the success predicates, measured after a control step, for one cube; by default before the first."""

    clearance_m: float = 0.0  # height of the cube's centre above its resting height on the table
    peak_clearance_m: float = 0.0  # the largest clearance so far in this episode
    speed_mps: float = 0.0  # speed of the cube's centre
    zone_offset_m: tuple[float, float] = (np.inf, np.inf)  # cube centre minus its zone's centre; infinite without zone
    held: bool = False  # both jaws touch the cube
    touched: bool = False  # any part of the arm touches the cube
    carried: bool = False  # at some time in this episode both jaws held the cube clear of the table
    flung: bool = False  # at some time in this episode the cube moved over the table with nothing touching it
    hand_distance_m: float = np.inf  # from the grasp point between the jaws to the cube's centre
    cube_m: tuple[float, float, float] = (0.0, 0.0, 0.0)  # the cube's centre
    start_m: tuple[float, float, float] = (0.0, 0.0, 0.0)  # the cube's centre at the start of the episode
    hand_m: tuple[float, float, float] = (0.0, 0.0, 0.0)  # the grasp point
    hand_zone_offset_m: tuple[float, float] = (np.inf, np.inf)  # grasp point minus the zone's centre
    others: tuple["TaskState", ...] = ()  # the same measurements for every further cube, each with its own zone


@dataclass(frozen=True)
class Task:
    """Instruction, start regions, time limit and success predicate."""

    name: str
    wordings: tuple[str, ...]  # the instruction, with {color} and, for the second cube, {other}; one is drawn
    success: Callable[[TaskState], bool]  # must hold for `hold_steps` control steps in a row
    hold_steps: int
    horizon_steps: int
    cube: Region
    other: Region | None = None  # where a second cube of another colour stands
    other_share: float = 1.0  # fraction of episodes with the second cube
    zones: tuple[Patch, ...] = ()


def _placed(state: TaskState) -> bool:
    return state.carried and _in_square(state) and _released(state) and _at_rest(state)


def _in_square(state: TaskState) -> bool:
    return max(abs(offset) for offset in state.zone_offset_m) < PLACE_HALF_M - CUBE_HALF_M


def _in_circle(state: TaskState) -> bool:
    return float(np.hypot(*state.zone_offset_m)) < PUSH_RADIUS_M - CUBE_HALF_M


def _pushed(state: TaskState) -> bool:
    return _in_circle(state) and _slid(state) and not state.carried and not state.flung and _at_rest(state)


def _stacked(state: TaskState) -> bool:
    below = state.others[0]
    x, y, z = np.subtract(state.cube_m, below.cube_m)
    on_top = np.hypot(x, y) < CUBE_HALF_M and abs(z - 2 * CUBE_HALF_M) < REST_CLEARANCE_M
    still = state.speed_mps < REST_SPEED_MPS and _at_rest(below) and not below.touched
    return bool(state.carried and on_top and _released(state) and still)


def _reached(state: TaskState) -> bool:
    x, y, z = np.subtract(state.hand_m, state.cube_m)
    return bool(np.hypot(x, y) < REACH_M and REACH_HEIGHT_M[0] < z < REACH_HEIGHT_M[1] and _slid(state))


def _pointed(state: TaskState) -> bool:
    over = float(np.hypot(*state.hand_zone_offset_m)) < POINT_M
    return over and POINT_HEIGHT_M[0] < state.hand_m[2] < POINT_HEIGHT_M[1]


def _pulled(state: TaskState) -> bool:
    nearer_m = float(np.hypot(*state.start_m[:2]) - np.hypot(*state.cube_m[:2]))
    return state.held and _slid(state) and nearer_m > PULL_M


def _nudged(state: TaskState) -> bool:
    pushed = not state.carried and not state.flung
    return pushed and _slid(state) and _at_rest(state) and _turn_deg(state) < -NUDGE_DEG


def _released(state: TaskState) -> bool:
    return not state.touched and state.hand_distance_m > AWAY_M


def _at_rest(state: TaskState) -> bool:
    return state.speed_mps < REST_SPEED_MPS and abs(state.clearance_m) < REST_CLEARANCE_M


def _slid(state: TaskState) -> bool:
    return state.peak_clearance_m < SLIDE_CLEARANCE_M


def _turn_deg(state: TaskState) -> float:
    """Rotation of the cube around the base since the start, in degrees; positive to the arm's left."""
    start, now = (np.arctan2(point[1], point[0]) for point in (state.start_m, state.cube_m))
    return float(np.rad2deg(now - start))


def _by_name(*tasks: Task) -> dict[str, Task]:
    return {task.name: task for task in tasks}


# The tasks that the clients learn.
TASKS = _by_name(
    Task("lift", ("Lift the {color} cube.",), lambda state: state.held and state.clearance_m > LIFT_CLEARANCE_M,
         hold_steps=5, horizon_steps=80, cube=Region((0.19, 0.225), (-20.0, 20.0))),
    Task("place", ("Put the {color} cube in the yellow square.",), _placed, hold_steps=4, horizon_steps=120,
         cube=Region((0.19, 0.225), (-20.0, 0.0)),
         zones=(Patch(Region((0.19, 0.22), (28.0, 40.0)), "square", PLACE_HALF_M),)),
    Task("push", ("Push the {color} cube into the white circle.",), _pushed, hold_steps=4, horizon_steps=100,
         cube=Region((0.19, 0.225), (-20.0, -2.0)),
         zones=(Patch(Region((0.195, 0.215), (30.0, 42.0)), "disc", PUSH_RADIUS_M),)),
    Task("stack", ("Stack the {color} cube on the {other} cube.",), _stacked, hold_steps=4, horizon_steps=120,
         cube=Region((0.19, 0.225), (-25.0, -5.0)), other=Region((0.19, 0.22), (15.0, 30.0))),
    Task("sort", ("Put the {color} cube in the yellow square and the {other} cube in the white circle.",),
         lambda state: all(_placed(one) for one in (state, *state.others)), hold_steps=4, horizon_steps=220,
         cube=Region((0.19, 0.225), (-16.0, 16.0)), other=Region((0.19, 0.225), (-16.0, 16.0)),
         zones=(Patch(Region((0.19, 0.21), (36.0, 46.0)), "square", PLACE_HALF_M),
                Patch(Region((0.19, 0.21), (-46.0, -36.0)), "disc", PUSH_RADIUS_M))),
)  # fmt: skip

# The tasks of the benchmark "ten labs": the scene tells which of them it is.
LAB_TASKS = _by_name(
    Task("square", ("Move the {color} cube to the yellow square.",), _placed, hold_steps=4, horizon_steps=120,
         cube=Region((0.19, 0.225), (-25.0, -5.0)),
         zones=(Patch(Region((0.19, 0.22), (18.0, 45.0)), "square", PLACE_HALF_M),)),
    Task("tower", ("Put the {color} cube on top of the {other} cube.",), _stacked, hold_steps=4, horizon_steps=120,
         cube=Region((0.19, 0.225), (-25.0, -5.0)), other=Region((0.19, 0.22), (8.0, 30.0))),
)  # fmt: skip

ANYWHERE = Region((0.185, 0.23), (-30.0, 30.0))
ON_THE_LEFT = Region((0.185, 0.23), (-8.0, 34.0))  # for tasks that move the cube to the right
FAR = Region((0.205, 0.235), (-30.0, 30.0))
ZONES_ANYWHERE = {shape: Patch(Region((0.18, 0.23), (-45.0, 45.0)), shape, half_m)
                  for shape, half_m in (("square", PLACE_HALF_M), ("disc", PUSH_RADIUS_M))}  # fmt: skip
# What the nano base is pretrained on, before any client trains: none of the tasks above and none of their goals.
PRETRAINING_TASKS = _by_name(
    Task("reach", ("Reach for the {color} cube.", "Go to the {color} cube.", "Move the hand above the {color} cube."),
         _reached, hold_steps=4, horizon_steps=60, cube=ANYWHERE, other=ANYWHERE, other_share=0.7),
    Task("grip", ("Grip the {color} cube.", "Grasp the {color} cube.", "Take hold of the {color} cube."),
         lambda state: state.held and _slid(state), hold_steps=5, horizon_steps=70,
         cube=ANYWHERE, other=ANYWHERE, other_share=0.5),
    Task("drag", ("Drag the {color} cube to the right.", "Pull the {color} cube to the right."),
         lambda state: state.held and _slid(state) and _turn_deg(state) < -DRAG_DEG,
         hold_steps=3, horizon_steps=90, cube=ON_THE_LEFT),
    Task("pull", ("Pull the {color} cube closer.", "Bring the {color} cube nearer."),
         _pulled, hold_steps=3, horizon_steps=80, cube=FAR, other=FAR, other_share=0.5),
    Task("nudge", ("Nudge the {color} cube to the right.", "Slide the {color} cube to the right."),
         _nudged, hold_steps=4, horizon_steps=90, cube=ON_THE_LEFT),
    Task("point_square", ("Point at the yellow square.", "Go to the yellow square."),
         _pointed, hold_steps=4, horizon_steps=60, cube=ANYWHERE,
         zones=(ZONES_ANYWHERE["square"], ZONES_ANYWHERE["disc"])),
    Task("point_circle", ("Point at the white circle.", "Go to the white circle."),
         _pointed, hold_steps=4, horizon_steps=60, cube=ANYWHERE,
         zones=(ZONES_ANYWHERE["disc"], ZONES_ANYWHERE["square"])),
)  # fmt: skip
ALL_TASKS = TASKS | LAB_TASKS | PRETRAINING_TASKS


def task_of(text: str) -> str:
    """Return the name of the task with the wording `text`, in any colours; `text` itself if no task has it."""
    words = "|".join(COLORS)
    for task in ALL_TASKS.values():
        for wording in task.wordings:
            pattern = re.sub(r"\\\{(color|other)\\\}", f"({words})", re.escape(wording))
            if re.fullmatch(pattern, text.strip(), flags=re.IGNORECASE):
                return task.name
    return text


def check_tasks(names: Iterable[str]) -> list[str]:
    """Return `names` as a list; raise ValueError, listing the valid ones, if one is not a task."""
    names = list(names)
    if unknown := [name for name in names if name not in ALL_TASKS]:
        raise ValueError(f"unknown task {unknown[0]!r}: choose one of {', '.join(ALL_TASKS)}")
    return names


def draw_layout(task: Task, rng: np.random.Generator, color: str | None = None) -> Layout:
    """Draw positions of cubes and zones, and the wording. The same generator state gives the same layout.

    Args:
        color: colour of the first cube; None draws one. The positions do not depend on it.

    Raises:
        ValueError: unknown colour.
    """
    if color is not None and color not in COLORS:
        raise ValueError(f"unknown colour {color!r}: choose one of {', '.join(COLORS)}")
    drawn = [str(name) for name in rng.permutation(list(COLORS))]
    colors = sorted(drawn, key=lambda name: name != color)  # stable: the others stay in the order drawn
    regions = [task.cube, *([task.other] if task.other and rng.random() < task.other_share else [])]
    cubes, zones_xy_m = draw_cubes(regions, colors, rng), draw_zones(task.zones, rng)
    wording = task.wordings[rng.integers(len(task.wordings))]
    return Layout(wording.format(color=colors[0], other=colors[1]), cubes, zones_xy_m)
