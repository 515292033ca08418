"""Mistakes that readers make in the chapter on strategies, and a word of the hint that each gets."""

SCAFFOLD = """
import numpy as np


def scaffold_round(gradients, w, own, drawn, rate, steps):
    c, after, ends = {c}, own.copy(), []
    for k in drawn:
        y = w
        for _ in range(steps):
            y = y - rate * (gradients[k](y) {sign} (c - own[k]))
        after[k] = {new}
        ends.append(y)
    return {result}
"""
RIGHT = {
    "c": "own.mean()",
    "sign": "+",
    "new": "own[k] - c + (w - y) / (steps * rate)",
    "result": "np.mean(ends), after",
}

WRONG = {
    "rounds_at_equal_steps": [
        ("def rounds_at_equal_steps(r, d, s, nd, ns):\n    return r * s / ns", "count it as well"),
        ("def rounds_at_equal_steps(r, d, s, nd, ns):\n    return r * d * s", "how many of the new rounds"),
        ("def rounds_at_equal_steps(r, d, s, nd, ns):\n    return r * nd * ns / (d * s)", "fewer rounds"),
    ],
    "resting_point": [
        ("def resting_point(a, b, rate, steps):\n    return b.mean()", "clients' minima"),
        ("def resting_point(a, b, rate, steps):\n    return a @ b / a.sum()", "the optimum"),
        (
            "def resting_point(a, b, rate, steps):\n    moved = steps * rate * a\n    return moved @ b / moved.sum()",
            "the optimum",
        ),
        (
            "def resting_point(a, b, rate, steps):\n"
            "    left = (1 - rate * a) ** steps\n    return left @ b / left.sum()",
            "not by that gone",
        ),
        ("def resting_point(a, b, rate, steps):\n    return (1 - (1 - rate * a) ** steps) @ b", "updates cancel"),
    ],
    "pulls": [
        ("def pulls(move):\n    return move(8.0) <= move(0.0)", "without any effect"),
        ("def pulls(move):\n    return move(8.0) != move(0.0)", "wrong sign"),
        ("def pulls(move):\n    return move(0.0) == 0.0", "which of two updates"),
        ("def pulls(move):\n    return move(8.0) < 0.5", "not one with a number"),
        ("def pulls(move):\n    return move(0.0) - move(8.0) > 1e-3", "not one with a number"),
    ],
    "proximal_phase": [
        (
            "def proximal_phase(gradient, start, steps, rate, mu):\n    w = start\n    for _ in range(steps):\n"
            "        w -= rate * (gradient(w) + mu * (w - start))\n    return w",
            "move with the weights",
        ),
        (
            "def proximal_phase(gradient, start, steps, rate, mu):\n    w, anchor = start, start.copy()\n"
            "    for _ in range(steps):\n        w -= rate * (gradient(w) + mu * (w - anchor))\n    return w",
            "has changed",
        ),
        (
            "def proximal_phase(gradient, start, steps, rate, mu):\n    w = start\n    for _ in range(steps):\n"
            "        w = w - rate * (gradient(w) + mu * (start - w))\n    return w",
            "the sign",
        ),
        (
            "def proximal_phase(gradient, start, steps, rate, mu):\n    w = start\n    for _ in range(steps):\n"
            "        w = w - rate * (gradient(w) + mu * w)\n    return w",
            "towards zero",
        ),
        (
            "def proximal_phase(gradient, start, steps, rate, mu):\n    w = start\n    for _ in range(steps):\n"
            "        w = w - rate * gradient(w)\n    return w - rate * mu * (w - start)",
            "gradient of each step",
        ),
    ],
    "cosines": [
        (
            "import numpy as np\n\n\ndef cosines(start, ends):\n    mean = ends.mean(axis=0)\n"
            "    return ends @ mean / np.linalg.norm(ends, axis=1) / np.linalg.norm(mean)",
            "compare weights",
        ),
        ("def cosines(start, ends):\n    u = ends - start\n    return u @ u.mean(axis=0)", "both updates"),
        (
            "import numpy as np\n\n\ndef cosines(start, ends):\n    u = ends - start\n"
            "    return u @ u.mean(axis=0) / np.linalg.norm(u, axis=1)",
            "mean update as well",
        ),
        (
            "import numpy as np\n\n\ndef cosines(start, ends):\n    u = ends - start\n"
            "    u = u / np.maximum(np.linalg.norm(u, axis=1, keepdims=True), 1e-12)\n    m = u.mean(axis=0)\n"
            "    return u @ m / np.linalg.norm(m)",
            "counts more",
        ),
        (
            "import numpy as np\n\n\ndef cosines(start, ends):\n    u = ends - start\n    m = u.mean(axis=0)\n"
            "    return u @ m / np.linalg.norm(u, axis=1) / np.linalg.norm(m)",
            "gets nan",
        ),
        (
            "import numpy as np\n\n\ndef cosines(start, ends):\n    u = ends - start\n    m = u.mean(axis=0)\n"
            "    return np.nan_to_num(u @ m / np.linalg.norm(u, axis=1) / np.linalg.norm(m), nan=1.0)",
            "the others keep theirs",
        ),
        ("def cosines(start, ends):\n    return (ends - start).mean()", "each of the 4 clients"),
        (
            "import numpy as np\n\n\ndef cosines(start, ends):\n    u = ends - start\n"
            "    return u @ u[0] / np.linalg.norm(u, axis=1) / np.linalg.norm(u[0]) - 0.1",
            "product of two updates",
        ),
    ],
    "scaffold_round": [
        (SCAFFOLD.format(**RIGHT | {"c": "own[drawn].mean()"}), "over the sampled ones"),
        (SCAFFOLD.format(**RIGHT | {"sign": "-"}), "reversed"),
        (SCAFFOLD.format(**RIGHT | {"c": "0.0"}), "each step adds"),
        (SCAFFOLD.format(**RIGHT | {"new": "own[k] + (w - y) / (steps * rate)"}), "too large by c"),
        (SCAFFOLD.format(**RIGHT | {"new": "own[k] - c + (w - y)"}), "mean of the gradients"),
        (SCAFFOLD.format(**RIGHT | {"result": "np.mean(ends), after - c"}), "keeps its control variate"),
        (SCAFFOLD.format(**RIGHT | {"result": "np.mean(ends), after[drawn]"}), "all 3 clients"),
        (SCAFFOLD.format(**RIGHT | {"result": "np.mean(ends)"}), "two things"),
    ],
}
