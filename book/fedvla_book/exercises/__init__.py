"""Checks of the exercises: ``check("02.pooled_std", pooled_std)`` confirms an answer or gives a hint.

A chapter's checks are functions of its module here, named like the exercise; each tests the reader's answer and raises
`Hint` if it is not right. A wrong answer never stops the notebook.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import wraps
from importlib import import_module
from typing import Any

import numpy as np

EMPTY = "There is no answer yet: replace the three dots."


class Hint(Exception):
    """An answer is wrong; the message is a hint."""


@dataclass(frozen=True)
class Verdict:
    """Result of a check, shown as a line of text."""

    name: str
    hint: str  # empty if the answer is right

    @property
    def passed(self) -> bool:
        """Whether the answer is right."""
        return not self.hint

    def _repr_markdown_(self) -> str:
        return f"✔ **{self.name}** is right." if self.passed else f"✎ **{self.name}**: not yet. {self.hint}"

    def __repr__(self) -> str:
        return self._repr_markdown_().replace("**", "")


def check(exercise: str, answer: Any) -> Verdict:
    """Check the answer to an exercise ``"chapter.name"``: a function or a value.

    Raises:
        ValueError: unknown exercise.
    """
    chapter, _, name = exercise.partition(".")
    checker = _checks(chapter).get(name)
    if checker is None:
        raise ValueError(f"unknown exercise {exercise!r}: choose from {', '.join(known(chapter)) or '01. to 10., 90.'}")
    try:
        checker(_wrapped(answer) if callable(answer) else _filled(answer))
    except Hint as hint:
        return Verdict(name, str(hint))
    return Verdict(name, "")


def known(chapter: str) -> list[str]:
    """Return the exercises of a chapter, such as ``02.pooled_std``."""
    return [f"{chapter}.{name}" for name in _checks(chapter)]


def _checks(chapter: str) -> dict[str, Callable[[Any], None]]:
    try:
        module = import_module(f"fedvla_book.exercises.chapter_{chapter}")
    except ModuleNotFoundError:
        return {}
    own = {name: item for name, item in vars(module).items() if getattr(item, "__module__", "") == module.__name__}
    return {name: item for name, item in own.items() if callable(item) and not name.startswith("_")}


def _wrapped(answer: Callable[..., Any]) -> Callable[..., Any]:
    """Wrap the reader's function so that an error in it, or a missing result, becomes a hint."""

    @wraps(answer)
    def call(*arguments: Any, **named: Any) -> Any:
        try:
            given = answer(*arguments, **named)
        except Exception as error:
            raise Hint(f"Your code raises {type(error).__name__}: {error}") from error
        return _filled(given)

    return call


def _filled(given: Any) -> Any:
    if given is None or given is ...:
        raise Hint(EMPTY)
    return given


def expect(right: bool, hint: str) -> None:
    """Raise `Hint` if `right` is false."""
    if not right:
        raise Hint(hint)


def close(given: Any, expected: Any, tolerance: float = 1e-6) -> bool:
    """Whether numbers or arrays have the same shape and values, up to a relative and absolute `tolerance`."""
    try:
        values = np.asarray(given, dtype=float)
    except (TypeError, ValueError) as error:
        raise Hint(f"Expected a number or an array of numbers, not {given!r}.") from error
    wanted = np.asarray(expected, dtype=float)
    return values.shape == wanted.shape and np.allclose(values, wanted, rtol=tolerance, atol=tolerance, equal_nan=True)
