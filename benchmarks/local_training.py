"""Local training of a frozen nano model: stored prefixes against LeRobot's data set, DataLoader and policy.

Both sides see the same frames in the same order and draw the same noise, so their losses must agree step by step.

    python benchmarks/local_training.py
"""

import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from lerobot.datasets import LeRobotDataset

from fedvla_lib.config import Config
from fedvla_lib.data import normalisation
from fedvla_lib.data.batches import Batches
from fedvla_lib.data.episode_writer import REPO_ID
from fedvla_lib.data.frame_store import FrameStore
from fedvla_lib.policy import model, prefix_cache
from fedvla_lib.policy.optimizers import adamw
from fedvla_lib.robot.spec import ACTION_KEY, FPS
from report import laptop, options, recording, report, start, timed

WARM_UP = 5  # steps: memory is allocated, and workers start


def main() -> None:
    """Measure and report."""
    parser = options(__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=40, help="gradient steps measured on each side")
    parser.add_argument("--workers", type=int, nargs="+", default=[0, 1, 2], help="DataLoader workers to try")
    chosen = parser.parse_args()
    config = laptop(chosen.profile)
    torch.set_num_threads(1)
    store = recording(config)
    episodes = list(store.episodes.episode_id)
    batches = Batches(store, episodes, config.chunk_size, config.batch_size, seed=1)
    stats = normalisation.episode_stats(store, episodes)

    ours = model.load_policy(config, stats)
    with tempfile.TemporaryDirectory() as fresh:  # without the cache of earlier runs
        stored_s = timed(lambda: prefix_cache.ensure_prefixes(ours, store, folder=Path(fresh)))
    supply = prefix_cache.with_cached_prefixes(ours, batches)
    our_losses, our_s = train(ours, config, (supply.at(step) for step in range(chosen.steps)), chosen.steps, fused=True)
    samples = chosen.steps * config.batch_size
    rows = []
    for workers in chosen.workers:
        theirs = model.load_policy(config, stats)
        loader = lerobot_batches(store, batches, chosen.steps, workers)
        their_losses, their_s = train(theirs, config, iter(loader), chosen.steps)
        rows.append(
            {
                "lerobot workers": workers,
                "ours [samples/s]": samples / our_s,
                "lerobot [samples/s]": samples / their_s,
                "ratio": their_s / our_s,
                "largest loss difference": float(np.abs(np.subtract(our_losses, their_losses)).max()),
                "storing the prefixes once [s]": stored_s,
                "frames": store.num_frames,
            }
        )
    report("local_training", rows, chosen.out)


def train(
    bundle: model.Bundle, config: Config, batches: Iterator[dict], steps: int, fused: bool | None = None
) -> tuple[list[float], float]:
    """Train with the same noise on both sides; return losses and seconds, with the first steps (warm-up)
    counted as average ones."""
    optimizer, scheduler = adamw(bundle, config, 0, 1000)
    optimizer.param_groups[0]["fused"] = fused  # None: PyTorch's default, which LeRobot leaves as it is
    trainable = [p for p in bundle.policy.parameters() if p.requires_grad]
    bundle.policy.train()
    losses: list[float] = []
    seconds = [
        timed(lambda: losses.append(one_step(bundle, next(batches), trainable, (optimizer, scheduler), len(losses))))
        for _ in range(steps)
    ]
    return losses, sum(seconds[WARM_UP:]) * steps / (steps - WARM_UP)


def one_step(bundle: model.Bundle, batch: dict, trainable: list, optimizer: tuple, step: int) -> float:
    """Take one gradient step on a raw batch, with or without a cached prefix; return its loss."""
    generator = torch.Generator().manual_seed(step)
    settings = bundle.policy.config
    noise = torch.randn((len(batch["task"]), settings.chunk_size, settings.max_action_dim), generator=generator)
    times = torch.rand(len(noise), generator=generator)
    if prefix_cache.PREFIX_KEY in batch:
        loss = prefix_cache.prefix_loss(bundle, batch, noise, times)
    else:
        loss = bundle.policy.forward(bundle.preprocess(batch), noise=noise, time=times)[0]
    optimizer[0].zero_grad(set_to_none=True)
    loss.backward()
    torch.nn.utils.clip_grad_norm_(trainable, settings.optimizer_grad_clip_norm)
    for part in optimizer:  # and its schedule
        part.step()
    return loss.item()


def lerobot_batches(store: FrameStore, batches: Batches, steps: int, workers: int) -> torch.utils.data.DataLoader:
    """Return LeRobot's loader of the same batches, which decodes frames on access."""
    chunk = [step / FPS for step in range(batches.chunk_size)]
    dataset = LeRobotDataset(REPO_ID, root=store.root, delta_timestamps={ACTION_KEY: chunk}, video_backend="pyav")
    order = [batches.rows_at(step).tolist() for step in range(steps)]
    return torch.utils.data.DataLoader(dataset, batch_sampler=order, num_workers=workers)


if __name__ == "__main__":
    start(main)
