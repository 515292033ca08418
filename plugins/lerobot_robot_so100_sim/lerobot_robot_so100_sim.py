"""LeRobot plugin: importing this registers the simulated SO-100 as a robot."""

from fedvla_lib.robot.lerobot_robot import So100SimRobot

__all__ = ["So100SimRobot"]
