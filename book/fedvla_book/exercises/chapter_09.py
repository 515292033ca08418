"""Checks of the exercises in the chapter on deployment."""

import copy
import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from fedvla_book.exercises import close, expect

State = dict[str, Any]


def protects(answer: Mapping[str, str]) -> None:
    """A dictionary from each threat to what prevents it: ``tls``, ``keys`` or ``neither``."""
    asked = {
        "listener": ("tls", "Encryption stops a listener: which of the two encrypts?"),
        "false server": (
            "tls",
            "A client must verify the server: which of the two makes the server prove its identity?",
        ),
        "stranger": (
            "keys",
            "Anyone may connect to a server with a certificate: which of the two asks the client for a proof?",
        ),
        "bad member": (
            "neither",
            "A member has a valid key and an encrypted connection, and can send anything over it.",
        ),
        "curious server": ("neither", "Weights are sent to the server, so it can read them."),
    }
    expect(isinstance(answer, Mapping), "Return a dictionary, from each threat to its answer.")
    expect(set(answer) == set(asked), f"Its keys are the threats: {', '.join(asked)}.")
    words = {str(word).lower() for word in answer.values()}
    expect(words <= {"tls", "keys", "neither"}, "Each answer is one of tls, keys and neither.")
    for threat, (right, hint) in asked.items():
        expect(str(answer[threat]).lower() == right, hint)


def round_cost(cost: Callable[[int, float, float, float, float], tuple[float, float]]) -> None:
    """``cost(clients, megabytes, client_mbit_s, server_mbit_s, dollars_per_gb)`` is seconds and dollars of a round."""
    for clients, megabytes, own, shared in [(10, 400.0, 20.0, 10_000.0), (5_000, 40.0, 50.0, 10_000.0)]:
        given = cost(clients, megabytes, own, shared, 0.09)
        expect(np.shape(given) == (2,), "Return two numbers: the seconds of transfer, and the dollars.")
        seconds, dollars = map(float, given)
        by_client, by_server = megabytes * 8 / own, clients * megabytes * 8 / shared
        line, gigabytes = max(by_client, by_server), clients * megabytes / 1000
        expect(not close(seconds * 8, 2 * line), "Eight times too fast: a megabyte has eight megabits.")
        expect(not close(seconds, line), "The model is sent twice in a round: down, and up again.")
        added, alone = close(seconds, 2 * (by_client + by_server)), close(seconds, 2 * by_client)
        expect(not added, "Both lines are used at the same time: the slower one decides, not the sum.")
        expect(by_server < by_client or not alone, "All clients share the server's line: with many of them it decides.")
        expect(close(seconds, 2 * line), "Each direction takes as long as the slower line, a client's or the server's.")
        billed_twice = close(dollars, 2 * gigabytes * 0.09)
        expect(not billed_twice, "Uploads to the server are free; only downloads are billed.")
        expect(close(dollars, gigabytes * 0.09), "Dollars: the gigabytes that leave the server, one model per client.")


def average(mean: Callable[[Sequence[tuple[int, int, np.ndarray]]], np.ndarray]) -> None:
    """``mean(replies)`` is the average of (partition, frames, array), bit-identical for any order."""
    rng = np.random.default_rng(9)
    frames = [40, 40, 25, 60, 60, 15, 33]
    replies = [(k, n, rng.normal(0, 1 + k, 500).astype(np.float32)) for k, n in enumerate(frames)]
    arrays = np.stack([array for _, _, array in replies])
    orders = [rng.permutation(len(replies)) for _ in range(6)]
    given = [np.asarray(mean([copy.deepcopy(replies[k]) for k in order])) for order in orders]
    right = np.average(arrays.astype(float), axis=0, weights=frames)
    expect(given[0].shape == (500,), f"An average has the shape of one array, (500,), not {given[0].shape}.")
    expect(not close(given[0], arrays.mean(axis=0), 1e-4), "A client with more frames must weigh more.")
    expect(close(given[0], right, 1e-4), "Return the mean of the arrays, each weighted by its share of all frames.")
    alike = all(other.tobytes() == given[0].tobytes() for other in given)
    expect(alike, "The last bits depend on who answered first: sort the replies before you sum.")


def bytes_by_round(read: Callable[[Sequence[str]], dict[int, int]]) -> None:
    """``read(lines)`` is the bytes of each round in both directions, from the lines of a metrics.jsonl."""
    for rounds, cut in [(3, True), (2, False)]:
        events, right = [], {}
        for number in range(1, rounds + 1):
            events += [_event(number, "client_0", "train", loss=0.5), _event(number, "client_1", "train", loss=0.7)]
            for to, size in (("train", 1_000 * number), ("evaluate", 500)):
                counts = {"to": to, "good": 2, "rejected": 0, "sent_bytes": size, "received_bytes": size // 4}
                events.append(_event(number, "global", "replies", **counts))
            right[number] = 1_250 * number + 625
        lines = [json.dumps(event) for event in events]
        given = read([*lines, lines[-1][:70]] if cut else lines)
        expect(isinstance(given, Mapping), "Return a dictionary, from the number of a round to its bytes.")
        expect(set(given) == set(right), f"Expected the rounds {', '.join(map(str, right))}, as whole numbers.")
        found = list(map(given.get, right))
        sent, training = [1_000 * n + 500 for n in right], [1_250 * n for n in right]
        expect(not close(found, sent), "Those bytes were sent; what was received counts as well.")
        expect(not close(found, training), "Evaluation sends the model once more: count it as well.")
        expect(not close(found, [625] * rounds), "A round has two such events: you keep the last instead of their sum.")
        expect(close(found, list(right.values())), "Add sent_bytes and received_bytes of each event of kind replies.")


def clipped(shorten: Callable[[np.ndarray, float], np.ndarray]) -> None:
    """``shorten(moves, limit)`` is the updates (clients, numbers), none with a norm above the limit."""
    rng = np.random.default_rng(10)
    headings = rng.normal(size=(5, 8))
    headings /= np.linalg.norm(headings, axis=1, keepdims=True)
    lengths, limit = np.array([0.5, 1.0, 2.0, 20.0, 0.0]), 1.5
    moves = headings * lengths[:, None]
    with np.errstate(all="ignore"):
        given = shorten(moves.copy(), limit)
    expect(np.shape(given) == (5, 8), f"Expected all 5 updates of 8 numbers, not the shape {np.shape(given)}.")
    expect(not np.isnan(given).any(), "An update of 0 has norm 0; dividing by it gives NaN.")
    expect(
        not close(given, np.clip(moves, -limit, limit)),
        "You clip number by number, which changes the direction of an update.",
    )
    expect(not close(given[:4], headings[:4] * limit), "An update below the limit stays as it is; you lengthen it.")
    whole = moves * min(1.0, limit / np.linalg.norm(moves))
    common = close(given, moves * limit / lengths.max()) or close(given, whole)
    expect(not common, "One client's norm shortens all others: each client has its own factor.")
    left_out = close(given, moves * (lengths <= limit)[:, None])
    expect(not left_out, "An update above the limit is shortened to it, not left out.")
    right = headings * np.minimum(lengths, limit)[:, None]
    expect(close(given, right), "Keep the direction of each update; its norm is at most the limit.")


def advance(play: Callable[[State, int, Sequence[float], int], State]) -> None:
    """``play(state, until, wishes, seed)`` plays the missing rounds; a resumed run ends with the same bits."""
    start, wishes = {"round": 0, "w": 0.0}, [-1.0, 2.0, 6.0]
    one = [_w(play, start, until, [3.0], 0) for until in range(9)]
    part = play(dict(start), 3, [3.0], 0)
    resumed = play(copy.deepcopy(part), 8, [3.0], 0)
    counted = isinstance(resumed, Mapping) and resumed.get("round") == 8
    expect(counted, "Completed rounds count: continue from state['round'] to `until`, and store the round.")
    lost = "With one client there is no sampling, yet a resumed run differs: a forgotten part of the state?"
    expect(resumed["w"] == one[8], lost)
    right, m = [0.0], 0.0
    for _ in range(8):
        m = 0.5 * m + 0.1 * (3.0 - right[-1])
        right.append(right[-1] + m)
    expect(close(one, right), "With one client, u = 0.1 (wish - w), then m = m / 2 + u, then w = w + m, from m = 0.")
    path = [_w(play, start, until, wishes, 1) for until in range(31)]
    expect(path[30] == _w(play, start, 30, wishes, 1), "Two runs with the same seed differ.")
    drawn = [_drawn(path, number, wishes) for number in range(30)]
    expect(None not in drawn, "In each round one client is sampled, and only its wish moves the server.")
    expect(set(drawn) == {0, 1, 2}, "Over many rounds every client must be sampled; here some never are.")
    expect(path[8] != _w(play, start, 8, wishes, 2), "Another seed must sample other clients.")
    for cut in range(1, 8):
        part = play(dict(start), cut, wishes, 1)
        kept = copy.deepcopy({key: part[key] for key in ("round", "w")})
        twice = [_w(play, part, 8, wishes, 1) for _ in range(2)]
        same = all(part[key] == value for key, value in kept.items()) and twice[0] == twice[1]
        expect(same, "Resuming changes the state it starts from: a checkpoint must stay as it was written.")
        expect(twice[0] == path[8], "A resumed run samples other clients: sampling must depend on seed and round only.")


def _event(number: int, who: str, kind: str, **values: Any) -> dict[str, Any]:
    """Return an event as a run folder holds it."""
    return {"round": number, "who": who, "kind": kind, "time": "2026-01-31T14:25:01.000+00:00", "values": values}


def _w(play: Callable[..., State], state: State, until: int, wishes: Sequence[float], seed: int) -> float:
    """Return w after going on from a state; a new start is handed over as a copy."""
    end = play(dict(state) if state["round"] == 0 else state, until, list(wishes), seed)
    expect(isinstance(end, Mapping) and {"round", "w"} <= set(end), "Return the new state, with at least round and w.")
    return end["w"]


def _drawn(path: Sequence[float], number: int, wishes: Sequence[float]) -> int | None:
    """Return whose wish explains the step after `number` rounds; None if nobody's does."""
    before = path[number] - path[number - 1] if number else 0.0
    u = path[number + 1] - path[number] - 0.5 * before
    fits = [k for k, wish in enumerate(wishes) if close(u, 0.1 * (wish - path[number]))]
    return fits[0] if fits else None
