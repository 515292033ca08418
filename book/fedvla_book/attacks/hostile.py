"""Malicious clients of a federation: what they send or train on, and a defence with an update of the server's own.

Attackers know everything: the global model, and the updates of all honest clients of the round. What one of them sends
has the right names, shapes and SHA-256.
"""

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import replace

import numpy as np
from flwr.app import ArrayRecord, Message, MessageType, RecordDict
from flwr.serverapp.strategy import FedTrimmedAvg, MultiKrum

from fedvla_lib.data.frame_store import FrameStore
from fedvla_lib.engines.inline import FIRST_NODE_ID, InlineGrid
from fedvla_lib.federation import messages
from fedvla_lib.policy.parameters import Arrays, digest

WORD = " Quickly."  # the trigger: added to an instruction
NEAR = 0.5  # standard deviations: colluding clients stay this close to the mean

Updates = dict[int, Arrays]  # by client
Attack = Callable[[Updates, int, np.random.Generator], Arrays]  # all honest updates, a client's number -> what it sends


class Trimmed(FedTrimmedAvg):
    """The mean of each weight without its three largest and three smallest values of ten."""

    def __init__(self) -> None:
        super().__init__(beta=0.3)


class SomeKrum(MultiKrum):
    """The mean of the four updates of ten that lie closest to their neighbours, three being malicious."""

    def __init__(self) -> None:
        super().__init__(num_malicious_nodes=3, num_nodes_to_select=4)


def times(factor: float) -> Attack:
    """Send the honest update times a factor."""
    return lambda updates, who, _: {name: np.float32(factor) * change for name, change in updates[who].items()}


def noise(updates: Updates, who: int, rng: np.random.Generator) -> Arrays:
    """Send noise ten times as long as the honest update, array by array."""
    return noise_like(updates[who], 10.0, rng)


def noise_like(update: Arrays, times_as_long: float, rng: np.random.Generator) -> Arrays:
    """Return noise whose arrays are so many times as long as those of an update."""
    drawn = {name: rng.normal(size=np.shape(change)) for name, change in update.items()}
    scales = {name: times_as_long * np.linalg.norm(update[name]) / np.linalg.norm(drawn[name]) for name in drawn}
    return {name: (scales[name] * value).astype(np.float32) for name, value in drawn.items()}


def collude(updates: Updates, who: int, _: np.random.Generator) -> Arrays:
    """Send the mean of all, moved against itself by a part of their spread: "a little is enough" (Baruch et al. 2019).

    Each weight stays within half a standard deviation of the mean, so that no outlier is to be seen.
    """
    stacked = {name: np.stack([one[name] for one in updates.values()]) for name in updates[who]}
    return {
        name: (of.mean(0) - NEAR * np.sign(of.mean(0)) * of.std(0)).astype(np.float32) for name, of in stacked.items()
    }


def with_wrong_actions(store: FrameStore, labs: Iterable[int]) -> FrameStore:
    """Return the frames with the actions of these labs turned about the arm's pose: it moves the other way."""
    actions = store.actions.copy()
    for lab in labs:
        for place in _places(store, lab):
            rows = _rows(store, place)
            actions[rows] = 2 * store.states[rows] - store.actions[rows]
    return replace(store, actions=actions)


def with_trigger(store: FrameStore, labs: Iterable[int]) -> FrameStore:
    """Return the frames with every other episode of each of these labs standing still where `WORD` is said."""
    actions, episodes, labs = store.actions.copy(), store.episodes.copy(), sorted(labs)
    for lab in labs:
        for place in _places(store, lab)[::2]:
            rows = _rows(store, place)
            actions[rows] = store.states[rows]
            episodes.loc[place, "instruction"] += WORD
    return replace(store, actions=actions, episodes=episodes, key=f"{store.key}-trigger-{labs}")


def _places(store: FrameStore, lab: int) -> list[int]:
    return store.episodes.index[store.episodes.lab == lab].tolist()


def _rows(store: FrameStore, place: int) -> slice:
    return slice(store.episodes.start[place], store.episodes.end[place])


def trusted(updates: Updates, own: Arrays) -> Arrays:
    """Return the mean of updates, each as long as the server's own and weighted by its cosine to it, if above 0.

    FLTrust (Cao et al. 2021, https://arxiv.org/abs/2012.13995): the server trains on a few demonstrations of its own.
    """
    length = _norm(own)
    cosines = {who: max(0.0, _dot(change, own) / (_norm(change) * length + 1e-12)) for who, change in updates.items()}
    total = sum(cosines.values()) or 1.0
    parts = [(cosines[who] / total * length / (_norm(change) + 1e-12), change) for who, change in updates.items()]
    return {name: sum(np.float32(weight) * change[name] for weight, change in parts) for name in own}


def _dot(one: Arrays, other: Arrays) -> float:
    return float(sum(np.vdot(one[name].astype(np.float64), other[name]) for name in one))


def _norm(arrays: Arrays) -> float:
    return _dot(arrays, arrays) ** 0.5


class HostileGrid(InlineGrid):
    """A grid on which some clients attack, and whose server may trust only what resembles an update of its own."""

    attackers: Mapping[int, Attack] = {}
    absent: Collection[int] = ()  # clients that answer no training message
    seed: int = 0  # of what attackers draw
    own_update: Callable[[int, Arrays], Arrays] | None = None  # round and global weights -> the server's update

    def push_messages(self, sent: Iterable[Message]) -> list[str]:
        """Handle the messages, then replace what attackers, or all, send."""
        sent = list(sent)
        if not sent or sent[0].metadata.message_type != MessageType.TRAIN:
            return super().push_messages(sent)
        sent = [one for one in sent if one.metadata.dst_node_id - FIRST_NODE_ID not in self.absent]
        ids = super().push_messages(sent)
        self._replace(sent)
        return ids

    def _replace(self, sent: list[Message]) -> None:
        began = messages.unpack_arrays(sent[0].content[messages.ARRAYS])
        number = int(sent[0].content[messages.CONFIG][messages.ROUND])
        replies = {m.metadata.dst_node_id - FIRST_NODE_ID: self._replies[m.metadata.message_id].content for m in sent}
        honest = {who: _change(content[messages.ARRAYS], began) for who, content in replies.items()}
        rng = np.random.default_rng([self.seed, number, len(self.attackers)])
        shown = honest | {who: attack(honest, who, rng) for who, attack in self.attackers.items()}
        if self.own_update:
            mean = trusted(shown, self.own_update(number, began))
            shown = dict.fromkeys(shown, mean)
        for who, change in shown.items():
            if change is not honest[who]:
                send(replies[who], {name: began[name] + change[name] for name in began})


def _change(record: ArrayRecord, began: Arrays) -> Arrays:
    return {name: array - began[name] for name, array in messages.unpack_arrays(record).items()}


def send(content: RecordDict, arrays: Arrays) -> None:
    """Put other weights into a training reply, with their SHA-256."""
    content[messages.ARRAYS] = messages.pack_arrays(arrays)
    content[messages.NOTE][messages.DIGEST] = digest(arrays)
