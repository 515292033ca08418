"""LeRobot's configuration of the simulated arm as a robot, ``--robot.type=so100_sim``.

LeRobot finds the class of a robot beside its configuration: this module's name without ``config_``.
"""

from dataclasses import dataclass

from lerobot.cameras.opencv import OpenCVCameraConfig
from lerobot.robots.config import RobotConfig
from lerobot.robots.so_follower.config_so_follower import SOFollowerConfig

from fedvla_lib.robot.layout import COLORS
from fedvla_lib.robot.spec import CAMERAS, NUM_JOINTS
from fedvla_lib.robot.tasks import check_tasks

FPS_LIMIT = 200  # time steps of the simulation in a second


@RobotConfig.register_subclass("so100_sim")
@dataclass
class So100SimRobotConfig(RobotConfig, SOFollowerConfig):
    """The flags of LeRobot's SO follower, and what a simulation needs besides; ValueError for a value it cannot use.

    Cameras are configured as LeRobot's ``opencv`` cameras: index 0 is the overhead camera, 1 the front camera.
    """

    port: str = "simulation"  # not opened
    task: str = "lift"  # whose cubes and zones are on the table
    color: str | None = None  # of the first cube in every scene, as --dataset.single_task names it; None draws one
    seed: int = 0  # of the first scene, layout and start pose; every further scene takes the next number
    lab: int = 0  # which lab's cameras, light, colours and calibration; 0 is the reference lab
    fps: int = 30  # actions in a second of simulated time: the value of --dataset.fps or --fps
    start_pose: list[float] | None = None  # joints at the start of every scene, as the data set of a real arm has them

    def __post_init__(self) -> None:
        super().__post_init__()
        check_tasks([self.task])
        if self.color not in (None, *COLORS):
            raise ValueError(f"robot.color={self.color!r} is not usable: choose one of {', '.join(COLORS)}")
        if not 1 <= self.fps <= FPS_LIMIT:
            raise ValueError(f"robot.fps={self.fps} is not usable: give a number from 1 to {FPS_LIMIT}")
        if self.lab < 0:
            raise ValueError(f"robot.lab={self.lab} is not usable: give 0 or more")
        if self.start_pose is not None and len(self.start_pose) != NUM_JOINTS:
            raise ValueError(f"robot.start_pose={self.start_pose} is not usable: give {NUM_JOINTS} numbers")
        for name, camera in self.cameras.items():
            _check_camera(name, camera)


def _check_camera(name: str, camera: object) -> None:
    if not isinstance(camera, OpenCVCameraConfig):
        raise ValueError(f"camera {name!r} is not simulated: give it the type opencv")
    if camera.index_or_path not in range(len(CAMERAS)):
        valid = ", ".join(f"{index} ({view})" for index, view in enumerate(CAMERAS))
        raise ValueError(f"camera {name!r} has index_or_path={camera.index_or_path}: choose from {valid}")
    if camera.rotation:
        raise ValueError(f"camera {name!r} has rotation={camera.rotation.value}: the simulated ones stand upright")
