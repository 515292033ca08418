"""Tables of the model: parameters of its parts, learning rates, and the error of averaging LoRA adapters."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from fedvla_lib.config import Config

if TYPE_CHECKING:  # loads torch, which tables of stored results do without
    from lerobot.policies.smolvla import SmolVLAPolicy

    from fedvla_lib.policy.model import Bundle

MODULES = {
    "model.vlm_with_expert.vlm.model.vision_model": "vision encoder",
    "model.vlm_with_expert.vlm.model.connector": "connector (pixel shuffle + projection)",
    "model.vlm_with_expert.vlm.model.text_model": "language model",
    "model.vlm_with_expert.vlm.lm_head": "language head (unused by the policy)",
    "model.vlm_with_expert.lm_expert": "action expert",
    "model.state_proj": "state projection",
    "model.action_in_proj": "action input projection",
    "model.action_out_proj": "action output projection",
    "model.action_time_mlp": "action-time MLP",
}


def module_table(policy: "SmolVLAPolicy") -> list[dict[str, Any]]:
    """Return one row per part of the model: module, its plain name, parameters and trainable parameters."""
    rows = []
    for prefix, part in MODULES.items():
        sizes = {p: p.numel() for name, p in policy.named_parameters() if name.startswith(prefix)}
        trained = sum(size for p, size in sizes.items() if p.requires_grad)
        rows.append({"module": prefix, "part": part, "parameters": sum(sizes.values()), "trainable": trained})
    return rows


def learning_rates(bundle: "Bundle", config: Config, *, steps: int) -> list[float]:
    """Return the learning rate of each of `steps` gradient steps."""
    from fedvla_lib.policy.optimizers import adamw  # loads torch

    _, scheduler = adamw(bundle, config, 0, steps)
    return [config.lr * scheduler.lr_lambdas[0](step) for step in range(steps)]


def adapters(policy: "SmolVLAPolicy") -> dict[str, np.ndarray]:
    """Return all A and B matrices of a policy by name, float32, including frozen ones."""
    from fedvla_lib.policy.lora import A, B  # loads torch

    return {name: p.detach().cpu().numpy().copy() for name, p in policy.named_parameters() if name.endswith((A, B))}


def averaging_error(updates: Sequence[Mapping[str, np.ndarray]], weights: Sequence[float]) -> dict[str, float]:
    """Return, for each adapted matrix, the relative error of averaging A and B separately.

    Args:
        updates: adapters of each client by name.
        weights: of the clients, summing to 1.

    Returns:
        ||sum_k p_k B_k A_k - (sum_k p_k B_k)(sum_k p_k A_k)|| / ||sum_k p_k B_k A_k||, Frobenius norms, by name.
    """
    from fedvla_lib.policy.lora import A, B  # loads torch

    errors = {}
    for name in [key.removesuffix(B) for key in updates[0] if key.endswith(B)]:
        pairs = [(update[name + B].astype(float), update[name + A].astype(float)) for update in updates]
        exact = sum(p * b @ a for p, (b, a) in zip(weights, pairs, strict=True))
        averaged = [sum(p * pair[i] for p, pair in zip(weights, pairs, strict=True)) for i in (0, 1)]
        errors[name] = float(np.linalg.norm(exact - averaged[0] @ averaged[1]) / max(np.linalg.norm(exact), 1e-30))
    return errors
