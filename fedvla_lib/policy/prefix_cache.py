"""Cache the prefix of each frame under a frozen vision-language model, and train the action expert on the cache.

SmolVLA's prefix (images, instruction, state) does not attend to the actions that follow it. If everything that makes
the prefix is frozen and images are not augmented, its keys and values are constant for a frame: they are computed once
with the policy's own methods and stored in a memory-mapped file, and a gradient step runs the expert only. The loss and
its gradients equal those of `SmolVLAPolicy.forward`.
"""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from filelock import FileLock
from lerobot.policies.common.flow_matching import euler_integrate
from lerobot.policies.common.vla_utils import make_att_2d_masks
from lerobot.policies.smolvla import SmolVLAPolicy
from lerobot.utils.constants import OBS_LANGUAGE_ATTENTION_MASK, OBS_LANGUAGE_TOKENS
from safetensors.torch import save
from tqdm.auto import tqdm
from transformers import DynamicCache

from fedvla_lib.data.batches import Batches, batch_of_rows, targets_of_rows
from fedvla_lib.data.frame_store import FrameStore
from fedvla_lib.files import cache_dir, new_folder
from fedvla_lib.policy import lean_expert
from fedvla_lib.policy.model import Bundle
from fedvla_lib.robot.spec import ACTION_KEY

PREFIX_KEY = "prefix"  # in a batch: keys and values of its frames, and their padding mask
BEFORE = ("model.vlm_with_expert.vlm.", "model.state_proj.")  # parameters that prefixes depend on
BATCH = 64  # frames per forward pass while filling the store


@dataclass(frozen=True)
class PrefixStore:
    """Keys and values of frames of a data set under one frozen model."""

    of: np.ndarray  # the N frames: rows of the data set, ascending
    cache: np.ndarray  # float32 (N, layers, 2, kv heads, prefix length, head dim): keys, then values
    real: np.ndarray  # bool (N, prefix length): False where the instruction is padded

    def batch(self, store: FrameStore, rows: np.ndarray, chunk_size: int) -> dict[str, Any]:
        """Return the batch of these rows with prefixes, keys and values and their mask, in place of images."""
        stored = np.searchsorted(self.of, rows)
        prefixes = torch.from_numpy(self.cache[stored]), torch.from_numpy(self.real[stored])
        return targets_of_rows(store, rows, chunk_size) | {PREFIX_KEY: prefixes}


def with_cached_prefixes(bundle: Bundle, batches: Batches, progress: bool = False) -> Batches:
    """Return the same training batches with stored prefixes if prefixes are constant, else `batches` itself."""
    if batches.augment or not is_constant(bundle.policy):
        return batches
    return replace(batches, supply=ensure_prefixes(bundle, batches.store, progress=progress).batch)


def is_constant(policy: SmolVLAPolicy) -> bool:
    """Return whether training leaves prefixes unchanged."""
    settings = policy.config
    return settings.freeze_vision_encoder and settings.train_expert_only and not settings.train_state_proj


def prefix_loss(bundle: Bundle, batch: dict[str, Any], noise: torch.Tensor, times: torch.Tensor) -> torch.Tensor:
    """Return the flow-matching loss of a batch with stored prefix: mean of `squared_errors` over real actions."""
    squared = squared_errors(bundle, batch, noise, times)
    return squared.sum() / ((~batch["action_is_pad"]).sum() * squared.shape[-1]).clamp_min(1)


def squared_errors(bundle: Bundle, batch: dict[str, Any], noise: torch.Tensor, times: torch.Tensor) -> torch.Tensor:
    """Return (v - (noise - action))^2 for a batch with stored prefix, (B, chunk, 6), 0 where the action is padded.

    Args:
        noise: float32 (B, chunk, max_action_dim), x_1 of the flow.
        times: float32 (B,), t in (0, 1); the expert sees x_t = t noise + (1 - t) action.
    """
    policy, width = bundle.policy, bundle.policy.config.action_feature.shape[0]
    actions = policy.prepare_action({ACTION_KEY: bundle.normalise_actions(batch[ACTION_KEY])})  # padded like the noise
    mixed = times[:, None, None] * noise + (1 - times[:, None, None]) * actions
    found = _velocity(bundle, batch[PREFIX_KEY], width)(mixed, times)
    squared = ((noise - actions)[..., :width] - found).square()
    return squared * ~batch["action_is_pad"].to(noise.device)[..., None]


@torch.no_grad()
def denoise(bundle: Bundle, prefix: tuple[torch.Tensor, torch.Tensor], noise: torch.Tensor) -> torch.Tensor:
    """Return the policy's action chunks for this noise, as `predict_action_chunk`: (B, chunk, 6) in degrees."""
    config = bundle.policy.config
    chunk = euler_integrate(_velocity(bundle, prefix, noise.shape[-1]), noise, config.num_steps)
    return bundle.postprocess(chunk[..., : config.action_feature.shape[0]])


def _velocity(bundle: Bundle, prefix: tuple[torch.Tensor, torch.Tensor], width: int) -> Callable[..., torch.Tensor]:
    """Return the first `width` dimensions of the flow's velocity after prefixes, as a function of chunks and times."""
    policy = bundle.policy
    stored, real = (part.to(policy.config.device) for part in prefix)
    if bundle.is_lean and not torch.is_autocast_enabled(stored.device.type):  # its derivatives are float32
        return partial(lean_expert.velocity, policy, lean_expert.prepared(policy, stored, real), width=width)

    def own(noisy: torch.Tensor, times: torch.Tensor) -> torch.Tensor:
        cache = DynamicCache([each.unbind(1) for each in stored.unbind(1)])
        return policy.model.denoise_step(real, cache, noisy, times)[..., :width]

    return own


def ensure_prefixes(
    bundle: Bundle, store: FrameStore, rows: np.ndarray | None = None, *, folder: Path | None = None,
    progress: bool = False,
) -> PrefixStore:  # fmt: skip
    """Return the prefixes of `rows`, by default all, under this model, computing them into `folder` if needed."""
    rows = np.arange(len(store.states)) if rows is None else rows
    target = (folder or cache_dir() / "prefixes") / _fingerprint(bundle, store, rows)
    if not target.is_dir():
        target.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(target.with_suffix(".lock")):  # so that concurrent processes compute them once
            if not target.is_dir():
                _fill(bundle, store, rows, target, progress)
    return PrefixStore(rows, np.load(target / "cache.npy", mmap_mode="r"), np.load(target / "real.npy"))


@torch.no_grad()
def _fill(bundle: Bundle, store: FrameStore, rows: np.ndarray, target: Path, progress: bool) -> None:
    cache, real, chunk_size = None, [], bundle.policy.config.chunk_size
    instructions = batch_of_rows(store, store.episodes.drop_duplicates("instruction").start, chunk_size)
    length = bundle.preprocess(instructions)[OBS_LANGUAGE_TOKENS].shape[1]  # of the longest one
    with new_folder(target) as draft:
        for start in tqdm(range(0, len(rows), BATCH), desc="frozen prefixes", disable=not progress):
            batch = batch_of_rows(store, rows[start : start + BATCH], chunk_size)
            stored, mask = prefill(bundle, batch, length)
            if cache is None:
                file, shape = draft / "cache.npy", (len(rows), *stored.shape[1:])
                cache = np.lib.format.open_memmap(file, mode="w+", dtype=np.float32, shape=shape)
            cache[start : start + len(stored)] = stored.cpu().numpy()
            real.append(mask.cpu().numpy())
        cache.flush()
        np.save(draft / "real.npy", np.concatenate(real))


def prefill(bundle: Bundle, batch: dict[str, Any], length: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """Run images, instruction and state through the vision-language model; gradients flow if enabled.

    Returns:
        keys and values, (B, layers, 2, kv heads, L, head dim), and the mask of real positions, bool (B, L);
        instructions are padded to at least `length` tokens.
    """
    policy = bundle.policy
    inputs = bundle.preprocess({key: value for key, value in batch.items() if key != ACTION_KEY})
    images, image_masks = policy.prepare_images(inputs)
    tokens, words = _pad(inputs[OBS_LANGUAGE_TOKENS], length), _pad(inputs[OBS_LANGUAGE_ATTENTION_MASK], length)
    embedded, real, blocks = policy.model.embed_prefix(images, image_masks, tokens, words, policy.prepare_state(inputs))
    _, cache = policy.model.vlm_with_expert.forward(
        attention_mask=make_att_2d_masks(real, blocks), position_ids=torch.cumsum(real, dim=1) - 1,
        inputs_embeds=[embedded, None], use_cache=True,
    )  # fmt: skip
    return torch.stack([torch.stack([layer.keys, layer.values], 1) for layer in cache.layers], 1), real


def _pad(tokens: torch.Tensor, length: int) -> torch.Tensor:
    return torch.nn.functional.pad(tokens, (0, max(0, length - tokens.shape[1])))


def _fingerprint(bundle: Bundle, store: FrameStore, rows: np.ndarray) -> str:
    """Hash of all that prefixes depend on: weights before the expert, statistics, the data set as decoded, its rows."""
    weights = {n: p.detach().contiguous().cpu() for n, p in bundle.policy.named_parameters() if n.startswith(BEFORE)}
    digest = hashlib.sha256(save(weights))
    for step in bundle.preprocess.steps:
        for name, value in sorted(step.state_dict().items()):
            digest.update(name.encode() + value.cpu().numpy().tobytes())
    digest.update(f"{store.root}|{store.key}|{len(store.states)}".encode() + store.states.tobytes() + rows.tobytes())
    digest.update("|".join(store.episodes.instruction).encode())
    return digest.hexdigest()[:16]
