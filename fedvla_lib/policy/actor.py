"""Run a policy in closed loop on observations: predict a chunk of actions, execute part of it, observe again."""

from collections import deque
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from fedvla_lib.data.augmentation import to_float
from fedvla_lib.policy import prefix_cache
from fedvla_lib.policy.model import Bundle
from fedvla_lib.robot.spec import STATE_KEY, Observation, image_key


class PolicyActor:
    """Controls the arm with a policy; executes `n_action_steps` of each predicted chunk before it observes again.

    The flow-matching noise is seeded by (`seed`, episode seed), so rollouts are reproducible.
    """

    def __init__(self, bundle: Bundle, seed: int = 0) -> None:
        self.bundle = bundle
        self.seed = seed

    def reset(self, env: Any, seed: int) -> None:
        """Start an episode: drop queued actions, read the instruction, seed the noise."""
        self._queue: deque[np.ndarray] = deque()
        self._instruction = env.instruction
        mixed = np.random.SeedSequence([self.seed, seed]).generate_state(1, np.uint64)[0]
        self._generator = torch.Generator().manual_seed(int(mixed >> 1))

    def act(self, observation: Observation) -> np.ndarray:
        """Return the next joint targets, float32 (6,): degrees, gripper 0-100."""
        return self.act_together([self], [observation])[0]

    @staticmethod
    def act_together(actors: Sequence["PolicyActor"], observations: Sequence[Observation]) -> list[np.ndarray]:
        """Return the next joint targets of several actors with one policy; new chunks are predicted in one batch."""
        due = [(actor, observed) for actor, observed in zip(actors, observations, strict=True) if not actor._queue]
        if due:
            bundle = due[0][0].bundle
            batch = _as_batch([observed for _, observed in due], [actor._instruction for actor, _ in due])
            noise = torch.cat([starting_noise(bundle, 1, actor._generator) for actor, _ in due])
            for (actor, _), chunk in zip(due, _denoise(bundle, batch, noise), strict=True):
                actor._queue.extend(chunk[: bundle.policy.config.n_action_steps].numpy())
        return [actor._queue.popleft() for actor in actors]


def starting_noise(bundle: Bundle, count: int, generator: torch.Generator) -> torch.Tensor:
    """Return the noise that `count` chunks are denoised from, on the policy's device: (B, chunk, max_action_dim)."""
    config = bundle.policy.config
    return torch.randn((count, config.chunk_size, config.max_action_dim), generator=generator).to(config.device)


@torch.no_grad()
def _denoise(bundle: Bundle, batch: dict[str, Any], noise: torch.Tensor) -> torch.Tensor:
    """Return action chunks, (B, chunk, 6) in degrees: `predict_action_chunk` with fewer operations."""
    bundle.policy.eval()
    return prefix_cache.denoise(bundle, prefix_cache.prefill(bundle, batch), noise)


def _as_batch(observations: Sequence[Observation], instructions: list[str]) -> dict[str, Any]:
    """Convert B Gymnasium observations to a raw batch."""
    pixels = [observation["pixels"] for observation in observations]
    images = {image_key(camera): to_float(np.stack([each[camera] for each in pixels])) for camera in pixels[0]}
    states = np.stack([np.asarray(observation["agent_pos"], np.float32) for observation in observations])
    return {**images, STATE_KEY: torch.from_numpy(states), "task": instructions}  # (B, 3, H, W), (B, 6)
