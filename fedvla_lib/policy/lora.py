"""LoRA: train two low-rank matrices per weight matrix (Hu et al. 2022, https://arxiv.org/abs/2106.09685).

A weight W becomes W + (alpha / r) B A with A (r, in) and B (out, r); only A and B are trained and exchanged. Averaging
A and B separately does not average the products B A, unless A is frozen and the same on all clients (FFA-LoRA: Sun et
al. 2024, https://arxiv.org/abs/2403.12313).
"""

import copy

import torch
from peft import LoraConfig, inject_adapter_in_model
from peft.tuners.lora import LoraLayer

EXPERT = r"vlm_with_expert\.lm_expert\..*\.(q|v)_proj"
PROJECTIONS = "action_in_proj|action_out_proj|action_time_mlp_in|action_time_mlp_out"
A, B = ".lora_A.default.weight", ".lora_B.default.weight"


def add_adapters(
    policy: torch.nn.Module, rank: int, *, freeze_a: bool = False, adapt_state: bool = False, seed: int = 0
) -> None:
    """Add adapters of this rank to the policy in place and make them its only trainable parameters.

    They adapt LeRobot's default targets: the expert's query and value matrices and the projections. B starts at zero,
    so the policy's output does not change at first.

    Args:
        freeze_a: train B only.
        adapt_state: also adapt the state projection; otherwise the prefix of a frame stays constant.
        seed: seed of A, which must be the same on every client.
    """
    targets = rf"model\.({EXPERT}|{PROJECTIONS}{'|state_proj' if adapt_state else ''})"
    settings = LoraConfig(r=rank, lora_alpha=rank, target_modules=targets)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        inject_adapter_in_model(settings, policy)
    for name, parameter in policy.named_parameters():
        parameter.requires_grad_(name.endswith(B) or (name.endswith(A) and not freeze_a))


def merged(policy: torch.nn.Module) -> torch.nn.Module:
    """Return a copy of the policy with its adapters merged into the weights; the policy itself if it has none."""
    if not any(isinstance(module, LoraLayer) for module in policy.modules()):
        return policy
    result = copy.deepcopy(policy)
    for name, module in list(result.named_modules()):
        if isinstance(module, LoraLayer):
            module.merge()
            parent, _, child = name.rpartition(".")
            setattr(result.get_submodule(parent), child, module.get_base_layer())
    return result
