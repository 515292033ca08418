"""Properties of the exchange format: round trips are exact, and damaged arrays are rejected."""

import numpy as np
import pytest
import torch

from fedvla_lib.data import normalisation
from fedvla_lib.federation import messages
from fedvla_lib.policy import parameters
from fedvla_lib.policy.parameters import ParameterError

pytestmark = pytest.mark.unit


@pytest.fixture
def policy():
    """Two trainable layers behind a frozen one; the last is bfloat16 and there is a scalar parameter."""
    torch.manual_seed(0)
    net = torch.nn.Sequential(torch.nn.Linear(3, 4), torch.nn.Linear(4, 2), torch.nn.Linear(2, 2).to(torch.bfloat16))
    net[0].requires_grad_(False)
    net.register_parameter("gain", torch.nn.Parameter(torch.tensor(0.5)))
    return net


def test_only_trainable_parameters_travel_as_float32(policy):
    arrays = parameters.trainable_arrays(policy)
    assert set(arrays) == {"gain", "1.weight", "1.bias", "2.weight", "2.bias"}
    assert {array.dtype for array in arrays.values()} == {np.dtype(np.float32)}


def test_extracted_arrays_do_not_alias_the_live_weights(policy):
    arrays = parameters.trainable_arrays(policy)
    before = parameters.digest(arrays)
    with torch.no_grad():
        policy[1].weight.add_(1)
    assert parameters.digest(arrays) == before


def test_loading_restores_every_value_and_leaves_frozen_ones(policy):
    frozen = policy[0].weight.clone()
    arrays = parameters.trainable_arrays(policy)
    other = {name: array + np.float32(1) for name, array in arrays.items()}
    parameters.load_arrays(policy, other)
    assert parameters.digest(parameters.trainable_arrays(policy)) != parameters.digest(arrays)
    parameters.load_arrays(policy, arrays)
    assert parameters.digest(parameters.trainable_arrays(policy)) == parameters.digest(arrays)
    assert torch.equal(policy[0].weight, frozen)


def test_a_rejected_set_changes_nothing(policy):
    before = parameters.digest(parameters.trainable_arrays(policy))
    bad = parameters.trainable_arrays(policy)
    bad["gain"] = np.array(np.nan, np.float32)
    with pytest.raises(ParameterError):
        parameters.load_arrays(policy, bad)
    assert parameters.digest(parameters.trainable_arrays(policy)) == before


def test_a_frozen_policy_is_refused(policy):
    with pytest.raises(ValueError, match="no trainable parameter"):
        parameters.trainable_arrays(policy.requires_grad_(False))


def test_digest_sees_values_names_and_shapes_but_not_order():
    a = {"x": np.zeros((2, 3), np.float32), "y": np.ones(2, np.float32)}
    assert parameters.digest(a) == parameters.digest({"y": a["y"], "x": a["x"]})
    changed = [
        {**a, "y": np.array([1, 1.0000001], np.float32)},
        {"x": a["y"], "y": a["x"]},
        {**a, "x": np.zeros((3, 2), np.float32)},
        {"x": a["x"]},
    ]
    assert len({parameters.digest(c) for c in [a, *changed]}) == 5


def _damage(arrays):
    first = next(iter(arrays))
    renamed = {("other" if name == first else name): array for name, array in arrays.items()}
    inf = arrays["1.bias"].copy()
    inf[0] = np.inf
    return {
        "missing": ("names", {name: array for name, array in arrays.items() if name != first}),
        "renamed": ("names", renamed),
        "reshaped": ("shape", {**arrays, "1.weight": arrays["1.weight"].T.copy()}),
        "float64": ("dtype", {**arrays, "1.weight": arrays["1.weight"].astype(np.float64)}),
        "infinite": ("non-finite", {**arrays, "1.bias": inf}),
        "altered": ("hash", {**arrays, "1.bias": arrays["1.bias"] + np.float32(1e-3)}),
    }


@pytest.mark.parametrize("fault", ["missing", "renamed", "reshaped", "float64", "infinite", "altered"])
def test_each_kind_of_damage_is_named(policy, fault):
    arrays = parameters.trainable_arrays(policy)
    kind, damaged = _damage(arrays)[fault]
    with pytest.raises(ParameterError) as caught:
        parameters.check_arrays(damaged, parameters.shapes_of(arrays), parameters.digest(arrays))
    assert caught.value.kind == kind
    assert "\n" not in str(caught.value)
    parameters.check_arrays(arrays, parameters.shapes_of(arrays), parameters.digest(arrays))


def test_arrays_and_statistics_survive_the_wire_exactly(policy):
    arrays = parameters.trainable_arrays(policy)
    back = messages.unpack_arrays(messages.pack_arrays(arrays))
    assert list(back) == list(arrays)
    assert parameters.digest(back) == parameters.digest(arrays)
    rng = np.random.default_rng(0)
    stats = {"action": {"mean": rng.normal(size=6), "count": np.array([7])}}
    returned = normalisation.unpack_stats(normalisation.pack_stats(stats))
    assert np.array_equal(returned["action"]["mean"], stats["action"]["mean"])
    assert returned["action"]["count"].dtype.kind == "i"
