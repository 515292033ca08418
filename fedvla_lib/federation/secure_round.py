"""Secure aggregation in Flower's messages: three short exchanges around the one that trains.

`SecureGrid` is the server's half. It stands between a strategy and the grid, and hands the strategy replies that all
hold the mean of the clients. The handlers are the client's half, and what a client has to remember during a round is in
its context. Clients are named by their place in the round.
"""

import math
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from functools import reduce
from typing import Any

import numpy as np
from flwr.app import ConfigRecord, Context, Error, Message, RecordDict
from flwr.common.constant import ErrorCode
from flwr.serverapp import Grid

from fedvla_lib.config import Config, from_run_config, sample_size
from fedvla_lib.federation import messages, privacy
from fedvla_lib.federation import secure_aggregation as secure
from fedvla_lib.federation.nodes import MOST_BYTES, Report, TooFewReplies, answered
from fedvla_lib.policy.parameters import Arrays, ParameterError, Shapes, check_digest, digest
from fedvla_lib.run_folder import GLOBAL

RECORD, MASKED = "secure", "masked"  # of the protocol in a message and in a client's state; the array of a reply
KEYS, SHARES, TRAIN, UNMASK = "train.keys", "train.shares", "train", "train.unmask"  # types of message


@dataclass
class Round:
    """What the server learns in a round; all by client."""

    keys: dict[int, secure.Public]
    neighbours: dict[int, list[int]]
    dealt: dict[int, dict[int, bytes]]  # from, to


class SecureGrid:
    """A grid whose training replies are masked; delegates everything else to `grid`.

    Args:
        shapes: of the trainable weights; the strategy's other records have the same.
        records: of arrays that a client sends.
        report: receives an event ``secure`` for each round: clients, bytes and seconds of the protocol.
    """

    def __init__(self, grid: Grid, config: Config, shapes: Shapes, records: tuple[str, ...], report: Report) -> None:
        self._grid, self._config, self._report = grid, config, report
        self._shapes = {record: shapes for record in records}

    def __getattr__(self, name: str) -> Any:
        """Delegate to the grid."""
        return getattr(self._grid, name)

    def send_and_receive(self, messages: Iterable[Message], *, timeout: float | None = None) -> list[Message]:
        """Send messages and return the replies; those for training all hold the mean update."""
        sent = list(messages)
        if not sent or sent[0].metadata.message_type != TRAIN:
            return list(self._grid.send_and_receive(sent, timeout=timeout))
        return self._train(dict(enumerate(sent)), timeout)

    def _train(self, orders: dict[int, Message], timeout: float | None) -> list[Message]:
        drawn = sample_size(self._config.fraction_train, self._config.num_clients)
        if len(orders) > drawn:
            raise ValueError(f"{len(orders)} clients train, num-clients={self._config.num_clients} allow for {drawn}")
        began, self._bytes, self._needed = time.perf_counter(), 0, secure.least_survivors(drawn)
        state = self._prepare(orders, timeout)
        letters = {me: _letter(me, {k: state.dealt[k][me] for k in self._peers(state, me)}) for me in state.dealt}
        sent = {me: _with_letter(orders[me], letter) for me, letter in letters.items()}
        prepared = time.perf_counter()
        replies = _by_client(sent, self._grid.send_and_receive(list(sent.values()), timeout=timeout))
        vectors, refused = self._vectors(sent, replies)
        trained = time.perf_counter()
        self._enough(len(vectors), len(orders), "sent their masked update")
        total = self._unmask(orders, state, vectors, reduce(np.add, vectors.values()), timeout)
        mean = secure.grid_for(self._config).real(total) / len(vectors)
        self._check_length(mean)
        round_number = orders[0].content[messages.CONFIG][messages.ROUND]
        seconds = time.perf_counter() - trained + prepared - began
        counts = {"clients": len(orders), "summed": len(vectors), "lost": len(orders) - len(vectors)}
        self._report(round_number, GLOBAL, "secure", counts | {"bytes": self._bytes, "seconds": seconds})
        records = _mean_records(orders[0], self._payload(mean))
        return [_with_mean(sent[me], replies[me], records) for me in vectors] + refused

    def _prepare(self, orders: dict[int, Message], timeout: float | None) -> Round:
        """Collect public keys and encrypted shares; those who do not answer are left out of the round."""
        found = self._ask(orders, KEYS, {me: ConfigRecord() for me in orders}, timeout)
        keys = {me: (note.get("encryption"), note.get("masking")) for me, note in found.items()}
        keys = {me: pair for me, pair in keys.items() if secure.is_public(pair)}
        self._enough(len(keys), len(orders), "sent keys")
        near = secure.neighbours(list(keys))
        letters = {me: _letter(me, {k: b"".join(_framed(keys[k])) for k in near[me]}) for me in keys}
        found = self._ask(orders, SHARES, letters, timeout)
        dealt = {me: _contents(note) for me, note in found.items()}
        dealt = {me: shares for me, shares in dealt.items() if sorted(shares) == near[me]}
        self._enough(len(dealt), len(orders), "dealt shares")
        return Round(keys, near, dealt)

    def _peers(self, state: Round, me: int) -> list[int]:
        """The neighbours that dealt shares, whose masks a client uses."""
        return [other for other in state.neighbours[me] if other in state.dealt]

    def _vectors(
        self, orders: dict[int, Message], replies: dict[int, Message]
    ) -> tuple[dict[int, np.ndarray], list[Message]]:
        """Return the masked vectors by client, and an error reply for each client whose vector is unusable."""
        size = sum(math.prod(shape) for shapes in self._shapes.values() for shape in shapes.values())
        vectors, refused = {}, []
        for me, order in orders.items():
            try:
                content = answered(replies.get(me), MOST_BYTES + np.uint32().nbytes * size).content
                if messages.METRICS not in content.metric_records:
                    raise ParameterError("metrics", f"there is no record {messages.METRICS!r}")
                arrays = messages.unpack_arrays(content.array_records.get(messages.ARRAYS, {}))
                vector = arrays.get(MASKED, np.zeros(0))
                if vector.dtype != np.uint32 or vector.shape != (size,):
                    raise ParameterError("shape", f"{MASKED} is {vector.dtype} {vector.shape}, expected {size} uint32")
                check_digest(arrays, str(content.config_records.get(messages.NOTE, {}).get(messages.DIGEST)))
                vectors[me] = vector
            except ParameterError as error:
                if me in replies:
                    failure = Error(code=ErrorCode.CLIENT_APP_RAISED_EXCEPTION, reason=str(error))
                    refused.append(Message(failure, reply_to=order))
        return vectors, refused

    def _unmask(
        self, orders: dict[int, Message], state: Round, vectors: dict[int, np.ndarray], total: np.ndarray,
        timeout: float | None,
    ) -> np.ndarray:  # fmt: skip
        """Ask for shares and take the masks off the sum."""
        lost = sorted(set(state.dealt) - set(vectors))
        order = ConfigRecord({"summed": sorted(vectors), "lost": lost})
        found = self._ask(orders, UNMASK, {me: order for me in vectors}, timeout)
        given = {me: _contents(note) for me, note in found.items()}
        secrets = {}
        for me in state.dealt:
            shares = [given[other][me] for other in state.neighbours[me] if me in given.get(other, {})]
            needed = secure.threshold(len(state.neighbours[me]))
            if len(shares) < needed:
                raise TooFewReplies(f"{len(shares)} shares of client {me} of the round came back, {needed} are needed")
            try:
                secrets[me] = secure.combined(shares[:needed])
            except (ValueError, IndexError) as error:
                raise TooFewReplies(f"the shares of client {me} of the round do not fit together: {error}") from error
        pairs = {me: [other for other in self._peers(state, me) if other in vectors] for me in lost}
        seeds = [secrets[me] for me in vectors]
        return secure.unmasked(total, seeds, {me: secrets[me] for me in lost}, state.keys, pairs)

    def _ask(
        self, orders: dict[int, Message], kind: str, letters: dict[int, ConfigRecord], timeout: float | None
    ) -> dict[int, ConfigRecord]:
        """Send each client a letter and return the notes of those that answer."""
        asked = {
            me: Message(RecordDict({RECORD: letter}), dst_node_id=orders[me].metadata.dst_node_id, message_type=kind)
            for me, letter in letters.items()
        }
        replies = _by_client(asked, self._grid.send_and_receive(list(asked.values()), timeout=timeout))
        good = {me: reply for me, reply in replies.items() if not reply.has_error() and RECORD in reply.content}
        sizes = {me: messages.count_bytes(reply.content) for me, reply in good.items()}
        good = {me: reply for me, reply in good.items() if sizes[me] <= MOST_BYTES}
        self._bytes += sum(messages.count_bytes(one.content) for one in asked.values()) + sum(map(sizes.get, good))
        return {me: good[me].content[RECORD] for me in asked if me in good}

    def _payload(self, vector: np.ndarray) -> privacy.Payload:
        """A vector as arrays by record and name, both in the order of the alphabet."""
        shapes = [(record, name) for record in sorted(self._shapes) for name in sorted(self._shapes[record])]
        sizes = [math.prod(self._shapes[record][name]) for record, name in shapes]
        payload: privacy.Payload = {record: {} for record in self._shapes}
        for (record, name), part in zip(shapes, np.split(vector, np.cumsum(sizes)[:-1]), strict=True):
            payload[record][name] = part.reshape(self._shapes[record][name]).astype(np.float32)
        return payload

    def _enough(self, count: int, clients: int, what: str) -> None:
        if count < self._needed:
            raise TooFewReplies(f"secure aggregation: {count} of {clients} clients {what}, {self._needed} are needed")

    def _check_length(self, mean: np.ndarray) -> None:
        """Without noise, a mean is no longer than its parts: a longer one has a mask left, or a part not clipped."""
        length, limit = float(np.linalg.norm(mean)), self._config.clip_norm
        if not privacy.is_private(self._config) and length > 1.001 * limit:
            raise TooFewReplies(f"the mean update has norm {length:.3g}, above clip-norm={limit:g}: a client lied")


def _by_client(orders: dict[int, Message], replies: Iterable[Message]) -> dict[int, Message]:
    place = {order.metadata.dst_node_id: me for me, order in orders.items()}
    return {place[reply.metadata.src_node_id]: reply for reply in replies}


def _mean_records(order: Message, mean: privacy.Payload) -> RecordDict:
    """Return what all replies of a round have in common: the global arrays plus the mean, and the digests."""
    start = messages.unpack_arrays(order.content[messages.ARRAYS])
    arrays = {name: array + mean[messages.ARRAYS][name] for name, array in start.items()}
    note = ConfigRecord({messages.DIGEST: digest(arrays), **messages.round_of(order.content)})
    content = RecordDict({messages.ARRAYS: messages.pack_arrays(arrays), messages.NOTE: note})
    for record, extra in mean.items():
        if record != messages.ARRAYS:
            messages.attach(content, messages.NOTE, record, extra)
    return content


def _with_mean(order: Message, reply: Message, records: RecordDict) -> Message:
    """Return a client's reply, with the records of the mean in place of its masked vector."""
    return Message(RecordDict({**records, messages.METRICS: reply.content[messages.METRICS]}), reply_to=order)


def _with_letter(order: Message, letter: ConfigRecord) -> Message:
    """Return a message with one more record; a strategy's messages to all clients have one content in common."""
    content, sent = RecordDict({**order.content, RECORD: letter}), order.metadata
    return Message(content, sent.dst_node_id, sent.message_type, group_id=sent.group_id)


def _letter(me: int, contents: dict[int, bytes]) -> ConfigRecord:
    return ConfigRecord({"me": me, "peers": list(contents), "contents": list(contents.values())})


def _contents(note: ConfigRecord) -> dict[int, bytes]:
    """What a letter holds, by client; {} if it is malformed."""
    peers, contents = note.get("peers"), note.get("contents")
    if not isinstance(peers, list) or not isinstance(contents, list) or len(peers) != len(contents):
        return {}
    good = all(type(k) is int for k in peers) and all(isinstance(one, bytes) and one for one in contents)
    return dict(zip(peers, contents, strict=True)) if good else {}


def _framed(keys: secure.Public) -> list[bytes]:
    """Two keys as bytes that can be taken apart again."""
    return [len(keys[0]).to_bytes(4, "little"), *keys]


def _keys(framed: bytes) -> secure.Public:
    end = 4 + int.from_bytes(framed[:4], "little")
    return framed[4:end], framed[end:]


def send_keys(message: Message, context: Context) -> Message:
    """Client: make secrets for the round, and send the public keys."""
    secrets = secure.new_secrets()
    context.state[RECORD] = ConfigRecord(asdict(secrets))
    encryption, masking = secure.public(secrets)
    return _reply(message, ConfigRecord({"encryption": encryption, "masking": masking}))


def send_shares(message: Message, context: Context) -> Message:
    """Client: deal shares of the secrets to the neighbours."""
    letter, state = message.content[RECORD], context.state[RECORD]
    peers = _contents(letter)
    if len(peers) < secure.LEAST_CLIENTS - 1:
        raise ValueError(f"{len(peers)} neighbours: secure aggregation needs {secure.LEAST_CLIENTS - 1} at least")
    state.update({"me": letter["me"], "peers": [*peers], "keys": [*peers.values()]})
    dealt = secure.deal(_secrets(state), letter["me"], {k: _keys(framed) for k, framed in peers.items()})
    return _reply(message, _letter(letter["me"], dealt))


def masked_update(payload: privacy.Payload, message: Message, context: Context, config: Config) -> Arrays:
    """Client: return what is sent in place of the payload, remember the others' shares, and forget the masks."""
    dealt, state = _contents(message.content[RECORD]), context.state[RECORD]
    secrets, keys = _secrets(state), _peer_keys(state)
    arrays = [payload[record][name] for record in sorted(payload) for name in sorted(payload[record])]
    steps = secure.grid_for(config).round(np.concatenate([array.ravel() for array in arrays]).astype(np.float64))
    if privacy.is_private(config) and config.noise_by == "together":
        round_number = message.content[messages.CONFIG][messages.ROUND]
        rng = privacy.source(config, round_number, privacy.CLIENT_NOISE, context.node_config[messages.PARTITION])
        steps = steps + secure.share_of_noise(config, len(steps), rng)
    masked = secure.masked(steps, secrets, state["me"], {k: keys[k] for k in dealt})
    # A second vector under the same masks would give away the difference of the two.
    kept = {name: state[name] for name in ("encryption", "me", "peers", "keys")}
    context.state[RECORD] = ConfigRecord(kept | {"dealers": [*dealt], "dealt": [*dealt.values()]})
    return {MASKED: masked}


def send_unmasking(message: Message, context: Context) -> Message:
    """Client: send one share of each neighbour, for the seed or for the key, once.

    Raises:
        ValueError: the server asks for both of a client, for too few clients in the sum, or a second time.
    """
    order, state = message.content[RECORD], context.state.config_records.get(RECORD, {})
    summed, lost, config = set(order["summed"]), set(order["lost"]), from_run_config(context.run_config)
    if both := summed & lost:
        raise ValueError(f"both shares of client {min(both)} of the round are asked for: that would uncover its update")
    if "dealers" not in state:
        raise ValueError("shares are sent once in a round, after training")
    least = secure.least_survivors(sample_size(config.fraction_train, config.num_clients))
    near = len(summed & {*state["dealers"], state["me"]})
    if state["me"] not in summed or len(summed) < least or near < secure.threshold(len(state["peers"])):
        raise ValueError(f"{len(summed)} clients are in the sum, {near} of them near this one: too few to hide among")
    keys, chosen = _peer_keys(state), {}
    for k, dealt in zip(state["dealers"], state["dealt"], strict=True):
        shares = secure.opened(state["encryption"], state["me"], k, keys[k], dealt)
        if shares and k in summed | lost:
            chosen[k] = shares[k in lost]
    del context.state[RECORD]
    return _reply(message, _letter(state["me"], chosen))


def _secrets(state: ConfigRecord) -> secure.Secrets:
    return secure.Secrets(state["encryption"], state["masking"], state["seed"])


def _peer_keys(state: ConfigRecord) -> dict[int, secure.Public]:
    return {k: _keys(framed) for k, framed in zip(state["peers"], state["keys"], strict=True)}


def _reply(message: Message, record: ConfigRecord) -> Message:
    return Message(RecordDict({RECORD: record}), reply_to=message)


HANDLERS: dict[str, Callable[[Message, Context], Message]] = {
    "keys": send_keys, "shares": send_shares, "unmask": send_unmasking,
}  # fmt: skip
