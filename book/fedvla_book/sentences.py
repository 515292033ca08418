"""Sentences that state a result, each in a single call, so that a page shows the sentence and hides little code."""

from typing import Any

from IPython.display import Markdown, display

from fedvla_lib.evaluation.statistics import p_text

LEVEL = 0.05  # of a test


def say(*sentences: str) -> None:
    """Show sentences, in Markdown, as one paragraph."""
    display(Markdown(" ".join(sentences)))


def rate(row: Any) -> str:
    """Return ``53% [41, 65] of 60 rollouts`` of a row with `success_rate`, `low`, `high` and `rollouts`."""
    return f"{row.success_rate:.0%} {interval(row.low, row.high)} of {row.rollouts:,.0f} rollouts"


def points(row: Any) -> str:
    """Return ``+3.1 points [-4.0, +10.2]`` of a row with `difference`, `low` and `high`, all three as shares."""
    return f"{100 * row.difference:+.1f} points {interval(row.low, row.high, '+.1f')}"


def is_clear(row: Any) -> bool:
    """Return whether a difference is shown: by its p-value after Holm's correction, or its interval if it has none."""
    p_holm = getattr(row, "p_holm", None)
    return p_holm < LEVEL if p_holm is not None else not row.low <= 0 <= row.high


def verdict(row: Any) -> str:
    """Return how the first method of a difference stands to the second, in words that `is_clear` supports."""
    if not is_clear(row):
        return "not shown to differ from"
    return "ahead of" if row.difference > 0 else "behind"


def corrected(row: Any) -> str:
    """Return `points`, and the p-value corrected by Holm's method."""
    return f"{points(row)}, p {p_text(row.p_holm)} (Holm)"


def interval(low: float, high: float, form: str = ".0f") -> str:
    """Return the limits of an interval, given as shares, in percent: ``[41, 65]``."""
    return f"[{format(100 * low, form)}, {format(100 * high, form)}]"
