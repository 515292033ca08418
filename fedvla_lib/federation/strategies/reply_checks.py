"""What a reply's numbers have to be before Flower averages them, and what an average has to be before it is used."""

import math
from typing import Any

import numpy as np
from flwr.app import Message

from fedvla_lib.federation import messages
from fedvla_lib.policy.parameters import Arrays, ParameterError


def require_finite(server_round: int, state: dict[str, Arrays]) -> None:
    """Raise FloatingPointError if the average, or what the strategy keeps, overflowed; all replies were finite."""
    for record, arrays in state.items():
        for name, array in arrays.items():
            if not np.isfinite(array).all():
                raise FloatingPointError(
                    f"round {server_round}: the average overflowed ({record} of {name!r} is not finite): "
                    "lower lr or server-lr; the last checkpoint is of the round before"
                )


def check_metrics(reply: Message, expected: tuple[str, ...]) -> None:
    """Raise ParameterError unless Flower can average the metrics of the reply, weighted by examples."""
    records = reply.content.metric_records
    if list(records) != [messages.METRICS]:
        raise ParameterError("metrics", f"expected one record {messages.METRICS!r} of numbers, got {list(records)}")
    count = examples(reply)
    if not isinstance(count, int) or count < 0:
        raise ParameterError("examples", f"{messages.EXAMPLES}={count!r}: expected a number of frames")
    found = set(records[messages.METRICS])
    if found != set(expected) and not (found == {messages.EXAMPLES} and count == 0):
        raise ParameterError("metrics", f"got {sorted(found)}, expected {sorted(expected)}")
    for key, value in records[messages.METRICS].items():
        if isinstance(value, list) or not math.isfinite(value):
            raise ParameterError("metrics", f"{key}={value!r} is not a finite number")


def examples(reply: Message) -> Any:
    """Return the training frames that a reply announces; they may be anything until they are checked."""
    return reply.content.metric_records[messages.METRICS].get(messages.EXAMPLES)
