"""Checks of the exercises in the chapter on strategies."""

from collections.abc import Callable, Sequence

import numpy as np

from fedvla_book.exercises import close, expect


def rounds_at_equal_steps(count: Callable[[int, int, int, int, int], float]) -> None:
    """``count(rounds, drawn, steps, new_drawn, new_steps)`` is how many rounds of the new kind cost as many steps."""
    for rounds, drawn, steps, new_drawn, new_steps in [(40, 4, 5, 4, 20), (40, 4, 5, 2, 2), (12, 3, 10, 9, 2)]:
        given = count(rounds, drawn, steps, new_drawn, new_steps)
        budget, by_phase = rounds * drawn * steps, rounds * steps / new_steps
        expect(drawn == new_drawn or not close(given, by_phase), "Every client that is drawn trains: count it as well.")
        expect(not close(given, budget), "Those are the gradient steps; in how many of the new rounds are they spent?")
        expect(close(given, budget / (new_drawn * new_steps)), "A round that does more steps leaves fewer rounds.")


def resting_point(rest: Callable[[np.ndarray, np.ndarray, float, int], float]) -> None:
    """``rest(curvature, wanted, rate, steps)`` is where federated averaging of quadratics stops."""
    cases = [([4, 1], [-1, 2], 0.1, 5), ([5, 2, 0.5], [0, 1, 4], 0.15, 8), ([3, 1], [2, -1], 0.2, 1)]
    for *arrays, rate, steps in cases:
        curvature, wanted = (np.array(values, dtype=float) for values in arrays)
        given = rest(curvature.copy(), wanted.copy(), rate, steps)
        optimum, left = curvature @ wanted / curvature.sum(), (1 - rate * curvature) ** steps
        expect(not close(given, wanted.mean()), "That is the mean of the wishes: only endless phases lead there.")
        expect(steps == 1 or not close(given, optimum), "That is the optimum: only phases of one step lead there.")
        expect(not close(given, left @ wanted / left.sum()), "You weigh by the share of the way left, not gone.")
        right = _averaged(curvature, wanted, rate, steps)
        expect(close(given, right), "At rest the movements cancel: what share of the way to its wish does a client go?")


def pulls(alive: Callable[[Callable[[float], float]], bool]) -> None:
    """``alive(move)`` tells whether a FedProx pulls; ``move(mu)`` is how far its client moves with the weight mu."""
    expect(not alive(_mover(0)), "A pull that changes nothing, to the last bit, passes your test.")
    expect(not alive(_mover(-1)), "A pull with the wrong sign, away from the global model, passes your test.")
    expect(bool(alive(_mover(1))), "You raise the alarm at a FedProx that works: which of two movements is shorter?")
    scaled = alive(_mover(1, wish=300.0)) and alive(_mover(1, wish=1e-4))
    expect(bool(scaled), "Clients move very far or very little: compare two movements, not one with a number.")


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
    expect(not close(given, right(0.0)), "The pull does nothing: does your anchor move along with the weights?")
    expect(not close(given, right(-mu)), "Your client is pushed away from the global model: look at the sign.")
    expect(not close(given, right(mu, np.zeros(3))), "You pull towards zero; the pull is towards the global model.")
    expect(close(given, right(mu)), "To the gradient of each step belongs mu times the way from the global model.")
    expect(close(mine, start), "The end is right, but the global model you were given has changed: step on a copy.")


def cosines(measure: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> None:
    """``measure(start, ends)`` is the cosine of each client's movement to the mean movement; 0 without a movement."""
    rng = np.random.default_rng(7)
    start, moved = rng.normal(0, 50, 12), rng.normal(0, 1, (4, 12)) * np.array([[1.0], [3.0], [0.5], [2.0]])
    mean, lengths = moved.mean(axis=0), np.linalg.norm(moved, axis=1)
    right = moved @ mean / lengths / np.linalg.norm(mean)
    units = moved / lengths[:, None]
    heading = units.mean(axis=0)
    with np.errstate(all="ignore"):
        given = measure(start.copy(), start + moved)
        still = measure(start.copy(), start + np.vstack([moved, np.zeros(12)]))
    expect(np.shape(given) == (4,), f"One cosine for each of the 4 clients is wanted, not the shape {np.shape(given)}.")
    expect(not close(given, moved @ mean), "Those are products: divide by the lengths of both movements.")
    expect(np.min(given) < 0.98, "All near 1: you compare weights, and the start that all share hides the movements.")
    expect(not close(given, moved @ mean / lengths), "Divide by the length of the mean movement as well.")
    expect(not close(given, units @ heading / np.linalg.norm(heading)), "In the mean, a longer movement counts more.")
    expect(close(given, right), "A cosine: the product of two movements, over the product of their lengths.")
    expect(not np.isnan(still).any(), "A client that did not move has length 0 and gets nan: give it the cosine 0.")
    expect(close(still, [*right, 0.0]), "A client that did not move has the cosine 0, and the others keep theirs.")


def scaffold_round(play: Callable[..., tuple[float, np.ndarray]]) -> None:
    """``play(gradients, w, own, drawn, rate, steps)`` is a round of SCAFFOLD: the new w, and all control variates."""
    curvature, wanted, own = np.array([4.0, 1.0, 2.0]), np.array([-1.0, 2.0, 0.5]), np.array([1.5, -0.8, 2.0])
    gradients = [lambda w, k=k: curvature[k] * (w - wanted[k]) for k in range(3)]
    for drawn, steps in [([0, 1], 4), ([2], 5), ([0, 1, 2], 3)]:
        given = play(gradients, 0.7, own.copy(), list(drawn), 0.1, steps)
        expect(isinstance(given, tuple) and len(given) == 2, "Return two things: the new w, and all control variates.")
        expect(np.shape(given[1]) == (3,), "Return the control variates of all 3 clients, drawn or not.")
        w, after = given[0], np.asarray(given[1], dtype=float)
        idle = [k for k in range(3) if k not in drawn]
        expect(close(after[idle], own[idle]), "A client that was not drawn keeps its control variate.")
        end, seen = _scaffold(gradients, drawn, steps, own.mean() - own)
        partial, _ = _scaffold(gradients, drawn, steps, own[drawn].mean() - own)
        turned, _ = _scaffold(gradients, drawn, steps, own - own.mean())
        expect(not idle or not close(w, partial), "c is the mean over all clients; you average over the drawn ones.")
        expect(not close(w, turned), "The correction is turned round: its own pull has to go, everybody's to come.")
        expect(close(w, end), "w is wrong: each step adds c - c_k, both as they were when the round began.")
        expect(not close(after[drawn], seen + own.mean()), "The new c_k are too large by c, which the steps contained.")
        expect(close(after[drawn], seen), "w is right; the new c_k is the mean of the gradients met on the way.")


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
    """Return how far a client moves that is pulled back (1), not at all (0), or away (-1)."""

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
