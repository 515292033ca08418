"""The nodes of a run: Flower gives them random ids, and each says once which partition it holds."""

import time
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from flwr.app import Message, MessageType, RecordDict
from flwr.serverapp import Grid

from fedvla_lib.config import sample_size
from fedvla_lib.data.normalisation import Stats, implausible, unpack_stats
from fedvla_lib.federation.messages import NOTE, count_bytes
from fedvla_lib.federation.node_keys import Proof
from fedvla_lib.policy.parameters import ParameterError
from fedvla_lib.robot.spec import ACTION_KEY, NUM_JOINTS, STATE_KEY

# Called with (round, who, kind, values) for each event; `RunFolder.log` is one.
Report = Callable[[int, str, str, dict[str, Any]], None]

MEASURES = {"mean": NUM_JOINTS, "std": NUM_JOINTS, "min": NUM_JOINTS, "max": NUM_JOINTS, "count": 1}  # -> length
MOST_FRAMES = 2**40  # keeps the sum of all counts in 64 bits; it does not protect against a client that lies
FURTHEST = 360.0  # degrees, or percent of the gripper: no joint of the arm gets as far
MOST_BYTES = 1e6  # of an introduction, and of a letter of secure aggregation
LONGEST = 1000  # characters of the name of a task, and of a reason
ROUNDING = 1e-6  # relative: how far a mean may lie outside its range


class TooFewReplies(RuntimeError):
    """A round has fewer valid replies than `min-replies`."""


@dataclass(frozen=True)
class Roster:
    """Which node holds which partition, and what its client reported before training; all by node id."""

    partition_of: dict[int, int]
    examples_of: dict[int, int] = field(default_factory=dict)  # training frames
    stats_of: dict[int, Stats] = field(default_factory=dict)
    tasks_of: dict[int, tuple[str, ...]] = field(default_factory=dict)
    needs_stats: bool = True  # else statistics that a client sends are not looked at
    most_frames: int = MOST_FRAMES  # 1 if all clients count alike
    num_clients: int = MOST_FRAMES  # partitions that there are
    frames_cap: float = 0.0  # see `Config`
    proof: Proof | None = None  # that a node holds the key of its number, see `node_keys`

    @property
    def nodes(self) -> list[int]:
        """Node ids, ordered by partition."""
        return sorted(self.partition_of, key=self.partition_of.get)

    def name(self, node_id: int) -> str:
        """Return the client's name: ``client_3`` holds partition 3."""
        return client_name(self.partition_of[node_id])

    def weight(self, node_id: int) -> int:
        """Return the frames that a client counts for: those announced, or `frames_cap` times the median if fewer."""
        announced = self.examples_of[node_id]
        cap = self.frames_cap * float(np.median(list(self.examples_of.values())))
        return min(announced, max(1, round(cap))) if cap else announced

    def plausible_stats(self, report: Report) -> list[Stats]:
        """Return the clients' statistics in the order of partitions, less those that others make implausible."""
        reasons = dict(zip(self.nodes, implausible([self.stats_of[node] for node in self.nodes]), strict=True))
        for node, reason in reasons.items():
            if reason:
                values = {"to": "query", "reason": "statistics", "detail": f"left out of the pool: {reason}"}
                report(0, self.name(node), "rejected", values)
        kept = [node for node, reason in reasons.items() if not reason]
        counted = {node: {"count": np.array([self.weight(node)])} for node in kept}
        return [{key: of | counted[node] for key, of in self.stats_of[node].items()} for node in kept]

    def sample(self, share: float, rng: np.random.Generator, by_task: bool = False) -> list[int]:
        """Sample a share of the clients without replacement: `sample_size` node ids, ordered by partition.

        Args:
            by_task: deal the places to the announced tasks in turn, so that no task is missed if there are enough.
        """
        nodes = self.nodes
        size = sample_size(share, len(nodes))
        if by_task:
            drawn, seen = rng.permutation(len(nodes)), Counter()
            turn = {}  # of each client: how many with its tasks were drawn before
            for i in drawn.tolist():
                turn[i] = seen[self.tasks_of[nodes[i]]]
                seen[self.tasks_of[nodes[i]]] += 1
            chosen = sorted(drawn.tolist(), key=turn.get)[:size]  # stable: within a turn in the order drawn
        else:
            chosen = rng.choice(len(nodes), size=size, replace=False)
        return [nodes[i] for i in sorted(chosen)]

    def add(self, reply: Message) -> None:
        """Add the client that introduces itself in `reply`; raise ParameterError if it cannot take part."""
        node, note = reply.metadata.src_node_id, reply.content.config_records.get(NOTE, {})
        partition_id, num_examples = note.get("partition-id"), note.get("num-examples")
        if type(partition_id) is not int or not 0 <= partition_id < self.num_clients:  # True is an int as well
            text = f"partition-id={partition_id!r}: expected a number from 0, below num-clients={self.num_clients}"
            raise ParameterError("partition", text)
        if self.proof:
            self.proof(node, partition_id, note.get("signature"))
        if holder := [other for other, taken in self.partition_of.items() if taken == partition_id]:
            raise ParameterError("partition", f"partition-id={partition_id!r} is held by node {holder[0]}, the first")
        if type(num_examples) is not int or not 0 < num_examples <= self.most_frames:
            text = f"{client_name(partition_id)}: num-examples={num_examples!r}: expected training frames above 0"
            raise ParameterError("examples", f"{text} and at most {self.most_frames}")
        tasks = note.get("tasks")
        if not isinstance(tasks, list) or not all(isinstance(task, str) and len(task) < LONGEST for task in tasks):
            raise ParameterError("tasks", f"{client_name(partition_id)}: tasks={str(tasks)[:LONGEST]}: expected texts")
        try:
            if self.needs_stats:
                self.stats_of[node] = _statistics(note.get("stats"), num_examples)
        except ParameterError as error:
            raise ParameterError(error.kind, f"{client_name(partition_id)}: {error}") from error
        self.partition_of[node], self.examples_of[node] = partition_id, num_examples
        self.tasks_of[node] = tuple(tasks)


def client_name(partition_id: int) -> str:
    """Return a client's name in metrics, folders and messages."""
    return f"client_{partition_id}"


def wait_for_nodes(grid: Grid, num_clients: int, timeout_s: float) -> list[int]:
    """Return the ids of all connected nodes once there are `num_clients`; raise TooFewReplies when the time is up."""
    deadline = time.monotonic() + timeout_s
    while len(nodes := sorted(grid.get_node_ids())) < num_clients:
        if time.monotonic() > deadline:
            raise TooFewReplies(
                f"{len(nodes)} of num-clients={num_clients} clients connected within {timeout_s:.0f} s: start more "
                f"(flwr run --federation-config num-supernodes={num_clients}) or give num-clients={len(nodes) or 1}"
            )
        time.sleep(0.5)
    return nodes


def introduce_nodes(grid: Grid, nodes: list[int], report: Report, timeout_s: float, **asked: Any) -> Roster:
    """Ask every node for its partition, frame count and statistics; report and skip nodes whose reply is invalid.

    `asked` are passed to `Roster`.
    """
    messages = [Message(RecordDict(), dst_node_id=node, message_type=MessageType.QUERY) for node in nodes]
    roster = Roster({}, **asked)
    for reply in grid.send_and_receive(messages, timeout=timeout_s):  # of two with one number the first keeps it
        try:
            roster.add(answered(reply, MOST_BYTES))
        except ParameterError as error:
            values = {"to": "query", "reason": error.kind, "detail": plain(str(error))}
            report(0, f"node_{reply.metadata.src_node_id}", "rejected", values)
    return roster


def plain(text: str) -> str:
    """Return what a client said as one short line without control characters, for terminals and logs.

    Of a long text its beginning and its end are kept: a traceback names the error last.
    """
    text = text if len(text) <= 4 * LONGEST else text[:LONGEST] + text[-LONGEST:]
    words = " ".join("".join(c if c.isprintable() else " " for c in text).split())
    return words if len(words) <= LONGEST else f"{words[: LONGEST // 4]} ... {words[5 - 3 * LONGEST // 4 :]}"


def answered(reply: Message | None, most_bytes: float) -> Message:
    """Return `reply` if it has content, or raise ParameterError: for none, an error, or one larger than it could need.

    Nothing of it is unpacked for that.
    """
    if reply is None:
        raise ParameterError("silent", "no reply in time")
    if reply.has_error():
        raise ParameterError("error", plain(str(reply.error.reason)) or f"error code {reply.error.code}")
    if (found := count_bytes(reply.content)) > most_bytes:
        raise ParameterError("size", f"{found / 1e6:,.0f} MB, expected at most {most_bytes / 1e6:,.0f}")
    return reply


def _statistics(text: Any, num_examples: int) -> Stats:
    """Return a client's statistics if they can be pooled; raise ParameterError saying what is wrong."""
    if not isinstance(text, str):
        raise ParameterError("statistics", f"statistics are not text but {type(text).__name__}")
    try:
        stats = unpack_stats(text)
    # Not JSON, ragged arrays, another structure, or nested too deeply.
    except (ValueError, TypeError, AttributeError, RecursionError) as error:
        raise ParameterError("statistics", f"statistics cannot be read: {error!r}") from error
    _check_keys("statistics", stats, (STATE_KEY, ACTION_KEY))
    for key, measures in stats.items():
        _check_keys(key, measures, MEASURES)
        _check_measures(key, measures)
        if (count := int(measures["count"][0])) != num_examples:
            raise ParameterError("examples", f"{key} counts {count} frames, but num-examples={num_examples}")
    return stats


def _check_keys(what: str, found: Iterable[str], expected: Iterable[str]) -> None:
    if set(found) != set(expected):
        raise ParameterError("statistics", f"{what}: got {sorted(found)}, expected {sorted(expected)}")


def _check_measures(key: str, measures: dict[str, np.ndarray]) -> None:
    """Raise ParameterError unless the measures of a feature are numbers that some frames could have."""
    for name, length in MEASURES.items():
        value, kind = measures[name], "i" if name == "count" else "f"
        if value.dtype.kind != kind or value.shape != (length,):
            found = f"{value.dtype} {value.shape}"
            raise ParameterError("statistics", f"{key}.{name} is {found}, expected {length} numbers")
        if kind == "f" and not (np.abs(value) <= FURTHEST).all():  # also false for NaN
            raise ParameterError("statistics", f"{key}.{name} is beyond what the arm can do, {FURTHEST:g}")
    mean, lowest, highest = measures["mean"], measures["min"], measures["max"]
    if (measures["std"] < 0).any():
        raise ParameterError("statistics", f"{key}.std is below 0")
    slack = ROUNDING * np.maximum(np.abs(lowest), np.abs(highest))
    if (lowest > highest).any() or (mean < lowest - slack).any() or (mean > highest + slack).any():
        raise ParameterError("statistics", f"{key}: a mean lies outside its min and max")
    if (measures["std"] > (highest - lowest) / 2 + slack).any():  # Popoviciu's inequality
        raise ParameterError("statistics", f"{key}: a std is above half the distance of min and max")
