"""LeRobot plugin: importing this registers the scripted expert as a teleoperator."""

from fedvla_lib.robot.lerobot_teleoperator import So100Script

__all__ = ["So100Script"]
