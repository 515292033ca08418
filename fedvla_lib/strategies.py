"""Federated averaging that checks what it averages: what Flower's strategies lack, as a mixin over any of them.

`Checked` leaves the averaging to Flower and adds four things around it: clients are drawn by partition, from a seed;
messages carry a SHA-256; each reply is checked and a bad one is left out by client name and reason; replies are summed
in the order of their partitions, so that the result does not depend on who answered first.
"""

import logging
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from flwr.app import ArrayRecord, ConfigRecord, Message, MetricRecord
from flwr.serverapp import Grid
from flwr.serverapp.strategy import FedAvg

from fedvla_lib import wire
from fedvla_lib.params import ParameterError, Shapes, digest
from fedvla_lib.roster import Report, Roster, TooFewReplies, answered
from fedvla_lib.run_folder import GLOBAL
from fedvla_lib.wire import Rollouts

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Selection:
    """Stands for the grid where Flower's strategies ask which nodes there are, and knows only the drawn ones."""

    node_ids: list[int]

    def get_node_ids(self) -> list[int]:
        """Return the drawn nodes."""
        return self.node_ids


class Checked:
    """Mixin: write ``class CheckedX(Checked, X)`` for a Flower strategy X derived from FedAvg.

    Args:
        roster: the clients that take part.
        shapes: names and shapes every reply must have.
        report: receives ``rejected``, ``train``, ``evaluate`` and ``replies`` events.
        keep_rollouts: receives (round, client's name, rollouts) of each good evaluation reply.
        train_share, evaluate_share: share of the clients drawn in a round.
        min_replies: good training replies without which the run stops.
        seed: fixes who is drawn.
        **flower: passed on to the Flower strategy.
    """

    def __init__(
        self,
        *,
        roster: Roster,
        shapes: Shapes,
        report: Report,
        keep_rollouts: Callable[[int, str, Rollouts], None],
        train_share: float = 1.0,
        evaluate_share: float = 1.0,
        min_replies: int = 1,
        seed: int = 0,
        **flower: Any,
    ) -> None:
        super().__init__(min_train_nodes=1, min_evaluate_nodes=1, min_available_nodes=1, **flower)
        self.roster, self.shapes, self.report, self.keep_rollouts = roster, shapes, report, keep_rollouts
        self.train_share, self.evaluate_share = train_share, evaluate_share
        self.min_replies, self.seed = min_replies, seed
        self._asked: list[int] = []

    def configure_train(
        self, server_round: int, arrays: ArrayRecord, config: ConfigRecord, grid: Grid
    ) -> Iterable[Message]:
        """Draw clients and address the global arrays, with their SHA-256, to each."""
        selection = self._select(self.train_share, server_round, 0)
        config[wire.DIGEST] = digest(wire.unpack_arrays(arrays))
        return super().configure_train(server_round, arrays, config, selection)

    def configure_evaluate(
        self, server_round: int, arrays: ArrayRecord, config: ConfigRecord, grid: Grid
    ) -> Iterable[Message]:
        """The same for evaluation; other clients may be drawn."""
        selection = self._select(self.evaluate_share, server_round, 1)
        if not selection.node_ids:
            return []
        config[wire.DIGEST] = digest(wire.unpack_arrays(arrays))
        return super().configure_evaluate(server_round, arrays, config, selection)

    def aggregate_train(
        self, server_round: int, replies: Iterable[Message]
    ) -> tuple[ArrayRecord | None, MetricRecord | None]:
        """Average the replies that pass all checks.

        Raises:
            TooFewReplies: fewer than `min_replies` passed.
        """
        good = self._good(server_round, "train", replies, self._check_train)
        if len(good) < self.min_replies:
            raise TooFewReplies(
                f"round {server_round}: {len(good)} of {len(self._asked)} training replies are good, "
                f"min-replies={self.min_replies} are required; the rejected ones are in metrics.jsonl"
            )
        return super().aggregate_train(server_round, good)

    def aggregate_evaluate(self, server_round: int, replies: Iterable[Message]) -> MetricRecord | None:
        """Average the metrics of the replies that pass; a client without held-out episodes has nothing to average."""
        good = self._good(server_round, "evaluate", replies, _check_evaluate)
        for reply in good:
            name = self.roster.name(reply.metadata.src_node_id)
            self.keep_rollouts(server_round, name, wire.unpack_rollouts(reply.content))
        measured = [reply for reply in good if _examples(reply) > 0]
        return super().aggregate_evaluate(server_round, measured) if measured else None

    def _select(self, share: float, server_round: int, purpose: int) -> Selection:
        rng = np.random.default_rng([self.seed, server_round, purpose])
        self._asked = self.roster.draw(share, rng)
        return Selection(self._asked)

    def _good(
        self, server_round: int, kind: str, replies: Iterable[Message], check: Callable[[Message], None]
    ) -> list[Message]:
        """Return the good replies in the order of their partitions; report each reply, good or not, and the counts."""
        by_node = {reply.metadata.src_node_id: reply for reply in replies}
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
            self.report(server_round, GLOBAL, "replies", counted | counts)
        return good

    def _reject(self, server_round: int, name: str, kind: str, error: ParameterError) -> None:
        logger.warning("round %d: %s reply of %s rejected (%s): %s", server_round, kind, name, error.kind, error)
        self.report(server_round, name, "rejected", {"to": kind, "reason": error.kind, "detail": str(error)})

    def _check_train(self, reply: Message) -> None:
        _check_metrics(reply, wire.TRAIN_METRICS)
        if _examples(reply) == 0:
            raise ParameterError("examples", f"{wire.EXAMPLES}=0: a client without training frames has no weight")
        wire.checked_arrays(reply.content, wire.NOTE, self.shapes)


class CheckedFedAvg(Checked, FedAvg):
    """Flower's FedAvg (McMahan et al. 2017, https://arxiv.org/abs/1602.05629) on checked replies.

    The new global array is sum_k n_k w_k / sum_k n_k with n_k the training frames of client k.
    """


def _check_evaluate(reply: Message) -> None:
    _check_metrics(reply, wire.EVALUATE_METRICS)
    wire.unpack_rollouts(reply.content)


def _check_metrics(reply: Message, expected: tuple[str, ...]) -> None:
    """Flower averages the one MetricRecord of each reply by its examples; make sure that it can."""
    records = reply.content.metric_records
    if list(records) != [wire.METRICS]:
        raise ParameterError("metrics", f"expected one record {wire.METRICS!r} of numbers, got {list(records)}")
    examples = _examples(reply)
    if not isinstance(examples, int) or examples < 0:
        raise ParameterError("examples", f"{wire.EXAMPLES}={examples!r}: expected a number of frames")
    if (found := set(records[wire.METRICS])) != set(expected) and not (found == {wire.EXAMPLES} and examples == 0):
        raise ParameterError("metrics", f"got {sorted(found)}, expected {sorted(expected)}")
    for key, value in records[wire.METRICS].items():
        if isinstance(value, list) or not math.isfinite(value):
            raise ParameterError("metrics", f"{key}={value!r} is not a finite number")


def _examples(reply: Message) -> Any:
    return reply.content.metric_records[wire.METRICS].get(wire.EXAMPLES)


def _values(reply: Message) -> dict[str, Any]:
    return {key.replace("-", "_"): value for key, value in reply.content.metric_records[wire.METRICS].items()}
