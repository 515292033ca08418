"""Checks of the exercises in the chapter on strategies."""

from collections.abc import Callable, Sequence

import numpy as np

from fedvla_book.exercises import close, expect


def rounds_at_equal_steps(count: Callable[[int, int, int, int, int], float]) -> None:
    """``count(rounds, drawn, steps, new_drawn, new_steps)`` is the number of new rounds with as many steps."""
    for rounds, drawn, steps, new_drawn, new_steps in [(40, 4, 5, 4, 20), (40, 4, 5, 2, 2), (12, 3, 10, 9, 2)]:
        given = count(rounds, drawn, steps, new_drawn, new_steps)
        budget, by_phase = rounds * drawn * steps, rounds * steps / new_steps
        expect(drawn == new_drawn or not close(given, by_phase), "Every sampled client trains: count it as well.")
        expect(not close(given, budget), "Those are the gradient steps; in how many of the new rounds are they taken?")
        expect(close(given, budget / (new_drawn * new_steps)), "A round with more steps leaves fewer rounds.")


def resting_point(rest: Callable[[np.ndarray, np.ndarray, float, int], float]) -> None:
    """``rest(curvature, wanted, rate, steps)`` is where federated averaging of quadratics converges."""
    cases = [([4, 1], [-1, 2], 0.1, 5), ([5, 2, 0.5], [0, 1, 4], 0.15, 8), ([3, 1], [2, -1], 0.2, 1)]
    for *arrays, rate, steps in cases:
        curvature, wanted = (np.array(values, dtype=float) for values in arrays)
        given = rest(curvature.copy(), wanted.copy(), rate, steps)
        optimum, left = curvature @ wanted / curvature.sum(), (1 - rate * curvature) ** steps
        expect(
            not close(given, wanted.mean()),
            "That is the mean of the clients' minima: only infinitely many local steps lead there.",
        )
        expect(steps == 1 or not close(given, optimum), "That is the optimum: only a single local step leads there.")
        expect(
            not close(given, left @ wanted / left.sum()), "You weight by the share of the way left, not by that gone."
        )
        right = _averaged(curvature, wanted, rate, steps)
        expect(
            close(given, right),
            "At convergence the updates cancel: what share of the way to its minimum does a client go?",
        )


def pulls(alive: Callable[[Callable[[float], float]], bool]) -> None:
    """``alive(move)`` tells whether a FedProx pulls; ``move(mu)`` is the length of a client's update with weight mu."""
    expect(not alive(_mover(0)), "A pull without any effect passes your test.")
    expect(not alive(_mover(-1)), "A pull with the wrong sign, away from the global model, passes your test.")
    expect(bool(alive(_mover(1))), "You reject a FedProx that works: which of two updates is shorter?")
    scaled = alive(_mover(1, wish=300.0)) and alive(_mover(1, wish=1e-4))
    expect(bool(scaled), "Updates can be very long or very short: compare two updates, not one with a number.")


def proximal_phase(train: Callable[..., np.ndarray]) -> None:
    """``train(gradient, start, steps, rate, mu)`` is where a client of FedProx ends; `start` stays as it was."""
    start, mu = np.array([1.0, -2.0, 0.5]), 3.0

    def gradient(w: np.ndarray) -> np.ndarray:
        return np.array([4.0, 1.0, 2.0]) * (w - np.array([-1.0, 2.0, 3.0]))

    def right(mu: float, anchor: np.ndarray = start) -> np.ndarray:
        w = start
        for _ in range(5):
            w = w - 0.1 * (gradient(w) + mu * (w - anchor))
        return w

    mine = start.copy()
    given = train(gradient, mine, 5, 0.1, mu)
    expect(not close(given, right(0.0)), "The pull has no effect: does your anchor move with the weights?")
    expect(not close(given, right(-mu)), "Your client is pushed away from the global model: look at the sign.")
    expect(not close(given, right(mu, np.zeros(3))), "You pull towards zero; the pull is towards the global model.")
    expect(close(given, right(mu)), "Add mu times the difference from the global model to the gradient of each step.")
    expect(close(mine, start), "The result is right, but the given global model has changed: step on a copy.")


def cosines(measure: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> None:
    """``measure(start, ends)`` is the cosine of each client's update with the mean update; 0 for an update of 0."""
    rng = np.random.default_rng(7)
    start, moved = rng.normal(0, 50, 12), rng.normal(0, 1, (4, 12)) * np.array([[1.0], [3.0], [0.5], [2.0]])
    mean, lengths = moved.mean(axis=0), np.linalg.norm(moved, axis=1)
    right = moved @ mean / lengths / np.linalg.norm(mean)
    units = moved / lengths[:, None]
    heading = units.mean(axis=0)
    with np.errstate(all="ignore"):
        given = measure(start.copy(), start + moved)
        still = measure(start.copy(), start + np.vstack([moved, np.zeros(12)]))
    expect(np.shape(given) == (4,), f"Expected one cosine for each of the 4 clients, not the shape {np.shape(given)}.")
    expect(not close(given, moved @ mean), "Those are products: divide by the norms of both updates.")
    expect(np.min(given) < 0.98, "All near 1: you compare weights, and the shared start hides the updates.")
    expect(not close(given, moved @ mean / lengths), "Divide by the norm of the mean update as well.")
    expect(not close(given, units @ heading / np.linalg.norm(heading)), "In the mean, a longer update counts more.")
    expect(close(given, right), "A cosine is the product of two updates over the product of their norms.")
    expect(not np.isnan(still).any(), "An update of 0 has norm 0 and gets nan: give it the cosine 0.")
    expect(close(still, [*right, 0.0]), "An update of 0 has the cosine 0, and the others keep theirs.")


def scaffold_round(play: Callable[..., tuple[float, np.ndarray]]) -> None:
    """``play(gradients, w, own, drawn, rate, steps)`` is one round of SCAFFOLD: the new w and all control variates."""
    curvature, wanted, own = np.array([4.0, 1.0, 2.0]), np.array([-1.0, 2.0, 0.5]), np.array([1.5, -0.8, 2.0])
    gradients = [lambda w, k=k: curvature[k] * (w - wanted[k]) for k in range(3)]
    for drawn, steps in [([0, 1], 4), ([2], 5), ([0, 1, 2], 3)]:
        given = play(gradients, 0.7, own.copy(), list(drawn), 0.1, steps)
        expect(isinstance(given, tuple) and len(given) == 2, "Return two things: the new w, and all control variates.")
        expect(np.shape(given[1]) == (3,), "Return the control variates of all 3 clients, sampled or not.")
        w, after = given[0], np.asarray(given[1], dtype=float)
        idle = [k for k in range(3) if k not in drawn]
        expect(close(after[idle], own[idle]), "A client that was not sampled keeps its control variate.")
        end, seen = _scaffold(gradients, drawn, steps, own.mean() - own)
        partial, _ = _scaffold(gradients, drawn, steps, own[drawn].mean() - own)
        turned, _ = _scaffold(gradients, drawn, steps, own - own.mean())
        expect(not idle or not close(w, partial), "c is the mean over all clients; you average over the sampled ones.")
        expect(not close(w, turned), "The correction is reversed: subtract the client's own variate, add the mean.")
        expect(close(w, end), "w is wrong: each step adds c - c_k, both from the start of the round.")
        expect(not close(after[drawn], seen + own.mean()), "The new c_k are too large by c, which the steps include.")
        expect(close(after[drawn], seen), "w is right; the new c_k is the mean of the gradients along the way.")


def _averaged(curvature: np.ndarray, wanted: np.ndarray, rate: float, steps: int) -> float:
    """Return w after many rounds of federated averaging."""
    w = 0.0
    for _ in range(2_000):
        ends = np.full(len(wanted), w)
        for _ in range(steps):
            ends = ends - rate * curvature * (ends - wanted)
        w = float(ends.mean())
    return w


def _mover(sign: int, wish: float = -1.0) -> Callable[[float], float]:
    """Return the update length of a client that is pulled back (1), not at all (0), or away (-1)."""

    def move(mu: float) -> float:
        w = 0.0
        for _ in range(50):
            w -= 0.01 * (4.0 * (w - wish) + sign * mu * w)
        return abs(w)

    return move


def _scaffold(
    gradients: Sequence[Callable[[float], float]], drawn: list[int], steps: int, shift: np.ndarray
) -> tuple[float, np.ndarray]:
    """Return the mean of where the drawn clients end, from 0.7, and the mean of the gradients that each met."""
    ends, seen = [], []
    for k in drawn:
        w, met = 0.7, []
        for _ in range(steps):
            met.append(gradients[k](w))
            w -= 0.1 * (met[-1] + shift[k])
        ends.append(w)
        seen.append(np.mean(met))
    return float(np.mean(ends)), np.array(seen)
