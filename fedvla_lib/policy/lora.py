"""LoRA: train two thin matrices beside each large one (Hu et al. 2022, https://arxiv.org/abs/2106.09685).

A weight W becomes W + (alpha / r) B A with A (r, in) and B (out, r). Only A and B train and travel. Averaging them
apart is not averaging what they do, since the mean of products is not the product of means; with A frozen and the same
everywhere it is (FFA-LoRA: Sun et al. 2024, https://arxiv.org/abs/2403.12313).
"""

import copy
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from peft import LoraConfig, inject_adapter_in_model
from peft.tuners.lora import LoraLayer

from fedvla_lib.policy.parameters import Arrays

EXPERT = r"vlm_with_expert\.lm_expert\..*\.(q|v)_proj"
AROUND = "action_in_proj|action_out_proj|action_time_mlp_in|action_time_mlp_out"
A, B = ".lora_A.default.weight", ".lora_B.default.weight"


def add_adapters(
    policy: torch.nn.Module, rank: int, *, freeze_a: bool = False, adapt_state: bool = False, seed: int = 0
) -> None:
    """Put adapters of this rank into the policy, in place; they alone train, and at first they change nothing.

    The matrices are those that LeRobot adapts by default: queries and values of the expert, and the projections.

    Args:
        freeze_a: train B only.
        adapt_state: adapt the projection of the state as well; without, a frame's prefix stays constant.
        seed: fixes A, which has to be the same on every client.
    """
    targets = rf"model\.({EXPERT}|{AROUND}{'|state_proj' if adapt_state else ''})"
    settings = LoraConfig(r=rank, lora_alpha=rank, target_modules=targets)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        inject_adapter_in_model(settings, policy)
    for name, parameter in policy.named_parameters():
        parameter.requires_grad_(name.endswith(B) or (name.endswith(A) and not freeze_a))


def merged(policy: torch.nn.Module) -> torch.nn.Module:
    """Return a copy of the policy whose adapters are added into its weights; the policy itself if it has none."""
    if not any(isinstance(module, LoraLayer) for module in policy.modules()):
        return policy
    whole = copy.deepcopy(policy)
    for name, module in list(whole.named_modules()):
        if isinstance(module, LoraLayer):
            module.merge()
            parent, _, child = name.rpartition(".")
            setattr(whole.get_submodule(parent), child, module.get_base_layer())
    return whole


def averaging_error(updates: Sequence[Mapping[str, np.ndarray]], weights: Sequence[float]) -> dict[str, float]:
    """Return, for each adapted matrix, how wrong it is to average A and B apart.

    Args:
        updates: adapters of each client by name, as they travel.
        weights: of the clients, summing to 1.

    Returns:
        ||sum_k p_k B_k A_k - (sum_k p_k B_k)(sum_k p_k A_k)|| / ||sum_k p_k B_k A_k||, Frobenius norms, by name.
    """
    found = {}
    for name in [key.removesuffix(B) for key in updates[0] if key.endswith(B)]:
        pairs = [(update[name + B].astype(float), update[name + A].astype(float)) for update in updates]
        right = sum(p * b @ a for p, (b, a) in zip(weights, pairs, strict=True))
        apart = [sum(p * pair[i] for p, pair in zip(weights, pairs, strict=True)) for i in (0, 1)]
        found[name] = float(np.linalg.norm(right - apart[0] @ apart[1]) / max(np.linalg.norm(right), 1e-30))
    return found


def adapters(policy: torch.nn.Module) -> Arrays:
    """Return all A and B of a policy by name, float32, whether they train or not."""
    return {name: p.detach().cpu().numpy().copy() for name, p in policy.named_parameters() if name.endswith((A, B))}
