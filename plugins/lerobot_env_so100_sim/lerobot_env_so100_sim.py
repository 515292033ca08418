"""LeRobot plugin: importing this registers the simulated SO-100 as an environment."""

from fedvla_lib.robot.lerobot_env import So100SimConfig

__all__ = ["So100SimConfig"]
