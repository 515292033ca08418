"""Local optimisers whose second moments come from the server, against their equations."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from fedvla_lib.config import Config, from_profile
from fedvla_lib.data.normalisation import Stats
from fedvla_lib.policy import model, optimizers
from fedvla_lib.policy.parameters import trainable
from fedvla_lib.robot.spec import ACTION_KEY, STATE_KEY

pytestmark = pytest.mark.unit
STATS: Stats = {
    key: {"mean": np.zeros(6), "std": np.ones(6), "min": -np.ones(6), "max": np.ones(6), "count": np.array([10])}
    for key in (STATE_KEY, ACTION_KEY)
}
NAME = "model.action_out_proj.bias"


@pytest.fixture(scope="module")
def bundle():
    return model.load_policy(CONFIG, STATS)


CONFIG = from_profile("tiny", base="nano-random", lr=1e-2, warmup_steps=0)


def walk(bundle, kind, second_moments, gradients, length=10**9):
    """Return the weights of one array after each step along the gradients, and the optimiser; start at 0."""
    named = trainable(bundle.policy)
    with torch.no_grad():
        for parameter in named.values():
            parameter.zero_()
    optimizer, scheduler = optimizers.build(bundle, replace(CONFIG, local_optimizer=kind), 0, length, second_moments)
    path = []
    for gradient in gradients:
        for parameter in named.values():
            parameter.grad = torch.full_like(parameter, float(gradient))
        optimizer.step()
        scheduler.step()
        path.append(float(named[NAME][0]))
    return path, optimizer


def everywhere(bundle, value):
    return {name: np.full(tuple(p.shape), value, np.float32) for name, p in trainable(bundle.policy).items()}


GRADIENTS = [0.5, -1.0, 2.0, 0.25, 1.0]


def test_sgd_is_gradient_descent(bundle):
    path, _ = walk(bundle, "sgd", {}, GRADIENTS)
    assert path == pytest.approx((-CONFIG.lr * np.cumsum(GRADIENTS)).tolist(), rel=1e-4)


def test_shared_second_moments_start_adam_where_the_server_is(bundle):
    """Against the equations: first moment from 0 and corrected, second from the server's and not."""
    betas, w, m, v, expected = bundle.policy.config.optimizer_betas, 0.0, 0.0, 4.0, []
    for step, gradient in enumerate(GRADIENTS, 1):
        m, v = betas[0] * m + (1 - betas[0]) * gradient, betas[1] * v + (1 - betas[1]) * gradient**2
        w -= CONFIG.lr * m / (1 - betas[0] ** step) / np.sqrt(v)
        expected.append(w)
    path, optimizer = walk(bundle, "adamw-shared", everywhere(bundle, 4.0), GRADIENTS)
    assert path == pytest.approx(expected, rel=1e-3)
    assert optimizers.second_moments_of(bundle, optimizer)[NAME] == pytest.approx(v, rel=1e-4)


def test_frozen_second_moments_make_a_step_linear_in_the_gradient(bundle):
    once, optimizer = walk(bundle, "adamw-frozen", everywhere(bundle, 4.0), GRADIENTS)
    twice, _ = walk(bundle, "adamw-frozen", everywhere(bundle, 4.0), [2 * g for g in GRADIENTS])
    assert twice == pytest.approx([2 * w for w in once], rel=1e-5)
    assert once[0] == pytest.approx(-CONFIG.lr * GRADIENTS[0] / 2, rel=1e-4)
    squares = optimizers.second_moments_of(bundle, optimizer)[NAME]
    assert squares == pytest.approx(np.mean(np.square(GRADIENTS)), rel=1e-5)


@pytest.mark.parametrize("kind", optimizers.SHARING)
def test_without_moments_of_the_server_it_is_adamw_and_measures_them(kind, bundle):
    path, optimizer = walk(bundle, kind, {}, GRADIENTS)
    assert path == walk(bundle, "adamw", {}, GRADIENTS)[0]
    beta, v = bundle.policy.config.optimizer_betas[1], 0.0
    for gradient in GRADIENTS:
        v = beta * v + (1 - beta) * gradient**2
    found = optimizers.second_moments_of(bundle, optimizer)[NAME]
    assert found == pytest.approx(v / (1 - beta ** len(GRADIENTS)), rel=1e-5)


def test_personal_parts_and_shared_moments_are_refused():
    with pytest.raises(ValueError, match="local-optimizer='adamw-shared' is not usable"):
        from_profile("tiny", personal="projections", local_optimizer="adamw-shared")
    assert Config().local_optimizer == "adamw"
