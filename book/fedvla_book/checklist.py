"""Shared by chapters: the checklist of a federated run, ticked by tests, and the display of library source."""

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from IPython.display import Markdown

STEPS = {
    "environment": "dependencies are installed at known versions",
    "model": "the policy loads, and only the intended parameters train",
    "data": "episodes are complete, and no episode is in two splits",
    "configuration": "all settings are known and in range",
    "training": "local steps change the weights and lower the loss",
    "parameters": "exchanged arrays are complete, validated and bit-identical to what was sent",
    "communication": "messages arrive, and their bytes are counted",
    "global_update": "the server's average is the intended one",
    "validation": "the model is evaluated on data that no client trained on",
}


@dataclass(frozen=True)
class Checklist:
    """The tested steps, shown as a list with ticks."""

    tested: frozenset[str]

    def _repr_markdown_(self) -> str:
        marks = {step: "☑" if step in self.tested else "☐" for step in STEPS}
        return "\n".join(f"- {marks[step]} **{step.replace('_', ' ')}**: {text}" for step, text in STEPS.items())

    def __repr__(self) -> str:
        return self._repr_markdown_().replace("**", "")


def checklist(**tests: bool) -> Checklist:
    """Return the checklist with a tick at each step given as True.

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
