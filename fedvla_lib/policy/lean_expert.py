"""The action expert's pass over stored prefixes, written again with few operations.

`SmolVLAPolicy` makes rotary tables, masks and positions anew in every layer, repeats keys for each query of a group and
lets autograd record thousands of small operations. Here tables and masks are made once for a batch, queries that share
keys stand in one matrix, and the parts that are made of many small operations have their derivative written out. Loss
and gradients equal the policy's own; `refusal` says for which policies.
"""

from dataclasses import dataclass

import torch
from lerobot.policies.common.vla_utils import create_sinusoidal_pos_embedding
from lerobot.policies.smolvla import SmolVLAPolicy
from torch.autograd import Function
from torch.nn import functional

Tensor = torch.Tensor
WAVELENGTH = 10_000.0  # longest of the rotary positions, as in LeRobot
MASKED = torch.finfo(torch.float32).min


@dataclass(frozen=True)
class _Attention:
    """What all layers of one kind share in a batch."""

    cos: Tensor  # of the queries' rotary angles, (B or 1, 1, chunk, head dim / 2)
    sin: Tensor
    mask: Tensor  # 0 or `MASKED`, added to the scores, (B * groups, heads per group * chunk, keys)


def refusal(policy: SmolVLAPolicy) -> str:
    """Return why the policy's expert cannot be computed here, or an empty string."""
    model = policy.model.vlm_with_expert
    expert, parts = model.lm_expert, list(policy.model.vlm_with_expert.lm_expert.modules())
    if model.num_expert_layers != model.num_vlm_layers:
        return f"{model.num_expert_layers} expert layers for {model.num_vlm_layers} of the vision-language model"
    if expert.config.hidden_act != "silu":
        return f"activation {expert.config.hidden_act!r}"
    if adapted := [type(part).__name__ for part in parts if "lora" in type(part).__module__]:
        return f"adapters ({adapted[0]})"
    if any(part.bias is not None for part in parts if isinstance(part, torch.nn.Linear)):
        return "layers with a bias"
    kinds = {parameter.dtype for parameter in expert.parameters()}
    return "" if kinds == {torch.float32} else f"parameters in {', '.join(sorted(map(str, kinds)))}"


def velocity(policy: SmolVLAPolicy, stored: Tensor, real: Tensor, noisy: Tensor, times: Tensor) -> Tensor:
    """Return the flow's velocity at noisy action chunks, as `SmolVLAPolicy.model.denoise_step` does.

    Args:
        stored: keys and values of the prefixes, float32 (B, layers, 2, kv heads, L, head dim).
        real: bool (B, L), False where the instruction is padded.
        noisy: float32 (B, chunk, max_action_dim).
        times: float32 (B,), in (0, 1).

    Returns:
        float32 (B, chunk, action dim): the dimensions of real actions only.
    """
    model, width = policy.model, policy.config.action_feature.shape[0]
    vlm, expert = model.vlm_with_expert, model.vlm_with_expert.lm_expert
    to_self, to_prefix = _shared(real, noisy.shape[1], stored.shape[3], vlm.num_attention_heads, stored.shape[-1])
    hidden = _embedded(policy, noisy, times).flatten(0, 1)  # (B * chunk, expert width)
    every = vlm.self_attn_every_n_layers
    for index, layer in enumerate(expert.layers):
        is_self = "cross" not in vlm.attention_mode or (every > 0 and index % every == 0)
        attend = _self_attention if is_self else _cross_attention
        mixed = attend(layer, hidden, stored[:, index], to_self if is_self else to_prefix)
        hidden = torch.addmm(hidden, mixed, layer.self_attn.o_proj.weight.t())
        norm, mlp = layer.post_attention_layernorm, layer.mlp
        both = NormedLinear.apply(hidden, norm.weight, norm.variance_epsilon, mlp.gate_proj.weight, mlp.up_proj.weight)
        hidden = torch.addmm(hidden, Gated.apply(both), mlp.down_proj.weight.t())
    out = model.action_out_proj
    return functional.linear(expert.norm(hidden), out.weight[:width], out.bias[:width]).view(*noisy.shape[:2], width)


def _embedded(policy: SmolVLAPolicy, noisy: Tensor, times: Tensor) -> Tensor:
    """Fuse actions and flow time, (B, chunk, expert width); the part of the time is computed once for a chunk."""
    model, settings = policy.model, policy.config
    actions = model.action_in_proj(noisy)
    width, fuse = actions.shape[-1], model.action_time_mlp_in
    waves = create_sinusoidal_pos_embedding(times, width, settings.min_period, settings.max_period, times.device)
    of_time = functional.linear(waves.to(actions.dtype), fuse.weight[:, width:], fuse.bias)
    fused = functional.linear(actions, fuse.weight[:, :width]) + of_time[:, None]
    return model.action_time_mlp_out(functional.silu(fused))


def _shared(real: Tensor, chunk: int, groups: int, heads: int, size: int) -> tuple[_Attention, _Attention]:
    """What layers share that attend to prefix and chunk, and what those share that attend to the prefix only."""
    count, length = real.shape
    steps = torch.arange(chunk, device=real.device)
    after = real.sum(1)[:, None] + steps  # positions of the chunk, (B, chunk)
    padded = torch.zeros(real.shape, device=real.device).masked_fill_(~real, MASKED)[:, None].expand(-1, chunk, -1)
    later = torch.full((chunk, chunk), MASKED, device=real.device).triu_(1).expand(count, -1, -1)

    def stacked(mask: Tensor) -> Tensor:
        whole = mask[:, None, None].expand(-1, groups, heads // groups, -1, -1)
        return whole.reshape(count * groups, -1, mask.shape[-1])

    whole = _Attention(*_angles(after, size), stacked(torch.cat([padded, later], 2)))
    return whole, _Attention(*_angles(steps[None], size), stacked(padded))


def _angles(positions: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Cosine and sine of rotary positions (B, T), each (B, 1, T, size / 2)."""
    exponents = (2.0 / size) * torch.arange(size // 2, dtype=torch.float32, device=positions.device)
    radians = positions[:, None, :, None].float() / WAVELENGTH**exponents
    return torch.cos(radians), torch.sin(radians)


def _self_attention(layer: torch.nn.Module, hidden: Tensor, stored: Tensor, shared: _Attention) -> Tensor:
    """Attend to the prefix and to the actions so far, (B * chunk, heads * head dim) before the output projection."""
    part, norm = layer.self_attn, layer.input_layernorm
    weights = part.q_proj.weight, part.k_proj.weight, part.v_proj.weight
    count, _, groups, _, size = stored.shape
    joint = NormedLinear.apply(hidden, norm.weight, norm.variance_epsilon, *weights)
    queries, keys, values = joint.view(count, -1, joint.shape[1] // size, size).transpose(1, 2).split(
        [weights[0].shape[0] // size, groups, groups], 1
    )  # fmt: skip
    queries, keys = (Rotated.apply(each, shared.cos, shared.sin) for each in (queries, keys))
    return _merged(Attended.apply(queries, keys, values, stored, shared.mask))


def _cross_attention(layer: torch.nn.Module, hidden: Tensor, stored: Tensor, shared: _Attention) -> Tensor:
    """Attend to the prefix, whose keys and values the layer projects once more."""
    part, norm = layer.self_attn, layer.input_layernorm
    count, _, groups, length, size = stored.shape
    queries = NormedLinear.apply(hidden, norm.weight, norm.variance_epsilon, part.q_proj.weight)
    queries = queries.view(count, -1, queries.shape[1] // size, size).transpose(1, 2)
    flat = stored.permute(1, 0, 3, 2, 4).reshape(2, count * length, groups * size)
    keys, values = (
        torch.mm(each, projection.weight.t()).view(count, length, groups, size).transpose(1, 2)
        for each, projection in zip(flat, (part.k_proj, part.v_proj), strict=True)
    )
    return _merged(Attended.apply(Rotated.apply(queries, shared.cos, shared.sin), keys, values, None, shared.mask))


def _merged(heads: Tensor) -> Tensor:
    """(B, heads, T, head dim) -> (B * T, heads * head dim)."""
    return heads.transpose(1, 2).reshape(heads.shape[0] * heads.shape[2], -1)


class NormedLinear(Function):
    """``y = (g * x / rms(x)) W'`` for several matrices W below each other; the gain g is multiplied into W.

    With n = x / rms(x) and G = dL/dy: dW = g * (G' n), dg = sum over rows of W * (G' n), and for dn = G (g * W):
    dx = (dn - n * mean(dn * n)) / rms(x).
    """

    @staticmethod
    def forward(ctx, x: Tensor, gain: Tensor, eps: float, *weights: Tensor) -> Tensor:
        scale = torch.linalg.vector_norm(x, dim=1, keepdim=True).square_().div_(x.shape[1]).add_(eps).rsqrt_()
        normed, weight = x * scale, weights[0] if len(weights) == 1 else torch.cat(weights)
        ctx.rows = [each.shape[0] for each in weights]
        ctx.save_for_backward(normed, scale, gain, weight)
        return torch.mm(normed, (weight * gain).t())

    @staticmethod
    def backward(ctx, grad: Tensor) -> tuple:
        normed, scale, gain, weight = ctx.saved_tensors
        product = torch.mm(normed.t(), grad).t()
        of_normed = torch.mm(grad, weight * gain)
        share = torch.linalg.vecdot(of_normed, normed)[:, None].div_(normed.shape[1])
        of_x = torch.addcmul(of_normed, normed, share, value=-1).mul_(scale)
        return of_x, (product * weight).sum(0), None, *(product * gain).split(ctx.rows)


class Gated(Function):
    """``silu(a) * b`` for a matrix with a in its left half and b in its right."""

    @staticmethod
    def forward(ctx, both: Tensor) -> Tensor:
        gate, up = both.chunk(2, 1)
        sigmoid = torch.sigmoid(gate)
        active = gate * sigmoid
        ctx.save_for_backward(both, sigmoid, active)
        return active * up

    @staticmethod
    def backward(ctx, grad: Tensor) -> Tensor:
        both, sigmoid, active = ctx.saved_tensors
        out = torch.empty_like(both)
        of_gate, of_up = out.chunk(2, 1)
        torch.mul(grad, active, out=of_up)
        slope = torch.addcmul(sigmoid, active, 1 - sigmoid)  # of silu
        torch.mul(slope, both.chunk(2, 1)[1], out=of_gate).mul_(grad)
        return out


class Rotated(Function):
    """Rotary positions: each pair (x_i, x_{i + half}) of (B, heads, T, head dim) turned by its angle."""

    @staticmethod
    def forward(ctx, x: Tensor, cos: Tensor, sin: Tensor) -> Tensor:
        ctx.save_for_backward(cos, sin)
        return _turned(x, cos, sin)

    @staticmethod
    def backward(ctx, grad: Tensor) -> tuple:
        cos, sin = ctx.saved_tensors
        return _turned(grad, cos, -sin), None, None


def _turned(x: Tensor, cos: Tensor, sin: Tensor) -> Tensor:
    out = torch.empty(x.shape, dtype=x.dtype, device=x.device)
    (left, right), (out_left, out_right) = x.chunk(2, -1), out.chunk(2, -1)
    torch.mul(left, cos, out=out_left).addcmul_(right, sin, value=-1)
    torch.mul(right, cos, out=out_right).addcmul_(left, sin)
    return out


class Attended(Function):
    """Attention of (B, heads, T, head dim) queries to the keys of their group, with a prefix of constant keys in front.

    Queries of a group share their keys, so they stand in one matrix and the keys are not repeated. Constant keys and
    values have no gradient, and none is computed.
    """

    @staticmethod
    def forward(ctx, queries: Tensor, keys: Tensor, values: Tensor, prefix: Tensor | None, mask: Tensor) -> Tensor:
        count, groups, own, size = keys.shape
        fixed = 0 if prefix is None else prefix.shape[3]
        both = keys.new_empty(2, count, groups, fixed + own, size)
        if fixed:
            both[:, :, :, :fixed] = prefix.transpose(0, 1)
        both[0, :, :, fixed:], both[1, :, :, fixed:] = keys, values
        asked, (told, said) = queries.reshape(count * groups, -1, size), both.flatten(1, 2)
        share = torch.baddbmm(mask, asked, told.transpose(1, 2), alpha=size**-0.5).softmax(-1)
        ctx.fixed, ctx.shape = fixed, keys.shape
        ctx.save_for_backward(asked, told, said, share)
        return torch.bmm(share, said).view(queries.shape)

    @staticmethod
    def backward(ctx, grad: Tensor) -> tuple:
        asked, told, said, share = ctx.saved_tensors
        rows = grad.reshape(asked.shape)
        of_share = torch.bmm(rows, said.transpose(1, 2))
        of_score = torch._softmax_backward_data(of_share, share, -1, share.dtype).mul_(asked.shape[-1] ** -0.5)
        of_keys = torch.bmm(of_score[:, :, ctx.fixed :].transpose(1, 2), asked).view(ctx.shape)
        of_values = torch.bmm(share[:, :, ctx.fixed :].transpose(1, 2), rows).view(ctx.shape)
        return torch.bmm(of_score, told).view(grad.shape), of_keys, of_values, None, None
