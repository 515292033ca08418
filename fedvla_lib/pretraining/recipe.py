"""The settings that decide the nano base."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Recipe:
    """What decides the nano base; the defaults made the one that comes with the package."""

    scenes: int = 10_000  # rendered scenes to learn from what words mean
    unseen_scenes: int = 500  # further ones, on which pointing is measured
    grounding_steps: int = 2500  # optimiser steps on them, of the vision-language part
    steps: int = 5000  # optimiser steps of the action expert
    episodes_per_task: int = 150  # demonstrations of each pretraining task
    image_size: int = 96  # side of the square camera images in pixels
    batch_size: int = 32  # scenes or samples per optimiser step
    lr: float = 1e-3  # peak learning rate of AdamW
    jitter: float = 1.0  # spread of cameras, light and colours from scene to scene
    rollouts: int = 50  # attempts at each task when the base is measured
    checkpoint_every: int = 500  # steps between checkpoints
    num_threads: int = 1  # torch threads
    seed: int = 7_000_000  # fixes all of it; far from the seeds of runs
