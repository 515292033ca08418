"""Checks of the exercises in the chapter CHAPTER."""

from collections.abc import Callable, Sequence

import numpy as np

from fedvla_book.exercises import close, expect


def points(difference: Callable[[float, float], float]) -> None:
    """``difference(a, b)`` is how many percentage points a is above b."""
    given = difference(0.75, 0.5)
    expect(
        not close(given, 50.0),
        "That is how many percent a is above b; percentage points are the difference of the two rates.",
    )
    expect(not close(given, 0.25), "Almost: a percentage point is a hundredth.")
    expect(close(given, 25.0) and close(difference(0.1, 0.4), -30.0), "Subtract b from a, in hundredths.")


def counted(count: Callable[[Sequence[bool]], tuple[int, int]]) -> None:
    """``count(outcomes)`` is (successes, rollouts)."""
    given = count([True, False, True])
    expect(np.shape(given) == (2,), "Return two numbers: successes and rollouts.")
    expect(not close(given, (2, 1)), "The second number counts all rollouts, not the failures.")
    expect(
        close(given, (2, 3)) and close(count([]), (0, 0)),
        "Count the successes and all outcomes; an empty list gives (0, 0).",
    )


def half_width(measure: Callable[[int, int], float]) -> None:
    """``measure(k, n)`` is 1.96 standard errors of k / n."""
    given, right = measure(30, 40), 1.96 * np.sqrt(0.75 * 0.25 / 40)
    expect(not close(given, right**2 / 1.96), "That is a variance: take the square root.")
    expect(not close(given, right * np.sqrt(40)), "More rollouts must make it narrower.")
    expect(close(given, right) and close(measure(0, 5), 0.0), "The standard error of a rate p is sqrt(p (1 - p) / n).")


def overall_rate(average: Callable[..., float]) -> None:
    """``average(rates, rollouts)`` is the success rate over all rollouts."""
    given = average([0.5, 1.0], [30, 10])
    expect(not close(given, 0.75), "A client with more rollouts must have a larger weight.")
    expect(
        close(given, 0.625) and close(average([0.2], [3]), 0.2),
        "Divide all clients' successes by all clients' rollouts.",
    )
