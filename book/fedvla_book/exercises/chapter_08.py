"""Checks of the exercises in the chapter on communication."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from fedvla_book.exercises import close, expect

Arrays = Mapping[str, np.ndarray]


def traffic(count: Callable[[Sequence[dict[str, Any]]], tuple[int, int]]) -> None:
    """``count(messages)`` is the bytes down and up; a message has ``to`` and ``records`` of arrays by name."""
    model, small = np.zeros((30, 4), np.float32), np.zeros(30, np.float16)
    change = {"w": np.zeros((30, 4), np.int8), "w|scale": np.zeros((), np.float32)}
    messages = [
        {"to": "client", "records": {"arrays": {"w": model}, "control": {"w": model}}},
        {"to": "client", "records": {"arrays": {"w": model, "b": small}}},
        {"to": "server", "records": {"arrays": change}},
        {"to": "server", "records": {"arrays": change, "control": {"w": model}}},
    ]
    down, up = 3 * 480 + 60, 2 * 124 + 480
    given = count(messages)
    expect(np.shape(given) == (2,), "Return two numbers: the bytes down, and the bytes up.")
    expect(not close(given, (up, down)), "Down comes first: from the server to the clients.")
    fours = (4 * (360 + 30), 4 * (2 * 121 + 120))
    expect(not close(given, fours), "Not every number has 4 bytes: use the array's size in bytes.")
    expect(not close(given, (2 * 480 + 60, 2 * 124)), "A message can carry more than one record of arrays: count all.")
    expect(not close(given, (360 + 30, 2 * 121 + 120)), "Those are counts of numbers; give sizes in bytes.")
    expect(close(given, (down, up)), "Add up the bytes of every array, of every record, of every message.")


def round_seconds(last: Callable[[dict[str, tuple[int, ...]], int, int, float], float]) -> None:
    """``last(shapes, down_bits, up_bits, line_mbit_s)`` is the transfer time of a client's arrays in a round."""
    shapes = {"layer.weight": (72, 96), "layer.bias": (72,), "scale": ()}
    numbers = 72 * 96 + 72 + 1
    for down, up, line in [(16, 8, 20.0), (32, 32, 100.0)]:
        given = last(dict(shapes), down, up, line)
        expect(np.shape(given) == (), "Expected one number: the seconds for both directions together.")
        bits, right = given * line * 1e6, numbers * (down + up)
        expect(not close(bits, right / 8), "Eight times too short: the line speed is in bits, and you count bytes.")
        expect(not close(bits, 8 * right), "Eight times too long: sizes are in bits here, and so is the line speed.")
        one_way = close(bits, numbers * down) or close(bits, numbers * up)
        expect(not one_way, "The arrays are sent twice in a round: down, and up again.")
        expect(not close(bits, right - down - up), "An array of shape () holds one number as well.")
        expect(
            close(bits, right),
            "All numbers, times their bits in both directions, over the bits per second of the line.",
        )


def personal_round(play: Callable[[Sequence[Arrays], Sequence[float], set[str]], list[Arrays]]) -> None:
    """``play(updates, frames, own)`` is each client's model in the next round; arrays named in `own` are not shared."""
    updates = [{"w": np.full(3, k + 1.0), "head": np.array([10.0 * k, k])} for k in range(3)]
    frames, mean = [50, 30, 20], np.full(3, 1.7)
    given = play([dict(update) for update in updates], list(frames), {"head"})
    expect(
        isinstance(given, list) and len(given) == 3, "There is no single global model: return a model for each client."
    )
    names = all(isinstance(model, Mapping) and set(model) == {"w", "head"} for model in given)
    expect(names, "Each client needs all its arrays for the next round, shared and own.")
    heads = [model["head"] for model in given]
    expect(not close(heads[0], heads[1]), "The arrays in `own` were shared as well; they stay with their client.")
    kept = all(close(head, update["head"]) for head, update in zip(heads, updates, strict=True))
    expect(kept, "Each client keeps its own arrays as they came out of its training.")
    expect(not close(given[0]["w"], np.full(3, 2.0)), "A client with more frames must weigh more in the shared arrays.")
    shared = all(close(model["w"], mean) for model in given)
    expect(shared, "What is shared is the mean weighted by frames, and the same for all clients.")
    whole = play([dict(update) for update in updates], list(frames), set())
    expect(close(whole[2]["head"], [7.0, 0.7]), "If `own` is empty everything is shared; only the names in it decide.")


def rounded_change(send: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, float, np.ndarray]]) -> None:
    """``send(change, left_over)`` is the levels, their scale, and the remainder."""
    change, left = np.array([254.0, -3.2, 0.8, 1.3]), np.array([0.0, 0.6, 0.9, -0.4])
    levels, scale, over = _sent(send, change, left)
    expect(close(levels, np.rint(levels)) and np.abs(levels).max() <= 127, "Levels are whole numbers, -127 to 127.")
    plain = np.rint(change / 2)
    expect(not close(levels, plain), "The previous remainder is not sent: add it, then round.")
    wanted = change + left
    expect(
        not close(levels, np.trunc(wanted / 2)), "You truncate, which loses up to a whole level: round to the nearest."
    )
    expect(close(levels * scale, 2 * np.rint(wanted / 2)), "The largest change gets level 127: that fixes the scale.")
    arrives = levels * scale
    expect(not close(over, change - arrives), "The previous remainder is part of the target.")
    expect(not close(over, arrives - wanted), "The remainder has the wrong sign: it is the target minus what arrives.")
    expect(close(over, wanted - arrives), "The remainder is the target minus what the server decodes from the levels.")
    with np.errstate(all="ignore"):
        levels, scale, over = _sent(send, np.zeros(4), np.zeros(4))
    still = close(levels * scale, np.zeros(4)) and close(over, np.zeros(4))
    expect(still, "If nothing changed, the scale is 0, and dividing by it gives NaN.")


def averaging_error(measure: Callable[[np.ndarray, np.ndarray, np.ndarray], float]) -> None:
    """``measure(B, A, weights)`` is the error of averaging A and B separately, relative to the mean of the products."""
    rng = np.random.default_rng(8)
    B, A, weights = rng.normal(size=(3, 6, 2)), rng.normal(size=(3, 2, 5)), np.array([0.6, 0.3, 0.1])
    given = measure(B.copy(), A.copy(), weights.copy())
    miss, size = _miss(B, A, weights)
    expect(not close(given, miss), "That is the norm of the error; divide by the norm of the exact mean.")
    against_apart = miss / np.linalg.norm(_apart(B, A, weights))
    expect(not close(given, against_apart), "Divide by the norm of the exact mean, not of the separate averages.")
    even = _miss(B, A, np.full(3, 1 / 3))
    expect(not close(given, even[0] / even[1]), "Clients have weights: use them in all three means.")
    expect(not close(given, (miss / size) ** 2), "That is the square: a Frobenius norm has a square root.")
    expect(close(given, miss / size), "Compare multiplying before averaging with averaging before multiplying.")
    frozen = np.repeat(A[:1], 3, axis=0)
    expect(close(measure(B.copy(), frozen, weights.copy()), 0.0), "With one A for all clients there is no error left.")


def thin_average(reduce: Callable[[np.ndarray, np.ndarray, np.ndarray, int], tuple[np.ndarray, np.ndarray]]) -> None:
    """``reduce(B, A, weights, rank)`` is the B and A of that rank whose product is closest to the mean product."""
    rng = np.random.default_rng(16)
    B, A, weights = rng.normal(size=(3, 7, 2)), rng.normal(size=(3, 2, 5)), np.array([0.6, 0.3, 0.1])
    for rank in (2, 3):
        given = reduce(B.copy(), A.copy(), weights.copy(), rank)
        expect(isinstance(given, tuple) and len(given) == 2, "Return two matrices: B, then A.")
        shapes = tuple(map(np.shape, given))
        expect(shapes == ((7, rank), (rank, 5)), f"Expected shapes (7, {rank}) and ({rank}, 5), not {shapes}.")
        product, whole = np.asarray(given[0]) @ np.asarray(given[1]), _right(B, A, weights)
        expect(
            not close(product, _apart(B, A, weights)),
            "That averages A and B separately; first compute the mean product.",
        )
        even = _best(_right(B, A, np.full(3, 1 / 3)), rank)
        expect(not close(product, even), "Clients have weights: use them in the mean of the products.")
        best, size = _best(whole, rank), np.linalg.norm(product)
        expect(not close(size, np.sqrt(rank)), "The singular values are lost: one of the matrices must contain them.")
        twice = _norm_of_squares(whole, rank)
        expect(not close(size, twice), "Both matrices contain the singular values; once is enough.")
        expect(close(product, best), "Truncate the SVD of the mean product to its largest singular values.")


def _sent(send: Callable[..., Any], change: np.ndarray, left_over: np.ndarray) -> list[np.ndarray]:
    """Return levels, scale and remainder of a client, or raise a hint if they are not three."""
    given = send(change.copy(), left_over.copy())
    expect(isinstance(given, tuple) and len(given) == 3, "Return three things: levels, scale, remainder.")
    expect(np.shape(given[0]) == change.shape, "Return a level for each number.")
    return [np.asarray(part, dtype=float) for part in given]


def _right(B: np.ndarray, A: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the weighted mean of the products."""
    return np.einsum("k,kor,kri->oi", weights, B, A)


def _apart(B: np.ndarray, A: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the product of the weighted means."""
    return np.tensordot(weights, B, 1) @ np.tensordot(weights, A, 1)


def _miss(B: np.ndarray, A: np.ndarray, weights: np.ndarray) -> tuple[float, float]:
    """Return the norm of the error, which is the covariance of B and A over clients, and of the exact mean."""
    covariance = _right(B - np.tensordot(weights, B, 1), A - np.tensordot(weights, A, 1), weights)
    return float(np.linalg.norm(covariance)), float(np.linalg.norm(_right(B, A, weights)))


def _best(matrix: np.ndarray, rank: int) -> np.ndarray:
    """Return the closest matrix of a rank: the projection on the leading eigenvectors of M M^T."""
    leading = np.linalg.eigh(matrix @ matrix.T)[1][:, -rank:]
    return leading @ leading.T @ matrix


def _norm_of_squares(matrix: np.ndarray, rank: int) -> float:
    """Return the norm of the closest matrix of a rank with its singular values squared."""
    return math.sqrt((np.linalg.eigvalsh(matrix @ matrix.T)[-rank:] ** 2).sum())
