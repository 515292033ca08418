"""The checklist of a federated run: nine steps, and which of them a chapter has tested."""

from dataclasses import dataclass

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
