"""So100Env: a simulated SO-100 arm as a Gymnasium environment. Nothing here knows about learning.

State and action are LeRobot's six numbers: five joints in degrees, the gripper from 0 (closed) to 100 (open). MuJoCo
works in radians; the two differ by an offset, as in LeRobot's calibration, where zero is about the middle of a joint's
travel:

    degrees = ZERO_DEG + 180 / pi * radians,   gripper = 100 * (radians - closed) / (open - closed)

so that at zero degrees the upper arm is vertical and the forearm horizontal, pointing straight ahead. Positive
shoulder_pan turns to the arm's left, positive shoulder_lift leans forward, positive elbow_flex and wrist_flex bend the
gripper down. The closed and open ends of the gripper are the ends of its joint's range in the model.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import gymnasium
import mujoco
import numpy as np
from gymnasium import spaces

from fedvla_lib.robot.labs import REFERENCE, Lab, draw_lab
from fedvla_lib.robot.layout import CUBE_HALF_M, Patch
from fedvla_lib.robot.rendering import SceneRenderer, open_renderer
from fedvla_lib.robot.scene import (
    CUBES,
    GRASP_SITE,
    JOINTS,
    TIMESTEP_S,
    ZONES,
    apply_lab,
    build_scene,
    cubes_of,
    place_objects,
)
from fedvla_lib.robot.spec import CAMERAS, FPS, NUM_JOINTS, Observation
from fedvla_lib.robot.tasks import ALL_TASKS, CARRY_CLEARANCE_M, Task, TaskState, check_tasks, draw_layout

ENV_ID = "fedvla/So100-v0"
ZERO_DEG = np.array([0.0, 90.0, -90.0, 0.0, 0.0])  # degrees that a joint shows when MuJoCo's angle is zero
HOME = np.array([0.0, -50.0, 30.0, 75.0, 0.0, 30.0])  # arm drawn back, gripper down and a third open; LeRobot units
HOME_NOISE = 2.0  # each reset moves every joint by up to this much, in its unit
IMAGE_SIZES = (16, 1024)  # smallest and largest camera image, in pixels
SUBSTEPS = round(1 / (FPS * TIMESTEP_S))
FLUNG_SPEED_MPS = 0.10  # an untouched cube faster than this over a whole control step has been flung


class So100Env(gymnasium.Env):
    """One SO-100 arm, one task with its cubes, two fixed cameras, controlled at 10 Hz.

    Observation: ``{"pixels": {camera: uint8 (size, size, 3)}, "agent_pos": float32 (6,)}``. Action: float32 (6,), the
    joint targets in the same units, clipped to the joint ranges. The reward is 1 when the task is fulfilled, which ends
    the episode; the task's horizon truncates it.

    Args:
        task: a name from `tasks.ALL_TASKS`, or a task of your own.
        image_size: side of the square camera images in pixels.
        render_mode: ``"rgb_array"`` or None; `render` returns all cameras side by side.
        cameras: cameras in the observation; ``()`` leaves out ``"pixels"`` and with it nearly all of the time. What
            `pictures` returns does not depend on it.
        lab: the place: camera poses, light, colours, calibration of the arm.
        screen: draw with this environment's renderer, which costs more to open than to use; it must show the same task
            at the same size, and stay open.
        jitter: above 0, every episode has a laboratory of its own, drawn with this spread; its arm is calibrated.

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
        screen: "So100Env | None" = None,
    ) -> None:
        self._task = task if isinstance(task, Task) else ALL_TASKS[check_tasks([task])[0]]
        _check_view(image_size, render_mode, cameras)
        self.task = self._task.name
        self.image_size = image_size
        self.render_mode = render_mode
        self.cameras = tuple(cameras)
        self.lab, self._jitter = lab, jitter
        self._max_episode_steps = self._task.horizon_steps
        self.model = build_scene(self._task, image_size)
        self.data = mujoco.MjData(self.model)
        self._renderer: SceneRenderer | None = None
        self._screen = screen  # not itself: what refers to itself is freed late, and by any thread
        self.action_space = spaces.Box(*self._range(), dtype=np.float32)
        self.observation_space = self._observation_space()
        self._parts = _parts(self.model)
        self.layout = draw_layout(self._task, np.random.default_rng(0))
        self._needs_reset = True

    @property
    def instruction(self) -> str:
        """The request in words, for the cubes' colours in this episode."""
        return self.layout.instruction

    @property
    def zones(self) -> tuple[Patch, ...]:
        """The coloured patches on the table, in the layout's order."""
        return self._task.zones

    @property
    def task_description(self) -> str:
        """The instruction under the name that LeRobot's evaluation asks for."""
        return self.instruction

    @property
    def joints(self) -> np.ndarray:
        """Joint positions as the arm reports them, float32 (6,), LeRobot units: with its calibration error."""
        return from_radians(self.data.qpos[:NUM_JOINTS], self.model.jnt_range[:NUM_JOINTS]) + self.joint_offset

    @property
    def joint_offset(self) -> np.ndarray:
        """What the arm reports minus what is true, float32 (6,), LeRobot units."""
        return np.append(self.lab.joint_offset_deg, 0.0).astype(np.float32)

    @property
    def cube_m(self) -> np.ndarray:
        """Centre of the first cube in the world frame, float64 (3,)."""
        return self.data.body(CUBES[0]).xpos.copy()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observation, dict]:
        """Start an episode.

        Args:
            seed: fixes where everything is.
            options: ``"color"`` fixes the first cube's colour, ``"joints"`` where the arm starts, (6,), LeRobot units.

        Raises:
            ValueError: unknown colour, or joints that are not six finite numbers.
        """
        super().reset(seed=seed)
        options = options or {}
        if self._jitter:
            self.lab = draw_lab("drawn", self.np_random, self._jitter, offsets=False)
        self.layout = draw_layout(self._task, self.np_random, options.get("color"))
        mujoco.mj_resetData(self.model, self.data)
        apply_lab(self.model, self.lab)
        home = HOME + self.np_random.uniform(-HOME_NOISE, HOME_NOISE, NUM_JOINTS)
        self._put_arm(_check_joints(options.get("joints", home), "joints"))
        place_objects(self.model, self.data, self.layout, self.lab)
        mujoco.mj_forward(self.model, self.data)
        self._step_count = self._streak = 0
        self._past = [_Past(self._cube_m(name)) for name in cubes_of(self.model)[: len(self.layout.cubes)]]
        self._needs_reset = False
        return self._observation(), self._info()

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict]:
        """Move towards `action` for a tenth of a second.

        Raises:
            ValueError: `action` is not six finite numbers.
            RuntimeError: the episode is over or never began.
        """
        target = _check_joints(action, "action") - self.joint_offset
        if self._needs_reset:
            raise RuntimeError("the episode is over: call reset() before step()")
        low, high = self.action_space.low, self.action_space.high
        self.data.ctrl[:] = to_radians(np.clip(target, low, high), self.model.jnt_range[:NUM_JOINTS])
        touched = self._advance()
        task = self._task
        first, *others = (self._look(index, touched) for index in range(len(self._past)))
        self._streak = self._streak + 1 if task.success(replace(first, others=tuple(others))) else 0
        self._step_count += 1
        terminated = self._streak >= task.hold_steps
        truncated = not terminated and self._step_count >= self._max_episode_steps
        self._needs_reset = terminated or truncated
        return self._observation(), float(terminated), terminated, truncated, self._info()

    def pictures(self, cameras: Sequence[str] = CAMERAS) -> dict[str, np.ndarray]:
        """Draw the scene as it stands: camera -> uint8 (size, size, 3)."""
        return {camera: self._draw(camera) for camera in cameras}

    def render(self) -> np.ndarray | None:
        """Return all cameras side by side, uint8 (size, 2 * size, 3); None without a render mode."""
        if self.render_mode is None:
            return None
        return np.hstack(list(self.pictures().values()))

    def close(self) -> None:
        """Free the renderer; the other environments of the process keep theirs."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def _put_arm(self, joints: np.ndarray) -> None:
        radians = to_radians(joints, self.model.jnt_range[:NUM_JOINTS])
        self.data.qpos[:NUM_JOINTS] = radians
        self.data.ctrl[:] = radians

    def _cube_m(self, name: str) -> tuple[float, float, float]:
        return tuple(float(value) for value in self.data.body(name).xpos)

    def _advance(self) -> set[str]:
        """Simulate one control step; the cubes that the arm touched at any moment of it."""
        touched = set()
        for _ in range(SUBSTEPS):
            mujoco.mj_step(self.model, self.data)
            touched |= {name for name in CUBES[: len(self._past)] if self._touching(name)}
        mujoco.mj_forward(self.model, self.data)  # positions and contacts of the state that is shown
        return touched

    def _touching(self, cube: str) -> set[str]:
        """Parts of the arm in contact with the cube: "fixed", "moving" (the jaws) or "arm"."""
        pairs = self.data.contact.geom[: self.data.ncon]
        geom = self.model.geom(cube).id
        others = pairs[(pairs == geom).any(axis=1)]
        return {self._parts[other] for other in others[others != geom]} - {""}

    def _look(self, index: int, touched_in_step: set[str]) -> TaskState:
        """Measure what the success predicates look at, for one cube, and remember what happened on the way."""
        name, past = CUBES[index], self._past[index]
        parts, cube_m = self._touching(name), self._cube_m(name)
        hand_m = tuple(float(value) for value in self.data.site(GRASP_SITE).xpos)
        held, clearance_m = {"fixed", "moving"} <= parts, cube_m[2] - CUBE_HALF_M
        speed_mps = float(np.linalg.norm(self.data.joint(name).qvel[:3]))
        past.peak_clearance_m = max(past.peak_clearance_m, clearance_m)
        past.carried |= held and clearance_m > CARRY_CLEARANCE_M
        past.flung |= name not in touched_in_step and speed_mps > FLUNG_SPEED_MPS
        return TaskState(
            clearance_m=clearance_m,
            peak_clearance_m=past.peak_clearance_m,
            speed_mps=speed_mps,
            zone_offset_m=self._from_zone(index, cube_m),
            held=held,
            touched=bool(parts),
            carried=past.carried,
            flung=past.flung,
            hand_distance_m=float(np.linalg.norm(np.subtract(hand_m, cube_m))),
            cube_m=cube_m,
            start_m=past.start_m,
            hand_m=hand_m,
            hand_zone_offset_m=self._from_zone(index, hand_m),
        )

    def _from_zone(self, index: int, point_m: tuple[float, float, float]) -> tuple[float, float]:
        """Where a point lies as seen from the centre of the zone that belongs to cube `index`."""
        if index >= len(self.layout.zones_xy_m):
            return np.inf, np.inf
        x, y = np.subtract(point_m[:2], self.layout.zones_xy_m[index])
        return float(x), float(y)

    def _observation(self) -> Observation:
        observation: Observation = {"agent_pos": self.joints}
        if self.cameras:
            observation["pixels"] = self.pictures(self.cameras)
        return observation

    def _info(self) -> dict[str, Any]:
        return {"is_success": self._streak >= self._task.hold_steps}

    def _draw(self, camera: str) -> np.ndarray:
        screen = self._screen or self
        if screen._renderer is None:
            screen._renderer = open_renderer(screen.model, screen.image_size)
        return screen._renderer.draw(self.model, self.data, camera)

    def _range(self) -> tuple[np.ndarray, np.ndarray]:
        limits_rad = self.model.jnt_range[:NUM_JOINTS]
        return from_radians(limits_rad[:, 0], limits_rad), from_radians(limits_rad[:, 1], limits_rad)

    def _observation_space(self) -> spaces.Dict:
        low, high = self._range()
        margin = 10.0  # MuJoCo's joint limits are soft
        parts: dict[str, spaces.Space] = {"agent_pos": spaces.Box(low - margin, high + margin, dtype=np.float32)}
        if self.cameras:
            image = spaces.Box(0, 255, (self.image_size, self.image_size, 3), np.uint8)
            parts["pixels"] = spaces.Dict({camera: image for camera in self.cameras})
        return spaces.Dict(parts)


@dataclass
class _Past:
    """What happened to a cube in this episode."""

    start_m: tuple[float, float, float]
    peak_clearance_m: float = 0.0
    carried: bool = False
    flung: bool = False


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
        raise ValueError(f"{what} has shape {target.shape}: give ({NUM_JOINTS},), one target for each of {JOINTS}")
    for name, value in zip(JOINTS, target, strict=True):
        if not np.isfinite(value):
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


def _parts(model: mujoco.MjModel) -> list[str]:
    """For every geom, the part of the arm it belongs to: "fixed", "moving", "arm", or "" for what is not the arm."""
    jaws = {"Fixed_Jaw": "fixed", "Moving_Jaw": "moving"}
    others = dict.fromkeys(("world", *CUBES, *ZONES), "")
    bodies = [model.body(body).name for body in model.geom_bodyid]
    return [jaws.get(name, others.get(name, "arm")) for name in bodies]


gymnasium.register(id=ENV_ID, entry_point="fedvla_lib.robot.sim:So100Env")
