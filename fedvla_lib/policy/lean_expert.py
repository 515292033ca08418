"""The action expert's pass over stored prefixes, written again with few operations.

`SmolVLAPolicy` recomputes rotary tables, masks and positions in every layer, repeats keys for each query of a group and
lets autograd record thousands of small operations. Here tables and masks are made once for a batch, queries that share
keys form one matrix, and the parts that are made of many small operations have their derivative written out. Loss
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
class _Shared:
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


def prepared(policy: SmolVLAPolicy, stored: Tensor, real: Tensor) -> list[tuple[_Shared, Tensor]]:
    """Return what does not depend on actions: for each layer its tables, and the keys and values of the prefixes.

    Args:
        stored: keys and values of the prefixes, float32 (B, layers, 2, kv heads, L, head dim).
        real: bool (B, L), False where the instruction is padded.
    """
    vlm, chunk = policy.model.vlm_with_expert, policy.config.chunk_size
    to_self, to_prefix = _tables(real, chunk, stored.shape[3], vlm.num_attention_heads, stored.shape[-1])
    prefixes = [stored[:, index].transpose(0, 1) for index in range(stored.shape[1])]
    return [
        (to_self, prefix) if _is_self(policy, index) else (to_prefix, _projected(prefix, layer.self_attn))
        for index, (layer, prefix) in enumerate(zip(vlm.lm_expert.layers, prefixes, strict=True))
    ]


def _is_self(policy: SmolVLAPolicy, index: int) -> bool:
    """Return whether a layer attends to the chunk too, and not to the prefix only."""
    vlm = policy.model.vlm_with_expert
    every = vlm.self_attn_every_n_layers
    return "cross" not in vlm.attention_mode or (every > 0 and index % every == 0)


def velocity(
    policy: SmolVLAPolicy, layers: list[tuple[_Shared, Tensor]], noisy: Tensor, times: Tensor, width: int
) -> Tensor:
    """Return the flow's velocity at noisy action chunks, as `SmolVLAPolicy.model.denoise_step` does.

    Args:
        layers: from `prepared`, for these samples.
        noisy: float32 (B, chunk, max_action_dim).
        times: float32 (B,), in (0, 1].
        width: action dimensions wanted, the first of max_action_dim.

    Returns:
        float32 (B, chunk, width).
    """
    model, expert = policy.model, policy.model.vlm_with_expert.lm_expert
    hidden = _embedded(policy, noisy, times).flatten(0, 1)  # (B * chunk, expert width)
    for index, (layer, (shared, prefix)) in enumerate(zip(expert.layers, layers, strict=True)):
        part, norm = layer.self_attn, layer.input_layernorm
        inward = (part.q_proj, part.k_proj, part.v_proj) if _is_self(policy, index) else (part.q_proj,)
        weights = (each.weight for each in (norm, *inward, part.o_proj))
        hidden = _Attention.apply(hidden, norm.variance_epsilon, prefix, shared, *weights)
        mlp, norm = layer.mlp, layer.post_attention_layernorm
        weights = (each.weight for each in (norm, mlp.gate_proj, mlp.up_proj, mlp.down_proj))
        hidden = _FeedForward.apply(hidden, norm.variance_epsilon, *weights)
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


def _tables(real: Tensor, chunk: int, groups: int, heads: int, size: int) -> tuple[_Shared, _Shared]:
    """What layers share that attend to prefix and chunk, and what those share that attend to the prefix only."""
    count, length = real.shape
    steps = torch.arange(chunk, device=real.device)
    after = real.sum(1)[:, None] + steps  # positions of the chunk, (B, chunk)
    padded = torch.zeros(real.shape, device=real.device).masked_fill_(~real, MASKED)[:, None].expand(-1, chunk, -1)
    later = torch.full((chunk, chunk), MASKED, device=real.device).triu_(1).expand(count, -1, -1)

    def stacked(mask: Tensor) -> Tensor:
        whole = mask[:, None, None].expand(-1, groups, heads // groups, -1, -1)
        return whole.reshape(count * groups, -1, mask.shape[-1])

    whole = _Shared(*_angles(after, size), stacked(torch.cat([padded, later], 2)))
    return whole, _Shared(*_angles(steps[None], size), stacked(padded))


def _angles(positions: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Cosine and sine of rotary positions (B, T), each (B, 1, T, size / 2)."""
    exponents = (2.0 / size) * torch.arange(size // 2, dtype=torch.float32, device=positions.device)
    radians = positions[:, None, :, None].float() / WAVELENGTH**exponents
    return torch.cos(radians), torch.sin(radians)


class _FeedForward(Function):
    """``x + D (silu(G n) * U n)`` with n = x / rms(x) * gain, for x (N, width) and matrices gate G, up U and down D."""

    @staticmethod
    def forward(ctx, x: Tensor, eps: float, gain: Tensor, gate: Tensor, up: Tensor, down: Tensor) -> Tensor:
        normed, scale = _normed(x, eps)
        inward = torch.cat([gate, up])
        both = torch.mm(normed, (inward * gain).t())
        inner = functional.silu(both[:, : len(gate)]).mul_(both[:, len(gate) :])
        ctx.save_for_backward(normed, scale, gain, inward, down, both, inner)
        return torch.addmm(x, inner, down.t())

    @staticmethod
    def backward(ctx, grad: Tensor) -> tuple:
        normed, scale, gain, inward, down, both, inner = ctx.saved_tensors
        of_inner, of_both, width = torch.mm(grad, down), torch.empty_like(both), inner.shape[1]
        torch.mul(of_inner, functional.silu(both[:, :width]), out=of_both[:, width:])
        of_active = of_inner.mul_(both[:, width:])
        torch.ops.aten.silu_backward.grad_input(of_active, both[:, :width], grad_input=of_both[:, :width])
        of_x, of_gain, of_inward = _linear_gradients(of_both, normed, scale, gain, inward)
        return of_x.add_(grad), None, of_gain, *of_inward.chunk(2), torch.mm(grad.t(), inner)


class _Attention(Function):
    """``x + O a`` where a attends to a prefix and, if there are matrices for keys and values, to the chunk so far."""

    @staticmethod
    def forward(ctx, x: Tensor, eps: float, prefix: Tensor, shared: _Shared, gain: Tensor, *weights: Tensor) -> Tensor:
        _, count, groups, length, size = prefix.shape
        *inward, out = weights
        normed, scale = _normed(x, eps)
        joint = torch.cat(inward)
        heads = torch.mm(normed, (joint * gain).t()).view(count, -1, len(joint) // size, size).transpose(1, 2)
        queries, *own = heads.split([len(each) // size for each in inward], 1)
        both = prefix
        if own:
            both = prefix.new_empty(2, count, groups, length + own[0].shape[2], size)
            both[..., :length, :] = prefix
            _turn(own[0], shared.cos, shared.sin, both[0, :, :, length:])
            both[1, :, :, length:] = own[1]
        asked, mixed, share = _attend(queries, *both, shared)
        ctx.shared, ctx.rows, ctx.fixed = shared, [len(each) for each in inward], length if own else 0
        ctx.save_for_backward(normed, scale, gain, joint, out, asked, both, share, mixed)
        return torch.addmm(x, mixed, out.t())

    @staticmethod
    def backward(ctx, grad: Tensor) -> tuple:
        normed, scale, gain, joint, out, asked, both, share, mixed = ctx.saved_tensors
        count, size = both.shape[1], both.shape[-1]
        of_joint = grad.new_empty(count, len(grad) // count, len(joint) // size, size)
        of_queries, *of_own = of_joint.transpose(1, 2).split([rows // size for rows in ctx.rows], 1)
        of_both = _attention_gradients(torch.mm(grad, out), asked, both, share, ctx.shared, of_queries, ctx.fixed)
        if of_own:
            _turn(of_both[0], ctx.shared.cos, -ctx.shared.sin, of_own[0])
            of_own[1].copy_(of_both[1])
        of_x, of_gain, of_inward = _linear_gradients(of_joint.view(len(grad), -1), normed, scale, gain, joint)
        of_prefix = None if of_own else of_both
        return of_x.add_(grad), None, of_prefix, None, of_gain, *of_inward.split(ctx.rows), torch.mm(grad.t(), mixed)


def _projected(stored: Tensor, part: torch.nn.Module) -> Tensor:
    """Keys and values of the prefix, projected once more: (2, B, groups, L, head dim), as are those stored."""
    _, count, groups, length, size = stored.shape
    flat = stored.transpose(2, 3).reshape(2, count * length, groups * size)
    both = torch.bmm(flat, torch.stack([part.k_proj.weight, part.v_proj.weight]).transpose(1, 2))
    return both.view(2, count, length, groups, size).transpose(2, 3).contiguous()


def _normed(x: Tensor, eps: float) -> tuple[Tensor, Tensor]:
    """Divide each row by its root mean square; return the rows, and the factors (N, 1)."""
    scale = torch.linalg.vector_norm(x, dim=1, keepdim=True).square_().div_(x.shape[1]).add_(eps).rsqrt_()
    return x * scale, scale


def _linear_gradients(grad: Tensor, normed: Tensor, scale: Tensor, gain: Tensor, weight: Tensor) -> tuple:
    """Gradients of x, gain g and weight W of ``y = (g * n) W'`` with n = x / rms(x), from G = dL/dy.

    dW = g * (G' n), dg = sum over rows of W * (G' n), and for dn = G (g * W): dx = (dn - n * mean(dn * n)) / rms(x).
    """
    product = torch.mm(grad.t(), normed)
    of_normed = torch.mm(grad, weight * gain)
    share = torch.linalg.vecdot(of_normed, normed)[:, None].div_(normed.shape[1])
    of_x = torch.addcmul(of_normed, normed, share, value=-1).mul_(scale)
    return of_x, (product * weight).sum(0), product.mul_(gain)


def _turn(x: Tensor, cos: Tensor, sin: Tensor, out: Tensor) -> Tensor:
    """Rotary positions: turn each pair (x_i, x_{i + half}) of (B, heads, T, head dim) by its angle, into `out`."""
    (left, right), (out_left, out_right) = x.chunk(2, -1), out.chunk(2, -1)
    torch.mul(left, cos, out=out_left).addcmul_(right, sin, value=-1)
    torch.mul(right, cos, out=out_right).addcmul_(left, sin)
    return out


def _attend(queries: Tensor, keys: Tensor, values: Tensor, shared: _Shared) -> tuple[Tensor, Tensor, Tensor]:
    """Attention of (B, heads, T, head dim) queries, not yet turned, to the (B, groups, keys, head dim) of their group.

    Queries of a group share their keys, so they form one matrix and the keys are not repeated.

    Returns:
        The queries, turned, (B * groups, heads per group * T, head dim); what they attend to, (B * T, heads * head
        dim); the shares of attention, (B * groups, heads per group * T, keys).
    """
    count, groups, _, size = keys.shape
    turned = _turn(queries, shared.cos, shared.sin, queries.new_empty(queries.shape))
    asked = turned.view(count * groups, -1, size)
    share = torch.baddbmm(shared.mask, asked, keys.flatten(0, 1).transpose(1, 2), alpha=size**-0.5).softmax(-1)
    mixed = torch.bmm(share, values.flatten(0, 1)).view(queries.shape).transpose(1, 2)
    return asked, mixed.reshape(count * queries.shape[2], -1), share


def _attention_gradients(
    grad: Tensor, asked: Tensor, both: Tensor, share: Tensor, shared: _Shared, of_queries: Tensor, fixed: int
) -> Tensor:
    """Write the gradient of the queries into `of_queries`; return those of keys and values after the first `fixed`."""
    count, heads, steps, size = of_queries.shape
    keys, values = both.flatten(1, 2)
    rows = grad.view(count, steps, heads, size).transpose(1, 2).reshape(asked.shape)
    of_share = torch.bmm(rows, values.transpose(1, 2))
    of_score = torch._softmax_backward_data(of_share, share, -1, share.dtype).mul_(size**-0.5)
    _turn(torch.bmm(of_score, keys).view(of_queries.shape), shared.cos, -shared.sin, of_queries)
    own = grad.new_empty(2, len(asked), both.shape[3] - fixed, size)
    torch.bmm(of_score[:, :, fixed:].transpose(1, 2), asked, out=own[0])
    torch.bmm(share[:, :, fixed:].transpose(1, 2), rows, out=own[1])
    return own.view(*both.shape[:3], -1, size)
