"""The lean pass of the action expert equals the policy's own, for every policy that it accepts."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from lerobot.policies.smolvla import SmolVLAPolicy
from torch.utils.flop_counter import FlopCounterMode
from transformers import DynamicCache

from fedvla_lib.config import from_profile
from fedvla_lib.policy import lean_expert, model
from fedvla_lib.policy.parameters import trainable
from fedvla_lib.robot.spec import ACTION_KEY, STATE_KEY

pytestmark = pytest.mark.unit
CONFIG = from_profile("tiny", base="nano-random", num_threads=1)
STATS = {key: {"mean": np.arange(6.0), "std": np.full(6, 5.0)} for key in (STATE_KEY, ACTION_KEY)}
LENGTH, BATCH = 13, 5  # tokens of a prefix, samples
ACCEPTED = {
    "as shipped": {},
    "other chunk": {"chunk_size": 7, "n_action_steps": 3},
    "self-attention in every layer": {"attention_mode": "self_attn"},
    "self-attention in every third layer": {"self_attn_every_n_layers": 3},
    "no self-attention": {"self_attn_every_n_layers": -1},
    "fewer layers": {"num_vlm_layers": 3},
    "narrower": {"expert_width_multiplier": 0.5},
    "other periods": {"min_period": 0.01, "max_period": 2.0},
}


def policy_of(**settings) -> SmolVLAPolicy:
    """A nano policy with random weights, norms included, and other settings."""
    config = model.load_policy(CONFIG, STATS).policy.config
    for name, value in settings.items():
        setattr(config, name, value)
    with torch.random.fork_rng():
        torch.manual_seed(1)
        policy = SmolVLAPolicy(config)
        for name, parameter in trainable(policy).items():
            if "norm" in name:
                torch.nn.init.uniform_(parameter, 0.5, 1.5)
    return policy


def inputs(policy, seed=0):
    """Prefixes of which some are padded, noisy actions, times, and a direction for the loss."""
    rng, vlm, settings = torch.Generator().manual_seed(seed), policy.model.vlm_with_expert, policy.config
    heads = vlm.num_key_value_heads, LENGTH, vlm.config.text_config.head_dim
    stored = torch.randn((BATCH, vlm.num_vlm_layers, 2, *heads), generator=rng)
    real = torch.ones(BATCH, LENGTH, dtype=torch.bool)
    real[1, 9:12], real[3, 10] = False, False
    noisy = torch.randn((BATCH, settings.chunk_size, settings.max_action_dim), generator=rng)
    return (stored, real, noisy, torch.rand(BATCH, generator=rng)), torch.randn((*noisy.shape[:2], 6), generator=rng)


def own(policy, stored, real, noisy, times):
    cache = DynamicCache()
    for layer in range(stored.shape[1]):
        cache.update(stored[:, layer, 0], stored[:, layer, 1], layer)
    return policy.model.denoise_step(real, cache, noisy, times)[..., :6]


def lean(policy, *arguments):
    stored, real, noisy, times = arguments
    return lean_expert.velocity(policy, lean_expert.prepared(policy, stored, real), noisy, times, width=6)


def loss_and_gradients(compute, policy):
    arguments, target = inputs(policy)
    loss = (target - compute(policy, *arguments)).square().mean()
    gradients = torch.autograd.grad(loss, list(trainable(policy).values()), allow_unused=True)
    return loss.item(), {name: g for name, g in zip(trainable(policy), gradients, strict=True) if g is not None}


@pytest.mark.parametrize("settings", ACCEPTED.values(), ids=ACCEPTED)
def test_loss_and_gradients_equal_the_policys_own(settings):
    policy = policy_of(**settings)
    assert lean_expert.refusal(policy) == ""
    expected, wanted = loss_and_gradients(own, policy)
    actual, found = loss_and_gradients(lean, policy)
    assert actual == pytest.approx(expected, rel=1e-6) and found.keys() == wanted.keys()
    apart = torch.stack([(found[name] - wanted[name]).norm() for name in wanted]).norm()
    assert apart < 1e-6 * torch.stack([g.norm() for g in wanted.values()]).norm()
    for name in wanted:
        torch.testing.assert_close(found[name], wanted[name], rtol=1e-4, atol=1e-6)


def test_each_sample_depends_on_its_own_real_positions_only():
    policy = policy_of()
    (stored, real, noisy, times), _ = inputs(policy)
    before = lean(policy, stored, real, noisy, times)
    stored[1, ..., 9:12, :] += 100  # padding
    torch.testing.assert_close(lean(policy, stored, real, noisy, times), before)
    stored[1, ..., 3, :] += 1
    changed = (lean(policy, stored, real, noisy, times) != before).flatten(1).any(1)
    assert changed.tolist() == [False, True, False, False, False]


def test_other_policies_are_refused_and_train_as_before():
    adapted = model.load_policy(replace(CONFIG, lora_rank=2), STATS)
    assert "adapters" in lean_expert.refusal(adapted.policy) and not adapted.is_lean
    assert "2 expert layers for 4" in lean_expert.refusal(policy_of(num_expert_layers=2))
    assert "bfloat16" in lean_expert.refusal(policy_of().to(torch.bfloat16))
    policy = policy_of()
    policy.model.vlm_with_expert.lm_expert.config.hidden_act = "gelu"
    assert "gelu" in lean_expert.refusal(policy)
    assert model.load_policy(CONFIG, STATS).is_lean


def test_fewer_numbers_are_multiplied_than_in_the_policys_own_pass():
    policy, counted = policy_of(), []
    for compute in (own, lean):
        with FlopCounterMode(display=False) as counter:
            loss_and_gradients(compute, policy)
        counted.append(counter.get_total_flops())
    assert counted[1] < counted[0]
