"""Wrong answers to the exercises in the chapter CHAPTER, each with a phrase from the hint it gets."""

WRONG = {
    "points": [
        ("def points(a, b):\n    return 100 * (a / b - 1)", "percent a is above b"),
        ("def points(a, b):\n    return a - b", "a hundredth"),
        ("def points(a, b):\n    return 100 * (b - a)", "Subtract b from a"),
    ],
    "counted": [
        ("def counted(outcomes):\n    return sum(outcomes)", "Two numbers"),
        ("def counted(outcomes):\n    return sum(outcomes), len(outcomes) - sum(outcomes)", "not the failures"),
    ],
    "half_width": [
        ("def half_width(k, n):\n    return 1.96 * (k / n) * (1 - k / n) / n", "take the square root"),
        ("import numpy as np\n\n\ndef half_width(k, n):\n    return 1.96 * np.sqrt(k / n * (1 - k / n))", "narrower"),
    ],
    "overall_rate": [
        ("import numpy as np\n\n\ndef overall_rate(rates, rollouts):\n    return np.mean(rates)", "larger weight"),
        ("def overall_rate(rates, rollouts):\n    return sum(rates)", "all clients' successes"),
    ],
}
