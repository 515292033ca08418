r"""The simulated SO-100 as an environment of LeRobot: importing this module registers ``so100_sim``.

LeRobot imports it where the distribution ``lerobot_env_so100_sim`` is installed, as ``make`` does::

    lerobot-eval --policy.path=FOLDER --env.type=so100_sim --env.task=lift,place --eval.n_episodes=20

Elsewhere add ``--env.discover_packages_path=fedvla_lib.robot.lerobot_env``.
"""

from dataclasses import dataclass, replace
from typing import Any

import gymnasium
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_STATE

from fedvla_lib.config import split_names
from fedvla_lib.robot.sim import ENV_ID
from fedvla_lib.robot.spec import CAMERAS, FPS, NUM_JOINTS, image_key
from fedvla_lib.robot.tasks import check_tasks

__path__: list[str] = []  # LeRobot's plugin loader looks for submodules and fails on a module without this


@EnvConfig.register_subclass("so100_sim")
@dataclass
class So100SimConfig(EnvConfig):
    """LeRobot's configuration of `So100Env`: two cameras, joint state, instruction; ValueError for an unknown task."""

    task: str = "lift"  # one task, or several separated by commas, which are evaluated and reported separately
    fps: int = FPS
    image_size: int = 96  # side of the square camera images in pixels
    render_mode: str = "rgb_array"

    def __post_init__(self) -> None:
        check_tasks(split_names(self.task))
        action = PolicyFeature(type=FeatureType.ACTION, shape=(NUM_JOINTS,))
        state = PolicyFeature(type=FeatureType.STATE, shape=(NUM_JOINTS,))
        image = PolicyFeature(type=FeatureType.VISUAL, shape=(self.image_size, self.image_size, 3))
        self.features = {ACTION: action, "agent_pos": state, **{f"pixels/{camera}": image for camera in CAMERAS}}
        images = {f"pixels/{camera}": image_key(camera) for camera in CAMERAS}
        self.features_map = {ACTION: ACTION, "agent_pos": OBS_STATE, **images}

    @property
    def gym_id(self) -> str:
        """Gymnasium's id of the environment."""
        return ENV_ID

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Keyword arguments of `So100Env`."""
        return {"task": self.task, "image_size": self.image_size, "render_mode": self.render_mode}

    def create_envs(
        self, n_envs: int, use_async_envs: bool = False
    ) -> dict[str, dict[int, gymnasium.vector.VectorEnv]]:
        """Return ``{task: {0: vector environment}}``, one entry per task."""
        return {
            name: EnvConfig.create_envs(replace(self, task=name), n_envs, use_async_envs)[self.type]
            for name in split_names(self.task)
        }
