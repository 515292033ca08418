"""Mistakes that readers make in the chapter on partitioning, and a word of the hint that each gets."""

WRONG = {
    "dealt": [
        ("def dealt(ids, n):\n    return [[i for i in ids if i % n == k] for k in range(n)]", "not by the id"),
        ("def dealt(ids, n):\n    return [sorted(ids)[k::n] for k in range(n - 1)]", "2 lists"),
        ("def dealt(ids, n):\n    return [list(ids)[k::n] for k in range(n)]", "Sort the ids"),
        ("def dealt(ids, n):\n    return [sorted(ids)[k : k + 1] for k in range(n)]", "exactly one client"),
    ],
    "pooled_std": [
        ("def pooled_std(n, m, s):\n    return n @ s / n.sum()", "left out"),
        ("def pooled_std(n, m, s):\n    return s.mean()", "6 joints"),
        (
            "def pooled_std(n, m, s):\n    mean = n @ m / n.sum()\n    return n @ (s**2 + (m - mean) ** 2) / n.sum()",
            "the root",
        ),
        (
            "import numpy as np\n\n\ndef pooled_std(n, m, s):\n"
            "    return np.sqrt((s**2 + (m - m.mean(axis=0)) ** 2).mean(axis=0))",
            "count more",
        ),
    ],
    "lacking": [
        ("def lacking(held):\n    return int((held == 0).sum())", "clients that miss any"),
        ("def lacking(held):\n    return int((held.sum(axis=1) == 0).sum())", "a row at a time"),
        (
            "def lacking(held):\n    return sum(bool(row.any()) and not row.all() for row in held)",
            "without any episode",
        ),
    ],
    "total_variation": [
        (
            "import numpy as np\n\n\ndef total_variation(held):\n    sizes = held.sum(axis=1)\n"
            "    apart = np.abs(held / sizes[:, None] - held.sum(axis=0) / held.sum()).sum(axis=1)\n"
            "    return sizes @ apart / sizes.sum()",
            "halve",
        ),
        (
            "import numpy as np\n\n\ndef total_variation(held):\n    sizes = held.sum(axis=1)\n"
            "    apart = np.abs(held / sizes[:, None] - held.sum(axis=0) / held.sum()).sum(axis=1)\n"
            "    return apart.mean() / 2",
            "weigh more",
        ),
        ("def total_variation(held):\n    return 0.0", "shares of tasks"),
    ],
}
