"""What chapters share: the checklist of a federated run, ticked by tests, and the library's own source, shown."""

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

STEPS = {
    "environment": "what is needed is installed, at known versions",
    "model": "the policy loads, and the right part of it trains",
    "data": "episodes are whole, and nothing is on two sides",
    "configuration": "all settings are known and in range",
    "training": "local steps change the weights and lower the loss",
    "parameters": "what travels is complete, checked and bit for bit what was sent",
    "communication": "messages arrive, and their bytes are counted",
    "global_update": "the server's average is the one that was meant",
    "validation": "the result is measured on what nobody trained on",
}


@dataclass(frozen=True)
class Checklist:
    """Steps that were tested; a notebook shows them as a list with ticks."""

    tested: frozenset[str]

    def _repr_markdown_(self) -> str:
        marks = {step: "☑" if step in self.tested else "☐" for step in STEPS}
        return "\n".join(f"- {marks[step]} **{step.replace('_', ' ')}**: {what}" for step, what in STEPS.items())

    def __repr__(self) -> str:
        return self._repr_markdown_().replace("**", "")


def checklist(**tests: bool) -> Checklist:
    """Return the list with a tick at each step whose test holds.

    Raises:
        ValueError: there is no such step.
        AssertionError: a test does not hold; the message names its step.
    """
    for step, holds in tests.items():
        if step not in STEPS:
            raise ValueError(f"unknown step {step!r}: choose from {', '.join(STEPS)}")
        if not bool(holds):
            raise AssertionError(f"the test of step {step!r} does not hold")
    return Checklist(frozenset(tests))


@dataclass(frozen=True)
class Source:
    """Code of the library; a notebook shows it as a block of Python."""

    code: str

    def _repr_markdown_(self) -> str:
        return f"```python\n{self.code}```"

    def __repr__(self) -> str:
        return self.code


def show(thing: Callable[..., Any]) -> Source:
    """Return the source of a function or class of the library as it is, so that a chapter cannot show another.

    Raises:
        ValueError: it is not the library's.
    """
    if not str(thing.__module__).startswith("fedvla_lib."):
        raise ValueError(f"{thing.__qualname__} is of {thing.__module__}, not of fedvla_lib: show what the library has")
    return Source(inspect.getsource(thing))
