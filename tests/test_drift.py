"""Norms and angles of hand-made updates."""

import numpy as np
import pytest

from fedvla_lib.federation.drift import MOST_COMPARED, geometry
from fedvla_lib.policy.parameters import layer_of

pytestmark = pytest.mark.unit
EXPERT = "model.vlm_with_expert.lm_expert.layers.{}.mlp.up_proj.weight"
START = {EXPERT.format(0): np.ones((2, 1), np.float32), "model.action_in_proj.weight": np.zeros(2, np.float32)}


def moved(expert, projection):
    return dict(zip(START, [START[EXPERT.format(0)] + np.float32(expert), np.float32(projection)], strict=True))


def test_parts_are_named_by_layer():
    assert layer_of(EXPERT.format(11)) == "expert layer 11"
    assert layer_of("model.action_in_proj.weight") == "projections"
    assert layer_of("model.vlm_with_expert.lm_expert.norm.weight") == "projections"


def test_lengths_and_angles_are_those_of_the_updates():
    found = geometry(START, {"a": moved([[3], [0]], [0, 0]), "b": moved([[0], [4]], [0, 0])})
    assert found["a"]["norm.all"] == pytest.approx(3) and found["b"]["norm.expert layer 0"] == pytest.approx(4)
    assert found["a"]["toward.b"] == pytest.approx(0)
    assert found["a"]["cosine.all"] == pytest.approx(3 / 5) and found["b"]["cosine.all"] == pytest.approx(4 / 5)
    assert found["a"]["norm.projections"] == found["a"]["cosine.projections"] == 0


def test_opposite_updates_point_apart():
    found = geometry(START, {"a": moved(1, [1, 0]), "b": moved(-1, [-1, 0])})
    assert found["a"]["toward.b"] == pytest.approx(-1)


def test_many_clients_are_compared_with_their_mean_only():
    rng = np.random.default_rng(0)
    ends = {f"client_{k}": moved(rng.normal(size=(2, 1)), rng.normal(size=2)) for k in range(MOST_COMPARED + 1)}
    few = dict(list(ends.items())[:MOST_COMPARED])
    assert any(name.startswith("toward") for name in geometry(START, few)["client_0"])
    found = geometry(START, ends)["client_0"]
    assert not any(name.startswith("toward") for name in found) and -1 <= found["cosine.all"] <= 1
