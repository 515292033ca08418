"""Mistakes that readers make in the chapter on deployment, and a word of the hint that each gets."""

PROTECTS = (
    "protects = {{'listener': {listener!r}, 'false server': {false!r}, 'stranger': {stranger!r},"
    " 'bad member': {bad!r}, 'curious server': {curious!r}}}"
)
GUARDED = {"listener": "tls", "false": "tls", "stranger": "keys", "bad": "neither", "curious": "neither"}

COST = """
def round_cost(clients, megabytes, own, shared, price):
    mbit = {mbit}
    line = {line}
    gigabytes = clients * megabytes / 1000
    return {result}
"""
PRICED = {
    "mbit": "8 * megabytes",
    "line": "max(mbit / own, clients * mbit / shared)",
    "result": "2 * line, gigabytes * price",
}

AVERAGE = """
import numpy as np


def average(replies):
    total = sum(frames for _, frames, _ in replies)
    mean = np.zeros_like(replies[0][2])
    for partition, frames, array in {order}:
        mean += {added}
    return {result}
"""
SUMMED = {
    "order": "sorted(replies, key=lambda reply: reply[0])",
    "added": "array * np.float32(frames / total)",
    "result": "mean",
}

READ = """
import json


def bytes_by_round(lines):
    found = {{}}
    for line in lines:
        {parse}
        if {chosen}:
            values = event["values"]
            found[{key}] = {sum}
    return {result}
"""
ADDED = {
    "parse": "event = json.loads(line) if line.endswith('}') else {'kind': 'cut'}",
    "chosen": "event['kind'] == 'replies'",
    "key": "event['round']",
    "sum": "found.get(event['round'], 0) + values['sent_bytes'] + values['received_bytes']",
    "result": "found",
}

CLIPPED = """
import numpy as np


def clipped(moves, limit):
    lengths = np.linalg.norm(moves, axis=1, keepdims=True)
    return {result}
"""

ADVANCE = """
import numpy as np


def advance(state, until, wishes, seed):
    {before}
    w, m = state["w"], {m}
    for number in {rounds}:
        k = {k}
        u = 0.1 * (wishes[k] - w)
        m = {step}
        w = w + m
    return {result}
"""
PLAYED = {
    "before": "pass",
    "m": "state.get('m', 0.0)",
    "rounds": "range(state['round'], until)",
    "k": "np.random.default_rng([seed, number]).integers(len(wishes))",
    "step": "0.5 * m + u",
    "result": "{'round': until, 'w': w, 'm': m}",
}
DRAWN = "rng.integers(len(wishes))"
KEPT_GENERATOR = {
    "before": "rng = state.get('rng') or np.random.default_rng(seed)",
    "k": DRAWN,
    "result": "{'round': until, 'w': w, 'm': m, 'rng': rng}",
}

WRONG = {
    "protects": [
        (PROTECTS.format(**GUARDED | {"listener": "keys"}), "which of the two encrypts"),
        (PROTECTS.format(**GUARDED | {"false": "keys"}), "prove its identity"),
        (PROTECTS.format(**GUARDED | {"stranger": "tls"}), "for a proof"),
        (PROTECTS.format(**GUARDED | {"bad": "keys"}), "send anything over it"),
        (PROTECTS.format(**GUARDED | {"curious": "tls"}), "can read them"),
        (PROTECTS.format(**GUARDED | {"bad": "both"}), "Each answer is one of"),
        ("protects = {'listener': 'tls'}", "Its keys are the threats"),
        ("protects = ['tls', 'tls', 'keys', 'neither', 'neither']", "Return a dictionary"),
    ],
    "round_cost": [
        (COST.format(**PRICED | {"mbit": "megabytes"}), "eight megabits"),
        (COST.format(**PRICED | {"line": "mbit / own"}), "with many of them"),
        (COST.format(**PRICED | {"line": "mbit / own + clients * mbit / shared"}), "not the sum"),
        (COST.format(**PRICED | {"line": "clients * mbit / shared"}), "as the slower line"),
        (COST.format(**PRICED | {"result": "line, gigabytes * price"}), "is sent twice"),
        (COST.format(**PRICED | {"result": "2 * line, 2 * gigabytes * price"}), "are free"),
        (COST.format(**PRICED | {"result": "2 * line, megabytes / 1000 * price"}), "one model per client"),
        (COST.format(**PRICED | {"result": "2 * line"}), "two numbers"),
    ],
    "average": [
        (AVERAGE.format(**SUMMED | {"order": "replies"}), "who answered first"),
        (AVERAGE.format(**SUMMED | {"order": "sorted(replies, key=lambda r: r[1])"}), "who answered first"),
        (AVERAGE.format(**SUMMED | {"added": "array / np.float32(len(replies))"}), "weigh more"),
        (AVERAGE.format(**SUMMED | {"added": "array * np.float32(frames)"}), "share of all frames"),
        (AVERAGE.format(**SUMMED | {"result": "mean.mean()"}), "shape of one array"),
    ],
    "bytes_by_round": [
        (READ.format(**ADDED | {"parse": "event = json.loads(line)"}), "JSONDecodeError"),
        (READ.format(**ADDED | {"sum": "values['sent_bytes'] + values['received_bytes']"}), "keep the last"),
        (READ.format(**ADDED | {"sum": "found.get(event['round'], 0) + values['sent_bytes']"}), "was received"),
        (READ.format(**ADDED | {"chosen": "event.get('values', {}).get('to') == 'train'"}), "Evaluation sends"),
        (READ.format(**ADDED | {"key": "str(event['round'])"}), "as whole numbers"),
        (READ.format(**ADDED | {"result": "list(found.values())"}), "Return a dictionary"),
        (READ.format(**ADDED | {"sum": "found.get(event['round'], 0) + values['received_bytes']"}), "of each event"),
    ],
    "clipped": [
        (CLIPPED.format(result="np.clip(moves, -limit, limit)"), "changes the direction"),
        (CLIPPED.format(result="moves / lengths * limit"), "gives NaN"),
        (CLIPPED.format(result="moves / np.maximum(lengths, 1e-12) * limit"), "you lengthen it"),
        (CLIPPED.format(result="moves * min(1.0, limit / lengths.max())"), "its own factor"),
        (CLIPPED.format(result="moves * min(1.0, limit / np.linalg.norm(moves))"), "its own factor"),
        (CLIPPED.format(result="np.where(lengths > limit, 0.0, moves)"), "not left out"),
        (CLIPPED.format(result="moves[lengths[:, 0] <= limit]"), "all 5 updates"),
        (CLIPPED.format(result="moves"), "Keep the direction"),
    ],
    "advance": [
        (ADVANCE.format(**PLAYED | {"result": "{'round': until, 'w': w}"}), "a forgotten part"),
        (ADVANCE.format(**PLAYED | {"rounds": "range(until)"}), "a forgotten part"),
        (
            ADVANCE.format(**PLAYED | {"result": "{'round': state['round'] + until, 'w': w, 'm': m}"}),
            "Completed rounds count",
        ),
        (ADVANCE.format(**PLAYED | {"step": "u"}), "then m = m / 2 + u"),
        (ADVANCE.format(**PLAYED | {"before": "rng = np.random.default_rng(seed)", "k": DRAWN}), "seed and round only"),
        (ADVANCE.format(**PLAYED | {"step": "0.5 * m + 0.1 * (np.mean(wishes) - w)"}), "only its wish moves"),
        (
            ADVANCE.format(**PLAYED | {"k": "np.random.default_rng(seed).integers(len(wishes))"}),
            "every client must be sampled",
        ),
        (ADVANCE.format(**PLAYED | {"k": "np.random.default_rng(number).integers(len(wishes))"}), "Another seed"),
        (
            ADVANCE.format(**PLAYED | {"k": "np.random.default_rng().integers(len(wishes))"}),
            "with the same seed differ",
        ),
        (ADVANCE.format(**PLAYED | {"result": "state.update(round=until, w=w, m=m) or state"}), "must stay"),
        (ADVANCE.format(**PLAYED | KEPT_GENERATOR), "must stay"),
        (ADVANCE.format(**PLAYED | {"result": "w"}), "at least round and w"),
    ],
}
