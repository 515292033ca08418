"""Checks of the exercises in the chapter on federated averaging."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from fedvla_book.exercises import close, expect

Weights = dict[str, np.ndarray]


def good_average(average: Callable[..., np.ndarray]) -> None:
    """``average(updates, frames)`` averages arrays by frames, without the clients that sent a non-finite value."""
    updates = [np.array([1.0, 2.0]), np.array([5.0, -2.0]), np.array([3.0, np.nan])]
    given = average(updates, [300, 100, 600])
    expect(np.shape(given) == (2,), f"Expected two values, one for each entry, not the shape {np.shape(given)}.")
    expect(not close(np.ravel(given)[0], 2.6), "One bad value excludes the whole reply, its good values as well.")
    expect(np.isfinite(given).all(), "NaN is in the average: leave the client out first; zero times NaN is NaN.")
    expect(not close(given, [0.8, 0.4]), "The shares no longer add up to 1: divide by the frames of those that remain.")
    expect(not close(given, [3.0, 0.0]), "A client with more frames has to count more.")
    expect(close(given, [2.0, 1.0]), "Average those that sent finite values only, weighted by their frames.")
    given = average([np.array([np.inf, 0.0]), np.array([2.0, 4.0]), np.array([6.0, 8.0])], [10, 30, 10])
    expect(close(given, [3.0, 5.0]), "Another client sends an infinite value, which is not finite either.")


def rounds_within(count: Callable[..., int]) -> None:
    """``count(budget_mb, parameters, trainers, evaluators)``: complete rounds whose messages fit (float32)."""
    given = count(170, 500_000, 4, 10)
    expect(given != 10, "A client that evaluates receives the weights as well: count that download.")
    expect(given != 3, "A client that evaluates sends numbers back, no weights: do not count an upload.")
    expect(given != 21, "Weights are sent down as well, to clients that train and to those that evaluate.")
    expect(given != 6, "Clients that train send weights back: count the upload.")
    expect(given != 18, "float32 takes four bytes for each parameter.")
    expect(float(given).is_integer() and given != 5, "Only complete rounds count, and the last one has to fit.")
    expect(given == 4, "A round sends the weights twice per client that trains and once per client that evaluates.")
    expect(count(27, 250_000, 3, 3) == 3, "A budget that fits exactly is enough.")


def round_losses(average: Callable[[list[dict[str, Any]]], Mapping[int, float]]) -> None:
    """``average(events)`` maps each round to its training loss, averaged over the clients that trained, by frames."""
    given = average([*_EVENTS])
    expect(isinstance(given, Mapping), "Return a dict: for each round its loss.")
    expect(0 not in given, "In round 0 no client trains; the model is only evaluated: look at the kind of each event.")
    expect(set(given) == {1, 2}, "Return one entry for each round in which a client trained.")
    found = [given[1], given[2]]
    expect(not close(found, [2.0, 1.25]), "A client with more frames counts more here, too.")
    expect(
        not close(found, [1.0, 550 / 600]),
        "Divide by the frames of the clients that trained in this round, not of all.",
    )
    expect(close(found, [1.5, 1.1]), "Take the loss and the frames of each event of kind train, and of no other kind.")
    alone = average([_event(5, "client_1", "train", 0.7, 40)])
    expect(dict(alone).keys() == {5} and close(alone[5], 0.7), "Rounds need not begin at 1: take them from the events.")


def _event(number: int, who: str, kind: str, loss: float, frames: int) -> dict[str, Any]:
    return {"round": number, "who": who, "kind": kind, "values": {"num_examples": frames, "loss": loss}}


_EVENTS = [
    _event(0, "global", "evaluate", 3.4, 24),
    _event(1, "client_0", "train", 3.0, 100),
    _event(1, "client_2", "train", 1.0, 300),
    _event(1, "global", "evaluate", 2.2, 24),
    _event(2, "client_1", "train", 2.0, 200),
    {"round": 2, "who": "client_0", "kind": "rejected", "values": {"to": "train", "reason": "hash"}},
    _event(2, "client_2", "train", 0.5, 300),
    _event(2, "global", "evaluate", 1.9, 24),
]


def federated_round(train: Callable[..., np.ndarray]) -> None:
    """``train(parts, weights, rate, local_steps)`` averages the clients' weights after local steps by frames."""
    rng = np.random.default_rng(4)
    parts = [(rng.normal(k, 1, (n, 2)), rng.normal(size=n)) for k, n in enumerate((5, 20, 10))]
    pooled = [tuple(np.concatenate(values) for values in zip(*parts, strict=True))]
    frames = np.array([5, 20, 10])
    for local_steps in (1, 4):
        weights = np.array([1.0, -1.0])
        given = train(parts, weights, 0.1, local_steps)
        expect(np.array_equal(weights, [1.0, -1.0]), "You overwrite the server's weights: take each step on a copy.")
        ends = np.stack([_descended([part], weights, local_steps) for part in parts])
        chained = np.stack([_descended(parts[: k + 1], weights, local_steps) for k in range(3)])
        for after in (chained[-1], chained.mean(axis=0), frames @ chained / 35):
            expect(not close(given, after), "Each client starts at the server's weights, not where another stopped.")
        expect(not close(given, ends.mean(axis=0)), "Not all clients count the same: weight them by their frames.")
        right = frames @ ends / 35
        expect(local_steps > 1 or close(given, right), "With one local step it has to be one step on all data at once.")
        together = _descended(pooled, weights, local_steps)
        own = "With several local steps clients diverge: average once, after the last, not after each."
        expect(local_steps == 1 or not close(given, together), own)
        expect(close(given, right), "Take all local steps of a client in a row, each from where the last one ended.")


def _descended(parts: Sequence[tuple[np.ndarray, ...]], w: np.ndarray, steps: int) -> np.ndarray:
    """Descend on each part in turn, for some steps."""
    for x, y in parts:
        for _ in range(steps):
            w = w - 0.1 * x.T @ (x @ w - y) / len(y)
    return w


def surviving(share: Callable[..., float]) -> None:
    """``share(start, updates, frames)`` is the norm of the mean update over the mean norm of the updates."""
    for seed in (0, 1):
        rng = np.random.default_rng(seed)
        start = {name: 5 + rng.normal(size=shape) for name, shape in (("a", (3,)), ("b", (2, 2)))}
        updates = [{name: array + rng.normal(size=array.shape) for name, array in start.items()} for _ in range(3)]
        frames = [10, 40, 150]
        given = share(start, updates, frames)
        nothing = {name: np.zeros_like(array) for name, array in start.items()}
        of_weights = _survives(nothing, updates, frames)
        expect(not close(given, of_weights), "You compare weights, which are nearly equal: subtract the start.")
        right = _survives(start, updates, frames)
        expect(not close(given, 1 / right), "It is inverted: the ratio cannot exceed 1.")
        alike = _survives(start, updates, [1, 1, 1])
        expect(not close(given, alike), "Weight clients by their frames, in numerator and denominator.")
        apart = [_survives({n: start[n]}, updates, frames) for n in start]
        expect(not close(given, np.mean(apart)), "One norm over all arrays together, not one for each array.")
        expect(close(given, right), "Numerator: the norm of the mean update. Denominator: the mean of the norms.")


def _survives(start: Weights, updates: list[Weights], frames: Sequence[int]) -> float:
    moves = np.stack([np.concatenate([(one[name] - start[name]).ravel() for name in start]) for one in updates])
    shares = np.array(frames) / sum(frames)
    return float(np.linalg.norm(shares @ moves) / (shares @ np.linalg.norm(moves, axis=1)))
