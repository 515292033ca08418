"""The one loop in which an actor moves the arm; recording demonstrations and evaluating policies share it."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from fedvla_lib.spec import FPS, NUM_JOINTS, Actor

if TYPE_CHECKING:
    from fedvla_lib.sim import So100Env


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


def run_episode(env: "So100Env", actor: Actor, seed: int) -> Episode:
    """Run `actor` in `env` from the reset with `seed` until success or the task's horizon.

    Raises:
        ValueError: the actor returned something else than six finite numbers.
    """
    observation, info = env.reset(seed=seed)
    actor.reset(env, seed)
    seen, actions, over = [], [], False
    while not over:
        action = np.asarray(actor.act(observation), dtype=np.float32)
        seen.append(observation)
        actions.append(action)
        observation, _, terminated, truncated, info = env.step(action)
        over = terminated or truncated
    sim = env.unwrapped
    return Episode(
        task=sim.task,
        instruction=sim.instruction,
        color=sim.layout.color,
        seed=seed,
        states=np.stack([frame["agent_pos"] for frame in seen]).reshape(-1, NUM_JOINTS),
        actions=np.stack(actions),
        images={camera: np.stack([frame["pixels"][camera] for frame in seen]) for camera in sim.cameras},
        success=bool(info["is_success"]),
    )
