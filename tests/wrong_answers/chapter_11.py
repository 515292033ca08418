"""Mistakes that readers make in the chapter on an arm of one's own, and a word of the hint that each gets."""

SPEED = "def fastest(clamp, fps):\n    return {}"
DEGREES = "def degrees(value, range_min, range_max):\n    return {}"
ROWS = "import numpy as np\n\n\ndef rows_at(frames, recorded, fps):\n    return {}"
OFFSET = """
import numpy as np


def zero_offset(today, recorded):
    moved = today.mean(axis=0) - recorded.mean(axis=0)
    return {}
"""
LAG = """
import numpy as np


def best_lag(given, recorded, most):
    def error(lag):
        rows = np.arange(len(given)) + lag
        inside = (rows >= 0) & (rows < len(recorded))
        {}

    {}
"""
MEAN = "return np.abs(given[inside] - recorded[rows[inside]]).mean()"

WRONG = {
    "fastest": [
        (SPEED.format("clamp"), "how many steps"),
        (SPEED.format("clamp / fps"), "multiply"),
        (SPEED.format("clamp * fps ** 2"), "times steps in a second"),
        (SPEED.format("clamp * 30"), "depend on both"),
    ],
    "degrees": [
        (DEGREES.format("value"), "not 50 degrees"),
        (DEGREES.format("value / 100 * (range_max - range_min) * 360 / 4095"), "half a range away"),
        (DEGREES.format("value / 200 * (range_max - range_min)"), "ticks of the encoder"),
        (DEGREES.format("(range_min + (value + 100) / 200 * (range_max - range_min)) * 360 / 4095"), "not tick 0"),
        (DEGREES.format("value / 100 * 180"), "Half a range"),
        (DEGREES.format("abs(value) / 200 * (range_max - range_min) * 360 / 4095"), "below the middle"),
    ],
    "rows_at": [
        (ROWS.format("np.arange(frames)"), "a third of its time"),
        (ROWS.format("np.arange(0, frames + 1, recorded / fps)"), "no row 9"),
        (ROWS.format("np.arange(0, frames, int(recorded / fps))"), "round each time"),
        (ROWS.format("np.arange(0, frames, 2)"), "Take the times"),
        (ROWS.format("np.floor(np.arange(0, frames, recorded / fps)) - (recorded == 25)"), "nearest one"),
        (ROWS.format("np.arange(0, frames, 3)[:, None]"), "list of row numbers"),
        (ROWS.format("np.round(np.arange(0, frames, recorded / fps)).astype(int)"), "no row 8"),
    ],
    "zero_offset": [
        (OFFSET.format("moved"), "never starts in quite the same pose"),
        (OFFSET.format("np.where(np.abs(moved) > 3, -moved, 0)"), "Today minus recorded"),
        (OFFSET.format("np.where(moved > 3, moved, 0)"), "either way"),
        (OFFSET.format("moved.max()"), "for each joint"),
        (OFFSET.format("np.where(np.abs(moved) > 3, 8.0, 0)"), "difference of the mean"),
    ],
    "best_lag": [
        (LAG.format(MEAN, "return -min(range(-most, most + 1), key=error)"), "sign is turned"),
        (LAG.format(MEAN, "return min(range(most + 1), key=error)"), "all shifts from -most"),
        (LAG.format(MEAN, "return min(range(-most, most + 1), key=error)"), "stands still"),
        (LAG.format(MEAN, "return [error(lag) for lag in range(-most, most + 1)]"), "one number"),
    ],
}
