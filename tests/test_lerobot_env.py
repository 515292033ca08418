"""LeRobot's tools find the environment, run a policy in it and read its success."""

import json
import os
import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from lerobot.envs.factory import make_env, make_env_config
from lerobot.envs.utils import env_to_policy_features, preprocess_observation

from fedvla_lib.config import from_profile
from fedvla_lib.policy import model
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


@pytest.mark.slow
def test_lerobot_eval_runs_a_saved_policy(tmp_path, warm_python):
    """The documented command, with a nano SmolVLA with random weights."""
    config = from_profile("tiny", base="nano-random", num_threads=1)
    stats = {key: {"mean": np.zeros(6), "std": np.ones(6)} for key in (STATE_KEY, ACTION_KEY)}
    model.save_policy(model.load_policy(config, stats), tmp_path / "policy")
    command = [
        warm_python, Path(sys.executable).with_name("lerobot-eval"), f"--policy.path={tmp_path / 'policy'}",
        "--policy.device=cpu", "--env.type=so100_sim", "--env.task=lift", f"--env.image_size={config.image_size}",
        "--env.discover_packages_path=fedvla_lib.robot.lerobot_env", "--eval.n_episodes=1", "--eval.batch_size=1",
        f"--output_dir={tmp_path / 'out'}",
    ]  # fmt: skip
    settings = {**os.environ, "HF_HUB_OFFLINE": "1", "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, cwd=tmp_path, env=settings)
    assert done.returncode == 0, done.stderr[-2000:]
    results = json.loads((tmp_path / "out" / "eval_info.json").read_text())
    assert results["overall"]["n_episodes"] == 1
    assert all(Path(video).stat().st_size > 1000 for video in results["overall"]["video_paths"])
