"""Strategies that check what they average: what Flower's lack, as a mixin over any of them, and SCAFFOLD.

`Checked` leaves the averaging to Flower and adds five things around it: clients are drawn by partition, from a seed;
messages carry a SHA-256; each reply is checked and a bad one is left out by client name and reason; replies are summed
in the order of their partitions, so that the result does not depend on who answered first; and each round leaves a
record of the bytes that travelled and of how far apart the clients moved.
"""

import logging
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from flwr.app import Array, ArrayRecord, ConfigRecord, Message, MetricRecord, RecordDict
from flwr.serverapp import Grid

from fedvla_lib.config import Config
from fedvla_lib.federation.drift import geometry
from fedvla_lib.federation.messages import (
    ARRAYS,
    DIGEST,
    EVALUATE_METRICS,
    EXAMPLES,
    METRICS,
    NOTE,
    STEPS,
    TRAIN_METRICS,
    Rollouts,
    checked_arrays,
    count_bytes,
    pack_arrays,
    unpack_arrays,
    unpack_rollouts,
)
from fedvla_lib.federation.nodes import Report, Roster, TooFewReplies, answered
from fedvla_lib.federation.quantisation import DOWNWARD, decode, encode
from fedvla_lib.policy.parameters import Arrays, ParameterError, Shapes, digest
from fedvla_lib.run_folder import GLOBAL

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class SampledNodes:
    """Stands for the grid where Flower's strategies ask which nodes there are, and knows only the drawn ones."""

    node_ids: list[int]

    def get_node_ids(self) -> list[int]:
        """Return the drawn nodes."""
        return self.node_ids


class Checked:
    """Mixin: write ``class CheckedX(Checked, X)`` for a Flower strategy X derived from FedAvg.

    Args:
        config: settings of the run: who is sampled, encoding of arrays, clipping, replies that a round needs.
        roster: the clients that take part.
        shapes: names and shapes every reply must have.
        report: receives ``rejected``, ``train``, ``evaluate``, ``drift`` and ``replies`` events.
        keep_rollouts: receives (round, client's name, rollouts) of each good evaluation reply.
        rounds_done: rounds of this run that an earlier process completed; Flower counts from 1 again.
        **flower: passed on to the Flower strategy.
    """

    _also: tuple[str, ...] = ()  # records of arrays a reply has beside the trained ones
    _memory: tuple[str, ...] = ()  # attributes of the Flower strategy that last from round to round

    def __init__(
        self,
        *,
        config: Config,
        roster: Roster,
        shapes: Shapes,
        report: Report,
        keep_rollouts: Callable[[int, str, Rollouts], None],
        rounds_done: int = 0,
        **flower: Any,
    ) -> None:
        super().__init__(min_train_nodes=1, min_evaluate_nodes=1, min_available_nodes=1, **flower)
        self.config, self.roster, self.shapes = config, roster, shapes
        self.report, self.keep_rollouts, self.rounds_done = report, keep_rollouts, rounds_done
        self._asked: list[int] = []
        self._sent_bytes = 0
        self._global: Arrays = {}

    def configure_train(
        self, server_round: int, arrays: ArrayRecord, config: ConfigRecord, grid: Grid
    ) -> Iterable[Message]:
        """Draw clients and address the global arrays, with their SHA-256, to each."""
        server_round += self.rounds_done
        selection = self._select(self.config.fraction_train, server_round, 0)
        self._global = unpack_arrays(arrays)
        config[DIGEST] = digest(self._downward(arrays))
        return self._counted(super().configure_train(server_round, arrays, config, selection))

    def configure_evaluate(
        self, server_round: int, arrays: ArrayRecord, config: ConfigRecord, grid: Grid
    ) -> Iterable[Message]:
        """The same for evaluation; other clients may be drawn."""
        server_round += self.rounds_done
        selection = self._select(self.config.fraction_evaluate, server_round, 1)
        if not selection.node_ids:
            return []
        config[DIGEST] = digest(self._downward(arrays))
        return self._counted(super().configure_evaluate(server_round, arrays, config, selection))

    def aggregate_train(
        self, server_round: int, replies: Iterable[Message]
    ) -> tuple[ArrayRecord | None, MetricRecord | None]:
        """Average the replies that pass all checks.

        Raises:
            TooFewReplies: fewer than `min_replies` passed.
        """
        server_round += self.rounds_done
        good = self._good(server_round, "train", replies, self._check_train)
        if len(good) < self.config.min_replies:
            raise TooFewReplies(
                f"round {server_round}: {len(good)} of {len(self._asked)} training replies are good, "
                f"min-replies={self.config.min_replies} are required; the rejected ones are in metrics.jsonl"
            )
        for reply in good if self.config.exchange != "float32" else []:
            self._restore(reply)
        self._take(server_round, good)
        for reply in good if self.config.clip_norm else []:
            self._clip(reply)
        arrays, metrics = super().aggregate_train(server_round, good)
        return _as_float32(arrays), metrics

    def aggregate_evaluate(self, server_round: int, replies: Iterable[Message]) -> MetricRecord | None:
        """Average the metrics of the replies that pass; a client without held-out episodes has nothing to average."""
        server_round += self.rounds_done
        good = self._good(server_round, "evaluate", replies, _check_evaluate)
        for reply in good:
            name = self.roster.name(reply.metadata.src_node_id)
            self.keep_rollouts(server_round, name, unpack_rollouts(reply.content))
        measured = [reply for reply in good if _examples(reply) > 0]
        return super().aggregate_evaluate(server_round, measured) if measured else None

    def memory(self) -> dict[str, Arrays]:
        """Return what this strategy keeps from round to round beside the global arrays: by attribute, then by name."""
        kept = {attribute: getattr(self, attribute) for attribute in self._memory}
        return {
            attribute: dict(value) if isinstance(value, dict) else {str(i): array for i, array in enumerate(value)}
            for attribute, value in kept.items()
            if value is not None
        }

    def remember(self, memory: dict[str, Arrays]) -> None:
        """Take over what `memory` of another process returned."""
        for attribute, arrays in memory.items():
            listed = all(name.isdecimal() for name in arrays)
            setattr(self, attribute, [arrays[str(i)] for i in range(len(arrays))] if listed else arrays)

    def _downward(self, arrays: ArrayRecord) -> Arrays:
        return encode(unpack_arrays(arrays), DOWNWARD[self.config.exchange])

    def _construct_messages(self, record: RecordDict, node_ids: list[int], message_type: str) -> Iterable[Message]:
        """Flower's, with arrays of as many bits as asked for; strategies have noted the unrounded ones by now."""
        if self.config.exchange != "float32":
            record[ARRAYS] = pack_arrays(self._downward(record[ARRAYS]))
        return super()._construct_messages(record, node_ids, message_type)

    def _restore(self, reply: Message) -> None:
        """Put into a reply that carries a change the arrays that it makes of the global ones."""
        change = decode(unpack_arrays(reply.content[ARRAYS]), self.config.exchange)
        reply.content[ARRAYS] = pack_arrays({name: self._global[name] + change[name] for name in change})

    def _clip(self, reply: Message) -> None:
        """Shorten a client's movement to `clip_norm`, in its own direction."""
        arrays = unpack_arrays(reply.content[ARRAYS])
        moved = {name: array - self._global[name] for name, array in arrays.items()}
        length = math.sqrt(sum(float(np.square(array, dtype=np.float64).sum()) for array in moved.values()))
        if length > self.config.clip_norm:
            share = np.float32(self.config.clip_norm / length)
            shortened = {name: self._global[name] + share * array for name, array in moved.items()}
            reply.content[ARRAYS] = pack_arrays(shortened)

    def _take(self, server_round: int, good: list[Message]) -> None:
        """Look at the good training replies before they are averaged: report where each client went."""
        name = self.roster.name
        ends = {name(r.metadata.src_node_id): unpack_arrays(r.content[ARRAYS]) for r in good}
        for who, values in geometry(self._global, ends).items():
            self.report(server_round, who, "drift", values)

    def _counted(self, messages: Iterable[Message]) -> list[Message]:
        messages = list(messages)
        self._sent_bytes = sum(count_bytes(message.content) for message in messages)
        return messages

    def _select(self, share: float, server_round: int, purpose: int) -> SampledNodes:
        rng = np.random.default_rng([self.config.seed, server_round, purpose])
        self._asked = self.roster.draw(share, rng)
        return SampledNodes(self._asked)

    def _good(
        self, server_round: int, kind: str, replies: Iterable[Message], check: Callable[[Message], None]
    ) -> list[Message]:
        """Return the good replies in the order of their partitions; report each reply, good or not, and the counts."""
        by_node = {reply.metadata.src_node_id: reply for reply in replies}
        received = sum(count_bytes(reply.content) for reply in by_node.values() if not reply.has_error())
        good, rejected = [], []
        for node in self._asked:  # ordered by partition
            try:
                check(answered(by_node.get(node)))
            except ParameterError as error:
                rejected.append(error.kind)
                self._reject(server_round, self.roster.name(node), kind, error)
            else:
                good.append(by_node[node])
                self.report(server_round, self.roster.name(node), kind, _values(by_node[node]))
        counts = {f"rejected_{reason}": rejected.count(reason) for reason in sorted(set(rejected))}
        if self._asked:
            counted = {"to": kind, "good": len(good), "rejected": len(rejected)}
            counted |= {"sent_bytes": self._sent_bytes, "received_bytes": received}
            self.report(server_round, GLOBAL, "replies", counted | counts)
        return good

    def _reject(self, server_round: int, name: str, kind: str, error: ParameterError) -> None:
        logger.warning("round %d: %s reply of %s rejected (%s): %s", server_round, kind, name, error.kind, error)
        self.report(server_round, name, "rejected", {"to": kind, "reason": error.kind, "detail": str(error)})

    def _check_train(self, reply: Message) -> None:
        _check_metrics(reply, TRAIN_METRICS)
        if _examples(reply) == 0:
            raise ParameterError("examples", f"{EXAMPLES}=0: a client without training frames has no weight")
        steps = reply.content.metric_records[METRICS][STEPS]
        if not isinstance(steps, int) or steps < 1:
            raise ParameterError("metrics", f"{STEPS}={steps!r}: expected a whole number of steps, 1 or more")
        announced = self.roster.examples_of.get(reply.metadata.src_node_id, _examples(reply))
        if _examples(reply) != announced:  # it would buy itself another weight in the average
            raise ParameterError("examples", f"{EXAMPLES}={_examples(reply)}, but it came with {announced}")
        checked_arrays(reply.content, NOTE, self.shapes, also=self._also, exchange=self.config.exchange)


def _check_evaluate(reply: Message) -> None:
    _check_metrics(reply, EVALUATE_METRICS)
    unpack_rollouts(reply.content)


def _check_metrics(reply: Message, expected: tuple[str, ...]) -> None:
    """Flower averages the one MetricRecord of each reply by its examples; make sure that it can."""
    records = reply.content.metric_records
    if list(records) != [METRICS]:
        raise ParameterError("metrics", f"expected one record {METRICS!r} of numbers, got {list(records)}")
    examples = _examples(reply)
    if not isinstance(examples, int) or examples < 0:
        raise ParameterError("examples", f"{EXAMPLES}={examples!r}: expected a number of frames")
    if (found := set(records[METRICS])) != set(expected) and not (found == {EXAMPLES} and examples == 0):
        raise ParameterError("metrics", f"got {sorted(found)}, expected {sorted(expected)}")
    for key, value in records[METRICS].items():
        if isinstance(value, list) or not math.isfinite(value):
            raise ParameterError("metrics", f"{key}={value!r} is not a finite number")


def _as_float32(arrays: ArrayRecord | None) -> ArrayRecord | None:
    """Flower's adaptive strategies compute with float64 scalars, which makes float64 of every array."""
    if arrays is None:
        return None
    return ArrayRecord({name: Array(np.asarray(array.numpy(), np.float32)) for name, array in arrays.items()})


def _examples(reply: Message) -> Any:
    return reply.content.metric_records[METRICS].get(EXAMPLES)


def _values(reply: Message) -> dict[str, Any]:
    return {key.replace("-", "_"): value for key, value in reply.content.metric_records[METRICS].items()}
