"""Gradient checkpointing (Chen et al. 2016, https://arxiv.org/abs/1604.06174): compute again what would take memory.

LeRobot's policy calls the parts of its layers itself, so that the switch of Transformers does not reach them.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch.utils.checkpoint import checkpoint


def recompute_activations(policy: torch.nn.Module) -> None:
    """Let the policy keep only the inputs of its attention and feed-forward layers for the backward pass, in place.

    Losses and gradients stay the same. The vision encoder is included if it is trained.
    """
    joint = policy.model.vlm_with_expert
    vlm = joint.get_vlm_model()
    if any(parameter.requires_grad for parameter in vlm.vision_model.parameters()):
        # Of a frozen encoder, Transformers would make the inputs ask for gradients and keep all that it computes.
        vlm.vision_model.gradient_checkpointing_enable({"use_reentrant": False})
    for method in ("forward_attn_layer", "forward_cross_attn_layer"):
        setattr(joint, method, partial(_again, getattr(joint, method)))
    for layer in (*vlm.text_model.layers, *joint.lm_expert.layers):
        layer.mlp.forward = partial(_again, layer.mlp.forward)


def _again(compute: Callable[..., Any], *inputs: Any, **named: Any) -> Any:
    """Call `compute`, which the backward pass will call again with the same inputs, if there will be one."""
    if not torch.is_grad_enabled():
        return compute(*inputs, **named)
    return checkpoint(compute, *inputs, use_reentrant=False, **named)
