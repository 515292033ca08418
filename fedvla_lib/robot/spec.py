"""Joint, camera and feature names, units, and the `Actor` protocol, shared by every other module.

State and action are six numbers in LeRobot's SO-100 convention: five joint positions in degrees, then the gripper
opening from 0 (closed) to 100 (open). This module imports nothing from the library, nor MuJoCo, torch or Flower.
"""

from typing import Any, Protocol

import numpy as np

JOINT_NAMES = (
    "shoulder_pan.pos", "shoulder_lift.pos", "elbow_flex.pos", "wrist_flex.pos", "wrist_roll.pos", "gripper.pos",
)  # fmt: skip
JOINT_UNITS = ("deg", "deg", "deg", "deg", "deg", "0-100")
NUM_JOINTS = len(JOINT_NAMES)
CAMERAS = ("overhead", "front")
FPS = 10  # control steps per second; also the frame rate of every recording and video

STATE_KEY = "observation.state"
ACTION_KEY = "action"
LAB_KEY = "lab_index"  # the lab in which a frame was recorded; data sets of a single lab do not have it
IMAGE_PREFIX = "observation.images."

# A Gymnasium observation: {"pixels": {camera: uint8 (H, W, 3)}, "agent_pos": float32 (6,)}.
Observation = dict[str, Any]


def image_key(camera: str) -> str:
    """LeRobot's feature name for a camera: ``overhead`` -> ``observation.images.overhead``."""
    return IMAGE_PREFIX + camera


class Actor(Protocol):
    """Controls the arm: a scripted expert or a policy. `rollout.run_episode` runs either."""

    def reset(self, env: Any, seed: int) -> None:
        """Prepare for a new episode in `env`, which has just been reset with `seed`."""

    def act(self, observation: Observation) -> np.ndarray:
        """Return the next joint targets, float32 (6,), in the units of this module."""
