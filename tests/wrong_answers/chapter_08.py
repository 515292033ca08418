"""Mistakes that readers make in the chapter on communication, and a word of the hint that each gets."""

TRAFFIC = """
def traffic(messages):
    total = {{"client": 0, "server": 0}}
    for message in messages:
        for name, record in message["records"].items():
            {condition}
                total[message["to"]] += sum({size} for array in record.values())
    return {result}
"""
COUNTED = {"condition": "if True:", "size": "array.nbytes", "result": 'total["client"], total["server"]'}

PERSONAL = """
import numpy as np


def personal_round(updates, frames, own):
    weights = {weights}
    shared = {{
        name: sum(w * update[name] for w, update in zip(weights, updates)) for name in updates[0] if {which}
    }}
    return {result}
"""
SHARED = {
    "weights": "np.array(frames) / np.sum(frames)",
    "which": "name not in own",
    "result": "[update | shared for update in updates]",
}

ROUNDED = """
import numpy as np


def rounded_change(change, left_over):
    wanted = {wanted}
    scale = np.abs(wanted).max() / {most}
    levels = {levels}
    return {result}
"""
SENT = {
    "wanted": "change + left_over",
    "most": "127",
    "levels": "np.rint(wanted / (scale or 1))",
    "result": "levels, scale, wanted - levels * scale",
}

AVERAGED = """
import numpy as np


def averaging_error(B, A, weights):
    right = sum(w * b @ a for w, b, a in zip({weights}, B, A))
    mean_b = sum(w * b for w, b in zip({weights}, B))
    mean_a = sum(w * a for w, a in zip({weights}, A))
    apart = mean_b @ mean_a
    miss, size = np.linalg.norm(right - apart), np.linalg.norm(right)
    return {result}
"""
RELATIVE = {"weights": "weights", "result": "miss / size"}

THIN = """
import numpy as np


def thin_average(B, A, weights, rank):
    whole = sum(w * b @ a for w, b, a in zip({weights}, B, A))
    u, s, vt = np.linalg.svd(whole, full_matrices=False)
    return {result}
"""

WRONG = {
    "traffic": [
        (TRAFFIC.format(**COUNTED | {"size": "4 * array.size"}), "Not every number"),
        (TRAFFIC.format(**COUNTED | {"size": "array.size"}), "in bytes"),
        (TRAFFIC.format(**COUNTED | {"condition": 'if name == "arrays":'}), "more than one record"),
        (TRAFFIC.format(**COUNTED | {"result": 'total["server"], total["client"]'}), "Down comes first"),
        (TRAFFIC.format(**COUNTED | {"result": 'total["server"] + total["client"]'}), "two numbers"),
        (TRAFFIC.format(**COUNTED | {"size": "array.nbytes * 8"}), "Add up the bytes"),
    ],
    "round_seconds": [
        (
            "import math\n\n\ndef round_seconds(shapes, down, up, line):\n"
            "    return sum(map(math.prod, shapes.values())) * (down + up) / 8 / (line * 1e6)",
            "too short",
        ),
        (
            "import math\n\n\ndef round_seconds(shapes, down, up, line):\n"
            "    return sum(map(math.prod, shapes.values())) * (down + up) / (line * 1e6 / 8)",
            "too long",
        ),
        (
            "import math\n\n\ndef round_seconds(shapes, down, up, line):\n"
            "    return sum(map(math.prod, shapes.values())) * down / (line * 1e6)",
            "are sent twice",
        ),
        (
            "import math\n\n\ndef round_seconds(shapes, down, up, line):\n"
            "    return sum(math.prod(s) for s in shapes.values() if s) * (down + up) / (line * 1e6)",
            "shape ()",
        ),
        (
            "import math\n\n\ndef round_seconds(shapes, down, up, line):\n"
            "    return sum(map(math.prod, shapes.values())) * (down + up) / (line * 2**20)",
            "All numbers",
        ),
        (
            "import math\n\n\ndef round_seconds(shapes, down, up, line):\n"
            "    n = sum(map(math.prod, shapes.values())) / (line * 1e6)\n    return n * down, n * up",
            "one number",
        ),
    ],
    "personal_round": [
        (PERSONAL.format(**SHARED | {"which": "True"}), "shared as well"),
        (PERSONAL.format(**SHARED | {"weights": "np.full(len(frames), 1 / len(frames))"}), "weigh more"),
        (PERSONAL.format(**SHARED | {"result": "shared"}), "no single global model"),
        (PERSONAL.format(**SHARED | {"result": "[shared for _ in updates]"}), "shared and own"),
        (PERSONAL.format(**SHARED | {"result": "[update | shared for update in updates[::-1]]"}), "keeps its own"),
        (PERSONAL.format(**SHARED | {"weights": "frames"}), "the mean weighted"),
        (PERSONAL.format(**SHARED | {"which": 'name != "head"'}), "only the names in it"),
    ],
    "rounded_change": [
        (ROUNDED.format(**SENT | {"wanted": "change"}), "then round"),
        (ROUNDED.format(**SENT | {"result": "levels, scale, change - levels * scale"}), "part of the target"),
        (ROUNDED.format(**SENT | {"result": "levels, scale, levels * scale - wanted"}), "wrong sign"),
        (ROUNDED.format(**SENT | {"result": "levels, scale, wanted - levels"}), "decodes from the levels"),
        (ROUNDED.format(**SENT | {"levels": "np.trunc(wanted / (scale or 1))"}), "the nearest"),
        (ROUNDED.format(**SENT | {"levels": "wanted / (scale or 1)"}), "whole numbers"),
        (ROUNDED.format(**SENT | {"levels": "np.rint(wanted / scale)"}), "gives NaN"),
        (ROUNDED.format(**SENT | {"most": "100"}), "fixes the scale"),
        (ROUNDED.format(**SENT | {"result": "levels * scale"}), "three things"),
        (ROUNDED.format(**SENT | {"result": "levels.sum(), scale, wanted"}), "level for each"),
    ],
    "averaging_error": [
        (AVERAGED.format(**RELATIVE | {"result": "miss"}), "the norm of the error"),
        (AVERAGED.format(**RELATIVE | {"result": "miss / np.linalg.norm(apart)"}), "the separate averages"),
        (AVERAGED.format(**RELATIVE | {"weights": "np.full(len(B), 1 / len(B))"}), "in all three means"),
        (AVERAGED.format(**RELATIVE | {"result": "(miss / size) ** 2"}), "has a square root"),
        (AVERAGED.format(**RELATIVE | {"result": "abs(right - apart).max() / size"}), "Compare multiplying"),
    ],
    "thin_average": [
        (
            "import numpy as np\n\n\ndef thin_average(B, A, weights, rank):\n    b = np.tensordot(weights, B, 1)\n"
            "    a = np.tensordot(weights, A, 1)\n    b = np.hstack([b, np.zeros((len(b), rank - 2))])\n"
            "    return b, np.vstack([a, np.zeros((rank - 2, a.shape[1]))])",
            "averages A and B separately",
        ),
        (THIN.format(weights="weights", result="u * s, vt"), "Expected shapes"),
        (THIN.format(weights="weights", result="u[:, :rank], vt[:rank]"), "values are lost"),
        (THIN.format(weights="weights", result="u[:, :rank] * s[:rank], s[:rank, None] * vt[:rank]"), "once is enough"),
        (THIN.format(weights="np.full(3, 1 / 3)", result="u[:, :rank] * s[:rank], vt[:rank]"), "Clients have weights"),
        (THIN.format(weights="weights", result="u[:, -rank:] * s[-rank:], vt[-rank:]"), "largest singular values"),
        (THIN.format(weights="weights", result="(u[:, :rank] * s[:rank]) @ vt[:rank]"), "two matrices"),
    ],
}
