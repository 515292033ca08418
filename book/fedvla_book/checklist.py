"""Shared by chapters: the steps of a federated run that a chapter has tested, and the display of library source.

``book/how_to_read.md`` lists the nine steps with what each means.
"""

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from IPython.display import Markdown

STEPS = (
    "environment", "model", "data", "configuration", "training", "parameters", "communication", "global_update",
    "validation",
)  # fmt: skip


@dataclass(frozen=True)
class Checklist:
    """The tested steps, shown as one line."""

    tested: frozenset[str]

    def _repr_markdown_(self) -> str:
        ticks = [f"☑ {step.replace('_', ' ')}" for step in STEPS if step in self.tested]
        return f"Tested in this run: {', '.join(ticks)}."

    __repr__ = _repr_markdown_


def checklist(**tests: bool) -> Checklist:
    """Return the steps given, each of which has to be True: its test holds.

    Raises:
        ValueError: unknown step.
        AssertionError: a test does not hold; the message names its step.
    """
    for step, holds in tests.items():
        if step not in STEPS:
            raise ValueError(f"unknown step {step!r}: choose from {', '.join(STEPS)}")
        if not bool(holds):
            raise AssertionError(f"the test of step {step!r} does not hold")
    return Checklist(frozenset(tests))


def show(function: Callable[..., Any]) -> Markdown:
    """Return the source of a function or class of the library as a block of Python.

    Raises:
        ValueError: it is not part of fedvla_lib.
    """
    if not str(function.__module__).startswith("fedvla_lib."):
        raise ValueError(f"{function.__qualname__} is in {function.__module__}: give a function of fedvla_lib")
    return Markdown(f"```python\n{inspect.getsource(function)}```")
