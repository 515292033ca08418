"""Why a policy fails on an arm although its loss is fine: what the arm gives and gets, beside recordings.

Each function tests one suspicion on demonstrations, never on a success rate: those that the policy learnt from, and a
few that somebody has made by hand on the arm as it is now. They go through the processors that the arm uses, so that a
mistake there shows. A data set's start poses are compared by `data.episode_checks.shift`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from fedvla_lib.config import Config
from fedvla_lib.data.batches import batch_of_rows, frame_rows
from fedvla_lib.data.frame_store import FrameStore
from fedvla_lib.evaluation.held_out import VALIDATION_STRIDE
from fedvla_lib.policy import prefix_cache
from fedvla_lib.policy.actor import starting_noise
from fedvla_lib.policy.model import Bundle
from fedvla_lib.robot.spec import ACTION_KEY, CAMERAS, STATE_KEY, image_key

FAR = 5.0  # standard deviations: beyond them is what the processors' statistics do not describe


@dataclass(frozen=True)
class Frames:
    """Every fifth frame of some demonstrations, with the chunk of actions that follows it."""

    store: FrameStore
    rows: np.ndarray  # int64 (N,)
    batch: dict[str, Any]  # of `batch_of_rows`


def frames_of(store: FrameStore, config: Config, episode_ids: Sequence[int] | None = None) -> Frames:
    """Return the frames of these episodes, by default of all."""
    ids = list(store.episodes.episode_id) if episode_ids is None else episode_ids
    rows = frame_rows(store, ids)[::VALIDATION_STRIDE]
    return Frames(store, rows, batch_of_rows(store, rows, config.chunk_size))


def beyond_statistics(bundle: Bundle, store: FrameStore) -> float:
    """Return the share of recorded joint values further than `FAR` standard deviations from the processors' mean.

    Of states and actions; near 0 if the processors normalise these joints, in these units. 1.0 without statistics.
    """
    (stats,) = [step.stats or {} for step in bundle.preprocess.steps if hasattr(step, "stats")]
    shares = []
    for key, values in ((STATE_KEY, store.states), (ACTION_KEY, store.actions)):
        if key not in stats:
            return 1.0
        mean, std = (np.asarray(stats[key][name], dtype=float) for name in ("mean", "std"))
        shares.append((np.abs(values - mean) > FAR * std).mean())
    return float(np.mean(shares))


@torch.no_grad()
def loss(bundle: Bundle, frames: Frames, seed: int = 0, **changed: Any) -> float:
    """Return the flow-matching loss on the frames, with entries of the batch `changed`; `seed` fixes noise and time."""
    generator, size = torch.Generator().manual_seed(seed), len(frames.rows)
    noise = starting_noise(bundle, size, generator)
    times = (torch.randperm(size, generator=generator) + 0.5) / size
    batch = frames.batch | changed
    prefixed = batch | {prefix_cache.PREFIX_KEY: prefix_cache.prefill(bundle, batch)}
    return prefix_cache.prefix_loss(bundle, prefixed, noise, times.to(noise.device)).item()


def arrangements(batch: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Return the images of a batch as cameras that are plugged in or mounted wrongly would give them, by what is wrong.

    Cameras exchanged, and both upside down. Done twice, each gives the images themselves.
    """
    one, other = map(image_key, CAMERAS)
    turned = {key: batch[key].flip(-1, -2) for key in (one, other)}
    return {"exchanged": {one: batch[other], other: batch[one]}, "upside down": turned}


def loss_by_arrangement(bundle: Bundle, frames: Frames, seed: int = 0) -> dict[str, float]:
    """Return the loss with the images as the arm gives them, ``"as given"``, and in each of the `arrangements`."""
    others = arrangements(frames.batch)
    given = {"as given": loss(bundle, frames, seed)}
    return given | {name: loss(bundle, frames, seed, **images) for name, images in others.items()}


@torch.no_grad()
def chunks(bundle: Bundle, frames: Frames, seed: int = 0, **changed: Any) -> np.ndarray:
    """Return the actions that the arm would get at each frame: (N, chunk, 6), degrees and the gripper 0-100."""
    noise = starting_noise(bundle, len(frames.rows), torch.Generator().manual_seed(seed))
    return prefix_cache.denoise(bundle, prefix_cache.prefill(bundle, frames.batch | changed), noise).cpu().numpy()


def lag_steps(bundle: Bundle, frames: Frames, most: int = 12, seed: int = 0) -> int:
    """Return by how many steps the actions that are executed run ahead of the demonstrated ones (negative: behind).

    It is the shift, of at most `most` steps, with the smallest mean error of the actions that are executed of a chunk.
    """
    executed = bundle.policy.config.n_action_steps
    given, store = chunks(bundle, frames, seed)[:, :executed], frames.store
    starts = np.repeat(store.episodes["start"].to_numpy(), store.episodes["num_frames"].to_numpy())[frames.rows]
    ends = store.episode_ends[frames.rows]

    def error(lag: int) -> float:
        wanted = frames.rows[:, None] + np.arange(executed) + lag
        inside = (wanted >= starts[:, None]) & (wanted < ends[:, None])
        apart = np.abs(given - store.actions[wanted.clip(0, len(store.actions) - 1)]).mean(axis=-1)
        return float(apart[inside].mean())

    return min(range(-most, most + 1), key=lambda lag: (error(lag), abs(lag)))
