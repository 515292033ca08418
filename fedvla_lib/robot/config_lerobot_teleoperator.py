"""LeRobot's configuration of the scripted expert as a teleoperator, ``--teleop.type=so100_script``."""

from dataclasses import dataclass

from lerobot.teleoperators.config import TeleoperatorConfig


@TeleoperatorConfig.register_subclass("so100_script")
@dataclass
class So100ScriptConfig(TeleoperatorConfig):
    """Which simulated arm the expert moves, and how long an episode is; ValueError for a value it cannot use.

    LeRobot does not tell a teleoperator when an episode ends: give it the same times as the recording.
    """

    robot_id: str | None = None  # the --robot.id of the simulated arm
    episode_time_s: float = 60.0  # the value of --dataset.episode_time_s; a new scene begins after it
    reset_time_s: float = 60.0  # the value of --dataset.reset_time_s; the arm waits in the new scene's start pose

    def __post_init__(self) -> None:
        if self.episode_time_s <= 0:
            raise ValueError(f"teleop.episode_time_s={self.episode_time_s} is not usable: give seconds above 0")
        if self.reset_time_s < 0:
            raise ValueError(f"teleop.reset_time_s={self.reset_time_s} is not usable: give seconds, 0 or more")
