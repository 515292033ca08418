"""So100Env: a simulated SO-100 arm as a Gymnasium environment. Does not know about learning.

State and action are LeRobot's six numbers: five joints in degrees, the gripper from 0 (closed) to 100 (open). MuJoCo
uses radians. As in LeRobot's calibration, where zero is about the middle of a joint's range, there is an offset:

    degrees = ZERO_DEG + 180 / pi * radians,   gripper = 100 * (radians - closed) / (open - closed)

At zero degrees the upper arm is vertical and the forearm horizontal, pointing straight ahead. Positive shoulder_pan
turns to the arm's left, positive shoulder_lift leans forward, positive elbow_flex and wrist_flex bend the gripper down.
"closed" and "open" are the limits of the gripper's joint range in the model.
"""

import math
from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from typing import Any

import gymnasium
import mujoco
import numpy as np
from gymnasium import spaces

from fedvla_lib.robot import scene
from fedvla_lib.robot.labs import REFERENCE, Lab, draw_lab
from fedvla_lib.robot.layout import CUBE_HALF_M
from fedvla_lib.robot.rendering import SceneRenderer
from fedvla_lib.robot.spec import CAMERAS, FPS, NUM_JOINTS, Observation
from fedvla_lib.robot.tasks import ALL_TASKS, CARRY_CLEARANCE_M, Task, TaskState, check_tasks, draw_layout

ENV_ID = "fedvla/So100-v0"
ZERO_DEG = np.array([0.0, 90.0, -90.0, 0.0, 0.0])  # LeRobot's angle of each joint at MuJoCo's zero
HOME = np.array([0.0, -50.0, 30.0, 75.0, 0.0, 30.0])  # arm retracted, gripper down and a third open; LeRobot units
HOME_NOISE = 2.0  # half range of the uniform noise on each joint at reset, in its unit
IMAGE_SIZES = (16, 1024)  # smallest and largest camera image, in pixels
SUBSTEPS = round(1 / (FPS * scene.TIMESTEP_S))
FLUNG_SPEED_MPS = 0.10  # a cube not touched during a control step but faster than this at its end was flung
NOT_THE_ARM = ("world", *scene.CUBES, *scene.ZONES)  # bodies


class So100Env(gymnasium.Env):
    """One SO-100 arm, one task with its cubes, two fixed cameras, controlled at 10 Hz.

    Observation: ``{"pixels": {camera: uint8 (size, size, 3)}, "agent_pos": float32 (6,)}``. Action: float32 (6,), the
    joint targets in the same units, clipped to the joint ranges. The reward is 1 on success, which terminates the
    episode; the task's horizon truncates it.

    Args:
        task: a name from `tasks.ALL_TASKS`, or a `Task`.
        image_size: side of the square camera images in pixels.
        render_mode: ``"rgb_array"`` or None; `render` returns all cameras side by side.
        cameras: cameras in the observation; ``()`` leaves out ``"pixels"`` and saves nearly all of the time of a step.
            `camera_images` does not depend on it.
        lab: camera poses, light, colours and calibration of the arm.
        jitter: above 0, a new lab without calibration offsets is drawn for every episode, with this spread.
        renderer_of: share this environment's renderer, since opening one is slow, and copy its scene if the task is
            the same; it must have the same image size, and stay open.

    Raises:
        ValueError: unknown task, camera or render mode, or an unusable image size.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": FPS}

    def __init__(
        self,
        task: str | Task = "lift",
        image_size: int = 96,
        render_mode: str | None = "rgb_array",
        cameras: tuple[str, ...] = CAMERAS,
        lab: Lab = REFERENCE,
        jitter: float = 0.0,
        renderer_of: "So100Env | None" = None,
    ) -> None:
        self._task = task if isinstance(task, Task) else ALL_TASKS[check_tasks([task])[0]]
        _check_view(image_size, render_mode, cameras)
        self.task = self._task.name
        self.image_size = image_size
        self.render_mode = render_mode
        self.cameras = tuple(cameras)
        self.lab, self._jitter = lab, jitter
        self._max_episode_steps = self._task.horizon_steps
        copied = renderer_of is not None and renderer_of._task == self._task
        self.model = copy(renderer_of.model) if copied else scene.build_scene(self._task, image_size)
        self.data = mujoco.MjData(self.model)
        self._renderer: SceneRenderer | None = None
        # Never self: a reference cycle would be freed late, in any thread.
        self._renderer_of = renderer_of and (renderer_of._renderer_of or renderer_of)
        self._limits_rad = self.model.jnt_range[:NUM_JOINTS]  # (6, 2)
        low, high = (from_radians(ends_rad, self._limits_rad) for ends_rad in self._limits_rad.T)
        self.action_space = spaces.Box(low, high, dtype=np.float32)
        self.observation_space = self._observation_space()
        self._touches = _touches(self.model)
        self.layout = draw_layout(self._task, np.random.default_rng(0))
        self._needs_reset = True

    @property
    def instruction(self) -> str:
        """The instruction of this episode."""
        return self.layout.instruction

    task_description = instruction  # the name used by LeRobot's evaluation

    @property
    def joints(self) -> np.ndarray:
        """Reported joint positions, with calibration error, float32 (6,), LeRobot units."""
        return from_radians(self.data.qpos[:NUM_JOINTS], self._limits_rad) + self.joint_offset

    @property
    def joint_offset(self) -> np.ndarray:
        """Calibration error: reported minus true joint positions, float32 (6,), LeRobot units."""
        return np.append(self.lab.joint_offset_deg, 0.0).astype(np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observation, dict]:
        """Start an episode.

        Args:
            seed: fixes the layout and the start pose.
            options: ``"color"``, the first cube's colour; ``"joints"``, the start pose, (6,), LeRobot units.

        Raises:
            ValueError: unknown colour, or joints that are not six finite numbers.
        """
        super().reset(seed=seed)
        options = options or {}
        if self._jitter:
            self.lab = draw_lab("drawn", self.np_random, self._jitter, offsets=False)
        self.layout = draw_layout(self._task, self.np_random, options.get("color"))
        mujoco.mj_resetData(self.model, self.data)
        scene.apply_lab(self.model, self.lab)
        home = HOME + self.np_random.uniform(-HOME_NOISE, HOME_NOISE, NUM_JOINTS)
        start = _check_joints(options.get("joints", home), "joints")
        self.data.qpos[:NUM_JOINTS] = self.data.ctrl[:] = to_radians(start, self._limits_rad)
        scene.place_objects(self.model, self.data, self.layout, self.lab)
        mujoco.mj_forward(self.model, self.data)
        self._step_count = self._streak = self._unmeasured = 0
        self._touched: set[tuple[str, str]] = set()
        cubes = scene.CUBES[: len(self.layout.cubes)]
        self._states = [TaskState(start_m=tuple(self.data.body(name).xpos.tolist())) for name in cubes]
        self._needs_reset = False
        return self._observation(), {"is_success": False}

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict]:
        """Move towards the joint targets `action` for one control step.

        Raises:
            ValueError: `action` is not six finite numbers.
            RuntimeError: the episode is over or was never started.
        """
        if self._needs_reset:
            raise RuntimeError("the episode is over: call reset() before step()")
        self._streak = self._streak + 1 if self.move(action) else 0
        self._step_count += 1
        terminated = self._streak >= self._task.hold_steps
        truncated = not terminated and self._step_count >= self._max_episode_steps
        self._needs_reset = terminated or truncated
        return self._observation(), float(terminated), terminated, truncated, {"is_success": terminated}

    def move(self, joints: np.ndarray, substeps: int = SUBSTEPS) -> bool:
        """Hold joint targets, (6,), LeRobot units, for some time steps of the simulation, in an episode or after it.

        Returns:
            Whether the task's success predicate holds; it is measured at 10 Hz, whatever the length of a move.

        Raises:
            ValueError: `joints` is not six finite numbers.
        """
        target = _check_joints(joints, "action") - self.joint_offset
        low, high = self.action_space.low, self.action_space.high
        self.data.ctrl[:] = to_radians(np.clip(target, low, high), self._limits_rad)
        self._touched |= self._advance(substeps)
        self._unmeasured += substeps
        if self._unmeasured >= SUBSTEPS:
            now = self._touching()
            self._states = [self._measure(i, before, self._touched, now) for i, before in enumerate(self._states)]
            self._touched, self._unmeasured = set(), 0
        first, *others = self._states
        return self._task.success(replace(first, others=tuple(others)))

    def camera_images(self, cameras: Sequence[str] = CAMERAS) -> dict[str, np.ndarray]:
        """Render the current scene: camera -> uint8 (size, size, 3)."""
        owner = self._renderer_of or self
        if owner._renderer is None:
            owner._renderer = SceneRenderer(owner.model, owner.image_size, owner.image_size)
        return {camera: owner._renderer.draw(self.model, self.data, camera) for camera in cameras}

    def render(self) -> np.ndarray | None:
        """Return all cameras side by side, uint8 (size, 2 * size, 3); None without a render mode."""
        if self.render_mode is None:
            return None
        return np.hstack(list(self.camera_images().values()))

    def close(self) -> None:
        """Free the renderer; other environments of the process keep theirs."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def _advance(self, substeps: int = SUBSTEPS) -> set[tuple[str, str]]:
        """Simulate some time steps; return what touched during them, see `_touching`."""
        touched = set()
        for _ in range(substeps):
            mujoco.mj_step(self.model, self.data)
            touched |= self._touching()
        mujoco.mj_forward(self.model, self.data)  # update positions and contacts to the final state
        return touched

    def _touching(self) -> set[tuple[str, str]]:
        """Return the pairs in contact of a cube and a part of the arm: "fixed", "moving" (the jaws) or "arm"."""
        touches = self._touches  # a dict of Python numbers: this runs 20 times a control step, on a few contacts
        return {touches[pair] for pair in map(tuple, self.data.contact.geom.tolist()) if pair in touches}

    def _measure(
        self, index: int, before: TaskState, touched: set[tuple[str, str]], now: set[tuple[str, str]]
    ) -> TaskState:
        """Return the input of the success predicates for one cube, whose state a control step earlier was `before`.

        `touched`: contacts during the control step, `now`: at its end, both as `_touching` returns them.
        """
        name = scene.CUBES[index]
        parts, cube_m = {part for cube, part in now if cube == name}, tuple(self.data.body(name).xpos.tolist())
        hand_m = tuple(self.data.site(scene.GRASP_SITE).xpos.tolist())
        held, clearance_m = {"fixed", "moving"} <= parts, cube_m[2] - CUBE_HALF_M
        speed_mps = float(np.linalg.norm(self.data.joint(name).qvel[:3]))
        flung = speed_mps > FLUNG_SPEED_MPS and all(name != cube for cube, _ in touched)
        return TaskState(
            clearance_m=clearance_m, peak_clearance_m=max(before.peak_clearance_m, clearance_m), speed_mps=speed_mps,
            zone_offset_m=self._from_zone(index, cube_m), held=held, touched=bool(parts),
            carried=before.carried or (held and clearance_m > CARRY_CLEARANCE_M), flung=before.flung or flung,
            hand_distance_m=float(np.linalg.norm(np.subtract(hand_m, cube_m))), cube_m=cube_m, start_m=before.start_m,
            hand_m=hand_m, hand_zone_offset_m=self._from_zone(index, hand_m),
        )  # fmt: skip

    def _from_zone(self, index: int, point_m: tuple[float, float, float]) -> tuple[float, float]:
        """Offset (x, y) of a point from the centre of cube `index`'s zone."""
        if index >= len(self.layout.zones_xy_m):
            return np.inf, np.inf
        x, y = np.subtract(point_m[:2], self.layout.zones_xy_m[index])
        return float(x), float(y)

    def _observation(self) -> Observation:
        observation: Observation = {"agent_pos": self.joints}
        if self.cameras:
            observation["pixels"] = self.camera_images(self.cameras)
        return observation

    def _observation_space(self) -> spaces.Dict:
        low, high = self.action_space.low, self.action_space.high
        margin = 10.0  # MuJoCo's joint limits are soft
        parts: dict[str, spaces.Space] = {"agent_pos": spaces.Box(low - margin, high + margin, dtype=np.float32)}
        if self.cameras:
            image = spaces.Box(0, 255, (self.image_size, self.image_size, 3), np.uint8)
            parts["pixels"] = spaces.Dict({camera: image for camera in self.cameras})
        return spaces.Dict(parts)


def to_radians(joints: np.ndarray, limits_rad: np.ndarray) -> np.ndarray:
    """LeRobot units (6,) -> MuJoCo joint angles in radians, float64 (6,). `limits_rad`: joint ranges, (6, 2)."""
    closed, opened = limits_rad[-1]
    joints = np.asarray(joints, dtype=np.float64)
    return np.append(np.deg2rad(joints[:-1] - ZERO_DEG), closed + joints[-1] / 100 * (opened - closed))


def from_radians(angles_rad: np.ndarray, limits_rad: np.ndarray) -> np.ndarray:
    """MuJoCo joint angles in radians (6,) -> LeRobot units, float32 (6,); the inverse of `to_radians`."""
    closed, opened = limits_rad[-1]
    gripper = 100 * (angles_rad[-1] - closed) / (opened - closed)
    return np.append(np.rad2deg(angles_rad[:-1]) + ZERO_DEG, gripper).astype(np.float32)


def _check_joints(values: np.ndarray, what: str) -> np.ndarray:
    target = np.asarray(values, dtype=np.float64)
    if target.shape != (NUM_JOINTS,):
        raise ValueError(f"{what} has shape {target.shape}: give ({NUM_JOINTS},), one value for each of {scene.JOINTS}")
    for name, value in zip(scene.JOINTS, target.tolist(), strict=True):
        if not math.isfinite(value):
            raise ValueError(f"{what} for {name} is {value}: give a finite number")
    return target


def _check_view(image_size: int, render_mode: str | None, cameras: tuple[str, ...]) -> None:
    smallest, largest = IMAGE_SIZES
    if not isinstance(image_size, int) or not smallest <= image_size <= largest:
        raise ValueError(f"image_size={image_size!r} is not usable: give a whole number from {smallest} to {largest}")
    if render_mode not in (None, "rgb_array"):
        raise ValueError(f"unknown render_mode {render_mode!r}: choose rgb_array or None")
    for camera in cameras:
        if camera not in CAMERAS:
            raise ValueError(f"unknown camera {camera!r}: choose from {', '.join(CAMERAS)}")


def _touches(model: mujoco.MjModel) -> dict[tuple[int, int], tuple[str, str]]:
    """Return the cube and the part of the arm ("fixed", "moving" or "arm") for each pair of their geoms' ids."""
    jaws = {"Fixed_Jaw": "fixed", "Moving_Jaw": "moving"}
    bodies = [model.body(body).name for body in model.geom_bodyid]
    arm = [(geom, jaws.get(body, "arm")) for geom, body in enumerate(bodies) if body not in NOT_THE_ARM]
    cubes = [(geom, body) for geom, body in enumerate(bodies) if body in scene.CUBES]
    return {pair: (cube, part) for a, part in arm for b, cube in cubes for pair in ((a, b), (b, a))}


gymnasium.register(id=ENV_ID, entry_point="fedvla_lib.robot.sim:So100Env")
