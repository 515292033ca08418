"""The checker behind the exercises: ``check("02.pooled_std", pooled_std)`` says what is right, or gives a hint.

A chapter's checks are functions of its module here, named like the exercise; each calls the reader's answer on cases
of its own and raises `Hint` where the answer is not right yet. A wrong answer never stops the notebook.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import wraps
from importlib import import_module
from typing import Any

import numpy as np

EMPTY = "Nothing is there yet: replace the three dots."


class Hint(Exception):
    """What is missing in an answer, in a sentence that helps to find it."""


@dataclass(frozen=True)
class Verdict:
    """What a check found; a notebook shows it as a line of text."""

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
    """Check an answer to an exercise, ``"chapter.name"``: a function, or a value.

    Raises:
        ValueError: there is no such exercise.
    """
    chapter, _, name = exercise.partition(".")
    judge = _checks(chapter).get(name)
    if judge is None:
        raise ValueError(f"unknown exercise {exercise!r}: choose from {', '.join(known(chapter)) or '01. to 09.'}")
    try:
        judge(_asked(answer) if callable(answer) else _filled(answer))
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
    own = {name: thing for name, thing in vars(module).items() if getattr(thing, "__module__", "") == module.__name__}
    return {name: thing for name, thing in own.items() if callable(thing) and not name.startswith("_")}


def _asked(answer: Callable[..., Any]) -> Callable[..., Any]:
    """Wrap the reader's function, so that an error in it becomes a hint, and so does an answer that is not there."""

    @wraps(answer)
    def ask(*arguments: Any, **named: Any) -> Any:
        try:
            given = answer(*arguments, **named)
        except Exception as error:
            raise Hint(f"Your code raises {type(error).__name__}: {error}") from error
        return _filled(given)

    return ask


def _filled(given: Any) -> Any:
    if given is None or given is ...:
        raise Hint(EMPTY)
    return given


def expect(right: bool, hint: str) -> None:
    """Raise `Hint` unless something is right."""
    if not right:
        raise Hint(hint)


def close(given: Any, expected: Any, tolerance: float = 1e-6) -> bool:
    """Whether numbers or arrays agree in shape and, up to `tolerance` (relative and absolute), in every value."""
    try:
        found = np.asarray(given, dtype=float)
    except (TypeError, ValueError) as error:
        raise Hint(f"A number or an array of numbers is wanted, not {given!r}.") from error
    wanted = np.asarray(expected, dtype=float)
    return found.shape == wanted.shape and np.allclose(found, wanted, rtol=tolerance, atol=tolerance, equal_nan=True)
