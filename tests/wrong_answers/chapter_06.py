"""Mistakes that readers make in the chapter that compares methods, and a word of the hint that each gets."""

STEPS = """def steps_spent(rounds, drawn, num_clients, local_steps):
    total = rounds * drawn * local_steps
    return {steps}
"""
BUDGETS = """def three_budgets(rounds, drawn, local_steps, mb):
    return {budgets}
"""
NEEDED = """import numpy as np


def demonstrations_needed(counts, rates, wanted):
    if wanted > rates[-1]:
        return {beyond}
    return {needed}
"""

WRONG = {
    "steps_spent": [
        (STEPS.format(steps="rounds * local_steps, total, total"), "not sampled in every round"),
        (STEPS.format(steps="total // num_clients, total, rounds * local_steps"), "Centralized takes"),
        (STEPS.format(steps="total, total, total"), "divide by the number"),
        (
            STEPS.format(steps="rounds * local_steps, *2 * (rounds * num_clients * local_steps,)"),
            "only the sampled clients",
        ),
        (STEPS.format(steps="[rounds * local_steps] * 3"), "of the federation together take"),
        (STEPS.format(steps="total"), "three numbers"),
    ],
    "unpaired": [
        ("def unpaired(left, right):\n    return set(left) - set(right)", "Both sides"),
        (
            "def unpaired(left, right):\n    return {seed for _, seed in left} ^ {seed for _, seed in right}",
            "in another task",
        ),
        ("def unpaired(left, right):\n    return [] if len(left) == len(right) else left", "are not enough"),
        (
            "def unpaired(left, right):\n    return [a for a, b in zip(left, right) if a != b]",
            "their order does not",
        ),
        (
            "def unpaired(left, right):\n"
            "    odd = set(left) ^ set(right)\n    return [a for a in odd if a[0] in {task for task, _ in left}]",
            "may also have run more",
        ),
    ],
    "three_budgets": [
        (BUDGETS.format(budgets="rounds * local_steps"), "three numbers"),
        (BUDGETS.format(budgets="[rounds * drawn * local_steps] * 2 + [2 * rounds * drawn * mb]"), "side by side"),
        (BUDGETS.format(budgets="drawn * local_steps, local_steps, 2 * drawn * mb"), "follow in a row"),
        (BUDGETS.format(budgets="rounds * local_steps, rounds * local_steps + 1, 2 * mb"), "adds the local steps"),
        (BUDGETS.format(budgets="local_steps * drawn, rounds * local_steps, 2 * rounds * drawn * mb"), "every drawn"),
        (BUDGETS.format(budgets="rounds * drawn * local_steps, rounds * local_steps, rounds * drawn * mb"), "twice"),
        (BUDGETS.format(budgets="rounds * drawn * local_steps, rounds * local_steps, 2 * rounds * mb"), "Every drawn"),
        (BUDGETS.format(budgets="rounds * drawn * local_steps, rounds * local_steps, mb"), "count the transfers"),
    ],
    "demonstrations_needed": [
        (NEEDED.format(beyond="np.inf", needed="np.interp(wanted, rates, counts)"), "in the logarithm"),
        (NEEDED.format(beyond="np.inf", needed="np.interp(wanted, rates, np.log2(counts))"), "turn it back"),
        (NEEDED.format(beyond="np.inf", needed="counts[np.searchsorted(rates, wanted)]"), "pass 0.3"),
        (NEEDED.format(beyond="counts[-1]", needed="2 ** np.interp(wanted, rates, np.log2(counts))"), "not reached"),
        (NEEDED.format(beyond="32.0", needed="2 ** np.interp(wanted, rates, np.log2(counts))"), "return infinity"),
        (
            NEEDED.format(
                beyond="np.inf", needed="2 ** np.interp(wanted, rates, np.log2(counts), left=0.0) - 0.0"
            ).replace("left=0.0", "left=-1.0"),
            "smallest count",
        ),
        (NEEDED.format(beyond="np.inf", needed="[wanted]"), "one number"),
    ],
}
