"""Checks of the exercises in the chapter on local training."""

from collections.abc import Callable
from typing import Any

import numpy as np

from fedvla_book.exercises import close, expect


def upload_mb(count: Callable[..., float]) -> None:
    """``count(parameters, trains, num_clients, num_rounds)`` is the megabytes of all uploads, in float32."""
    parameters, trains = np.array([400_000, 250_000, 30_000]), np.array([False, True, True])
    given = count(parameters, trains, 5, 8)
    expect(not close(given, 4 * 680_000 * 40 / 1e6), "Frozen parts are not sent: count only trainable parameters.")
    expect(not close(given, 280_000 * 40 / 1e6), "That is the number of parameters; in float32 each takes four bytes.")
    expect(not close(given, 4 * 280_000 * 40), "That is in bytes; a megabyte is a million of them.")
    expect(not close(given, 4 * 280_000 / 1e6), "That is one upload; each client sends one in each round.")
    expect(close(given, 44.8), "Bytes of the trainable parameters, times clients, times rounds, over a million.")
    other = count(parameters, np.array([True, False, True]), 2, 3)
    expect(close(other, 4 * 430_000 * 6 / 1e6), "Wrong for another choice of trainable parts: use `trains`.")


def flow_loss(measure: Callable[..., float]) -> None:
    """``measure(velocity, noise, action, is_pad)`` is the flow-matching loss over the steps that are not padding."""
    for seed in (0, 1):
        velocity, noise, action = np.random.default_rng(seed).normal(size=(3, 3, 4, 6))
        is_pad = np.arange(4) >= np.array([[4], [3], [1 + seed]])
        given = measure(velocity, noise, action, is_pad)
        expect(np.shape(given) == (), f"Expected one number for the batch, not the shape {np.shape(given)}.")
        squares = (velocity - (noise - action)) ** 2
        backward = (velocity - (action - noise)) ** 2
        expect(not close(given, squares.mean()), "Padding is still in: average over valid steps only.")
        diluted = squares[~is_pad].sum() / squares.size
        expect(not close(given, diluted), "Padding is not in the sum, but still in the number that you divide by.")
        each = np.mean([one[~pad].mean() for one, pad in zip(squares, is_pad, strict=True)])
        expect(not close(given, each), "Each valid step counts the same: do not average within a sample first.")
        expect(not close(given, 6 * squares[~is_pad].mean()), "Divide by the number of joints as well.")
        expect(
            not close(given, backward[~is_pad].mean()), "The sign: the velocity points from the action to the noise."
        )
        expect(close(given, squares[~is_pad].mean()), "Square the difference of the velocity and noise minus action.")


def denoised(walk: Callable[..., np.ndarray]) -> None:
    """``walk(velocity, noise, num_steps)`` follows ``velocity(x, t)`` from t = 1 to t = 0 in Euler steps."""
    for num_steps in (4, 5):
        noise = np.array([2.0, -1.0, 0.5])
        asked: list[tuple[np.ndarray, float]] = []
        given = walk(_noting(asked), noise, num_steps)
        expect(close(noise, [2.0, -1.0, 0.5]), "You overwrite the given noise: work on a copy.")
        times = [t for _, t in asked]
        once = f"{num_steps} steps evaluate the velocity once each; yours evaluate it {len(asked)} times."
        expect(len(asked) == num_steps, once)
        expect(close(times[0], 1.0), "Start at t = 1, in pure noise; a step evaluates the velocity at its start.")
        right = np.arange(num_steps, 0, -1) / num_steps
        expect(close(times, right), "All steps are equally long, and the last one starts before t = 0.")
        expect(not close(asked[-1][0], noise), "Evaluate the velocity at the current point, not at the noise.")
        expect(not close(given, _walked(noise, right, -1 / num_steps)), "Time runs down: go against the velocity.")
        expect(
            not close(given, _walked(noise, right, 1.0)), "A step is 1 / num_steps long; you add the whole velocity."
        )
        stride = "Subtract the length of a step times the velocity at the current point."
        expect(close(given, _walked(noise, right, 1 / num_steps)), stride)


def _field(x: np.ndarray, t: float) -> np.ndarray:
    return 0.5 * x + t


def _noting(asked: list[tuple[np.ndarray, float]]) -> Callable[[np.ndarray, float], np.ndarray]:
    """Return a velocity that records where and when it is evaluated."""

    def velocity(x: np.ndarray, t: float) -> np.ndarray:
        asked.append((np.array(x), float(t)))
        return _field(x, t)

    return velocity


def _walked(x: np.ndarray, times: np.ndarray, length: float) -> np.ndarray:
    for t in times:
        x = x - length * _field(x, t)
    return x


def resumable(train: Callable[..., tuple[np.ndarray, Any]]) -> None:
    """``train(weights, gradient, num_steps, state)`` returns weights and state, and goes on exactly from a state."""
    start = np.array([3.0, -2.0])

    def go(weights: np.ndarray, num_steps: int, state: Any) -> tuple[np.ndarray, Any]:
        given = train(weights, _slope, num_steps, state)
        expect(isinstance(given, tuple) and len(given) == 2, "Return two things: the weights, and the state.")
        return given

    whole = np.array(go(start.copy(), 4, None)[0])
    unbroken = "Wrong even without a stop: compare with the two formulas, from s = 0 on."
    expect(close(whole, _descended(start, 4)), unbroken)
    weights, state = go(start.copy(), 2, None)
    half = np.array(weights)
    momentum_lost, place_lost, both_lost = (
        _descended(half, 2, first, kept) for first, kept in ((2, 0.0), (0, _momentum(start, 2)), (0, 0.0))
    )
    rest = np.array(go(weights, 2, state)[0])
    expect(not close(rest, both_lost), "After the stop everything starts from zero: return the state, and use it.")
    expect(not close(rest, momentum_lost), "After the stop the momentum starts at zero: it belongs in the state.")
    expect(
        not close(rest, place_lost),
        "After the stop the learning rate starts at its peak: the step number belongs in the state, too.",
    )
    expect(np.array_equal(rest, whole), "Two and two steps must give the same bits as four.")
    again = np.array(go(weights, 2, state)[0])
    expect(np.array_equal(again, rest), "A second run from the same checkpoint differs: you changed its contents.")


def _slope(w: np.ndarray) -> np.ndarray:
    return 0.5 * w - np.array([1.0, 0.5])


def _descended(w: np.ndarray, steps: int, first: int = 0, momentum: np.ndarray | float = 0.0) -> np.ndarray:
    for step in range(first, first + steps):
        momentum = 0.9 * momentum + _slope(w)
        w = w - 0.1 / (1 + step) * momentum
    return w


def _momentum(w: np.ndarray, steps: int) -> np.ndarray:
    """Return the momentum after some steps: the last step over its rate."""
    return (_descended(w, steps - 1) - _descended(w, steps)) * steps / 0.1


def two_errors(measure: Callable[..., tuple[float, float]]) -> None:
    """``measure(policy, states_deg)`` is the mean error on recorded states, and on those the policy brings about."""
    for policy, states in (
        (lambda state: state + 1.9, np.arange(0.0, 22.0, 2.0)),
        (lambda state: 1.2 * state - 1.0, np.array([4.0, 5.0, 3.5, 3.0, 4.5, 5.5])),
    ):
        given = measure(policy, states.copy())
        expect(np.shape(given) == (2,), "Return two numbers: on recorded states, and on the policy's own.")
        recorded = policy(states[:-1])
        own = np.array([_after(policy, states[0], n) for n in range(1, len(states))])
        opened, closed = (np.abs(wanted - states[1:]).mean() for wanted in (recorded, own))
        late = np.abs(recorded - states[:-1]).mean()
        expect(not close(given[0], late), "An answer is the next target: compare with the *next* state.")
        signed = (recorded - states[1:]).mean()
        expect(not close(given[0], signed), "Errors of opposite sign must not cancel: average absolute values.")
        expect(
            close(given[0], opened), "The first number: query the policy at each recorded state that has a next one."
        )
        expect(
            not close(given[1], opened),
            "The second number queries recorded states too: query where the policy has moved the arm.",
        )
        last = np.abs(own - states[1:])[-1]
        expect(not close(given[1], last), "The second number is a mean over all steps, not the error at the end.")
        expect(
            close(given[1], closed),
            "The second number: start at the first state, and query the policy at each of its answers.",
        )


def _after(policy: Callable[[float], float], state: float, times: int) -> float:
    for _ in range(times):
        state = policy(state)
    return state
