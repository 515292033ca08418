"""Loss and action error on held-out frames, with fixed noise and flow time so that models can be compared."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from fedvla_lib.config import Config
from fedvla_lib.data.batches import batch_of_rows
from fedvla_lib.data.frame_store import FrameStore
from fedvla_lib.policy import prefix_cache
from fedvla_lib.policy.actor import starting_noise
from fedvla_lib.policy.model import Bundle
from fedvla_lib.policy.prefix_cache import PREFIX_KEY
from fedvla_lib.robot.spec import ACTION_KEY, JOINT_NAMES

VALIDATION_STRIDE = 5  # frames, half a second: neighbouring frames are nearly the same
VALIDATION_BATCH = 32  # fixed, so that the noise does not depend on the batch size of training


def measure_frames(
    bundle: Bundle, batches: list[dict[str, Any]], *, tolerance: float, seed: int = 0
) -> dict[str, np.ndarray]:
    """Measure the policy on each frame of held-out raw batches, with noise and flow time fixed by `seed`.

    Returns:
        Arrays with an entry for each frame, over the valid (not padded) actions of its chunk:
        num_actions: number of valid actions;
        loss: flow-matching loss, in normalised units;
        action_error: mean absolute error of the predicted joint targets, over all joints (degrees; gripper 0-100);
        action_accuracy: share of predicted joint targets within `tolerance` of the demonstration;
        action_error.<joint>: the same error for each joint.
    """
    if not batches:
        raise ValueError("no held-out batches: give at least one validation episode")
    generator = torch.Generator().manual_seed(seed)
    measured = [_measure(bundle, batch, generator, tolerance) for batch in batches]
    return {name: np.concatenate([arrays[name] for arrays in measured]) for name in measured[0]}


def average(frames: dict[str, np.ndarray]) -> dict[str, float]:
    """Return the mean of each measurement over all valid actions of the given frames."""
    weights = frames["num_actions"]
    return {name: float(np.average(each, weights=weights)) for name, each in frames.items() if name != "num_actions"}


@torch.no_grad()
def _measure(
    bundle: Bundle, batch: dict[str, Any], generator: torch.Generator, tolerance: float
) -> dict[str, np.ndarray]:
    if PREFIX_KEY not in batch:
        batch = batch | {PREFIX_KEY: prefix_cache.prefill(bundle, batch)}
    valid = ~batch["action_is_pad"].numpy()  # (B, chunk)
    num_actions, loss = valid.sum(axis=1), _fixed_loss(bundle, batch, generator)
    predicted = prefix_cache.denoise(bundle, batch[PREFIX_KEY], starting_noise(bundle, len(valid), generator))
    error = (predicted - batch[ACTION_KEY]).abs().double().numpy()  # (B, chunk, 6)
    by_joint = (error * valid[..., None]).sum(axis=1) / num_actions[:, None]
    accuracy = ((error <= tolerance) & valid[..., None]).sum(axis=(1, 2)) / (num_actions * error.shape[-1])
    joints = {f"action_error.{name}": by_joint[:, i] for i, name in enumerate(JOINT_NAMES)}
    return {
        "num_actions": num_actions, "loss": loss, "action_error": by_joint.mean(axis=1),
        "action_accuracy": accuracy, **joints,
    }  # fmt: skip


def _fixed_loss(bundle: Bundle, batch: dict[str, Any], generator: torch.Generator) -> np.ndarray:
    """Flow-matching loss of each frame, (B,), with noise ~ N(0, 1) and time spread evenly over (0, 1)."""
    size = len(batch["task"])
    noise = starting_noise(bundle, size, generator)
    times = (torch.randperm(size, generator=generator) + 0.5) / size
    squared = prefix_cache.squared_errors(bundle, batch, noise, times.to(noise.device))  # (B, chunk, 6)
    return squared.sum((1, 2)).double().cpu().numpy() / (squared.shape[-1] * (~batch["action_is_pad"]).sum(1).numpy())


def by_episode(frames: dict[str, np.ndarray], store: FrameStore, episode_ids: Sequence[int]) -> list[dict[str, float]]:
    """Return the averages of measured `held_out_batches` for each episode, with episode_id and num_examples."""
    counts = [len(rows) for rows in _measured_rows(store, episode_ids)]
    ends = np.cumsum(counts)
    return [
        {"episode_id": episode, "num_examples": n, **average({k: each[end - n : end] for k, each in frames.items()})}
        for episode, n, end in zip(episode_ids, counts, ends, strict=True)
    ]


def held_out_batches(
    store: FrameStore, episode_ids: Sequence[int], config: Config, bundle: Bundle | None = None
) -> list[dict[str, Any]]:
    """Return raw batches of every fifth frame of the given episodes, without augmentation.

    For a policy whose training uses stored prefixes, they have those in place of images.
    """
    rows = np.array([row for episode in _measured_rows(store, episode_ids) for row in episode])
    cuts, supply = range(0, len(rows), VALIDATION_BATCH), batch_of_rows
    if bundle and len(rows) and prefix_cache.is_constant(bundle.policy):
        supply = prefix_cache.ensure_prefixes(bundle, store, np.sort(rows)).batch
    return [supply(store, rows[i : i + VALIDATION_BATCH], config.chunk_size) for i in cuts]


def _measured_rows(store: FrameStore, episode_ids: Sequence[int]) -> list[range]:
    """Return every fifth row of each episode."""
    table = store.episodes.set_index("episode_id").loc[list(episode_ids)]
    return [range(start, end, VALIDATION_STRIDE) for start, end in zip(table.start, table.end, strict=True)]
