"""Mistakes that readers make in the chapter on data, and a word of the hint that each gets."""

WRONG = {
    "tracking_error": [
        (
            "def tracking_error(s, a, d):\n    return np.abs(a[: len(a) - d] - s[d:]).mean()",
            "leave its column out",
        ),
        (
            "def tracking_error(s, a, d):\n    return np.abs(s[: len(s) - d, :5] - a[d:, :5]).mean()",
            "back in time",
        ),
        (
            "def tracking_error(s, a, d):\n    return np.abs(a - np.roll(s, -d, axis=0))[:, :5].mean()",
            "without a later state",
        ),
        (
            "def tracking_error(s, a, d):\n    return np.abs(a[: len(a) - d, :5] - s[d:, :5]).mean(axis=0)",
            "the shape (5,)",
        ),
        ("def tracking_error(s, a, d):\n    return (a[: len(a) - d, :5] - s[d:, :5]).mean()", "without their sign"),
        ("def tracking_error(s, a, d):\n    return np.abs(a - s)[:, :5].mean()", "`delay_frames` later"),
        (
            "def tracking_error(s, a, d):\n"
            "    pairs = zip(a[:-d, :5], s[d:, :5])\n"
            "    return sum(np.abs(x - y).mean() for x, y in pairs) / (len(a) - d)",
            "every frame has a pair",
        ),
    ],
    "video_time": [
        ("def video_time(i, n, t, fps):\n    return i / fps", "two things"),
        (
            "def video_time(i, n, t, fps):\n    return i // n[0], t[i // n[0]] + i % n[0] / fps",
            "add their lengths up",
        ),
        (
            "def video_time(i, n, t, fps):\n    ends = np.cumsum(n)\n    k = np.searchsorted(ends, i, side='right')\n"
            "    return k, t[k] + i - ends[k] + n[k]",
            "divide by the frame rate",
        ),
        (
            "def video_time(i, n, t, fps):\n    ends = np.cumsum(n)\n    k = np.searchsorted(ends, i, side='right')\n"
            "    return k, (i - ends[k] + n[k]) / fps",
            "where its file does",
        ),
        (
            "def video_time(i, n, t, fps):\n    return np.searchsorted(np.cumsum(n), i, side='right'), i / fps",
            "not of the data set",
        ),
        (
            "def video_time(i, n, t, fps):\n    ends = np.cumsum(n)\n    k = np.searchsorted(ends, i)\n"
            "    return k, t[k] + (i - ends[k] + n[k]) / fps",
            "the first of the next",
        ),
        (
            "def video_time(i, n, t, fps):\n    ends = np.cumsum(n)\n    k = np.searchsorted(ends, i, side='right')\n"
            "    return k, t[k] + (i - ends[k] + n[k] + 1) / fps",
            "the frames since then",
        ),
        (
            "def video_time(i, n, t, fps):\n    ends = np.cumsum(n)\n    k = np.searchsorted(ends, i, side='right')\n"
            "    return k, t[k] + (i - ends[k] + n[k]) / 10",
            "the one that is given",
        ),
    ],
    "chunk_at": [
        (
            "def chunk_at(a, row, end, size):\n    i = np.arange(row, row + size)\n"
            "    return a[np.minimum(i, len(a) - 1)], i >= len(a)",
            "the next episode",
        ),
        (
            "def chunk_at(a, row, end, size):\n    i = np.arange(row, row + size)\n"
            "    return a[np.minimum(i, end)], i >= end",
            "the next episode",
        ),
        (
            "def chunk_at(a, row, end, size):\n    i = np.arange(row, min(row + size, end))\n    return a[i], i >= end",
            "`size` rows",
        ),
        (
            "def chunk_at(a, row, end, size):\n    chunk, left = np.zeros((size, 6)), min(size, end - row)\n"
            "    chunk[:left] = a[row : row + left]\n    return chunk, np.arange(size) >= left",
            "zero position",
        ),
        (
            "def chunk_at(a, row, end, size):\n    return a[[row] * size], np.arange(row, row + size) >= end",
            "one row further",
        ),
        (
            "def chunk_at(a, row, end, size):\n    return a[np.minimum(np.arange(row, row + size), end - 1)]",
            "two things",
        ),
        (
            "def chunk_at(a, row, end, size):\n    i = np.arange(row, row + size)\n"
            "    return a[np.minimum(i, end - 1)], row + size > end",
            "one value for each",
        ),
        (
            "def chunk_at(a, row, end, size):\n    i = np.arange(row, row + size)\n"
            "    return a[np.minimum(i, end - 1)], i < end",
            "marks real actions",
        ),
        (
            "def chunk_at(a, row, end, size):\n    i = np.arange(row, row + size)\n"
            "    return a[np.minimum(i, end - 1)], i > end",
            "Padding starts",
        ),
    ],
    "normalised": [
        (
            "def normalised(a, index, ids):\n    return (a - a.mean(axis=0)) / a.std(axis=0)",
            "the leak",
        ),
        (
            "def normalised(a, index, ids):\n    a = a[np.isin(index, ids)]\n"
            "    return (a - a.mean(axis=0)) / a.std(axis=0)",
            "held-out ones too",
        ),
        (
            "def normalised(a, index, ids):\n    known = a[np.isin(index, ids)]\n"
            "    return (a - known.mean()) / known.std()",
            "each joint",
        ),
        (
            "def normalised(a, index, ids):\n    each = [a[index == i] for i in ids]\n"
            "    mean = np.mean([x.mean(axis=0) for x in each], axis=0)\n"
            "    return (a - mean) / np.mean([x.std(axis=0) for x in each], axis=0)",
            "all training frames together",
        ),
        (
            "def normalised(a, index, ids):\n    z, seen = np.empty_like(a), np.isin(index, ids)\n"
            "    for part in (seen, ~seen):\n"
            "        z[part] = (a[part] - a[part].mean(axis=0)) / a[part].std(axis=0)\n    return z",
            "the statistics of training",
        ),
    ],
    "rollouts_needed": [
        (
            "def rollouts_needed(p, width):\n    n = 1\n"
            "    while 2 * 1.96 * np.sqrt(p * (1 - p) / n) >= width:\n        n += 1\n    return n",
            "has no width",
        ),
        (
            "def rollouts_needed(p, width, z=1.96):\n    n = 1\n"
            "    while z * np.sqrt(p * (1 - p) / n + z**2 / (4 * n**2)) / (1 + z**2 / n) >= width:\n"
            "        n += 1\n    return n",
            "from low to high",
        ),
        (
            "def rollouts_needed(p, width, z=1.96):\n    n = 1\n"
            "    while 2 * z * np.sqrt(p * (1 - p) / n + z**2 / (4 * n**2)) >= width:\n"
            "        n += 1\n    return n",
            "The factor in front",
        ),
        (
            "def rollouts_needed(p, width, z=1.96):\n    n = 10\n"
            "    while 2 * z * np.sqrt(p * (1 - p) / n + z**2 / (4 * n**2)) / (1 + z**2 / n) >= width:\n"
            "        n += 10\n    return n",
            "each n in turn",
        ),
    ],
}
