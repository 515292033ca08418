"""Checks of the exercises in the chapter on privacy."""

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from fedvla_book.exercises import close, expect

PEOPLE = ("eavesdropper", "server", "other labs")
HIDDEN_FROM = {  # from whom each measure hides one lab's own update
    "TLS": {"eavesdropper"},
    "node keys": set(),
    "secure aggregation": {"eavesdropper", "server"},
    "noise by the server": {"other labs"},
    "noise by each lab": {"server", "other labs", "eavesdropper"},
}


def hides_one_update(table: Mapping[str, Sequence[str]]) -> None:
    """A dict: for each measure alone, from whom it hides what one lab's update says; others may see it."""
    expect(isinstance(table, Mapping), "Give a dict: for each measure the list of those it hides an update from.")
    given = {name: set(who) for name, who in table.items()}
    expect(set(given) == set(HIDDEN_FROM), f"The measures are {', '.join(HIDDEN_FROM)}.")
    expect(set().union(*given.values()) <= set(PEOPLE), f"They can hide it from {', '.join(PEOPLE)}.")
    expect("server" not in given["TLS"], "TLS ends at the server, which reads every update.")
    expect(not given["node keys"], "Keys say who a node is; they encrypt nothing.")
    summed = given["secure aggregation"]
    expect("server" in summed, "The masks of the labs cancel only in the sum, so the server cannot read one update.")
    expect("other labs" not in summed, "Masks hide updates on the way; the model, which all labs get, holds the sum.")
    expect("server" not in given["noise by the server"], "Whoever adds the noise has seen the update without it.")
    expect("eavesdropper" in summed, "What is masked for the server is masked for everyone on the way.")
    expect(given == HIDDEN_FROM, "Ask for each pair: does this measure change what this person sees?")


def private_mean(mean: Callable[..., np.ndarray]) -> None:
    """``mean(updates, limit, noise, rng)`` clips, sums, adds noise of ``noise * limit``, and divides by the number."""
    updates = np.array([[3.0, 4.0], [0.3, 0.4], [0.0, 0.0], [-6.0, 0.0]])

    def run(rows: np.ndarray, noise: float, limit: float = 1.0) -> np.ndarray:
        return np.asarray(mean(rows.copy(), limit, noise, np.random.default_rng(0)))

    given = run(updates, 0.0)
    expect(given.shape == (2,), "Return one array of the size of an update.")
    expect(np.isfinite(given).all(), "An update of length zero gives 0 / 0: scale by min(1, limit / length) with care.")
    expect(not close(given, updates.mean(axis=0)), "Nothing is clipped: without it one lab can move the sum anywhere.")
    whole = updates.mean(axis=0)
    expect(not close(given, whole / np.linalg.norm(whole)), "Clip each update before they are added, not their mean.")
    signs = np.array([[0.6, 0.8], [0.6, 0.8], [0, 0], [-1, 0]]).mean(axis=0)
    expect(not close(given, signs), "A short update stays as it is: clipping only shortens.")
    expect(not close(given, np.clip(updates, -1, 1).mean(axis=0)), "Clip the length of an update, not each number.")
    expect(close(given, [-0.025, 0.3]), "Scale each update to the limit if it is longer, and average them.")
    many = np.zeros((4, 40_000))
    deviation = np.std(run(many, 2.0, limit=3.0))
    expect(not math.isclose(deviation, 0, abs_tol=1e-9), "There is no noise yet.")
    expect(not math.isclose(deviation, 6, rel_tol=0.05), "The noise is for the sum: divide it by the number as well.")
    expect(not math.isclose(deviation, 3, rel_tol=0.05), "Noise once on the sum; here every update got all of it.")
    expect(not math.isclose(deviation, 0.5, rel_tol=0.05), "The noise is in units of the limit: noise * limit.")
    expect(math.isclose(deviation, 1.5, rel_tol=0.05), "The noise on the sum has standard deviation noise * limit.")


def epsilon_of_run(epsilon: Callable[[float, int, float], float]) -> None:
    """``epsilon(noise, rounds, delta)`` by Renyi accounting: orders 1.1 to 64 in steps of 0.1, Gaussian noise."""
    orders = np.arange(11, 641) / 10

    def right(noise: float, rounds: int, delta: float) -> float:
        return float((rounds * orders / (2 * noise**2) + math.log(1 / delta) / (orders - 1)).min())

    for noise, rounds, delta in [(1.2, 2, 0.01), (4.0, 100, 1e-5)]:
        given = epsilon(noise, rounds, delta)
        expect(np.shape(given) == (), "Return one number.")
        expect(not close(given, right(noise, 1, delta)), "That is one round, and every round releases a model.")
        expect(
            not close(given, rounds * right(noise, 1, delta)),
            "Add the divergences, and convert once, at the end.",
        )
        at_two = rounds * 2 / (2 * noise**2) + math.log(1 / delta)
        expect(not close(given, at_two), "Any order above 1 gives a bound: take the smallest over all of them.")
        expect(
            close(given, right(noise, rounds, delta)), "Minimise rounds * a / (2 noise^2) + log(1 / delta) / (a - 1)."
        )


def state_from_gradient(state: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> None:
    """``state(weight, bias)`` is x, from dL/dW = g x^T and dL/db = g, exact, and with zeros in g."""
    rng = np.random.default_rng(5)
    x = rng.normal(size=6)
    g = rng.normal(size=20)
    g[[3, 7]] = 0.0
    given = np.asarray(state(np.outer(g, x), g.copy()))
    expect(given.shape == (6,), "Return the six numbers of the state.")
    expect(np.isfinite(given).all(), "Some entries of the bias gradient are zero: dividing by each of them gives NaN.")
    expect(not close(given, g.sum() * x), "Divide by the bias gradient.")
    expect(close(given, x), "Every row of dL/dW is x times that row's entry of dL/db.")
    rough = np.outer(g, x) + rng.normal(size=(20, 6)) * 0.01
    given = np.asarray(state(rough, g.copy()))
    best = g @ rough / (g @ g)
    expect(close(given, best), "With noise, rows with a large entry count more: use least squares, g W / (g g).")


def masked(mask: Callable[[np.ndarray, int, Mapping[tuple[int, int], np.ndarray]], np.ndarray]) -> None:
    """``mask(vector, me, masks)``: of each pair (i, j), i < j, client i adds the mask and j takes it off, mod 2^32."""
    rng = np.random.default_rng(2)
    vectors = rng.integers(0, 1000, (3, 50))
    masks = {(i, j): rng.integers(0, 2**32, 50, dtype=np.uint32) for i in range(3) for j in range(i + 1, 3)}
    given = [np.asarray(mask(vectors[me].copy(), me, dict(masks))) for me in range(3)]
    expect(all(one.shape == (50,) for one in given), "Return a vector of the same size.")
    expect(all(one.dtype == np.uint32 for one in given), "Return uint32, so that sums wrap around at 2^32.")
    plain = any(np.array_equal(one, vector) for one, vector in zip(given, vectors, strict=True))
    expect(not plain, "One vector is sent without a mask: every client is in two of the pairs.")
    total = np.sum(given, axis=0, dtype=np.uint32)
    expect(np.array_equal(total, vectors.sum(axis=0)), "The masks do not cancel: one adds and one takes off.")


def needs_noise(names: Callable[[Sequence[Mapping[str, object]]], Sequence[str]]) -> None:
    """``names(released)`` lists what is computed from the labs' data, leaves the server, and has no noise."""
    released = [
        {"name": "model of round 1", "from_data": True, "noise": True, "leaves": True},
        {"name": "mean and spread of the joints", "from_data": True, "noise": False, "leaves": True},
        {"name": "number of rounds", "from_data": False, "noise": False, "leaves": True},
        {"name": "log of the server", "from_data": True, "noise": False, "leaves": False},
        {"name": "held-out loss of each round", "from_data": True, "noise": False, "leaves": True},
    ]
    given = list(names([*released]))
    expect(all(isinstance(name, str) for name in given), "Return a list of names.")
    expect("mean and spread of the joints" in given, "The statistics before the first round are data, too.")
    expect("number of rounds" not in given, "A setting tells nothing about the labs' data.")
    expect("log of the server" not in given, "What stays at the server is not released: it is trusted here.")
    expect("model of round 1" not in given, "The model has its noise already.")
    right = ["mean and spread of the joints", "held-out loss of each round"]
    expect(sorted(given) == sorted(right), "Three conditions: from the data, without noise, and it leaves the server.")
