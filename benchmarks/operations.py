"""Floating-point operations of a full-size training step, counted without computing them, and the numbers it trains.

PyTorch's meta device runs LeRobot's policy without memory or arithmetic; what counts is the same on every machine.

    python benchmarks/operations.py
"""

import torch
from torch.fx.experimental import _config as tracing
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import FlopCounterMode

from fedvla_book import full_size
from fedvla_lib.config import PROFILES
from fedvla_lib.policy import lora
from fedvla_lib.policy.parameters import trainable
from fedvla_lib.robot.spec import CAMERAS
from report import options, report, start

RANK, WORDS = 16, 48  # of the adapters; tokens of an instruction, padded


class NothingPadded(TorchDispatchMode):
    """Answers whether all of an image is real, which the meta device cannot know: it is."""

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        """Run an operation, or say yes where it would read a value."""
        if func is torch.ops.aten._local_scalar_dense.default and args[0].is_meta:
            return 1
        return func(*args, **(kwargs or {}))


def main() -> None:
    """Count and report."""
    chosen = options(__doc__.splitlines()[0]).parse_args()
    rows = []
    for kind in ("all weights", "action expert", f"LoRA, rank {RANK}"):
        policy = made(kind)
        sizes = {"parameters": sum(p.numel() for p in policy.parameters())}
        sizes["trained"] = sum(p.numel() for p in trainable(policy).values())
        rows.append({"what trains": kind, **sizes, **operations(policy)})
    report("operations", rows, chosen.out)


def made(kind: str) -> torch.nn.Module:
    """Return the policy on the meta device with its trainable parameters chosen."""
    policy = full_size.meta_policy()
    if kind == "all weights":
        joint = policy.model.vlm_with_expert
        joint.train_expert_only = joint.freeze_vision_encoder = False
        policy.requires_grad_(True)
        joint.set_requires_grad()
    if kind.startswith("LoRA"):
        with torch.device("meta"):
            lora.add_adapters(policy, RANK, adapt_state=True)
    return policy.train()


def operations(policy: torch.nn.Module) -> dict[str, float]:
    """Count the matrix products of one sample: two images, an instruction, a state and a chunk of the profile gpu."""
    settings, chunk = policy.config, PROFILES["gpu"]["chunk_size"]
    tracing.meta_nonzero_assume_all_nonzero = True  # of masks: nothing is padded
    with torch.device("meta"), NothingPadded(), FlopCounterMode(display=False) as counter:
        images = [torch.zeros(1, 3, full_size.IMAGE_SIZE, full_size.IMAGE_SIZE)] * len(CAMERAS)
        present = [torch.ones(1, dtype=torch.bool)] * len(CAMERAS)
        words, real = torch.zeros(1, WORDS, dtype=torch.long), torch.ones(1, WORDS, dtype=torch.bool)
        state, actions = torch.zeros(1, settings.max_state_dim), torch.zeros(1, chunk, settings.max_action_dim)
        loss = policy.model.forward(images, present, words, real, state, actions, actions, torch.zeros(1)).mean()
        forward = counter.get_total_flops()
        loss.backward()
    return {"forward [G]": forward / 1e9, "step [G]": counter.get_total_flops() / 1e9}


if __name__ == "__main__":
    start(main)
