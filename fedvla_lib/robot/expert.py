"""Scripted experts: they read the true layout, plan a path for the gripper and solve inverse kinematics with mink.

The path is a list of `Waypoint`s for the grasp point between the finger tips; the gripper always points down. The speed
between waypoints is smooth, so that demonstrations have no jumps or pauses and the next action follows from the images
and the joint positions.
"""

from collections.abc import Callable, Iterable
from contextlib import closing
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import mink
import numpy as np
from tqdm import tqdm

from fedvla_lib.robot.layout import CUBE_HALF_M, Cube, Layout, cartesian
from fedvla_lib.robot.rollout import run_episode
from fedvla_lib.robot.scene import GRASP_SITE, build_arm
from fedvla_lib.robot.sim import So100Env, from_radians, to_radians
from fedvla_lib.robot.spec import NUM_JOINTS, Observation

OPEN, CLOSED = 34.0, 4.0  # gripper commands
FORK = 13.0  # gripper command at which both finger tips push one face of the cube
FORK_GAP_M = 0.040  # distance from the cube's centre at which the fork comes down
FORK_CONTACT_M = 0.022  # distance while pushing
GRASP_HEIGHT_M = 0.016  # heights of the grasp point above the table
STACK_HEIGHT_M = GRASP_HEIGHT_M + 2 * CUBE_HALF_M
PUSH_HEIGHT_M, HOVER_HEIGHT_M, CARRY_HEIGHT_M = 0.018, 0.075, 0.080
REACH_HEIGHT_M, POINT_HEIGHT_M, LIFT_HEIGHT_M = 0.048, 0.055, 0.095
RISE_M = 0.059  # distance the hand rises after releasing the cube
DRAG_HEIGHT_M = 0.017  # the cube stays on the table
PULL_M = 0.032
DRAG_RAD, NUDGE_RAD = np.deg2rad(17.0), np.deg2rad(16.0)
SIDESTEP_M = 0.009  # offset of the open jaws towards the fixed jaw, so that neither touches the cube on the way down
CLOSE_STEPS = OPEN_STEPS = 4
MIN_STEPS = 4
SPEED_M = 0.011  # mean distance per control step
SOLVER_STEPS = 60  # maximum inverse kinematics iterations per control step
SOLVER_TOLERANCE_RAD = 2e-4  # stop when the update is smaller
Point = tuple[float, float, float]


@dataclass(frozen=True)
class Waypoint:
    """Target of the grasp point, `steps` control steps after the previous waypoint."""

    position_m: Point
    yaw_rad: float  # rotation of the gripper about the vertical; at 0 the jaws close along y
    gripper: float  # 0-100
    steps: int


class Expert:
    """An `Actor` for every task; reads the true layout from the environment at the start of an episode."""

    def __init__(self) -> None:
        self._arm = _Arm()

    def reset(self, env: Any, seed: int) -> None:
        """Plan the episode in `env`, a `So100Env` that has just been reset. `seed` is not used."""
        sim: So100Env = env.unwrapped
        self._offset = sim.joint_offset  # the plan is in true angles, commands are in reported ones
        start = self._arm.start(sim.joints - self._offset)
        self._path = _interpolate(start, PLANS[sim.task](sim.layout, start))
        self._step = 0

    def act(self, observation: Observation) -> np.ndarray:
        """Return the next joint targets, float32 (6,), LeRobot units; after the plan's end the last ones again."""
        target = self._path[min(self._step, len(self._path) - 1)]
        self._step += 1
        return self._arm.solve(target) + self._offset


def expert_success(task: str, seeds: Iterable[int]) -> list[dict[str, Any]]:
    """Run the expert without cameras on each seed; rows with task, seed, success and steps."""
    expert = Expert()
    with closing(So100Env(task, cameras=(), render_mode=None)) as env:
        episodes = (run_episode(env, expert, seed) for seed in tqdm(seeds, desc=f"expert {task}", disable=None))
        return [{"task": task, "seed": e.seed, "success": e.success, "steps": e.num_frames} for e in episodes]


class _Arm:
    """Inverse kinematics, warm-started with the previous control step."""

    def __init__(self) -> None:
        model = build_arm()
        self._limits_rad = model.jnt_range[:NUM_JOINTS].copy()
        self._configuration = mink.Configuration(model)
        self._task = mink.FrameTask(GRASP_SITE, "site", position_cost=1.0, orientation_cost=0.05, lm_damping=1e-6)
        self._limits = [mink.ConfigurationLimit(model)]

    def start(self, joints: np.ndarray) -> Waypoint:
        """Start from these joint positions, LeRobot units, and return the grasp point's pose."""
        self._configuration.update(to_radians(joints, self._limits_rad))
        pose = self._configuration.get_transform_frame_to_world(GRASP_SITE, "site")
        across = pose.rotation().as_matrix()[:, 0]
        yaw_rad = float(np.arctan2(-across[0], across[1]))
        return Waypoint(tuple(pose.translation()), yaw_rad, float(joints[-1]), 0)

    def solve(self, target: Waypoint) -> np.ndarray:
        """Return joint targets for the grasp point at `target`, float32 (6,), LeRobot units."""
        across, up = np.array([-np.sin(target.yaw_rad), np.cos(target.yaw_rad), 0.0]), np.array([0.0, 0.0, 1.0])
        # Gripper down: the site's y axis points up, its x axis runs across the jaws.
        rotation = mink.SO3.from_matrix(np.column_stack([across, up, np.cross(across, up)]))
        self._task.set_target(mink.SE3.from_rotation_and_translation(rotation, np.array(target.position_m)))
        for _ in range(SOLVER_STEPS):
            velocity = mink.solve_ik(self._configuration, [self._task], 1.0, "daqp", damping=1e-6, limits=self._limits)
            self._configuration.integrate_inplace(velocity, 1.0)
            if np.linalg.norm(velocity) < SOLVER_TOLERANCE_RAD:
                break
        joints = from_radians(self._configuration.q, self._limits_rad)
        joints[-1] = target.gripper
        return joints


def _interpolate(start: Waypoint, plan: list[Waypoint]) -> list[Waypoint]:
    """Return one waypoint per control step, along straight lines with smooth acceleration and braking."""
    path = []
    for begin, end in pairwise([start, *plan]):
        before, after = (np.array([*one.position_m, one.yaw_rad, one.gripper]) for one in (begin, end))
        for progress in (_smooth(step / end.steps) for step in range(1, end.steps + 1)):
            *position_m, yaw_rad, gripper = (1 - progress) * before + progress * after
            path.append(Waypoint(tuple(position_m), yaw_rad, gripper, 1))
    return path


def _smooth(progress: float) -> float:
    return progress * progress * (3 - 2 * progress)


def _move(begin: Waypoint, position_m: Point, yaw_rad: float, gripper: float) -> Waypoint:
    """Return a waypoint whose number of steps follows from the distance."""
    distance_m = float(np.linalg.norm(np.subtract(position_m, begin.position_m)))
    return Waypoint(position_m, yaw_rad, gripper, max(MIN_STEPS, round(distance_m / SPEED_M)))


def _grasp(start: Waypoint, cube: Cube, height_m: float = GRASP_HEIGHT_M) -> list[Waypoint]:
    """Hover over the cube, descend, close."""
    around = _sidestep(*cube.xy_m, cube.yaw_rad)
    hover = _move(start, (*around, HOVER_HEIGHT_M), cube.yaw_rad, OPEN)
    down = _move(hover, (*around, height_m), cube.yaw_rad, OPEN)
    return [hover, down, Waypoint((*cube.xy_m, height_m), cube.yaw_rad, CLOSED, CLOSE_STEPS)]


def _sidestep(x: float, y: float, yaw_rad: float) -> tuple[float, float]:
    """Return the grasp point for open jaws around (x, y). Only one jaw moves, so the centre shifts on closing."""
    return x - SIDESTEP_M * np.sin(yaw_rad), y + SIDESTEP_M * np.cos(yaw_rad)


def _carry(start: Waypoint, cube: Cube, to_xy_m: tuple[float, float], height_m: float) -> list[Waypoint]:
    """Grasp the cube, carry it along an arc around the base, set it down with the hand at `height_m`, release, rise."""
    path = _grasp(start, cube)
    path.append(_move(path[-1], (*cube.xy_m, CARRY_HEIGHT_M), cube.yaw_rad, CLOSED))
    path += _arc(path[-1], to_xy_m, CARRY_HEIGHT_M, CLOSED)
    yaw_rad = path[-1].yaw_rad
    path.append(_move(path[-1], (*to_xy_m, height_m), yaw_rad, CLOSED))
    around = _sidestep(*to_xy_m, yaw_rad)
    path.append(Waypoint((*around, height_m), yaw_rad, OPEN, OPEN_STEPS))
    return [*path, _move(path[-1], (*around, height_m + RISE_M), yaw_rad, OPEN)]


def _sweep(start: Waypoint, cube: Cube, radius_m: float, bearing_rad: float) -> list[Waypoint]:
    """Come down beside the cube with the jaws as a fork and push it along an arc to the given polar position."""
    cube_radius_m, cube_rad = _polar(*cube.xy_m)
    side = np.sign(bearing_rad - cube_rad)  # 1 sweeps to the left
    beside_rad = cube_rad - side * FORK_GAP_M / cube_radius_m
    yaw_rad = beside_rad + np.pi / 2  # both finger tips at the same bearing
    beside = cartesian(cube_radius_m, beside_rad)
    hover = _move(start, (*beside, HOVER_HEIGHT_M), yaw_rad, FORK)
    down = _move(hover, (*beside, PUSH_HEIGHT_M), yaw_rad, FORK)
    end = cartesian(radius_m, bearing_rad - side * FORK_CONTACT_M / radius_m)
    return [hover, down, *_arc(down, end, PUSH_HEIGHT_M, FORK)]


def _grasp_and_move(start: Waypoint, cube: Cube, to_m: Point, height_m: float = GRASP_HEIGHT_M) -> list[Waypoint]:
    path = _grasp(start, cube, height_m)
    return [*path, _move(path[-1], to_m, cube.yaw_rad, CLOSED)]


def _sort_plan(layout: Layout, start: Waypoint) -> list[Waypoint]:
    path: list[Waypoint] = []
    for cube, zone_xy_m in zip(layout.cubes, layout.zones_xy_m, strict=True):
        path += _carry(path[-1] if path else start, cube, zone_xy_m, GRASP_HEIGHT_M)
    return path


def _drag_plan(layout: Layout, start: Waypoint) -> list[Waypoint]:
    path = _grasp(start, layout.cubes[0], DRAG_HEIGHT_M)
    radius_m, bearing_rad = _polar(*layout.cubes[0].xy_m)
    return path + _arc(path[-1], cartesian(radius_m, bearing_rad - DRAG_RAD), DRAG_HEIGHT_M, CLOSED)


def _pull_plan(layout: Layout, start: Waypoint) -> list[Waypoint]:
    radius_m, bearing_rad = _polar(*layout.cubes[0].xy_m)
    nearer_m = (*cartesian(radius_m - PULL_M, bearing_rad), DRAG_HEIGHT_M)
    return _grasp_and_move(start, layout.cubes[0], nearer_m, DRAG_HEIGHT_M)


def _nudge_plan(layout: Layout, start: Waypoint) -> list[Waypoint]:
    radius_m, bearing_rad = _polar(*layout.cubes[0].xy_m)
    return _sweep(start, layout.cubes[0], radius_m, bearing_rad - NUDGE_RAD)


def _point_plan(layout: Layout, start: Waypoint) -> list[Waypoint]:
    zone_xy_m = layout.zones_xy_m[0]
    return [_move(start, (*zone_xy_m, POINT_HEIGHT_M), _polar(*zone_xy_m)[1], OPEN)]


def _arc(begin: Waypoint, end_xy_m: tuple[float, float], height_m: float, gripper: float) -> list[Waypoint]:
    """Return an arc around the base to `end_xy_m`, one waypoint per control step; the gripper turns along."""
    x, y, z = begin.position_m
    (radius_m, bearing_rad), (end_radius_m, end_bearing_rad) = _polar(x, y), _polar(*end_xy_m)
    turn_rad = end_bearing_rad - bearing_rad
    steps = max(MIN_STEPS, round(abs(turn_rad) * max(radius_m, end_radius_m) / SPEED_M))
    path = []
    for step in range(1, steps + 1):
        progress = _smooth(step / steps)
        point_m = cartesian(radius_m + progress * (end_radius_m - radius_m), bearing_rad + progress * turn_rad)
        position_m = (*point_m, z + progress * (height_m - z))
        path.append(Waypoint(position_m, begin.yaw_rad + progress * turn_rad, gripper, 1))
    return path


def _polar(x: float, y: float) -> tuple[float, float]:
    """Radius in metres and bearing in radians, around the arm's first joint."""
    return float(np.hypot(x, y)), float(np.arctan2(y, x))


PLANS: dict[str, Callable[[Layout, Waypoint], list[Waypoint]]] = {
    "lift": lambda layout, start: _grasp_and_move(start, layout.cubes[0], (*layout.cubes[0].xy_m, LIFT_HEIGHT_M)),
    "place": lambda layout, start: _carry(start, layout.cubes[0], layout.zones_xy_m[0], GRASP_HEIGHT_M),
    "push": lambda layout, start: _sweep(start, layout.cubes[0], *_polar(*layout.zones_xy_m[0])),
    "stack": lambda layout, start: _carry(start, layout.cubes[0], layout.cubes[1].xy_m, STACK_HEIGHT_M),
    "sort": _sort_plan,
    "reach": lambda layout, start: [
        _move(start, (*layout.cubes[0].xy_m, REACH_HEIGHT_M), layout.cubes[0].yaw_rad, OPEN)],
    "grip": lambda layout, start: _grasp(start, layout.cubes[0]),
    "drag": _drag_plan, "pull": _pull_plan, "nudge": _nudge_plan,
    "point_square": _point_plan, "point_circle": _point_plan,
}  # fmt: skip
