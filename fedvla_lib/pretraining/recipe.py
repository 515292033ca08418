"""Settings of the nano base's pretraining."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Recipe:
    """Settings of pretraining; the defaults made the base in this package. Comments are the help texts of flags."""

    scenes: int = 10_000  # rendered scenes for phrase grounding
    unseen_scenes: int = 500  # further scenes on which the pointing error is measured
    grounding_steps: int = 2500  # gradient steps of the vision-language part on the scenes
    steps: int = 5000  # gradient steps of the action expert
    episodes_per_task: int = 150  # demonstrations recorded per pretraining task
    image_size: int = 96  # side length of the square camera images, in pixels
    batch_size: int = 32  # scenes or samples per gradient step
    lr: float = 1e-3  # peak learning rate of AdamW
    jitter: float = 1.0  # scale of the variation of cameras, light and colours between scenes
    rollouts: int = 50  # rollouts per task in the final evaluation
    checkpoint_every: int = 500  # gradient steps between checkpoints
    num_threads: int = 1  # torch threads
    seed: int = 7_000_000  # seed of everything; far from the seeds of runs
