"""The scripted expert in the place of a leader arm: it moves the simulated arm of the same process."""

import logging
import math
import time
from typing import Any

import numpy as np
from lerobot.teleoperators import Teleoperator
from lerobot.utils.decorators import check_if_already_connected, check_if_not_connected

from fedvla_lib.robot.config_lerobot_teleoperator import So100ScriptConfig
from fedvla_lib.robot.expert import Expert
from fedvla_lib.robot.lerobot_robot import So100SimRobot
from fedvla_lib.robot.spec import JOINT_NAMES

logger = logging.getLogger(__name__)


class So100Script(Teleoperator):
    """Plays the expert's plan for the scene on the table, waits for the episode's end, and prepares the next scene.

    It reads the scene from the robot, which LeRobot's commands make in the same process, and ends an episode by the
    clock, as they do.
    """

    config_class = So100ScriptConfig
    name = "so100_script"

    def __init__(self, config: So100ScriptConfig) -> None:
        super().__init__(config)
        self.config = config
        self._connected = False

    @property
    def action_features(self) -> dict[str, type]:
        return dict.fromkeys(JOINT_NAMES, float)

    @property
    def feedback_features(self) -> dict[str, type]:
        return {}

    @property
    def is_connected(self) -> bool:
        return self._connected

    @property
    def is_calibrated(self) -> bool:
        return True

    @check_if_already_connected
    def connect(self, calibrate: bool = True) -> None:
        self._connected, self._ends_s, self._expert = True, math.inf, None
        self._waiting = False

    def calibrate(self) -> None:
        """Nothing: the script has no joints of its own."""

    def configure(self) -> None:
        """Nothing, as for a calibration."""

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        """Nothing: a script feels no force."""

    @check_if_not_connected
    def disconnect(self) -> None:
        self._connected = False

    @check_if_not_connected
    def get_action(self) -> dict[str, float]:
        """Return the next joint targets by feature name, in the units of the robot's calibration.

        Raises:
            RuntimeError: this process has no simulated arm of that id.
        """
        robot = So100SimRobot.connected.get(self.config.robot_id)
        if robot is None:
            known = ", ".join(map(repr, So100SimRobot.connected)) or "none"
            raise RuntimeError(
                f"the script knows only simulated arms, and none in this process has teleop.robot_id="
                f"{self.config.robot_id!r} (there are: {known}): give --robot.type=so100_sim and its --robot.id"
            )
        self._keep_time(robot)
        joints = self._start if self._waiting else self._expert.act({})
        return {f"{name}.pos": value for name, value in robot.bus.reported(joints).items()}

    def _keep_time(self, robot: So100SimRobot) -> None:
        """Begin an episode, or the time between two, when the one before has lasted as long as it should."""
        now_s = time.perf_counter()
        if self._expert is None:
            self._expert = Expert(robot.config.fps)
            self._play(robot, robot.config.seed, now_s)
        elif now_s >= self._ends_s and not self._waiting:
            if left := self._expert.steps_left:
                logger.warning("The episode ended %d steps before the expert was done: give it a longer time", left)
            self._seed, self._start = robot.next_scene(), np.array(robot.env.joints)
            self._waiting, self._ends_s = True, now_s + self.config.reset_time_s
        if self._waiting and now_s >= self._ends_s:
            self._play(robot, self._seed, now_s)

    def _play(self, robot: So100SimRobot, seed: int, now_s: float) -> None:
        self._expert.reset(robot.env, seed)
        self._waiting, self._ends_s = False, now_s + self.config.episode_time_s
