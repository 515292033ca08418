"""Sentences that state a result, each in a single call, so that a page shows the sentence and hides little code."""

from typing import Any

from IPython.display import Markdown, display


def say(*sentences: str) -> None:
    """Show sentences, in Markdown, as one paragraph."""
    display(Markdown(" ".join(sentences)))


def rate(row: Any) -> str:
    """Return ``53% [41, 65] of 60 rollouts`` of a row with `success_rate`, `low`, `high` and `rollouts`."""
    return f"{row.success_rate:.0%} {interval(row.low, row.high)} of {row.rollouts:,.0f} rollouts"


def points(row: Any) -> str:
    """Return ``+3.1 points [-4.0, +10.2]`` of a row with `difference`, `low` and `high`, all three as shares."""
    return f"{100 * row.difference:+.1f} points {interval(row.low, row.high, '+.1f')}"


def interval(low: float, high: float, form: str = ".0f") -> str:
    """Return the limits of an interval, given as shares, in percent: ``[41, 65]``."""
    return f"[{format(100 * low, form)}, {format(100 * high, form)}]"
