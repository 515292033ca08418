"""Cache the prefix of each frame under a frozen vision-language model, and train the action expert on the cache.

SmolVLA's prefix (images, instruction, state) does not attend to the actions that follow it. If everything that makes
the prefix is frozen and images are not augmented, its keys and values are constant for a frame: they are computed once
with the policy's own methods and stored in a memory-mapped file, and a gradient step runs the expert only. The loss and
its gradients equal those of `SmolVLAPolicy.forward`.
"""

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
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
BATCH = 64  # frames per forward pass while filling the store


@dataclass(frozen=True)
class PrefixStore:
    """Keys and values of all frames of a data set under one frozen model."""

    cache: np.ndarray  # float32 (N, layers, 2, kv heads, prefix length, head dim): keys, then values
    real: np.ndarray  # bool (N, prefix length): False where the instruction is padded

    def rows(self, rows: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
        """Return keys and values, and the mask, of frames `rows`."""
        return torch.from_numpy(self.cache[rows]), torch.from_numpy(self.real[rows])


class PrefixBatches:
    """The same training batches with stored prefixes in place of images."""

    def __init__(self, batches: Batches, prefixes: PrefixStore) -> None:
        self._batches, self._prefixes = batches, prefixes
        self.seed, self.num_examples = batches.seed, batches.num_examples

    def at(self, step: int) -> dict[str, Any]:
        """Return the batch of a gradient step: targets in degrees, padding mask, task and prefix."""
        rows = self._batches.rows_at(step)
        targets = targets_of_rows(self._batches.store, rows, self._batches.chunk_size)
        return targets | {PREFIX_KEY: self._prefixes.rows(rows)}


def with_cached_prefixes(bundle: Bundle, batches: Batches, progress: bool = False) -> Batches | PrefixBatches:
    """Return the same training batches with stored prefixes if prefixes are constant, else `batches` itself."""
    if batches.augment or not is_constant(bundle.policy):
        return batches
    return PrefixBatches(batches, ensure_prefixes(bundle, batches.store, cache_dir() / "prefixes", progress))


def is_constant(policy: SmolVLAPolicy) -> bool:
    """Return whether training leaves prefixes unchanged."""
    settings = policy.config
    return settings.freeze_vision_encoder and settings.train_expert_only and not settings.train_state_proj


def prefix_loss(bundle: Bundle, batch: dict[str, Any], noise: torch.Tensor, times: torch.Tensor) -> torch.Tensor:
    """Return the flow-matching loss of a batch with stored prefix: mean of (v - (noise - action))^2 over real actions.

    Args:
        noise: float32 (B, chunk, max_action_dim), x_1 of the flow.
        times: float32 (B,), t in (0, 1); the expert sees x_t = t noise + (1 - t) action.
    """
    policy, width = bundle.policy, bundle.policy.config.action_feature.shape[0]
    stored, real = (part.to(noise.device) for part in batch[PREFIX_KEY])
    actions = policy.prepare_action({ACTION_KEY: bundle.normalise_actions(batch[ACTION_KEY])})  # padded like the noise
    mixed = times[:, None, None] * noise + (1 - times[:, None, None]) * actions
    if bundle.is_lean:
        velocity = lean_expert.velocity(policy, stored, real, mixed, times)
    else:
        velocity = policy.model.denoise_step(real, _as_cache(stored), mixed, times)[..., :width]
    squared = ((noise - actions)[..., :width] - velocity).square()
    valid = ~batch["action_is_pad"].to(noise.device)
    return (squared * valid[..., None]).sum() / (valid.sum() * width).clamp_min(1)


def ensure_prefixes(bundle: Bundle, store: FrameStore, folder: Path, progress: bool = True) -> PrefixStore:
    """Return the prefixes of all frames of `store` under this model, computing them into `folder` if needed."""
    target = folder / _fingerprint(bundle, store)
    if not target.is_dir():
        _fill(bundle, store, target, progress)
    return PrefixStore(np.load(target / "cache.npy", mmap_mode="r"), np.load(target / "real.npy"))


@torch.no_grad()
def _fill(bundle: Bundle, store: FrameStore, target: Path, progress: bool) -> None:
    count, length, cache = len(store.states), _longest(bundle, store), None
    real = []
    with new_folder(target) as draft:
        for start in tqdm(range(0, count, BATCH), desc="frozen prefixes", disable=not progress):
            rows = np.arange(start, min(start + BATCH, count))
            stored, mask = prefill(bundle, batch_of_rows(store, rows, bundle.policy.config.chunk_size), length)
            if cache is None:
                file, shape = draft / "cache.npy", (count, *stored.shape[1:])
                cache = np.lib.format.open_memmap(file, mode="w+", dtype=np.float32, shape=shape)
            cache[rows] = stored.cpu().numpy()
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


def _as_cache(stored: torch.Tensor) -> DynamicCache:
    cache = DynamicCache()
    for layer in range(stored.shape[1]):
        cache.update(stored[:, layer, 0], stored[:, layer, 1], layer)
    return cache


def _pad(tokens: torch.Tensor, length: int) -> torch.Tensor:
    return torch.nn.functional.pad(tokens, (0, max(0, length - tokens.shape[1])))


def _longest(bundle: Bundle, store: FrameStore) -> int:
    """Number of tokens of the longest instruction in the data set."""
    first = store.episodes.drop_duplicates("instruction").start.to_numpy()
    return bundle.preprocess(batch_of_rows(store, first, bundle.policy.config.chunk_size))[OBS_LANGUAGE_TOKENS].shape[1]


def _fingerprint(bundle: Bundle, store: FrameStore) -> str:
    """Hash of everything that prefixes depend on: frozen weights, statistics and the data set."""
    frozen = {n: p.detach().contiguous().cpu() for n, p in bundle.policy.named_parameters() if not p.requires_grad}
    digest = hashlib.sha256(save(frozen))
    for step in bundle.preprocess.steps:
        for name, value in sorted(step.state_dict().items()):
            digest.update(name.encode() + value.cpu().numpy().tobytes())
    digest.update(f"{store.root}|{len(store.states)}".encode() + np.ascontiguousarray(store.states).tobytes())
    digest.update("|".join(store.episodes.instruction).encode())
    return digest.hexdigest()[:16]
