"""Checks around Flower's strategies, as a mixin.

`Checked` leaves the aggregation to Flower and adds: clients are sampled by partition from a seed; messages carry a
SHA-256; each reply is validated, and an invalid one is rejected with client name and reason; replies are aggregated in
the order of partitions, so that the result does not depend on who replied first; each round reports the bytes exchanged
and the client drift.
"""

import logging
import math
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
from flwr.app import Array, ArrayRecord, ConfigRecord, Message, MetricRecord
from flwr.app.exception import AppExitException
from flwr.serverapp import Grid
from flwr.serverapp.strategy import Strategy

from fedvla_lib.config import Config
from fedvla_lib.evaluation import measure
from fedvla_lib.federation import messages, privacy
from fedvla_lib.federation.accountant import Ledger
from fedvla_lib.federation.drift import geometry
from fedvla_lib.federation.nodes import Report, Roster, TooFewReplies, answered, plain
from fedvla_lib.federation.quantisation import DOWNWARD, encode
from fedvla_lib.federation.rollout_replies import Rollouts, unpack_rollouts
from fedvla_lib.federation.strategies.reply_checks import check_metrics, examples, require_finite
from fedvla_lib.policy.optimizers import SHARING
from fedvla_lib.policy.parameters import Arrays, ParameterError, Shapes, digest
from fedvla_lib.policy.training import seeded
from fedvla_lib.run_folder import GLOBAL

logger = logging.getLogger(__name__)
ROOM_BYTES, BYTES_A_NUMBER = 100e6, 8  # of a reply: for films and the like, and for the arrays
EVERYBODY = ("fraction_train", "fraction_evaluate", "min_train_nodes", "min_evaluate_nodes", "min_available_nodes")
PERSISTENT = ("momentum_vector", "m_t", "v_t", "limits", *messages.EXTRA)  # attributes that persist between rounds


class Checked:
    """Mixin: ``class CheckedX(Checked, X)`` for a Flower strategy X, or wrapper of one; it gets what passed the checks.

    Args:
        config: settings of the run: sampling, encoding of arrays, clipping, replies that a round needs.
        roster: the clients that take part.
        shapes: names and shapes every reply must have.
        report: receives ``rejected``, ``train``, ``evaluate``, ``drift`` and ``replies`` events.
        keep_rollouts: receives (round, client name, rollouts) of each valid evaluation reply.
        rounds_done: rounds of this run that an earlier process completed; Flower counts from 1 again.
        **flower: passed on to the Flower strategy.
    """

    ledger: Ledger | None = None  # of what a run with noise has spent
    caps_updates = True  # unless a strategy adds noise of its own: no update's length may then depend on the others
    _extra_records: tuple[str, ...] = ()  # attributes with arrays that travel beside the model's, both ways in training

    def __init__(
        self, *, config: Config, roster: Roster, shapes: Shapes, report: Report,
        keep_rollouts: Callable[[int, str, Rollouts], None], rounds_done: int = 0, **flower: Any,
    ) -> None:  # fmt: skip
        super().__init__(**flower)
        layer: Any = self
        while isinstance(layer, Strategy):  # it finds only those that were sampled here
            vars(layer).update(dict.fromkeys(EVERYBODY, 1))
            layer = getattr(layer, "strategy", None)
        self.config, self.roster, self.shapes = config, roster, shapes
        self.report, self.keep_rollouts, self.rounds_done = report, keep_rollouts, rounds_done
        if config.local_optimizer in SHARING:
            self.second_moments: Arrays = {}
            self._extra_records += (messages.SECOND_MOMENTS,)
        if config.clip_quantile:
            self.limits: Arrays = {"clip_norm": np.array(config.clip_norm)}
        self._sampled: list[int] = []
        self._spent: dict[str, float] = {}  # what the ledger says of a round whose updates are released to the server
        self._sent_bytes = 0
        self._global: Arrays = {}
        self._arrived: dict[int, Arrays] = {}  # in training replies, decoded, by node
        self._rolled_out: dict[int, Rollouts] = {}  # in evaluation replies, by node

    def configure_train(
        self, server_round: int, arrays: ArrayRecord, config: ConfigRecord, grid: Grid
    ) -> Iterable[Message]:
        """Sample clients and address the global arrays, with their SHA-256, to each."""
        self._global = messages.unpack_arrays(arrays)
        sampled = self._sample(self.config.fraction_train, server_round, 0)
        self._spent = self.ledger.spend() if self.ledger and privacy.hides_updates(self.config) else {}
        server_round += self.rounds_done
        with self._in_flower(server_round):
            sent = super().configure_train(server_round, arrays, config, sampled)
        return self._sealed(sent, self._extra_records)

    def configure_evaluate(
        self, server_round: int, arrays: ArrayRecord, config: ConfigRecord, grid: Grid
    ) -> Iterable[Message]:
        """The same for evaluation; other clients may be sampled."""
        sampled = self._sample(self.config.fraction_evaluate, server_round, 1)
        if not self._sampled:
            return []
        return self._sealed(super().configure_evaluate(server_round + self.rounds_done, arrays, config, sampled))

    def aggregate_train(
        self, server_round: int, replies: Iterable[Message]
    ) -> tuple[ArrayRecord | None, MetricRecord | None]:
        """Aggregate the valid replies.

        Raises:
            TooFewReplies: there are fewer than `min_replies`, or too few for the strategy.
            FloatingPointError: the new global arrays, or what the strategy keeps, are not finite.
        """
        server_round += self.rounds_done
        valid = self._valid(server_round, "train", replies, self._check_train)
        if len(valid) < self.config.min_replies:
            raise TooFewReplies(
                f"round {server_round}: {len(valid)} of {len(self._sampled)} training replies are valid, "
                f"min-replies={self.config.min_replies} are required; the rejected ones are in metrics.jsonl"
            )
        for reply in valid:
            self._restore(reply)
        self._report_drift(server_round, valid)
        if self.config.update_cap and self.caps_updates and not privacy.weighs_alike(self.config):
            self._cap(server_round, valid)
        if self.config.clip_norm or self.ledger:
            self._protect(server_round, valid)
        self._before_aggregation(valid)
        for reply in valid:
            if reply.metadata.src_node_id in self.roster.examples_of:
                values = reply.content.metric_records[messages.METRICS]
                values[messages.EXAMPLES] = self.roster.weight(reply.metadata.src_node_id)
        with self._in_flower(server_round):
            arrays, metrics = super().aggregate_train(server_round, valid)
        if arrays is None:
            raise TooFewReplies(f"round {server_round}: strategy={self.config.strategy} refused {len(valid)} replies")
        # Flower's adaptive strategies compute in float64.
        model = {name: np.asarray(array.numpy(), np.float32) for name, array in arrays.items()}
        require_finite(server_round, {messages.ARRAYS: model, **self.state()})
        return ArrayRecord({name: Array(array) for name, array in model.items()}), metrics

    def aggregate_evaluate(self, server_round: int, replies: Iterable[Message]) -> MetricRecord | None:
        """Average the metrics of the valid replies of clients that have held-out episodes."""
        server_round += self.rounds_done
        due = self.config.client_rollouts if measure.rolls_out(self.config, server_round) else 0
        valid = self._valid(server_round, "evaluate", replies, partial(self._check_evaluate, most=due))
        for node in [reply.metadata.src_node_id for reply in valid]:
            self.keep_rollouts(server_round, self.roster.name(node), self._rolled_out.pop(node))
        measured = [reply for reply in valid if examples(reply) > 0]
        return super().aggregate_evaluate(server_round, measured) if measured else None

    @property
    def records(self) -> tuple[str, ...]:
        """Names of the records of arrays that a client sends after training."""
        return (messages.ARRAYS, *self._extra_records)

    @property
    def size(self) -> int:
        """How many numbers a client sends."""
        return len(self.records) * sum(math.prod(shape) for shape in self.shapes.values())

    @property
    def _most_bytes(self) -> float:
        return 1e6 * self.config.reply_limit_mb or ROOM_BYTES + BYTES_A_NUMBER * self.size

    def state(self) -> dict[str, Arrays]:
        """Return the strategy's state beside the global arrays: by attribute, then by name."""
        kept = {name: value for name in PERSISTENT if (value := getattr(self, name, None)) is not None}
        listed = {name: {str(i): a for i, a in enumerate(value)} for name, value in kept.items() if type(value) is list}
        return {name: listed.get(name) or dict(value) for name, value in kept.items()}

    def load_state(self, state: dict[str, Arrays]) -> None:
        """Restore what `state` returned in another process; ValueError if that cannot be all."""
        if isinstance(getattr(self, "strategy", None), Strategy):
            raise ValueError(f"strategy={self.config.strategy!r} wraps another, whose state is not saved: start anew")
        for attribute, arrays in state.items():
            listed = all(name.isdecimal() for name in arrays)
            setattr(self, attribute, [arrays[str(i)] for i in range(len(arrays))] if listed else arrays)

    def _sealed(self, sent: Iterable[Message], extra: tuple[str, ...] = ()) -> list[Message]:
        """The strategy's messages, with encoded arrays and their SHA-256; it has stored the unrounded ones by now."""
        sent = list(sent)
        for content in {id(message.content): message.content for message in sent}.values():  # they may share one
            for name in extra:
                if arrays := getattr(self, name):  # second moments are known after the first round
                    messages.attach(content, messages.CONFIG, name, arrays)
            encoded = encode(messages.unpack_arrays(content[messages.ARRAYS]), DOWNWARD[self.config.exchange])
            content[messages.CONFIG][messages.DIGEST] = digest(encoded)
            if self.config.exchange != "float32":
                content[messages.ARRAYS] = messages.pack_arrays(encoded)
        addressed = {message.metadata.dst_node_id for message in sent}
        self._sampled = [node for node in self._sampled if node in addressed]
        self._sent_bytes = sum(messages.count_bytes(message.content) for message in sent)
        return sent

    @contextmanager
    def _in_flower(self, server_round: int) -> Iterator[None]:
        """Fix the global generators that Flower draws from, unless noise is secret; its refusals become ValueErrors."""
        try:
            with nullcontext() if self.config.secret_noise else seeded(self.config.seed, server_round):
                yield
        except AppExitException as error:
            raise ValueError(f"round {server_round}, strategy={self.config.strategy}: {error}") from error

    def _restore(self, reply: Message) -> None:
        """Replace an encoded update in a reply by global arrays plus update; wrappers pair arrays by their place."""
        node, record = reply.metadata.src_node_id, reply.content[messages.ARRAYS]
        if self.config.exchange != "float32":
            self._arrived[node] = {name: self._global[name] + change for name, change in self._arrived[node].items()}
            record = messages.pack_arrays(self._arrived[node])
        reply.content[messages.ARRAYS] = ArrayRecord({name: record[name] for name in self.shapes})

    def _protect(self, server_round: int, valid: list[Message]) -> None:
        """Clip what each client sent, unless it did so itself; with noise, put one noised mean in place of them all.

        A strategy that then averages the replies, weights being equal, gets that mean, whatever it makes of it.
        """
        config, limit = self.config, float(getattr(self, "limits", {}).get("clip_norm", self.config.clip_norm))
        spent = self.ledger.spend() if self.ledger and not privacy.hides_updates(config) else self._spent
        values = {"clip_norm": limit} | spent
        sent = protected = [self._payload(reply) for reply in valid]
        if not privacy.hides_updates(config):
            norms = [privacy.norm(payload) for payload in sent]
            values["clipped"] = sum(norm > limit for norm in norms)
            protected = [privacy.clipped(payload, limit) for payload in sent]
            if config.clip_quantile:
                rng = privacy.source(config, server_round, privacy.COUNT_NOISE)
                self.limits = {"clip_norm": np.array(privacy.adapted(limit, norms, config, rng))}
        if privacy.is_private(config) and config.noise_by == "server":
            rng = privacy.source(config, server_round, privacy.SERVER_NOISE)
            noise = privacy.noise_beside_count(config.noise, len(valid)) if config.clip_quantile else config.noise
            protected = [privacy.noised_mean(protected, noise * limit, rng)] * len(valid)
        for reply, before, payload in zip(valid, sent, protected, strict=True):
            if payload is not before:
                self._replace(reply, payload)
        self.report(server_round, GLOBAL, "privacy", values)

    def _cap(self, server_round: int, valid: list[Message]) -> None:
        """Shorten changes of the weights that are longer than `update_cap` times the round's median, unless that is 0.

        Not the extra records: SCAFFOLD's are changes that clients have kept in full by now.
        """
        norms = [privacy.norm(self._payload(reply)) for reply in valid]
        limit = self.config.update_cap * float(np.median(norms))
        for reply, length in zip(valid, norms, strict=True):
            if length > limit > 0:
                self._replace(reply, privacy.clipped(self._payload(reply), limit))
                who = self.roster.name(reply.metadata.src_node_id)
                self.report(server_round, who, "capped", {"norm": length, "limit": limit})

    def _payload(self, reply: Message) -> privacy.Payload:
        """Return what a client contributes: the change of the weights, and the extra records."""
        together = self.records if privacy.weighs_alike(self.config) else (messages.ARRAYS,)
        content = {name: messages.unpack_arrays(reply.content[name]) for name in together}
        changes = {name: array - self._global[name] for name, array in content[messages.ARRAYS].items()}
        return content | {messages.ARRAYS: changes}

    def _replace(self, reply: Message, payload: privacy.Payload) -> None:
        ends = {name: self._global[name] + change for name, change in payload[messages.ARRAYS].items()}
        for record, arrays in (payload | {messages.ARRAYS: ends}).items():
            reply.content[record] = messages.pack_arrays(arrays)

    def _report_drift(self, server_round: int, valid: list[Message]) -> None:
        """Report how far the clients' weights are apart, unless only their mean is known."""
        nodes = [reply.metadata.src_node_id for reply in valid]
        ends = {self.roster.name(node): self._arrived.pop(node) for node in nodes}
        for who, values in geometry(self._global, ends).items() if not self.config.secure_aggregation else ():
            self.report(server_round, who, "drift", values)

    def _before_aggregation(self, valid: list[Message]) -> None:
        """Combine and remove the extra records of the valid training replies."""
        for name in self._extra_records if valid else ():
            arrived = {reply.metadata.src_node_id: messages.unpack_arrays(reply.content.pop(name)) for reply in valid}
            setattr(self, name, self._combined(name, arrived))

    def _combined(self, record: str, arrived: dict[int, Arrays]) -> Arrays:
        """Return the new arrays of an extra record: the mean of the clients', weighted by training frames."""
        frames, replies = [self.roster.weight(node) for node in arrived], list(arrived.values())
        means = {name: np.average([reply[name] for reply in replies], 0, frames) for name in replies[0]}
        return {name: mean.astype(np.float32) for name, mean in means.items()}

    def _sample(self, share: float, server_round: int, purpose: int) -> SimpleNamespace:
        """Sample clients, and return a stand-in for the grid that lists only them."""
        rng = privacy.source(self.config, server_round + self.rounds_done, purpose)
        self._sampled = self.roster.sample(share, rng, by_task=self.config.sampling == "by-task")
        return SimpleNamespace(get_node_ids=lambda: self._sampled)

    def _valid(
        self, server_round: int, kind: str, replies: Iterable[Message], check: Callable[[Message], None]
    ) -> list[Message]:
        """Return the valid replies in the order of partitions; report each reply and the counts."""
        by_node = {reply.metadata.src_node_id: reply for reply in replies}
        received = sum(messages.count_bytes(reply.content) for reply in by_node.values() if not reply.has_error())
        valid, rejected = [], []
        for node in self._sampled:  # ordered by partition
            try:
                check(reply := answered(by_node.get(node), self._most_bytes))
                messages.check_round(reply.content, server_round)
            except ParameterError as error:
                name, reason, detail = self.roster.name(node), error.kind, plain(str(error))
                rejected.append(reason)
                logger.warning("round %d: %s reply of %s rejected (%s): %s", server_round, kind, name, reason, detail)
                self.report(server_round, name, "rejected", {"to": kind, "reason": reason, "detail": detail})
            else:
                valid.append(reply)
                numbers = reply.content.metric_records[messages.METRICS].items()
                values = {key.replace("-", "_"): value for key, value in numbers}
                self.report(server_round, self.roster.name(node), kind, values)
        counts = {f"rejected_{reason}": rejected.count(reason) for reason in sorted(set(rejected))}
        if self._sampled:
            counted = {"to": kind, "good": len(valid), "rejected": len(rejected)}
            counted |= {"sent_bytes": self._sent_bytes, "received_bytes": received}
            self.report(server_round, GLOBAL, "replies", counted | counts)
        return valid

    def _check_train(self, reply: Message) -> None:
        expected = messages.train_metrics(privacy.hides_updates(self.config))
        check_metrics(reply, (*expected, *getattr(self, "extra_metrics", ())))
        if examples(reply) == 0:
            raise ParameterError("examples", f"{messages.EXAMPLES}=0: a client without training frames has no weight")
        steps = reply.content.metric_records[messages.METRICS][messages.STEPS]
        if not isinstance(steps, int) or steps < 1:
            raise ParameterError("metrics", f"{messages.STEPS}={steps!r}: expected a whole number of steps, 1 or more")
        announced = self.roster.examples_of.get(reply.metadata.src_node_id, examples(reply))
        if examples(reply) != announced:  # its weight in the average must not change
            found = f"{messages.EXAMPLES}={examples(reply)}"
            raise ParameterError("examples", f"{found}, but the client first reported {announced}")
        exchange, extra = self.config.exchange, self._extra_records
        arrays = messages.checked_arrays(reply.content, messages.NOTE, self.shapes, also=extra, exchange=exchange)
        for record in extra:
            messages.checked_arrays(reply.content, messages.NOTE, self.shapes, record, (messages.ARRAYS, *extra))
        self._arrived[reply.metadata.src_node_id] = arrays

    def _check_evaluate(self, reply: Message, most: int) -> None:
        check_metrics(reply, messages.EVALUATE_METRICS)
        node = reply.metadata.src_node_id
        self._rolled_out[node] = unpack_rollouts(reply.content, self.roster.tasks_of.get(node, ()), most)
