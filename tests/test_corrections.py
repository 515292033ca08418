"""Corrections of local training by strategies, on problems with a known solution: quadratics, and autograd."""

import numpy as np
import pytest
import torch
from flwr.app import ConfigRecord, Context, Message, MetricRecord, RecordDict
from flwr.clientapp import ClientApp

from fedvla_lib.config import Config
from fedvla_lib.engines.inline import FIRST_NODE_ID, InlineGrid, claim_identity
from fedvla_lib.federation import messages
from fedvla_lib.federation.checkpoint import flat, nested
from fedvla_lib.federation.client_app import control_variates, correction_for
from fedvla_lib.federation.nodes import Roster
from fedvla_lib.federation.strategies import build
from fedvla_lib.federation.strategies.fedprox import Proximal
from fedvla_lib.federation.strategies.scaffold import ControlVariates
from fedvla_lib.policy.parameters import digest

pytestmark = pytest.mark.unit
CURVATURE, TARGET = (4.0, 1.0), (-1.0, 2.0)  # client k minimises CURVATURE[k] / 2 (w - TARGET[k])^2
RATE, STEPS = 0.1, 5


@pytest.fixture(autouse=True)
def identity():
    claim_identity()


def parameter(value):
    return torch.nn.Parameter(torch.as_tensor(value, dtype=torch.float32).clone())


def local_phase(weight, k, correction=None, steps=STEPS):
    """Plain gradient descent of client k, in place."""
    optimizer = torch.optim.SGD([weight], lr=RATE)
    for _ in range(steps):
        optimizer.zero_grad()
        (CURVATURE[k] / 2 * (weight - TARGET[k]).square().sum()).backward()
        if correction:
            correction({"w": weight})
        optimizer.step()


def quadratic_app(examples=(1, 1)) -> ClientApp:
    """Two clients with different optima and curvatures, on the same code as the robot's clients."""
    app = ClientApp()

    @app.train()
    def train(message: Message, context: Context) -> Message:
        k = context.node_config["partition-id"]
        weight = parameter(messages.unpack_arrays(message.content[messages.ARRAYS])["w"])
        correction = correction_for(message, context, {"w": weight})
        local_phase(weight, k, correction)
        arrays = {"w": weight.detach().numpy()}
        metrics = MetricRecord({messages.EXAMPLES: examples[k], messages.STEPS: 1, "loss": 0.0, "seconds": 0.0})
        note = ConfigRecord({messages.DIGEST: digest(arrays), **messages.round_of(message.content)})
        reply = RecordDict(
            {messages.ARRAYS: messages.pack_arrays(arrays), messages.METRICS: metrics, messages.NOTE: note}
        )
        for record, change in control_variates(correction, context).items():
            messages.attach(reply, messages.NOTE, record, change)
        return Message(reply, reply_to=message)

    return app


def serving(grid, examples, share, rounds_done=0, **settings):
    """The strategy of these settings, for the two clients of the grid."""
    nodes = grid.get_node_ids()
    return build.build_strategy(
        Config(fraction_train=share, **settings), shapes={"w": (1,)},
        roster=Roster({node: node - FIRST_NODE_ID for node in nodes}, dict(zip(nodes, examples, strict=True))),
        report=lambda *_: None, keep_rollouts=lambda *_: None, rounds_done=rounds_done,
    )  # fmt: skip


def federate(rounds, examples=(1, 1), share=1.0, replaced_after=0, **settings):
    """Run a strategy on the two quadratics from w = 0; return w after each round, the strategy and the clients' state.

    After `replaced_after` rounds a new server continues from the checkpoint of the first.
    """
    grid, done = InlineGrid(quadratic_app(examples), 2, {}, raise_errors=True), 0
    strategy = serving(grid, examples, share, **settings)
    arrays, path = messages.pack_arrays({"w": np.zeros(1, np.float32)}), []
    for number in range(1, rounds + 1):
        if number - 1 == replaced_after > 0:
            kept, done = nested(flat(strategy.state())), replaced_after
            strategy = serving(grid, examples, share, done, **settings)
            strategy.load_state(kept)
        replies = grid.send_and_receive(strategy.configure_train(number - done, arrays, ConfigRecord(), grid))
        arrays, _ = strategy.aggregate_train(number - done, replies)
        path.append(float(messages.unpack_arrays(arrays)["w"][0]))
    return path, strategy, grid.client_states()


def optimum(examples=(1, 1)):
    pull = np.multiply(CURVATURE, examples)
    return float(pull @ np.array(TARGET) / pull.sum())


def shrink(k):
    """Fraction of the distance to its own optimum that is left after a local phase of client k."""
    return (1 - RATE * CURVATURE[k]) ** STEPS


def test_fedavg_stops_at_a_biased_point_and_scaffold_at_the_optimum():
    moved = np.array([1 - shrink(0), 1 - shrink(1)])
    biased = float(moved @ np.array(TARGET) / moved.sum())  # where the two updates cancel
    assert abs(biased - optimum()) > 0.3
    assert federate(60, strategy="fedavg")[0][-1] == pytest.approx(biased, abs=1e-4)
    assert federate(60, strategy="scaffold")[0][-1] == pytest.approx(optimum(), abs=1e-4)


@pytest.mark.parametrize("examples", [(3, 1), (1, 9)])
def test_scaffold_finds_the_optimum_of_the_weighted_loss(examples):
    assert federate(80, examples, strategy="scaffold")[0][-1] == pytest.approx(optimum(examples), abs=1e-4)


def test_scaffold_finds_the_optimum_when_one_client_of_two_is_sampled():
    assert federate(150, share=0.5, strategy="scaffold")[0][-1] == pytest.approx(optimum(), abs=1e-3)


def test_scaffold_equals_a_computation_by_hand():
    w, server, own = 0.0, 0.0, [0.0, 0.0]
    expected = []
    for _ in range(3):
        ends, fresh = [], []
        for k in range(2):
            y, gradients = w, []
            for _ in range(STEPS):
                gradients.append(CURVATURE[k] * (y - TARGET[k]))
                y -= RATE * (gradients[-1] - own[k] + server)
            ends.append(y)
            fresh.append(own[k] - server + (w - y) / (STEPS * RATE))  # the paper's option II
            assert fresh[-1] == pytest.approx(np.mean(gradients))
        server += sum((new - old) / 2 for new, old in zip(fresh, own, strict=True))
        own, w = fresh, sum(ends) / 2
        expected.append(w)
    path, strategy, _ = federate(3, strategy="scaffold")
    np.testing.assert_allclose(path, expected, rtol=1e-5)
    np.testing.assert_allclose(strategy.control["w"], server, rtol=1e-5)


def test_control_variates_sum_to_zero_over_clients():
    rng = np.random.default_rng(0)
    server = {"w": np.zeros(4, np.float32)}
    own = [{}, {}, {}]
    for _ in range(3):
        changes = []
        for k in range(3):
            control = ControlVariates(server, own[k])
            for _ in range(2):
                weight = parameter(np.zeros(4))
                weight.grad = torch.from_numpy(rng.normal(size=4).astype(np.float32))
                control({"w": weight})
            own[k] = control.updated()
            changes.append(control.change()["w"])
        server = {"w": server["w"] + np.mean(changes, axis=0)}
        assert np.abs(sum(c["w"] - server["w"] for c in own)).max() < 1e-6


@pytest.mark.parametrize(("examples", "share"), [((1, 1), 1.0), ((3, 1), 1.0), ((1, 9), 0.5)])
def test_what_the_server_adds_up_is_the_weighted_mean_of_what_clients_keep(examples, share):
    """So sum_k p_k (c_k - c) = 0, whoever was sampled: with the strategy and Flower's Context."""
    _, strategy, kept = federate(7, examples, share, strategy="scaffold")
    own = [kept[f"{FIRST_NODE_ID + k}:{messages.CONTROL}"]["w"] for k in range(2)]
    assert abs(own[0] - own[1]) > 0.1
    np.testing.assert_allclose(np.average(own, axis=0, weights=examples), strategy.control["w"], atol=1e-5)


def test_a_parameter_without_gradient_has_a_control_variate_of_zero():
    used, idle = parameter([1.0]), parameter([1.0])
    used.grad = torch.tensor([2.0])
    zeros = {"used": np.zeros(1, np.float32), "idle": np.zeros(1, np.float32)}
    control = ControlVariates(zeros, {})
    control({"used": used, "idle": idle})
    assert control.updated() == {"used": np.float32([2.0]), "idle": np.float32([0.0])}
    assert idle.grad is None


def test_the_proximal_pull_is_the_gradient_of_the_squared_distance():
    anchor = torch.randn(5, generator=torch.Generator().manual_seed(0))
    weight = parameter(anchor)
    pull = Proximal({"w": weight}, mu=0.7)
    with torch.no_grad():
        weight += 1.0
    (0.7 / 2 * (weight - anchor).square().sum()).backward()
    expected = weight.grad.clone()
    weight.grad.zero_()
    pull({"w": weight})
    torch.testing.assert_close(weight.grad, expected)
    assert (weight.grad != 0).all()  # with the live weights as anchor the gradient would be 0


def test_fedprox_without_weight_is_fedavg_to_the_last_bit():
    assert federate(5, strategy="fedprox", proximal_mu=0.0)[0] == federate(5, strategy="fedavg")[0]


def test_the_pull_shortens_what_clients_move_and_lessens_the_bias():
    free, held = parameter([0.0]), parameter([0.0])
    local_phase(free, 0)
    local_phase(held, 0, Proximal({"w": held}, mu=5.0))
    assert abs(held.item()) < 0.6 * abs(free.item())
    biased, pulled = (federate(100, strategy=name, proximal_mu=5.0)[0][-1] for name in ("fedavg", "fedprox"))
    assert abs(pulled - optimum()) < 0.8 * abs(biased - optimum())


def test_fedavgm_without_momentum_and_with_rate_one_is_fedavg():
    still = federate(5, strategy="fedavgm", server_momentum=0.0, server_lr=1.0)[0]
    assert still == federate(5, strategy="fedavg")[0]


def test_fedavgm_adds_up_what_the_server_did_before():
    w, momentum, path = 0.0, 0.0, []
    for _ in range(3):
        averaged = np.mean([TARGET[k] + (w - TARGET[k]) * shrink(k) for k in range(2)])
        momentum = 0.6 * momentum + (w - averaged)
        w -= 0.5 * momentum
        path.append(w)
    np.testing.assert_allclose(
        federate(3, strategy="fedavgm", server_momentum=0.6, server_lr=0.5)[0], path, rtol=1e-5
    )  # fmt: skip


@pytest.mark.parametrize("name", ["fedadam", "fedyogi"])
def test_adaptive_strategies_equal_a_float64_reference(name):
    w, m, v, path = 0.0, 0.0, 0.0, []
    for step in range(1, 5):
        update = np.mean([TARGET[k] + (w - TARGET[k]) * shrink(k) for k in range(2)]) - w
        m = 0.9 * m + 0.1 * update
        v = {
            "fedadam": 0.99 * v + 0.01 * update**2,
            "fedyogi": v - 0.01 * update**2 * np.sign(v - update**2),
        }[name]
        rate = 0.05 * np.sqrt(1 - 0.99 ** (step + 1)) / (1 - 0.9 ** (step + 1)) if name == "fedadam" else 0.05
        w += rate * m / (np.sqrt(v) + 1e-3)
        path.append(w)
    found, *_ = federate(4, strategy=name, server_lr=0.05)
    np.testing.assert_allclose(found, path, rtol=1e-4)


@pytest.mark.parametrize("name", ["fedavgm", "fedadam", "fedyogi", "scaffold"])
def test_a_server_that_takes_over_continues_from_the_state_of_the_first(name):
    """Momentum, second moments, control variate, round number and sampled clients."""
    settings = {"strategy": name, "share": 0.5}
    assert federate(8, replaced_after=4, **settings)[0] == federate(8, **settings)[0]


def updates_from(w):
    return np.array([(TARGET[k] - w) * (1 - shrink(k)) for k in range(2)])


@pytest.mark.parametrize("examples", [(1, 1), (3, 1)])
def test_diloco_equals_a_computation_by_hand_and_a_restart_changes_nothing(examples):
    rate, beta, w, m, expected = 0.7, 0.9, 0.0, 0.0, []
    for _ in range(6):
        u = np.average(updates_from(w), weights=examples)
        m = beta * m + u
        w += rate * (u + beta * m)
        expected.append(w)
    settings = {"strategy": "diloco", "server_momentum": beta}  # the rate is the default
    assert federate(6, examples, **settings)[0] == pytest.approx(expected, rel=1e-5)
    assert federate(6, examples, replaced_after=3, **settings)[0] == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("examples", [(1, 1), (3, 1)])
def test_fedexp_equals_a_computation_by_hand(examples):
    w, expected, rates = 0.0, [], []
    for _ in range(6):
        each = updates_from(w)
        u = np.average(each, weights=examples)
        rates.append(max(1.0, np.average(each**2, weights=examples) / (2 * (u**2 + 1e-3))))
        w += rates[-1] * u
        expected.append(w)
    assert max(rates) > 1.5
    # In float32: where the clients nearly cancel, the rate multiplies the rounding of a small mean.
    assert federate(6, examples, strategy="fedexp")[0] == pytest.approx(expected, rel=1e-3)


def test_the_median_ignores_weights():
    path, *_ = federate(1, (1, 100), strategy="fedmedian")
    ends = [TARGET[k] * (1 - shrink(k)) for k in range(2)]
    assert path[0] == pytest.approx(np.median(ends), rel=1e-5)


def test_a_damaged_control_variate_is_rejected():
    app = quadratic_app()
    grid = InlineGrid(app, 2, {}, raise_errors=True)
    nodes = grid.get_node_ids()
    seen = []
    strategy = build.build_strategy(
        Config(strategy="scaffold", fraction_train=1.0), shapes={"w": (1,)},
        roster=Roster({node: node - FIRST_NODE_ID for node in nodes}, dict.fromkeys(nodes, 1)),
        report=lambda _, who, kind, values: seen.append((who, kind, values.get("reason"))),
        keep_rollouts=lambda *_: None,
    )  # fmt: skip
    start = messages.pack_arrays({"w": np.zeros(1, np.float32)})
    replies = grid.send_and_receive(strategy.configure_train(1, start, ConfigRecord(), grid))
    replies[1].content[messages.CONTROL] = messages.pack_arrays({"w": np.full(1, np.nan, np.float32)})
    strategy.aggregate_train(1, replies)
    assert ("client_1", "rejected", "non-finite") in seen and ("client_0", "train", None) in seen
    assert strategy.control["w"] == pytest.approx(0.5 * FIRST_CONTROL)


# Mean gradient of client 0's first local phase from w = 0, and nothing from client 1.
FIRST_CONTROL = (0.0 - TARGET[0] * (1 - shrink(0))) / (STEPS * RATE)
