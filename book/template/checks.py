"""Checks of the exercises in the chapter CHAPTER."""

from collections.abc import Callable, Sequence

import numpy as np

from fedvla_book.exercises import close, expect


def points(difference: Callable[[float, float], float]) -> None:
    """``difference(a, b)`` is how many percentage points a is above b."""
    given = difference(0.75, 0.5)
    expect(not close(given, 50.0), "That is how many percent a is above b; points are a plain difference.")
    expect(not close(given, 0.25), "Nearly: a point is a hundredth.")
    expect(close(given, 25.0) and close(difference(0.1, 0.4), -30.0), "Take b from a, in hundredths.")


def counted(count: Callable[[Sequence[bool]], tuple[int, int]]) -> None:
    """``count(outcomes)`` is (successes, attempts)."""
    given = count([True, False, True])
    expect(np.shape(given) == (2,), "Two numbers are wanted: successes and attempts.")
    expect(not close(given, (2, 1)), "The second number is of all attempts, not of failures.")
    expect(close(given, (2, 3)) and close(count([]), (0, 0)), "Count again, for an empty list too.")


def reach(measure: Callable[[int, int], float]) -> None:
    """``measure(k, n)`` is 1.96 standard errors of k / n."""
    given, right = measure(30, 40), 1.96 * np.sqrt(0.75 * 0.25 / 40)
    expect(not close(given, right**2 / 1.96), "That is a variance: take the root.")
    expect(not close(given, right * np.sqrt(40)), "More attempts have to make it narrower.")
    expect(close(given, right) and close(measure(0, 5), 0.0), "The standard error of a rate has p, 1 - p and n in it.")


def averaged(average: Callable[..., float]) -> None:
    """``average(rates, attempts)`` is the rate over all attempts."""
    given = average([0.5, 1.0], [30, 10])
    expect(not close(given, 0.75), "A client with more attempts has to weigh more.")
    expect(close(given, 0.625) and close(average([0.2], [3]), 0.2), "Successes of all, over attempts of all.")
