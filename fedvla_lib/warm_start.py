"""The warm start: a nano SmolVLA that has learned one task on this machine, for the federation to begin with.

Averaging helps little while every client still learns to see. So the server first trains the nano model, all of it, on
demonstrations of one task that it recorded itself; the federation then freezes the vision-language part, as SmolVLA's
recipe does, and trains the action expert. ``base = "nano-warm"`` names this model; it is made once and cached.
"""

import hashlib
import json
from dataclasses import replace
from pathlib import Path

from filelock import FileLock
from safetensors.numpy import load_file

from fedvla_lib import data, model
from fedvla_lib.config import Config, cache_dir, code_digest
from fedvla_lib.params import load_arrays
from fedvla_lib.train import WEIGHTS_FILE, TrainResult, local_train

WARM_BASE = "nano-warm"
TASK = "lift"
RECORDING_SEED = 500_000  # the server's demonstrations are none of the clients'
TRAINED_BY = (*data.RECORDED_BY, "source", "store", "data", "nano", "model", "train", "warm_start")  # code that decides
# What the trained weights depend on: federations that differ in other settings begin with the same warm start.
SETTINGS = (
    "image_size", "val_fraction", "chunk_size", "batch_size", "warmup_steps", "warm_steps", "warm_episodes", "warm_lr",
    "seed",
)  # fmt: skip


def recipe(config: Config) -> Config:
    """Return the settings the warm start is trained with: random weights, everything trainable, one task."""
    return replace(
        config,
        base="nano",
        data="",
        tasks=TASK,
        seed=RECORDING_SEED + config.seed,
        freeze_vision_encoder=False,
        train_expert_only=False,
        train_state_proj=True,
        augment=True,
        lr=config.warm_lr,
        local_steps=config.warm_steps,
        episodes_per_task=config.warm_episodes,
    )


def folder_of(config: Config) -> Path:
    """Return where the warm start of these settings is kept: a ``pretrained_model`` folder, if it exists."""
    settings = {name: getattr(config, name) for name in SETTINGS} | {"code": code_digest(*TRAINED_BY)}
    key = hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:12]
    return cache_dir() / f"nano-warm-{key}"


def checkpoints_of(config: Config) -> Path:
    """Return where the training leaves its checkpoints; they stay, so that its course can be looked at later."""
    return folder_of(config).with_name(folder_of(config).name + "-checkpoints")


def resolve(config: Config) -> Config:
    """Return `config` with ``base = "nano-warm"`` replaced by its folder, trained now if it is not there yet."""
    if config.base != WARM_BASE:
        return config
    folder = folder_of(config)
    if not folder.exists():
        keep(train(config)[0], config)
    return replace(config, base=str(folder))


def prepare(config: Config) -> tuple[model.Bundle, data.Batches]:
    """Return what the training starts from: the nano model with random weights, and its batches."""
    settings = recipe(config)
    store = data.open_store(data.resolve(settings), image_size=settings.image_size)
    train_ids, _ = data.split(store, settings.val_fraction, settings.seed)
    batches = data.Batches(
        store, train_ids, settings.chunk_size, settings.batch_size, seed=settings.seed, augment=settings.augment
    )
    return model.load_policy(settings, data.episode_stats(store, train_ids)), batches


def train(config: Config, progress: bool = True) -> tuple[model.Bundle, TrainResult]:
    """Train the warm start; an interrupted training goes on from its last checkpoint, a finished one is loaded."""
    settings = recipe(config)
    bundle, batches = prepare(config)
    checkpoints = checkpoints_of(config)
    checkpoints.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(checkpoints.with_suffix(".lock")):  # the second of two processes finds what the first has trained
        result = local_train(
            bundle,
            batches,
            settings,
            steps=settings.local_steps,
            checkpoint_dir=checkpoints,
            resume=True,
            progress=progress,
        )
    return bundle, result


def kept_steps(config: Config) -> list[int]:
    """Return the steps of the training whose weights are kept, in order; none before it has begun."""
    return sorted(int(folder.name.removeprefix("step_")) for folder in checkpoints_of(config).glob("step_*"))


def at_step(config: Config, step: int) -> model.Bundle:
    """Return the model as it was after `step` steps of its training.

    Raises:
        ValueError: no weights are kept of that step; the message lists those there are.
    """
    if step not in kept_steps(config):
        raise ValueError(f"no weights of step {step} in {checkpoints_of(config)}: choose one of {kept_steps(config)}")
    bundle, _ = prepare(config)
    load_arrays(bundle.policy, load_file(checkpoints_of(config) / f"step_{step:06d}" / WEIGHTS_FILE))
    return bundle


def keep(bundle: model.Bundle, config: Config) -> Path:
    """Put a trained warm start in its place for whoever begins with it; one that is there already stays."""
    folder = folder_of(config)
    if not folder.exists():
        model.save_policy(bundle, folder)
    return folder
