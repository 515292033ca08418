"""The control loop: an actor moves the arm. Used to record demonstrations and to evaluate policies."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from fedvla_lib.robot.spec import FPS, NUM_JOINTS, Actor, Observation

if TYPE_CHECKING:
    from fedvla_lib.robot.sim import So100Env


@dataclass(frozen=True)
class Episode:
    """One episode: `states[t]` and the images at t are what the actor observed when it chose `actions[t]`."""

    task: str
    instruction: str
    seed: int
    states: np.ndarray  # float32 (T, 6), LeRobot units
    actions: np.ndarray  # float32 (T, 6), joint targets given by the actor
    images: dict[str, np.ndarray]  # camera -> uint8 (T, H, W, 3); empty for an environment without cameras
    success: bool

    @property
    def num_frames(self) -> int:
        """Control steps taken."""
        return len(self.actions)

    @property
    def duration_s(self) -> float:
        """Simulated duration in seconds."""
        return self.num_frames / FPS


# Returns one action per actor from one observation per actor.
ActTogether = Callable[[Sequence[Actor], Sequence[Observation]], Sequence[np.ndarray]]


def run_episode(env: "So100Env", actor: Actor, seed: int) -> Episode:
    """Reset `env` with `seed` and run `actor` until success or the task's horizon.

    Raises:
        ValueError: the actor returned something other than six finite numbers.
    """
    return run_episodes([env], [actor], [seed])[0]


def act_in_turn(actors: Sequence[Actor], observations: Sequence[Observation]) -> list[np.ndarray]:
    """Call each actor separately."""
    return [actor.act(observation) for actor, observation in zip(actors, observations, strict=True)]


def run_episodes(
    envs: Sequence["So100Env"], actors: Sequence[Actor], seeds: Sequence[int], together: ActTogether = act_in_turn
) -> list[Episode]:
    """Run one episode per environment in lockstep, so that a model can compute the actions of all of them in one batch.

    An environment without cameras renders only when its actor reads ``observation["pixels"]``, which a policy does once
    per chunk; its episode has no images.

    Args:
        envs: one environment, `actors` one actor and `seeds` one seed per episode.
        together: chooses the actions of the episodes that are still running.
    """
    episodes = [RunningEpisode(env, actor, seed) for env, actor, seed in zip(envs, actors, seeds, strict=True)]
    while running := [episode for episode in episodes if not episode.over]:
        actions = together([episode.actor for episode in running], [episode.observation for episode in running])
        for episode, action in zip(running, actions, strict=True):
            episode.step(np.asarray(action, dtype=np.float32))
    return [episode.result() for episode in episodes]


class LazyObservation(dict):
    """An observation whose images, if it lacks them, are rendered on first access, as the scene is at that moment."""

    def __init__(self, observation: Observation, env: "So100Env") -> None:
        super().__init__(observation)
        self._env = env

    def __missing__(self, key: str) -> dict[str, np.ndarray]:
        if key != "pixels":
            raise KeyError(key)
        self[key] = self._env.camera_images()
        return self[key]


class RunningEpisode:
    """An episode that is still running."""

    def __init__(self, env: "So100Env", actor: Actor, seed: int) -> None:
        self.env, self.actor, self.seed = env, actor, seed
        self.observation = LazyObservation(env.reset(seed=seed)[0], env.unwrapped)
        actor.reset(env, seed)
        self.over = self._success = False
        self._observations: list[Observation] = []
        self._actions: list[np.ndarray] = []

    def step(self, action: np.ndarray) -> None:
        self._observations.append(self.observation)
        self._actions.append(action)
        observation, _, terminated, truncated, info = self.env.step(action)
        self.observation = LazyObservation(observation, self.env.unwrapped)
        self.over, self._success = terminated or truncated, bool(info["is_success"])

    def result(self) -> Episode:
        sim = self.env.unwrapped
        return Episode(
            task=sim.task, instruction=sim.instruction, seed=self.seed, success=self._success,
            states=np.stack([frame["agent_pos"] for frame in self._observations]).reshape(-1, NUM_JOINTS),
            actions=np.stack(self._actions),
            images={name: np.stack([frame["pixels"][name] for frame in self._observations]) for name in sim.cameras},
        )  # fmt: skip
