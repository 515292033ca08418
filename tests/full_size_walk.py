"""Walk through what a lab does with the profile `gpu`, with random weights, and print seconds and memory of each step.

python tests/full_size_walk.py DEVICE FOLDER

$HF_HOME/hub holds what `full_size.write_hub` writes, and $HF_HUB_OFFLINE is 1. A federation of one client runs one
round with each kind of training: load, train one step on a batch of one sample, exchange and check, average, save.
LeRobot then loads the saved model and predicts a chunk of actions.
"""

import resource
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies import make_pre_post_processors
from lerobot.policies.smolvla import SmolVLAPolicy

from fedvla_book.full_size import BACKBONE
from fedvla_lib import run_folder
from fedvla_lib.config import Config, from_profile
from fedvla_lib.data.batches import batch_of_rows
from fedvla_lib.data.frame_store import open_store
from fedvla_lib.data.record import record
from fedvla_lib.engines import inline
from fedvla_lib.run_folder import GLOBAL

KINDS = {"expert": {}, "LoRA": {"lora_rank": 16, "gradient_checkpointing": True}}


@contextmanager
def measured(what: str, device: str) -> Iterator[None]:
    """Print the seconds of a step, and the most memory so far."""
    began = time.perf_counter()
    yield
    gib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    card = f", {torch.cuda.max_memory_allocated() / 2**30:.1f} GiB on the card" if device != "cpu" else ""
    print(f"{what}: {time.perf_counter() - began:.0f} s, {gib:.1f} GiB{card}", flush=True)


def settings(device: str, folder: Path, **kind: object) -> Config:
    """The profile, on one episode and for one step of one sample; a CPU computes bfloat16 many times more slowly."""
    return from_profile(
        "gpu", device=device, mixed_precision=device != "cpu", batch_size=1, data=str(folder / "data"), num_clients=1,
        num_server_rounds=1, local_steps=1, warmup_steps=0, val_fraction=0.0, eval_rollouts=0, client_rollouts=0,
        fraction_evaluate=0.0, out=str(folder / "runs"), **kind,
    )  # fmt: skip


def predict(saved: Path, config: Config) -> torch.Tensor:
    """Return the chunk that LeRobot's policy, loaded by LeRobot, predicts for the first frame, in degrees.

    As saved, LeRobot would load the backbone's own weights first, to overwrite them: without them, its types differ.
    """
    chosen = PreTrainedConfig.from_pretrained(saved)
    assert chosen.load_vlm_weights and chosen.vlm_model_name == BACKBONE
    chosen.load_vlm_weights, chosen.device = False, config.device
    policy = SmolVLAPolicy.from_pretrained(saved, config=chosen).float().eval()
    before, after = make_pre_post_processors(
        chosen, pretrained_path=str(saved), preprocessor_overrides={"device_processor": {"device": config.device}}
    )
    store = open_store(config.data, image_size=config.image_size, progress=False)
    frame = batch_of_rows(store, [0], config.chunk_size)
    with torch.no_grad():
        return after(policy.predict_action_chunk(before(frame)))


def main(device: str, folder: Path) -> None:
    """Walk, and end with an AssertionError where a step gives what it must not."""
    record(["lift"], 1, folder / "data", image_size=224, progress=False)
    for name, kind in KINDS.items():
        config = settings(device, folder, **kind)
        with measured(f"{name}: a round", device):
            root = inline.run_inline(config, progress=False, raise_errors=True)
        trained = run_folder.read_metrics(root, "train")
        replies = run_folder.read_metrics(root, "replies").query("to == 'train'").iloc[0]
        print(f"{name}: step {trained.seconds[0]:.0f} s, {replies.received_bytes / 1e6:.1f} MB sent, "
              f"loss {trained.loss[0]:.2f}", flush=True)  # fmt: skip
        moved = run_folder.read_metrics(root, "drift").query(f"who != {GLOBAL!r}")["norm.all"].iloc[0]
        assert trained.loss[0] > 0 < moved and run_folder.read_metrics(root, "rejected").empty
    with measured("LeRobot: load and predict", device):
        chunk = predict(root / "global_model" / "round_1", config)
    assert chunk.shape == (1, 50, 6) and torch.isfinite(chunk).all()
    print("walked", flush=True)


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))
