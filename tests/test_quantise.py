"""Quantised exchange: rounding errors are small and carried over; arrays that cannot be decoded are rejected."""

import numpy as np
import pytest
from flwr.app import Context, RecordDict

from fedvla_lib.config import EXCHANGES
from fedvla_lib.federation import client_app, messages
from fedvla_lib.federation.quantisation import DOWNWARD, SCALE, check_encoded, decode, encode, with_feedback
from fedvla_lib.policy.parameters import ParameterError

pytestmark = pytest.mark.unit
SHAPES = {"weight": (40, 30), "gain": ()}
ROUNDED = ("float16", "int8")


def change(seed, scale=1e-3):
    rng = np.random.default_rng(seed)
    return {name: np.asarray(scale * rng.normal(size=shape), np.float32) for name, shape in SHAPES.items()}


def test_every_exchange_has_a_way_down():
    assert tuple(DOWNWARD) == EXCHANGES


@pytest.mark.parametrize(("exchange", "bits"), [("float32", 32), ("float16", 16), ("int8", 8)])
def test_fewer_bits_and_an_error_of_half_a_step(exchange, bits):
    sent = change(0)
    encoded = encode(sent, exchange)
    check = encoded["weight"]
    assert check.itemsize * 8 == bits
    arrived = decode(encoded, exchange)
    step = {"float32": 0, "float16": 2**-10 * 0.004, "int8": np.abs(sent["weight"]).max() / 127}[exchange]
    assert np.abs(arrived["weight"] - sent["weight"]).max() <= step / 2 * 1.001
    assert {name: array.shape for name, array in arrived.items()} == SHAPES
    assert all(array.dtype == np.float32 for array in arrived.values())


@pytest.mark.parametrize("exchange", ROUNDED)
def test_zeros_and_huge_values_survive(exchange):
    zeros = {"w": np.zeros(3, np.float32)}
    np.testing.assert_array_equal(decode(encode(zeros, exchange), exchange)["w"], 0)
    huge = {"w": np.float32([1e30, -1e30])}
    assert np.isfinite(decode(encode(huge, exchange), exchange)["w"]).all()


@pytest.mark.parametrize("exchange", ROUNDED)
def test_with_feedback_the_sum_over_rounds_is_right_up_to_one_rounding(exchange):
    left_over, arrived, exact = {}, np.zeros(SHAPES["weight"]), np.zeros(SHAPES["weight"])
    without = np.zeros(SHAPES["weight"])
    for number in range(60):
        now = change(number)
        now["weight"][0] = 1e-6  # always the same, and less than half a step beside the others
        encoded, left_over = with_feedback(now, left_over, exchange)
        arrived += decode(encoded, exchange)["weight"]
        without += decode(encode(now, exchange), exchange)["weight"]
        exact += now["weight"]
    np.testing.assert_allclose(arrived + left_over["weight"], exact, atol=1e-6)
    one_rounding = np.abs(with_feedback(change(0), {}, exchange)[1]["weight"]).max()
    assert np.abs(arrived - exact).max() < 3 * one_rounding
    if exchange == "int8":
        assert (without[0] == 0).all()  # lost in every round
        assert abs(arrived[0].mean() - exact[0].mean()) < 0.5 * exact[0].mean()


@pytest.mark.parametrize("exchange", ROUNDED)
def test_a_client_keeps_the_remainder_in_its_context_and_sends_it_later(exchange):
    start, context = change(99, scale=1.0), Context(1, 2, {}, RecordDict(), {})
    arrived, exact = np.zeros(SHAPES["weight"]), np.zeros(SHAPES["weight"])
    for number in range(60):
        after = {name: start[name] + array for name, array in change(number).items()}
        exact += after["weight"] - start["weight"]
        sent = client_app._outgoing(after, start, exchange, context)
        arrived += decode(sent, exchange)["weight"]
    left_over = messages.unpack_arrays(context.state[client_app.LEFT_OVER])["weight"]
    np.testing.assert_allclose(arrived + left_over, exact, atol=1e-6)
    assert left_over.any()


def test_what_cannot_be_decoded_is_refused():
    good = encode(change(0), "int8")
    check_encoded(good, SHAPES, "int8")
    check_encoded(encode(change(0), "float16"), SHAPES, "float16")
    faults = {
        "names": {name: array for name, array in good.items() if name != "gain" + SCALE},
        "dtype": {**good, "weight": good["weight"].astype(np.float32)},
        "non-finite": {**good, "weight" + SCALE: np.asarray(np.nan, np.float32)},
    }
    for kind, encoded in faults.items():
        with pytest.raises(ParameterError) as caught:
            check_encoded(encoded, SHAPES, "int8")
        assert caught.value.kind == kind
    with pytest.raises(ParameterError, match="expected float16"):
        check_encoded(change(0), SHAPES, "float16")
