"""The simulated SO-100 for LeRobot's robot commands: its own `SOFollower`, with simulated motors on the bus.

Names, units, calibration, limits, errors and log lines are LeRobot's code. What is simulated is below it: the registers
of six STS3215 servos, and the pictures of two cameras. Time is simulated too: each action takes ``1 / fps`` seconds of
it, however long the machine needs, so that the same actions have the same effect on any machine.
"""

import logging
import weakref
from typing import Any, ClassVar

import numpy as np
from lerobot.cameras import Camera, ColorMode
from lerobot.cameras.opencv import OpenCVCameraConfig
from lerobot.motors import Motor, MotorCalibration, MotorNormMode
from lerobot.motors.feetech import FeetechMotorsBus
from lerobot.motors.motors_bus import MotorsBusBase
from lerobot.robots import Robot
from lerobot.robots.so_follower import SOFollower
from lerobot.utils.decorators import check_if_already_connected, check_if_not_connected

from fedvla_lib.robot.config_lerobot_robot import FPS_LIMIT, So100SimRobotConfig
from fedvla_lib.robot.labs import labs
from fedvla_lib.robot.rendering import SceneRenderer
from fedvla_lib.robot.sim import So100Env
from fedvla_lib.robot.spec import CAMERAS, FPS, JOINT_NAMES
from fedvla_lib.robot.tasks import ALL_TASKS

logger = logging.getLogger(__name__)
MODEL = "sts3215"
LAST_TICK = FeetechMotorsBus.model_resolution_table[MODEL] - 1  # of the position encoder, in one turn
GRIPPER_TICKS = (1422, 2673)  # closed and open
SMALLEST_SCENE = 64  # pixels; for a robot without cameras


class SimulatedBus(FeetechMotorsBus):
    """Six servos that turn the joints of a `So100Env`. Joints, (6,), are in the environment's units.

    An encoder counts `LAST_TICK` ticks in a turn, with the environment's zero degrees in the middle. As in the servos,
    a position is the encoder's minus the register Homing_Offset, and goals are kept between the two position limits.
    """

    def __init__(self, env: So100Env, motors: dict[str, Motor], calibration: dict[str, MotorCalibration]) -> None:
        MotorsBusBase.__init__(self, "simulation", motors, calibration)  # the others open a serial port
        self._id_to_model_dict = {motor.id: motor.model for motor in motors.values()}
        self._id_to_name_dict = {motor.id: name for name, motor in motors.items()}
        self.protocol_version = 0
        self.env, self._open, self.holds = env, False, False
        low, high = (self._ticks(ends) for ends in (env.action_space.low, env.action_space.high))
        reach = np.floor(np.minimum(low, LAST_TICK - high)[:-1])  # symmetric: the middle is zero degrees
        self._registers: dict[str, dict[str, int]] = {
            "Homing_Offset": dict.fromkeys(motors, 0),
            "Min_Position_Limit": dict(zip(motors, map(int, [*reach, GRIPPER_TICKS[0]]), strict=True)),
            "Max_Position_Limit": dict(zip(motors, map(int, [*(LAST_TICK - reach), GRIPPER_TICKS[1]]), strict=True)),
        }
        self.start()

    def start(self) -> None:
        """Begin a scene: the goal is where the joints are."""
        self._goal, self.actions = self._ticks(self.env.joints), 0

    def reported(self, joints: np.ndarray) -> dict[str, float]:
        """Return joints as the motors would report them, in the units of their calibration, by motor."""
        values = self._normalize(dict(zip(self.ids, map(int, self._positions(joints)), strict=True)))
        return {self._id_to_name(id_): value for id_, value in values.items()}

    def turn(self, fps: int) -> None:
        """Let the motors turn towards their goals for ``1 / fps`` seconds."""
        before, after = (round(count * FPS_LIMIT / fps) for count in (self.actions, self.actions + 1))
        offset, low, high = map(self._of_all, ("Homing_Offset", "Min_Position_Limit", "Max_Position_Limit"))
        goal = np.clip(self._goal - offset, low, high) + offset
        self.holds = self.env.move(_joints(goal), after - before)
        self.actions += 1

    @property
    def is_connected(self) -> bool:
        return self._open

    @check_if_already_connected
    def connect(self, handshake: bool = True) -> None:
        self._open = True

    @check_if_not_connected
    def disconnect(self, disable_torque: bool = True) -> None:
        self._open = False

    @check_if_not_connected
    def read(self, data_name: str, motor: str, *, normalize: bool = True, num_retry: int = 0) -> Any:
        return self.sync_read(data_name, motor, normalize=normalize)[motor]

    @check_if_not_connected
    def write(self, data_name: str, motor: str, value: Any, *, normalize: bool = True, num_retry: int = 0) -> None:
        self.sync_write(data_name, {motor: value}, normalize=normalize)

    @check_if_not_connected
    def sync_read(self, data_name: str, motors: Any = None, *, normalize: bool = True, num_retry: int = 0) -> dict:
        present = data_name == "Present_Position"
        ticks = self._positions(self.env.joints) if present else self._of_all(data_name)
        values = dict(zip(self.ids, map(int, ticks), strict=True))
        if normalize and data_name in self.normalized_data:
            values = self._normalize(values)
        return {name: values[self.motors[name].id] for name in self._get_motors_list(motors)}

    @check_if_not_connected
    def sync_write(self, data_name: str, values: Any, *, normalize: bool = True, num_retry: int = 0) -> None:
        given = self._get_ids_values_dict(values)
        ticks = self._unnormalize(given) if normalize and data_name in self.normalized_data else given
        for id_, tick in ticks.items():
            self._registers.setdefault(data_name, {})[self._id_to_name(id_)] = int(tick)
            if data_name == "Goal_Position":
                self._goal[self.ids.index(id_)] = tick + self._registers["Homing_Offset"][self._id_to_name(id_)]

    def _positions(self, joints: np.ndarray) -> np.ndarray:
        return np.rint(self._ticks(joints)) - self._of_all("Homing_Offset")

    def _of_all(self, register: str) -> np.ndarray:
        return np.array([self._registers.get(register, {}).get(name, 0) for name in self.motors])

    @staticmethod
    def _ticks(joints: np.ndarray) -> np.ndarray:
        """Return the encoders' positions, float64 (6,)."""
        closed, opened = GRIPPER_TICKS
        joints = np.asarray(joints, dtype=np.float64)
        return np.append(LAST_TICK / 2 + joints[:-1] * LAST_TICK / 360, closed + joints[-1] / 100 * (opened - closed))


def _joints(ticks: np.ndarray) -> np.ndarray:
    """Return joints, (6,), from encoder positions; the inverse of `SimulatedBus._ticks`."""
    closed, opened = GRIPPER_TICKS
    return np.append((ticks[:-1] - LAST_TICK / 2) * 360 / LAST_TICK, 100 * (ticks[-1] - closed) / (opened - closed))


class SimulatedCamera(Camera):
    """A camera of a `So100Env`, in the size and colour order of an ``opencv`` camera's configuration."""

    def __init__(self, config: OpenCVCameraConfig, env: So100Env) -> None:
        super().__init__(config)
        self._env, self._view = env, CAMERAS[config.index_or_path]
        self._swapped = config.color_mode == ColorMode.BGR
        self._renderer: SceneRenderer | None = None

    @staticmethod
    def find_cameras() -> list[dict[str, Any]]:
        return [{"name": name, "type": "so100_sim", "id": index} for index, name in enumerate(CAMERAS)]

    @property
    def is_connected(self) -> bool:
        return self._renderer is not None

    @check_if_already_connected
    def connect(self, warmup: bool = True) -> None:
        self._renderer = SceneRenderer(self._env.model, self.width, self.height)

    @check_if_not_connected
    def read(self) -> np.ndarray:
        image = self._renderer.draw(self._env.model, self._env.data, self._view)
        return image[..., ::-1].copy() if self._swapped else image

    def async_read(self, timeout_ms: float = 200) -> np.ndarray:
        return self.read()

    def read_latest(self, max_age_ms: int = 500) -> np.ndarray:
        return self.read()

    @check_if_not_connected
    def disconnect(self) -> None:
        self._renderer.close()
        self._renderer = None


class So100SimRobot(SOFollower):
    """LeRobot's SO follower on simulated motors; its scene is that of `config.seed`, then of the following numbers."""

    config_class = So100SimRobotConfig
    name = "so100_sim"
    # By id, as an operating system has devices by name: LeRobot gives a teleoperator no way to the robot that it moves.
    connected: ClassVar[weakref.WeakValueDictionary] = weakref.WeakValueDictionary()

    def __init__(self, config: So100SimRobotConfig) -> None:
        Robot.__init__(self, config)  # SOFollower's would open the serial port
        self.config = config
        sides = [side for camera in config.cameras.values() for side in (camera.width, camera.height)]
        lab = labs(config.lab + 1)[config.lab]
        size = max(sides, default=SMALLEST_SCENE)
        self.env = So100Env(config.task, size, render_mode=None, cameras=(), lab=lab)
        body = MotorNormMode.DEGREES if config.use_degrees else MotorNormMode.RANGE_M100_100
        modes = [*[body] * (len(JOINT_NAMES) - 1), MotorNormMode.RANGE_0_100]
        names = [name.removesuffix(".pos") for name in JOINT_NAMES]
        motors = {name: Motor(id_, MODEL, mode) for id_, (name, mode) in enumerate(zip(names, modes, strict=True), 1)}
        if self.calibration and set(self.calibration) != set(motors):
            raise ValueError(f"{self.calibration_fpath} is not a calibration of this arm: give {', '.join(motors)}")
        self.bus = SimulatedBus(self.env, motors, self.calibration)
        self.cameras = {name: SimulatedCamera(camera, self.env) for name, camera in config.cameras.items()}

    def connect(self, calibrate: bool = True) -> None:
        super().connect(calibrate)
        self.connected[self.id] = self
        self._seed = None
        self.next_scene()

    def next_scene(self) -> int:
        """Put the objects of the next scene on the table and the arm into its start pose; return the scene's seed."""
        self._report()
        self._seed = self.config.seed if self._seed is None else self._seed + 1
        given = {"color": self.config.color, "joints": self.config.start_pose}
        self.env.reset(seed=self._seed, options={name: value for name, value in given.items() if value is not None})
        self.bus.start()
        self._streak, self.solved = 0, False
        return self._seed

    def _report(self) -> None:
        if self.bus.actions:
            done = "solved" if self.solved else "not solved"
            logger.info("%s: scene of seed %d, %r, %s", self, self._seed, self.env.instruction, done)

    def calibrate(self) -> None:
        """Write the calibration file to the motors, or, where there is none, the one that the motors have to a file."""
        if self.calibration:
            self.bus.write_calibration(self.calibration)
            return
        self.calibration = self.bus.calibration = self.bus.read_calibration()
        self._save_calibration()
        logger.info("Calibration saved to %s", self.calibration_fpath)

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        sent = super().send_action(action)
        self.bus.turn(self.config.fps)
        self._streak = self._streak + 1 if self.bus.holds else 0
        self.solved |= self._streak * FPS >= ALL_TASKS[self.env.task].hold_steps * self.config.fps
        return sent

    def disconnect(self) -> None:
        super().disconnect()
        self._report()
        self.connected.pop(self.id, None)
