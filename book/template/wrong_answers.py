"""Mistakes that readers make in the chapter CHAPTER, and a phrase of the hint that each gets."""

WRONG = {
    "points": [
        ("def points(a, b):\n    return 100 * (a / b - 1)", "percent a is above b"),
        ("def points(a, b):\n    return a - b", "a hundredth"),
        ("def points(a, b):\n    return 100 * (b - a)", "Take b from a"),
    ],
    "counted": [
        ("def counted(outcomes):\n    return sum(outcomes)", "Two numbers"),
        ("def counted(outcomes):\n    return sum(outcomes), len(outcomes) - sum(outcomes)", "not of failures"),
    ],
    "reach": [
        ("def reach(k, n):\n    return 1.96 * (k / n) * (1 - k / n) / n", "take the root"),
        ("import numpy as np\n\n\ndef reach(k, n):\n    return 1.96 * np.sqrt(k / n * (1 - k / n))", "narrower"),
    ],
    "averaged": [
        ("import numpy as np\n\n\ndef averaged(rates, attempts):\n    return np.mean(rates)", "weigh more"),
        ("def averaged(rates, attempts):\n    return sum(rates)", "Successes of all"),
    ],
}
