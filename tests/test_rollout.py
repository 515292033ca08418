"""The control loop: an episode holds what the actor observed and did."""

import numpy as np
import pytest

from fedvla_lib.evaluation.rollouts import evaluate
from fedvla_lib.robot.expert import Expert
from fedvla_lib.robot.rollout import run_episode
from fedvla_lib.robot.sim import HOME, So100Env
from fedvla_lib.robot.spec import CAMERAS, FPS

pytestmark = pytest.mark.integration
SIZE = 32


class Stubborn:
    """An actor with one fixed target, which stores its observations."""

    def __init__(self, target):
        self.target = target

    def reset(self, env, seed):
        self.seed, self.seen = seed, []

    def act(self, observation):
        self.seen.append(observation)
        return self.target


class Glancer(Expert):
    """An expert that reads the images at every eighth step, as a policy does once per chunk."""

    def reset(self, env, seed):
        super().reset(env, seed)
        self.steps, self.looks = 0, []

    def act(self, observation):
        if self.steps % 8 == 0:
            self.looks.append(observation["pixels"])
        self.steps += 1
        return super().act(observation)


@pytest.fixture(scope="module")
def env():
    return So100Env("lift", image_size=SIZE)


def test_episode_holds_what_the_actor_saw_when_it_acted(env):
    actor = Stubborn(HOME)
    episode = run_episode(env, actor, seed=7)
    assert actor.seed == episode.seed == 7
    assert episode.num_frames == len(actor.seen) == 80  # the horizon, since this actor never succeeds
    assert episode.duration_s == 80 / FPS
    assert not episode.success
    for time in (0, 40, 79):
        np.testing.assert_array_equal(episode.states[time], actor.seen[time]["agent_pos"])
        for camera in CAMERAS:
            np.testing.assert_array_equal(episode.images[camera][time], actor.seen[time]["pixels"][camera])


def test_episode_types_and_words(env):
    episode = run_episode(env, Expert(), seed=1)
    frames = episode.num_frames
    assert episode.success
    assert episode.states.dtype == episode.actions.dtype == np.float32
    assert episode.states.shape == episode.actions.shape == (frames, 6)
    assert {camera: image.shape for camera, image in episode.images.items()} == dict.fromkeys(
        CAMERAS, (frames, SIZE, SIZE, 3)
    )
    assert episode.task == "lift"
    assert episode.instruction == f"Lift the {env.layout.cubes[0].color} cube."


def test_same_seed_same_episode_with_or_without_images(env):
    one, again = run_episode(env, Expert(), seed=3), run_episode(env, Expert(), seed=3)
    unseen = run_episode(So100Env("lift", cameras=(), render_mode=None), Expert(), seed=3)
    for other in (again, unseen):
        np.testing.assert_array_equal(one.states, other.states)
        np.testing.assert_array_equal(one.actions, other.actions)
    np.testing.assert_array_equal(one.images["front"], again.images["front"])
    assert unseen.images == {}


def test_without_cameras_an_actor_sees_the_moment_at_which_it_looks(env):
    actor = Glancer()
    blind = run_episode(So100Env("lift", SIZE, cameras=()), actor, seed=3)
    recorded = run_episode(env, Expert(), seed=3)
    np.testing.assert_array_equal(blind.actions, recorded.actions)
    assert blind.images == {} and len(actor.looks) == -(-recorded.num_frames // 8)
    for look, images in enumerate(actor.looks):
        for camera in CAMERAS:
            np.testing.assert_array_equal(images[camera], recorded.images[camera][8 * look])


def test_without_a_video_images_are_rendered_only_when_the_actor_reads_them_and_the_result_is_the_same(
    tmp_path, monkeypatch
):
    drawn, draw = [], So100Env.camera_images
    monkeypatch.setattr(So100Env, "camera_images", lambda sim, *names: drawn.append(sim) or draw(sim, *names))
    whole = evaluate(Glancer(), ["lift", "place"], [1, 2], image_size=SIZE, videos_dir=tmp_path / "all", progress=False)
    drawn.clear()
    none = evaluate(Glancer(), ["lift", "place"], [1, 2], image_size=SIZE, progress=False)
    assert len(list((tmp_path / "all").glob("*.mp4"))) == len({row["video"] for row in whole}) == 4
    assert [row | {"video": None} for row in none] == [row | {"video": None} for row in whole]
    assert len(drawn) == sum(-(-row["steps"] // 8) for row in none)


def test_replaying_the_actions_repeats_the_episode(env):
    """Seed and actions are enough to reproduce an episode."""
    episode = run_episode(env, Expert(), seed=5)
    observation, _ = env.reset(seed=5)
    for state, action in zip(episode.states, episode.actions, strict=True):
        np.testing.assert_array_equal(observation["agent_pos"], state)
        observation, _, terminated, _, info = env.step(action)
    assert terminated and info["is_success"]


@pytest.mark.parametrize("target", [np.full(6, np.nan), np.zeros(5)])
def test_an_actor_that_breaks_the_contract_is_stopped(env, target):
    with pytest.raises(ValueError, match="action"):
        run_episode(env, Stubborn(target), seed=0)
