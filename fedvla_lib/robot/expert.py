"""Scripted experts: they read the true layout, plan a path for the gripper and solve inverse kinematics with mink.

The path is a list of `Waypoint`s for the grasp point between the finger tips; the gripper always points down. The speed
between waypoints is smooth, so that demonstrations have no jumps or pauses and the next action follows from the images
and the joint positions. A lab's operator adds habits: pace, approach, grasp, pauses, corrections.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import mink
import numpy as np
from tqdm import tqdm

from fedvla_lib.robot.layout import CUBE_HALF_M, Cube, Layout, cartesian
from fedvla_lib.robot.operators import Operator
from fedvla_lib.robot.rollout import run_episode
from fedvla_lib.robot.scene import GRASP_SITE, build_arm
from fedvla_lib.robot.sim import So100Env, from_radians, to_radians
from fedvla_lib.robot.spec import FPS, NUM_JOINTS, Observation

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
PAUSE_STEPS = (2, 6)  # shortest and longest pause of an operator who hesitates
WRONG_AIM_M, WRONG_AIM_HEIGHT_M = 0.016, 0.050  # where a descent that will be corrected aims, beside the cube
SLIP_M = 0.006  # how far off the goal an imperfect demonstration releases the cube; its grasp offset is doubled
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
    """An `Actor` for every task; reads the true layout from the environment at the start of an episode.

    `fps`: control steps per second. With more of them the path is the same, in smaller steps.
    """

    def __init__(self, fps: int = FPS) -> None:
        self._arm, self._fps = _Arm(), fps

    def reset(self, env: Any, seed: int) -> None:
        """Plan the episode in `env`, a `So100Env` that has just been reset; `seed` fixes what its operator does."""
        sim: So100Env = env.unwrapped
        self._offset = sim.joint_offset  # the plan is in true angles, commands are in reported ones
        start = _Plan(self._arm.start(sim.joints - self._offset), sim.lab.operator, np.random.default_rng(seed))
        self._path = _interpolate(PLANS[sim.task](start, sim.layout, sim.layout.cubes[0]), self._fps)
        self._step = 0

    def act(self, observation: Observation) -> np.ndarray:
        """Return the next joint targets, float32 (6,), LeRobot units; after the plan's end the last ones again."""
        target = self._path[min(self._step, len(self._path) - 1)]
        self._step += 1
        return self._arm.solve(target) + self._offset

    @property
    def steps_left(self) -> int:
        """Control steps until the plan's end."""
        return max(0, len(self._path) - self._step)


def expert_success(task: str, seeds: Iterable[int]) -> list[dict[str, Any]]:
    """Run the expert without cameras on each seed; rows with task, seed, success and steps."""
    env, expert = So100Env(task, cameras=(), render_mode=None), Expert()
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


def _interpolate(plan: list[Waypoint], fps: int) -> list[Waypoint]:
    """Return one waypoint per control step, along straight lines with smooth acceleration and braking."""
    path = []
    for begin, end in pairwise(plan):
        before, after = (np.array([*one.position_m, one.yaw_rad, one.gripper]) for one in (begin, end))
        steps = max(1, round(end.steps * fps / FPS))
        paced = _smooth if end.steps > 1 else float  # an arc's points, a control step apart, are smooth as they stand
        for progress in (paced(step / steps) for step in range(1, steps + 1)):
            *position_m, yaw_rad, gripper = (1 - progress) * before + progress * after
            path.append(Waypoint(tuple(position_m), yaw_rad, gripper, 1))
    return path


def _smooth(progress: float) -> float:
    return progress * progress * (3 - 2 * progress)


class _Plan(list[Waypoint]):
    """Waypoints, the first of them where the gripper is; every method appends some and returns the plan."""

    def __init__(self, start: Waypoint, operator: Operator, rng: np.random.Generator) -> None:
        super().__init__([start])
        self._operator, self._rng = operator, rng
        self._speed_m = SPEED_M * operator.speed
        imperfect = rng.random() < operator.imperfect
        self._grasp_m = operator.grasp_m * (2 if imperfect else 1)
        angle_rad = rng.uniform(0, 2 * np.pi)
        self._slip_m = SLIP_M * imperfect * np.array([np.cos(angle_rad), np.sin(angle_rad)])

    def move(self, position_m: Point, yaw_rad: float, gripper: float) -> "_Plan":
        """Go straight to `position_m`; the number of steps follows from the distance."""
        distance_m = float(np.linalg.norm(np.subtract(position_m, self[-1].position_m)))
        self.append(Waypoint(position_m, yaw_rad, gripper, max(MIN_STEPS, round(distance_m / self._speed_m))))
        return self

    def descend(self, xy_m: tuple[float, float], height_m: float, yaw_rad: float, gripper: float) -> "_Plan":
        """Come from above to a point near the table, with the operator's habits on the way."""
        hover_m, (radius_m, bearing_rad) = HOVER_HEIGHT_M + self._operator.hover_m, _polar(*xy_m)
        beside = [cartesian(radius_m, bearing_rad + m / radius_m) for m in (self._operator.side_m, WRONG_AIM_M)]
        self.move((*beside[0], hover_m), yaw_rad, gripper)
        if self._rng.random() < self._operator.hesitation:
            self.append(replace(self[-1], steps=int(self._rng.integers(*PAUSE_STEPS, endpoint=True))))
        if self._rng.random() < self._operator.correction:
            self.move((*beside[1], WRONG_AIM_HEIGHT_M), yaw_rad, gripper).move((*xy_m, hover_m), yaw_rad, gripper)
        return self.move((*xy_m, height_m), yaw_rad, gripper)

    def arc(self, end_xy_m: tuple[float, float], height_m: float, gripper: float) -> "_Plan":
        """Go along an arc around the base to `end_xy_m`, one waypoint per control step; the gripper turns along."""
        begin = self[-1]
        x, y, z = begin.position_m
        (radius_m, bearing_rad), (end_radius_m, end_bearing_rad) = _polar(x, y), _polar(*end_xy_m)
        turn_rad = end_bearing_rad - bearing_rad
        steps = max(MIN_STEPS, round(abs(turn_rad) * max(radius_m, end_radius_m) / self._speed_m))
        for progress in (_smooth(step / steps) for step in range(1, steps + 1)):
            point_m = cartesian(radius_m + progress * (end_radius_m - radius_m), bearing_rad + progress * turn_rad)
            position_m = (*point_m, z + progress * (height_m - z))
            self.append(Waypoint(position_m, begin.yaw_rad + progress * turn_rad, gripper, 1))
        return self

    def grasp(self, cube: Cube, height_m: float = GRASP_HEIGHT_M) -> "_Plan":
        """Hover over the cube, descend, close."""
        along = self._grasp_m * np.array([np.cos(cube.yaw_rad), np.sin(cube.yaw_rad)])
        x, y = np.add(cube.xy_m, along).tolist()
        self.descend(_sidestep(x, y, cube.yaw_rad), height_m, cube.yaw_rad, OPEN)
        self.append(Waypoint((x, y, height_m), cube.yaw_rad, CLOSED, CLOSE_STEPS))
        return self

    def carry(self, cube: Cube, to_xy_m: tuple[float, float], height_m: float) -> "_Plan":
        """Grasp the cube, carry it along an arc, set it down with the hand at `height_m`, release, rise."""
        to_xy_m = tuple(np.add(to_xy_m, self._slip_m).tolist())
        self.grasp(cube).move((*cube.xy_m, CARRY_HEIGHT_M), cube.yaw_rad, CLOSED).arc(to_xy_m, CARRY_HEIGHT_M, CLOSED)
        yaw_rad = self[-1].yaw_rad
        around = _sidestep(*to_xy_m, yaw_rad)
        self.move((*to_xy_m, height_m), yaw_rad, CLOSED)
        self.append(Waypoint((*around, height_m), yaw_rad, OPEN, OPEN_STEPS))
        return self.move((*around, height_m + RISE_M), yaw_rad, OPEN)

    def sweep(self, cube: Cube, radius_m: float, bearing_rad: float) -> "_Plan":
        """Come down beside the cube with the jaws as a fork and push it along an arc to the given polar position."""
        cube_radius_m, cube_rad = _polar(*cube.xy_m)
        side = np.sign(bearing_rad - cube_rad)  # 1 sweeps to the left
        beside_rad = cube_rad - side * FORK_GAP_M / cube_radius_m
        yaw_rad = beside_rad + np.pi / 2  # both finger tips at the same bearing
        beside = cartesian(cube_radius_m, beside_rad)
        end = cartesian(radius_m, bearing_rad - side * FORK_CONTACT_M / radius_m)
        self.descend(beside, PUSH_HEIGHT_M, yaw_rad, FORK)
        return self.arc(end, PUSH_HEIGHT_M, FORK)

    def point(self, xy_m: tuple[float, float]) -> "_Plan":
        """Move the open hand over a point of the table."""
        return self.move((*xy_m, POINT_HEIGHT_M), _polar(*xy_m)[1], OPEN)


def _sidestep(x: float, y: float, yaw_rad: float) -> tuple[float, float]:
    """Return the grasp point for open jaws around (x, y). Only one jaw moves, so the centre shifts on closing."""
    return x - SIDESTEP_M * np.sin(yaw_rad), y + SIDESTEP_M * np.cos(yaw_rad)


def _polar(x: float, y: float) -> tuple[float, float]:
    """Radius in metres and bearing in radians, around the arm's first joint."""
    return float(np.hypot(x, y)), float(np.arctan2(y, x))


def _beside(cube: Cube, farther_m: float, turn_rad: float) -> tuple[float, float]:
    """Polar position of the cube, changed by these; a positive angle turns to the left."""
    radius_m, bearing_rad = _polar(*cube.xy_m)
    return radius_m + farther_m, bearing_rad + turn_rad


# By task: extends the plan that holds the start, for a layout and its first cube.
PLANS: dict[str, Callable[[_Plan, Layout, Cube], _Plan]] = {
    "lift": lambda plan, layout, cube: plan.grasp(cube).move((*cube.xy_m, LIFT_HEIGHT_M), cube.yaw_rad, CLOSED),
    "place": lambda plan, layout, cube: plan.carry(cube, layout.zones_xy_m[0], GRASP_HEIGHT_M),
    "push": lambda plan, layout, cube: plan.sweep(cube, *_polar(*layout.zones_xy_m[0])),
    "stack": lambda plan, layout, cube: plan.carry(cube, layout.cubes[1].xy_m, STACK_HEIGHT_M),
    "sort": lambda plan, layout, cube: plan.carry(cube, layout.zones_xy_m[0], GRASP_HEIGHT_M).carry(
        layout.cubes[1], layout.zones_xy_m[1], GRASP_HEIGHT_M
    ),
    "reach": lambda plan, layout, cube: plan.move((*cube.xy_m, REACH_HEIGHT_M), cube.yaw_rad, OPEN),
    "grip": lambda plan, layout, cube: plan.grasp(cube),
    "drag": lambda plan, layout, cube: plan.grasp(cube, DRAG_HEIGHT_M).arc(
        cartesian(*_beside(cube, 0.0, -DRAG_RAD)), DRAG_HEIGHT_M, CLOSED
    ),
    "pull": lambda plan, layout, cube: plan.grasp(cube, DRAG_HEIGHT_M).move(
        (*cartesian(*_beside(cube, -PULL_M, 0.0)), DRAG_HEIGHT_M), cube.yaw_rad, CLOSED
    ),
    "nudge": lambda plan, layout, cube: plan.sweep(cube, *_beside(cube, 0.0, -NUDGE_RAD)),
    "point_square": lambda plan, layout, cube: plan.point(layout.zones_xy_m[0]),
    "point_circle": lambda plan, layout, cube: plan.point(layout.zones_xy_m[0]),
}
PLANS |= {"square": PLANS["place"], "tower": PLANS["stack"]}
