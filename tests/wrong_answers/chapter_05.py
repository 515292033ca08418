"""Mistakes that readers make in the chapter on evaluation, and a word of the hint that each gets."""

WILSON = """import numpy as np


def wilson_interval(k, n, z={z}):
    p = k / n
    middle = p + z**2 / (2 * n)
    half = z * np.sqrt(p * (1 - p) / n + z**2 / (4 * n**2))
    return {ends}
"""
NEEDED = """import numpy as np


def visible(attempts, rate):
    gap = np.arange(1e-4, 1 - rate, 1e-4)
    spread = {spread} + 0 * gap
    return gap[{z}**2 * spread / gap**2 <= attempts][0]
"""
JUMPS = """import numpy as np


def jump_ratio(actions, n):
    change = {change}
    meet = {meet}
    return {ratio}
"""
CHANGE = "np.abs(np.diff(actions, axis=0))"
RATIO = "change[meet].mean() / change[~meet].mean()"
PLACES = "np.arange(1, len(actions)) % n == 0"
BOTH = "rate * (1 - rate) + (rate + gap) * (1 - rate - gap)"
PAIRS = """import numpy as np


def misled(loss, success):
    a, b = np.triu_indices(len(loss), 1)
    sign = np.sign((loss[a] - loss[b]) * (success[a] - success[b]))
    return {share}
"""

WRONG = {
    "incomplete": [
        ("import numpy as np\n\n\ndef incomplete(f, s, r):\n    return np.flatnonzero(f == 0)", "lack its end"),
        ("import numpy as np\n\n\ndef incomplete(f, s, r):\n    return np.flatnonzero(f < s)", "too long"),
        ("import numpy as np\n\n\ndef incomplete(f, s, r):\n    return np.flatnonzero(f != s)", "Check the row"),
        ("import numpy as np\n\n\ndef incomplete(f, s, r):\n    return np.flatnonzero(f != r)", "3, 4 and 6"),
        ("def incomplete(f, s, r):\n    return (f != s) | (s != r)", "mask"),
        ("import numpy as np\n\n\ndef incomplete(f, s, r):\n    return np.flatnonzero(f == s)", "0 and 5"),
        ("def incomplete(f, s, r):\n    return [1, 2, 3, 4, 6]", "has to be empty"),
    ],
    "wilson_interval": [
        (
            "def wilson_interval(k, n):\n    p = k / n\n    half = 1.96 * (p * (1 - p) / n) ** 0.5\n"
            "    return p - half, p + half",
            "no width",
        ),
        ("def wilson_interval(k, n):\n    return k / n", "two numbers"),
        (WILSON.format(z=1.96, ends="middle - half, middle + half"), "over 1 + z²/n"),
        (WILSON.format(z=1.96, ends="np.array([middle + half, middle - half]) / (1 + z**2 / n)"), "swapped"),
        (WILSON.format(z=1.645, ends="np.array([middle - half, middle + half]) / (1 + z**2 / n)"), "90 % interval"),
        (WILSON.format(z=1.96, ends="p - half / (1 + z**2 / n), p + half / (1 + z**2 / n)"), "middle is off"),
        (WILSON.format(z=1.96, ends="middle / (1 + z**2 / n) - half, middle / (1 + z**2 / n) + half"), "width is not"),
    ],
    "faster_by": [
        (
            "import numpy as np\n\n\ndef faster_by(before, after):\n    return np.nanmean(before) - np.nanmean(after)",
            "different seeds",
        ),
        ("def faster_by(before, after):\n    return (before - after).mean()", "NaN propagates"),
        (
            "import numpy as np\n\n\ndef faster_by(before, after):\n"
            "    return (np.nan_to_num(before) - np.nan_to_num(after)).mean()",
            "does not take 0 s",
        ),
        ("import numpy as np\n\n\ndef faster_by(before, after):\n    return np.nanmean(after - before)", "sign"),
        ("def faster_by(before, after):\n    return before - after", "one number"),
        ("import numpy as np\n\n\ndef faster_by(before, after):\n    return np.nansum(before - after)", "solve"),
        ("def faster_by(before, after):\n    return -0.6", "3 s are saved"),
    ],
    "jump_ratio": [
        (JUMPS.format(change=CHANGE, meet="np.arange(len(change)) % n == 0", ratio=RATIO), "Off by one"),
        (JUMPS.format(change="np.diff(actions, axis=0)", meet=PLACES, ratio=RATIO), "opposite sign"),
        (JUMPS.format(change=CHANGE, meet=PLACES, ratio="change[~meet].mean() / change[meet].mean()"), "inverted"),
        (JUMPS.format(change=CHANGE, meet=PLACES, ratio="change[meet].mean() / change.mean()"), "second mean"),
        (JUMPS.format(change=CHANGE, meet="np.arange(2, len(actions) + 1) % n == 0", ratio=RATIO), "is a multiple"),
        (JUMPS.format(change=CHANGE, meet=PLACES, ratio="change[meet].mean(0) / change[~meet].mean(0)"), "all joints"),
    ],
    "misled": [
        (PAIRS.format(share="(sign > 0).mean()"), "leave that pair out"),
        (PAIRS.format(share="(sign < 0).sum() / (sign != 0).sum()"), "where the loss is right"),
        (PAIRS.format(share="(sign > 0).sum()"), "a count"),
        (
            "import numpy as np\n\n\ndef misled(loss, success):\n"
            "    sign = np.diff(loss) * np.diff(success)\n    return (sign > 0).sum() / (sign != 0).sum()",
            "with all others",
        ),
        ("def misled(loss, success):\n    return 0.0", "List the pairs"),
        ("def misled(loss, success):\n    return 0.4", "every pair is misleading"),
        ("def misled(loss, success):\n    return 1.0 if loss[0] < loss[1] else 0.4", "no pair is misleading"),
    ],
    "visible": [
        (NEEDED.format(spread=BOTH, z=1.96), "half of the experiments"),
        (NEEDED.format(spread="rate * (1 - rate)", z=2.8), "variances add up"),
        (NEEDED.format(spread="2 * rate * (1 - rate)", z=2.8), "variance of its own"),
        (NEEDED.format(spread=BOTH, z=2.49), "the formula says"),
    ],
}
