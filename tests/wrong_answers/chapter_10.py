"""Mistakes that readers make in the chapter on privacy, and a word of the hint that each gets."""

HIDES = """
hides_one_update = {{
    "TLS": {tls},
    "node keys": {keys},
    "secure aggregation": {secure},
    "noise by the server": {server},
    "noise by each lab": ["server", "other labs", "eavesdropper"],
}}
"""
HIDDEN = {"tls": '["eavesdropper"]', "keys": "[]", "secure": '["eavesdropper", "server"]', "server": '["other labs"]'}

MEAN = """
import numpy as np


def private_mean(updates, limit, noise, rng):
    lengths = np.linalg.norm(updates, axis=1, keepdims=True)
    clipped = {clipped}
    total = clipped.sum(axis=0)
    noised = total + rng.normal(0, {deviation}, {size})
    return {result}
"""
PRIVATE = {
    "clipped": "updates * np.minimum(1, limit / np.maximum(lengths, 1e-12))",
    "deviation": "noise * limit", "size": "total.shape", "result": "noised / len(updates)",
}  # fmt: skip

EPSILON = """
import math

import numpy as np


def epsilon_of_run(noise, rounds, delta):
    a = np.arange(11, 641) / 10
    return {result}
"""

STATE = """
import numpy as np


def state_from_gradient(weight, bias):
    return {result}
"""

MASKED = """
import numpy as np


def masked(vector, me, masks):
    covered = vector.astype({dtype})
    for (i, j), mask in masks.items():
        if me == i:
            covered = covered + mask
        {other}
    return covered
"""

NEEDS = """
def needs_noise(released):
    return [one["name"] for one in released if {condition}]
"""

WRONG = {
    "hides_one_update": [
        (HIDES.format(**HIDDEN | {"tls": '["eavesdropper", "server"]'}), "TLS ends at the server"),
        (HIDES.format(**HIDDEN | {"keys": '["eavesdropper"]'}), "they encrypt nothing"),
        (HIDES.format(**HIDDEN | {"secure": "[]"}), "cannot read one update"),
        (HIDES.format(**HIDDEN | {"secure": '["server", "other labs"]'}), "holds the sum"),
        (HIDES.format(**HIDDEN | {"secure": '["server"]'}), "everyone on the way"),
        (HIDES.format(**HIDDEN | {"server": '["other labs", "server"]'}), "Whoever adds the noise"),
        (HIDES.format(**HIDDEN | {"tls": "[]"}), "Ask for each pair"),
        (HIDES.format(**HIDDEN | {"tls": '["robot"]'}), "They can hide it from"),
        ("hides_one_update = {}", "The measures are"),
    ],
    "private_mean": [
        (MEAN.format(**PRIVATE | {"clipped": "updates"}), "Nothing is clipped"),
        (MEAN.format(**PRIVATE | {"clipped": "updates / lengths * np.minimum(lengths, limit)"}), "length zero gives"),
        (MEAN.format(**PRIVATE | {"clipped": "updates * limit / np.maximum(lengths, 1e-12)"}), "A short update"),
        (MEAN.format(**PRIVATE | {"clipped": "np.clip(updates, -limit, limit)"}), "not each number"),
        (
            MEAN.format(**PRIVATE | {"clipped": "updates / len(updates)", "result": "noised / np.linalg.norm(noised)"}),
            "before they are added",
        ),
        (MEAN.format(**PRIVATE | {"deviation": "0"}), "no noise yet"),
        (MEAN.format(**PRIVATE | {"result": "total / len(updates) + noised - total"}), "noise is for the sum"),
        (MEAN.format(**PRIVATE | {"deviation": "noise"}), "in units of the limit"),
        (MEAN.format(**PRIVATE | {"deviation": "noise * limit * len(updates) ** 0.5"}), "every update got all"),
        (MEAN.format(**PRIVATE | {"result": "noised"}), "and average them"),
        (MEAN.format(**PRIVATE | {"deviation": "3 * noise * limit"}), "has standard deviation"),
    ],
    "epsilon_of_run": [
        (EPSILON.format(result="(a / (2 * noise**2) + math.log(1 / delta) / (a - 1)).min()"), "That is one round"),
        (
            EPSILON.format(result="rounds * (a / (2 * noise**2) + math.log(1 / delta) / (a - 1)).min()"),
            "convert once",
        ),
        (EPSILON.format(result="rounds / noise**2 + math.log(1 / delta)"), "take the smallest"),
        (EPSILON.format(result="rounds * a / (2 * noise**2) + math.log(1 / delta) / (a - 1)"), "one number"),
        (EPSILON.format(result="(rounds * a / noise**2 + math.log(1 / delta) / (a - 1)).min()"), "Minimise"),
    ],
    "state_from_gradient": [
        (STATE.format(result="(weight / bias[:, None]).mean(axis=0)"), "gives NaN"),
        (STATE.format(result="weight.sum(axis=0)"), "Divide by the bias"),
        (STATE.format(result="weight.sum(axis=0) / bias.sum()"), "least squares"),
        (STATE.format(result="bias @ weight"), "Every row"),
        (STATE.format(result="weight"), "six numbers"),
    ],
    "masked": [
        (MASKED.format(dtype="np.uint32", other="pass"), "without a mask"),
        (MASKED.format(dtype="np.uint32", other="if me == j:\n            covered = covered + mask"), "do not cancel"),
        (MASKED.format(dtype="np.int64", other="if me == j:\n            covered = covered - mask"), "Return uint32"),
        (
            "import numpy as np\n\n\ndef masked(vector, me, masks):\n    return vector.astype(np.uint32)[:10]",
            "of the same size",
        ),
    ],
    "needs_noise": [
        (NEEDS.format(condition='one["from_data"] and "model" in one["name"]'), "before the first round"),
        (NEEDS.format(condition='not one["noise"] and one["leaves"]'), "A setting tells"),
        (NEEDS.format(condition='not one["noise"] and one["from_data"]'), "What stays"),
        (NEEDS.format(condition='one["from_data"] and one["leaves"]'), "has its noise"),
        (NEEDS.format(condition='"joints" in one["name"]'), "Three conditions"),
        ("def needs_noise(released):\n    return released", "list of names"),
    ],
}
