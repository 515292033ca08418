"""The one loop in which an actor moves the arm; recording demonstrations and evaluating policies share it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from fedvla_lib.robot.spec import FPS, NUM_JOINTS, Actor, Observation

if TYPE_CHECKING:
    from fedvla_lib.robot.sim import So100Env


@dataclass(frozen=True)
class Episode:
    """What happened: `states[t]` and the images at t are what the actor saw when it chose `actions[t]`."""

    task: str
    instruction: str
    color: str
    seed: int
    states: np.ndarray  # float32 (T, 6), LeRobot units
    actions: np.ndarray  # float32 (T, 6), joint targets as the actor gave them
    images: dict[str, np.ndarray]  # camera -> uint8 (T, H, W, 3); empty if the environment draws none
    success: bool

    @property
    def num_frames(self) -> int:
        """Control steps taken."""
        return len(self.actions)

    @property
    def duration_s(self) -> float:
        """Length in seconds of the arm's time."""
        return self.num_frames / FPS


# Chooses an action for each of several actors that act at the same time, from what each of them sees.
ActTogether = Callable[[Sequence[Actor], Sequence[Observation]], Sequence[np.ndarray]]


def run_episode(env: "So100Env", actor: Actor, seed: int) -> Episode:
    """Run `actor` in `env` from the reset with `seed` until success or the task's horizon.

    Raises:
        ValueError: the actor returned something else than six finite numbers.
    """
    return run_episodes([env], [actor], [seed])[0]


def act_in_turn(actors: Sequence[Actor], observations: Sequence[Observation]) -> list[np.ndarray]:
    """Let each actor choose on its own."""
    return [actor.act(observation) for actor, observation in zip(actors, observations, strict=True)]


def run_episodes(
    envs: Sequence["So100Env"], actors: Sequence[Actor], seeds: Sequence[int], together: ActTogether = act_in_turn
) -> list[Episode]:
    """Run an episode in each environment, all in step, so that a model can choose for all of them at once.

    An environment without cameras draws only when its actor looks at ``observation["pixels"]``, which a policy does
    once a chunk; its episode keeps no pictures.

    Args:
        envs: one environment, `actors` one actor and `seeds` one seed for each episode.
        together: chooses the actions of those that are not done yet.
    """
    courses = [RunningEpisode(env, actor, seed) for env, actor, seed in zip(envs, actors, seeds, strict=True)]
    while running := [course for course in courses if not course.over]:
        actions = together([course.actor for course in running], [course.observation for course in running])
        for course, action in zip(running, actions, strict=True):
            course.step(np.asarray(action, dtype=np.float32))
    return [course.episode() for course in courses]


class LazyObservation(dict):
    """An observation whose pictures are drawn when they are first asked for, of the scene as it then stands."""

    def __init__(self, observation: Observation, env: "So100Env") -> None:
        super().__init__(observation)
        self._env = env

    def __missing__(self, key: str) -> dict[str, np.ndarray]:
        if key != "pixels":
            raise KeyError(key)
        self[key] = self._env.pictures()
        return self[key]


class RunningEpisode:
    """An episode on its way."""

    def __init__(self, env: "So100Env", actor: Actor, seed: int) -> None:
        self.env, self.actor, self.seed = env, actor, seed
        self.observation = self._shown(env.reset(seed=seed)[0])
        actor.reset(env, seed)
        self.over = self._success = False
        self._seen: list[Observation] = []
        self._actions: list[np.ndarray] = []

    def step(self, action: np.ndarray) -> None:
        self._seen.append(self.observation)
        self._actions.append(action)
        observation, _, terminated, truncated, info = self.env.step(action)
        self.observation = self._shown(observation)
        self.over, self._success = terminated or truncated, bool(info["is_success"])

    def _shown(self, observation: Observation) -> Observation:
        sim = self.env.unwrapped
        return observation if sim.cameras else LazyObservation(observation, sim)

    def episode(self) -> Episode:
        sim = self.env.unwrapped
        return Episode(
            task=sim.task,
            instruction=sim.instruction,
            color=sim.layout.color,
            seed=self.seed,
            states=np.stack([frame["agent_pos"] for frame in self._seen]).reshape(-1, NUM_JOINTS),
            actions=np.stack(self._actions),
            images={camera: np.stack([frame["pixels"][camera] for frame in self._seen]) for camera in sim.cameras},
            success=self._success,
        )
