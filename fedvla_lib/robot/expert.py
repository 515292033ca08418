"""Scripted demonstrators: they know where the cube is, plan a path for the gripper and solve it with mink.

The path is a list of `Waypoint`s for the grasp point between the finger tips, always with the gripper pointing down.
Between waypoints the grasp point moves with a smooth speed profile, so that a demonstration has neither jumps nor
pauses: what to do next can be read from the pictures and the joint positions.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import mink
import numpy as np
from tqdm import tqdm

from fedvla_lib.robot.layout import CUBE_HALF_M, Cube, Layout
from fedvla_lib.robot.rollout import run_episode
from fedvla_lib.robot.scene import GRASP_SITE, build_arm
from fedvla_lib.robot.sim import So100Env, from_radians, to_radians
from fedvla_lib.robot.spec import NUM_JOINTS, Observation

OPEN, CLOSED = 34.0, 4.0  # gripper commands: wide enough for a turned cube, and firm
FORK = 13.0  # gripper opening at which both finger tips push one face of the cube
FORK_GAP_M = 0.040  # how far beside the cube's centre the fork comes down
FORK_CONTACT_M = 0.022  # distance from the fork to the cube's centre while it pushes
GRASP_HEIGHT_M = 0.016  # heights of the grasp point above the table
PUSH_HEIGHT_M = 0.018
HOVER_HEIGHT_M = 0.075
CARRY_HEIGHT_M = 0.080
RISE_M = 0.059  # how far the hand rises after letting go
REACH_HEIGHT_M = 0.048
POINT_HEIGHT_M = 0.055
DRAG_HEIGHT_M = 0.017  # the cube stays on the table
PULL_M = 0.032
DRAG_RAD, NUDGE_RAD = np.deg2rad(17.0), np.deg2rad(16.0)
LIFT_HEIGHT_M = 0.095
SIDESTEP_M = 0.009  # open jaws come down this far towards the fixed one's side, so that neither grazes the cube
CLOSE_STEPS = OPEN_STEPS = 4
MIN_STEPS = 4
SPEED_M = 0.011  # how far the grasp point travels in one control step, on average
SOLVER_STEPS = 60  # at most so many iterations of inverse kinematics per control step
SOLVER_TOLERANCE_RAD = 2e-4  # a smaller correction ends the iteration


@dataclass(frozen=True)
class Waypoint:
    """Where the grasp point should be, `steps` control steps after the waypoint before."""

    position_m: tuple[float, float, float]
    yaw_rad: float  # turn of the gripper about the vertical; at 0 the jaws close along y
    gripper: float  # 0-100
    steps: int


class Expert:
    """An Actor for each of our tasks; it reads the true layout from the environment when an episode starts."""

    def __init__(self) -> None:
        self._arm = _Arm()

    def reset(self, env: Any, seed: int) -> None:
        """Plan the episode in `env`, a `So100Env` that has just been reset. `seed` is not needed."""
        sim: So100Env = env.unwrapped
        self._offset = sim.joint_offset  # the plan is made in true angles, the arm is told its own
        start = self._arm.start(sim.joints - self._offset)
        self._path = _interpolate(start, PLANS[sim.task](sim.layout, start))
        self._step = 0

    def act(self, observation: Observation) -> np.ndarray:
        """Return the next joint targets, float32 (6,), LeRobot units; after the plan's end its last ones."""
        target = self._path[min(self._step, len(self._path) - 1)]
        self._step += 1
        return self._arm.solve(target) + self._offset


def expert_success(task: str, seeds: Iterable[int]) -> list[dict[str, Any]]:
    """Run the expert without cameras on each seed; rows with task, seed, success and steps."""
    env = So100Env(task, cameras=(), render_mode=None)
    expert, rows = Expert(), []
    for seed in tqdm(seeds, desc=f"expert {task}", disable=None):
        episode = run_episode(env, expert, seed)
        rows.append({"task": task, "seed": seed, "success": episode.success, "steps": episode.num_frames})
    env.close()
    return rows


class _Arm:
    """Inverse kinematics of the arm alone, warm-started from one control step to the next."""

    def __init__(self) -> None:
        model = build_arm()
        self._limits_rad = model.jnt_range[:NUM_JOINTS].copy()
        self._configuration = mink.Configuration(model)
        self._task = mink.FrameTask(GRASP_SITE, "site", position_cost=1.0, orientation_cost=0.05, lm_damping=1e-6)
        self._limits = [mink.ConfigurationLimit(model)]

    def start(self, joints: np.ndarray) -> Waypoint:
        """Take over the joint positions, LeRobot units, and return where the grasp point is with them."""
        self._configuration.update(to_radians(joints, self._limits_rad))
        pose = self._configuration.get_transform_frame_to_world(GRASP_SITE, "site")
        across = pose.rotation().as_matrix()[:, 0]
        yaw_rad = float(np.arctan2(-across[0], across[1]))
        return Waypoint(tuple(pose.translation()), yaw_rad, float(joints[-1]), 0)

    def solve(self, target: Waypoint) -> np.ndarray:
        """Joint targets that put the grasp point at `target`, float32 (6,), LeRobot units."""
        self._task.set_target(_pose(target))
        for _ in range(SOLVER_STEPS):
            velocity = mink.solve_ik(self._configuration, [self._task], 1.0, "daqp", damping=1e-6, limits=self._limits)
            self._configuration.integrate_inplace(velocity, 1.0)
            if np.linalg.norm(velocity) < SOLVER_TOLERANCE_RAD:
                break
        joints = from_radians(self._configuration.q, self._limits_rad)
        joints[-1] = target.gripper
        return joints


def _pose(target: Waypoint) -> mink.SE3:
    """Gripper down: the site's y axis points up, its x axis runs across the jaws."""
    across = np.array([-np.sin(target.yaw_rad), np.cos(target.yaw_rad), 0.0])
    up = np.array([0.0, 0.0, 1.0])
    rotation = np.column_stack([across, up, np.cross(across, up)])
    return mink.SE3.from_rotation_and_translation(mink.SO3.from_matrix(rotation), np.array(target.position_m))


def _interpolate(start: Waypoint, plan: list[Waypoint]) -> list[Waypoint]:
    """One waypoint per control step, along straight lines with speeds that start and end gently."""
    path = []
    for begin, end in pairwise([start, *plan]):
        for step in range(1, end.steps + 1):
            path.append(_between(begin, end, _smooth(step / end.steps)))
    return path


def _between(begin: Waypoint, end: Waypoint, share: float) -> Waypoint:
    position_m = (1 - share) * np.array(begin.position_m) + share * np.array(end.position_m)
    yaw_rad = (1 - share) * begin.yaw_rad + share * end.yaw_rad
    return Waypoint(tuple(position_m), yaw_rad, (1 - share) * begin.gripper + share * end.gripper, 1)


def _smooth(share: float) -> float:
    return share * share * (3 - 2 * share)


def _move(begin: Waypoint, position_m: tuple[float, float, float], yaw_rad: float, gripper: float) -> Waypoint:
    """A waypoint whose number of steps follows from the distance."""
    distance_m = float(np.linalg.norm(np.subtract(position_m, begin.position_m)))
    return Waypoint(position_m, yaw_rad, gripper, max(MIN_STEPS, round(distance_m / SPEED_M)))


def _grasp(start: Waypoint, cube: Cube, height_m: float = GRASP_HEIGHT_M) -> list[Waypoint]:
    """Hover over the cube, descend, close."""
    around = _sidestep(*cube.xy_m, cube.yaw_rad)
    hover = _move(start, (*around, HOVER_HEIGHT_M), cube.yaw_rad, OPEN)
    down = _move(hover, (*around, height_m), cube.yaw_rad, OPEN)
    return [hover, down, Waypoint((*cube.xy_m, height_m), cube.yaw_rad, CLOSED, CLOSE_STEPS)]


def _sidestep(x: float, y: float, yaw_rad: float) -> tuple[float, float]:
    """Where open jaws are centred on (x, y): only one jaw moves, so closed they are centred elsewhere."""
    return x - SIDESTEP_M * np.sin(yaw_rad), y + SIDESTEP_M * np.cos(yaw_rad)


def _carry(start: Waypoint, cube: Cube, to_xy_m: tuple[float, float], height_m: float) -> list[Waypoint]:
    """Grasp the cube, carry it along an arc around the base, set it down with the hand at `height_m`, let go, rise."""
    path = _grasp(start, cube)
    path.append(_move(path[-1], (*cube.xy_m, CARRY_HEIGHT_M), path[-1].yaw_rad, CLOSED))
    path += _arc(path[-1], to_xy_m, CARRY_HEIGHT_M, CLOSED)
    path.append(_move(path[-1], (*to_xy_m, height_m), path[-1].yaw_rad, CLOSED))
    around = _sidestep(*to_xy_m, path[-1].yaw_rad)
    path.append(Waypoint((*around, height_m), path[-1].yaw_rad, OPEN, OPEN_STEPS))
    return [*path, _move(path[-1], (*around, height_m + RISE_M), path[-1].yaw_rad, OPEN)]


def _sweep(start: Waypoint, cube: Cube, radius_m: float, bearing_rad: float) -> list[Waypoint]:
    """Come down beside the cube with the jaws as a fork and sweep it along an arc to the given place."""
    cube_radius_m, cube_rad = _polar(*cube.xy_m)
    side = np.sign(bearing_rad - cube_rad)  # 1 sweeps to the left
    beside_rad = cube_rad - side * FORK_GAP_M / cube_radius_m
    yaw_rad = beside_rad + np.pi / 2  # both finger tips at the same bearing
    beside = _cartesian(cube_radius_m, beside_rad)
    hover = _move(start, (*beside, HOVER_HEIGHT_M), yaw_rad, FORK)
    down = _move(hover, (*beside, PUSH_HEIGHT_M), yaw_rad, FORK)
    end = _cartesian(radius_m, bearing_rad - side * FORK_CONTACT_M / radius_m)
    return [hover, down, *_arc(down, end, PUSH_HEIGHT_M, FORK)]


def _lift_plan(layout: Layout, start: Waypoint) -> list[Waypoint]:
    path = _grasp(start, layout.cubes[0])
    return [*path, _move(path[-1], (*layout.cube_xy_m, LIFT_HEIGHT_M), path[-1].yaw_rad, CLOSED)]


def _place_plan(layout: Layout, start: Waypoint) -> list[Waypoint]:
    return _carry(start, layout.cubes[0], layout.zone_xy_m, GRASP_HEIGHT_M)


def _push_plan(layout: Layout, start: Waypoint) -> list[Waypoint]:
    return _sweep(start, layout.cubes[0], *_polar(*layout.zone_xy_m))


def _stack_plan(layout: Layout, start: Waypoint) -> list[Waypoint]:
    upper, lower = layout.cubes
    return _carry(start, upper, lower.xy_m, GRASP_HEIGHT_M + 2 * CUBE_HALF_M)


def _sort_plan(layout: Layout, start: Waypoint) -> list[Waypoint]:
    path: list[Waypoint] = []
    for cube, zone_xy_m in zip(layout.cubes, layout.zones_xy_m, strict=True):
        path += _carry(path[-1] if path else start, cube, zone_xy_m, GRASP_HEIGHT_M)
    return path


def _reach_plan(layout: Layout, start: Waypoint) -> list[Waypoint]:
    return [_move(start, (*layout.cube_xy_m, REACH_HEIGHT_M), layout.cube_yaw_rad, OPEN)]


def _point_plan(layout: Layout, start: Waypoint) -> list[Waypoint]:
    return [_move(start, (*layout.zone_xy_m, POINT_HEIGHT_M), _polar(*layout.zone_xy_m)[1], OPEN)]


def _grip_plan(layout: Layout, start: Waypoint) -> list[Waypoint]:
    return _grasp(start, layout.cubes[0])


def _drag_plan(layout: Layout, start: Waypoint) -> list[Waypoint]:
    path = _grasp(start, layout.cubes[0], DRAG_HEIGHT_M)
    radius_m, bearing_rad = _polar(*layout.cube_xy_m)
    return path + _arc(path[-1], _cartesian(radius_m, bearing_rad - DRAG_RAD), DRAG_HEIGHT_M, CLOSED)


def _pull_plan(layout: Layout, start: Waypoint) -> list[Waypoint]:
    path = _grasp(start, layout.cubes[0], DRAG_HEIGHT_M)
    radius_m, bearing_rad = _polar(*layout.cube_xy_m)
    nearer = _cartesian(radius_m - PULL_M, bearing_rad)
    return [*path, _move(path[-1], (*nearer, DRAG_HEIGHT_M), path[-1].yaw_rad, CLOSED)]


def _nudge_plan(layout: Layout, start: Waypoint) -> list[Waypoint]:
    radius_m, bearing_rad = _polar(*layout.cube_xy_m)
    return _sweep(start, layout.cubes[0], radius_m, bearing_rad - NUDGE_RAD)


def _arc(begin: Waypoint, end_xy_m: tuple[float, float], height_m: float, gripper: float) -> list[Waypoint]:
    """The way to `end_xy_m` around the base, turning the gripper along, as one waypoint per control step."""
    x, y, z = begin.position_m
    (radius_m, bearing_rad), (end_radius_m, end_bearing_rad) = _polar(x, y), _polar(*end_xy_m)
    turn_rad = end_bearing_rad - bearing_rad
    steps = max(MIN_STEPS, round(abs(turn_rad) * max(radius_m, end_radius_m) / SPEED_M))
    path = []
    for step in range(1, steps + 1):
        share = _smooth(step / steps)
        point = _cartesian(radius_m + share * (end_radius_m - radius_m), bearing_rad + share * turn_rad)
        path.append(Waypoint((*point, z + share * (height_m - z)), begin.yaw_rad + share * turn_rad, gripper, 1))
    return path


def _polar(x: float, y: float) -> tuple[float, float]:
    """Radius in metres and bearing in radians, around the arm's first joint."""
    return float(np.hypot(x, y)), float(np.arctan2(y, x))


def _cartesian(radius_m: float, bearing_rad: float) -> tuple[float, float]:
    return float(radius_m * np.cos(bearing_rad)), float(radius_m * np.sin(bearing_rad))


PLANS = {
    "lift": _lift_plan,
    "place": _place_plan,
    "push": _push_plan,
    "stack": _stack_plan,
    "sort": _sort_plan,
    "reach": _reach_plan,
    "grip": _grip_plan,
    "drag": _drag_plan,
    "pull": _pull_plan,
    "nudge": _nudge_plan,
    "point_square": _point_plan,
    "point_circle": _point_plan,
}
