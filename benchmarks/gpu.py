"""A full-size training step on a card: time, memory and bytes, for all weights, the action expert and LoRA.

    python benchmarks/gpu.py --batch 8

Without a CUDA device it says so and ends. The weights are random, which costs the same; nothing is downloaded.
"""

import tempfile
from pathlib import Path

import numpy as np
import torch

from fedvla_book import full_size
from fedvla_lib.config import from_profile
from fedvla_lib.data import normalisation
from fedvla_lib.data.batches import Batches
from fedvla_lib.data.frame_store import FrameStore, open_store
from fedvla_lib.data.record import record
from fedvla_lib.policy import model
from fedvla_lib.policy.training import local_train
from report import median_seconds, options, report, start

KINDS = {
    "all weights": {"train_expert_only": False, "freeze_vision_encoder": False},
    "action expert": {},
    "LoRA, rank 16": {"lora_rank": 16},
}
STEPS = 5  # gradient steps per measurement


def main() -> None:
    """Measure and report."""
    parser = options(__doc__.splitlines()[0])
    parser.add_argument("--batch", type=int, default=8, help="samples of a gradient step")
    chosen = parser.parse_args()
    if not torch.cuda.is_available():
        print("no card: PyTorch finds no CUDA device, so there is nothing to measure")
        return
    with tempfile.TemporaryDirectory() as name:
        base = str(full_size.write_folder(Path(name) / "base"))
        store = open_store(record(["lift"], 1, Path(name) / "data", image_size=224, progress=False), image_size=224)
        rows = [
            measure(kind, store, chosen.batch, chosen.repeats, base=base, gradient_checkpointing=saving)
            for kind in KINDS
            for saving in (False, True)
        ]
    report("gpu", rows, chosen.out)


def measure(kind: str, store: FrameStore, batch: int, repeats: int, **settings: object) -> dict[str, object]:
    """Train for a few steps with the settings of the profile; a row of what they cost."""
    config = from_profile("gpu", batch_size=batch, **KINDS[kind], **settings)
    bundle = model.load_policy(config, normalisation.episode_stats(store, [0]))
    batches = Batches(store, [0], config.chunk_size, batch, seed=0, augment=config.augment)
    torch.cuda.reset_peak_memory_stats()
    took_s = median_seconds(lambda: local_train(bundle, batches, config, steps=STEPS, progress=False), repeats) / STEPS
    return {
        "what trains": kind, "gradient checkpointing": config.gradient_checkpointing, "batch": batch,
        "card": torch.cuda.get_device_name(), "step [s]": took_s,
        "peak memory [GB]": torch.cuda.max_memory_allocated() / 1e9,
        "update [MB]": sum(np.prod(array.shape) * 4 for array in bundle.shared_arrays().values()) / 1e6,
    }  # fmt: skip


if __name__ == "__main__":
    start(main)
