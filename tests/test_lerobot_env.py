"""LeRobot's tools find the environment, run a policy in it and read its success."""

import gymnasium
import numpy as np
import pytest
from lerobot.configs.parser import load_plugin
from lerobot.envs.factory import make_env, make_env_config
from lerobot.envs.utils import env_to_policy_features, preprocess_observation

from fedvla_lib.robot.expert import Expert
from fedvla_lib.robot.layout import COLORS
from fedvla_lib.robot.lerobot_env import So100SimConfig
from fedvla_lib.robot.spec import ACTION_KEY, CAMERAS, STATE_KEY, image_key
from fedvla_lib.robot.tasks import TASKS

pytestmark = pytest.mark.integration
SIZE = 32


@pytest.fixture
def lift():
    envs = make_env(make_env_config("so100_sim", task="lift", image_size=SIZE), n_envs=2)
    yield envs["lift"][0]
    envs["lift"][0].close()


def test_registered_under_its_name_with_the_features_of_our_data():
    load_plugin("fedvla_lib.robot.lerobot_env")  # LeRobot's flag, for who has not installed the plugin
    config = make_env_config("so100_sim", image_size=SIZE)
    assert isinstance(config, So100SimConfig) and config.type == "so100_sim"
    features = env_to_policy_features(config)
    assert {key: feature.shape for key, feature in features.items()} == {
        ACTION_KEY: (6,),
        STATE_KEY: (6,),
        **{image_key(camera): (3, SIZE, SIZE) for camera in CAMERAS},
    }


def test_observations_arrive_under_the_policy_s_keys(lift):
    observation, _ = lift.reset(seed=[0, 1])
    batch = preprocess_observation(observation)
    assert batch[STATE_KEY].shape == (2, 6)
    for camera in CAMERAS:
        assert batch[image_key(camera)].shape == (2, 3, SIZE, SIZE)


def test_lerobot_reads_instruction_horizon_and_frame_rate(lift):
    lift.reset(seed=[0, 1])
    assert set(lift.call("task_description")) <= {f"Lift the {color} cube." for color in COLORS}
    assert lift.call("_max_episode_steps") == (TASKS["lift"].horizon_steps,) * 2
    assert lift.metadata["render_fps"] == make_env_config("so100_sim").fps


def test_success_reaches_lerobot_through_final_info(lift):
    observation, _ = lift.reset(seed=[0, 1])
    experts = [Expert(), Expert()]
    for expert, env, seed in zip(experts, lift.envs, (0, 1), strict=True):
        expert.reset(env, seed)
    succeeded = np.zeros(2, dtype=bool)
    while not succeeded.all():
        action = np.stack([expert.act(observation) for expert in experts])
        observation, reward, terminated, truncated, info = lift.step(action)
        assert not truncated.any()
        if "final_info" in info:
            succeeded |= info["final_info"]["is_success"] & terminated & (reward == 1)


def test_several_tasks_become_several_environments():
    envs = make_env(make_env_config("so100_sim", task="lift, push", image_size=SIZE))
    assert list(envs) == ["lift", "push"]
    for name, by_id in envs.items():
        assert isinstance(by_id[0], gymnasium.vector.VectorEnv)
        assert by_id[0].call("task") == (name,)
        by_id[0].close()


def test_an_unknown_task_is_named_with_the_valid_ones():
    with pytest.raises(ValueError, match="'juggle'.*lift, place, push"):
        make_env_config("so100_sim", task="lift,juggle")
