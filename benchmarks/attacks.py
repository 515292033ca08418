"""What one malicious client can do to a federation: attacks on real runs, refused, survived or lost.

    python benchmarks/attacks.py --profile tiny

Client 0 of five follows the protocol but for one thing, in every round. An attack is refused if the server leaves out
this client, or what it announced, and says why; lost if the run ends, if an honest client is left out, or if the
held-out loss is more than a tenth above that of five honest clients under the same rule; else survived. Where it is not
refused it is tried again without the limits on what one client may weigh (`frames-cap` and `update-cap` 0), with the
mean and with the median. The first row is a client that follows the protocol, beside the model before training: where
that is within a tenth as well, the loss cannot tell an attack that only prevents learning.
"""

import json
import logging
import math
import pickle
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from flwr.app import Array, ArrayRecord, ConfigRecord, Context, Message, RecordDict

from fedvla_book.attacks import hostile
from fedvla_lib import run_folder
from fedvla_lib.config import Config
from fedvla_lib.data.normalisation import pack_stats, unpack_stats
from fedvla_lib.engines.inline import FIRST_NODE_ID, run_inline
from fedvla_lib.federation import client, client_app, messages
from fedvla_lib.federation.messages import ARRAYS, METRICS, NOTE
from fedvla_lib.federation.nodes import TooFewReplies
from fedvla_lib.policy.parameters import Arrays
from fedvla_lib.run_folder import GLOBAL
from report import laptop, options, report, start

CLIENTS, ATTACKER = 5, 0
WORSE = 1.1  # times the loss of honest clients
MANY = 2**40
NO_LIMITS = {"frames_cap": 0.0, "update_cap": 0.0}
VARIANTS = {"as it is": {}, "without limits": NO_LIMITS, "median": NO_LIMITS | {"strategy": "fedmedian"}}
ENDED = (TooFewReplies, FloatingPointError, ValueError)
Change = Callable[[RecordDict, Message], None]  # of a reply to a message


def main() -> None:
    """Try every attack and report."""
    parser = options(__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", choices=ATTACKS, default=list(ATTACKS), help="attacks to try")
    chosen = parser.parse_args()
    logging.disable(logging.WARNING)  # the table says what was rejected
    app, rows = client_app.build(client.cached(client.LOADERS)), []
    with tempfile.TemporaryDirectory() as folder:
        config = laptop(
            chosen.profile, num_clients=CLIENTS, num_server_rounds=2, eval_rollouts=0, client_rollouts=0, eval_every=0,
            out=folder,
        )  # fmt: skip
        honest = {name: tried(app, replace(config, **settings)) for name, settings in VARIANTS.items()}
        told = {name: "survived" for name in VARIANTS} | {f"loss, {name}": 1.0 for name in VARIANTS}
        before = honest["as it is"].before / honest["as it is"].loss
        rows.append({"client 0": "follows the protocol"} | told | {"named": f"before training {before:.2f}"})
        for name in chosen.only:
            needed = replace(config, client_rollouts=int("evaluate" in ATTACKS[name]))  # what it says of its rollouts
            rows.append({"client 0": name} | row(attacked(app, ATTACKS[name]), needed, honest))
            report("attacks", rows, chosen.out)  # each time: the whole takes minutes


@dataclass(frozen=True)
class Tried:
    """A run: its held-out loss before training and in the end, infinite if it failed, and who was refused and why."""

    before: float
    loss: float
    reasons: str  # for client 0
    others: str  # for honest clients


def row(app: Callable, config: Config, honest: dict[str, Tried]) -> dict[str, object]:
    """Try an attack with the default settings, and unless it is refused with the others."""
    told: dict[str, object] = dict.fromkeys([*VARIANTS, *(f"loss, {name}" for name in VARIANTS)])
    for name, settings in VARIANTS.items():
        found = tried(app, replace(config, **settings))
        fine = found.loss <= WORSE * honest[name].loss and not found.others
        told[name] = "lost" if not fine else "refused" if found.reasons else "survived"
        told[f"loss, {name}"] = _finite(found.loss / honest[name].loss)
        if name == "as it is":
            told["named"] = found.reasons + f" honest: {found.others}" * bool(found.others)
            if told[name] == "refused":
                break
    return told


def _finite(ratio: float) -> float | str:
    return ratio if math.isfinite(ratio) else "the run ended"


def tried(app: Callable, config: Config) -> Tried:
    """Run a federation."""
    before = run_folder.run_folders(config)
    try:
        run_inline(config, clients_app=app, progress=False)
        ended = False
    except ENDED:
        ended = True
    (root,) = run_folder.run_folders(config) - before
    refused, mine = (
        run_folder.read_metrics(root, "rejected"),
        {f"client_{ATTACKER}", f"node_{FIRST_NODE_ID + ATTACKER}"},
    )
    named = [
        ", ".join(sorted({row.reason for row in refused.itertuples() if (row.who in mine) == own}))
        for own in (True, False)
    ]
    losses = run_folder.read_metrics(root, "evaluate").query("who == @GLOBAL").loss
    return Tried(float(losses.iloc[0]), math.inf if ended else float(losses.iloc[-1]), *named)


def attacked(app: Callable, changes: dict[str, Change]) -> Callable:
    """Return the app whose replies the attacker changes, by type of message."""

    def call(message: Message, context: Context) -> Message:
        reply, change = app(message, context), changes.get(message.metadata.message_type)
        if change and context.node_config[messages.PARTITION] == ATTACKER:
            change(reply.content, message)
        return reply

    return call


def says(record: str, **values: object) -> Change:
    """Announce other values; underscores become dashes."""

    def change(content: RecordDict, _: Message) -> None:
        content[record].update({name.replace("_", "-"): value for name, value in values.items()})

    return change


def statistics(content: RecordDict, _: Message, **measures: float) -> None:
    """Announce other statistics of each joint."""
    stats = unpack_stats(content[NOTE]["stats"])
    for of in stats.values():
        of.update({name: np.full(of[name].shape, value, of[name].dtype) for name, value in measures.items()})
    content[NOTE]["stats"] = pack_stats(stats)


def many_frames(content: RecordDict, message: Message) -> None:
    """Announce a trillion frames, in the statistics as well."""
    says(NOTE, num_examples=MANY)(content, message)
    statistics(content, message, count=MANY)


def many_and_turned(content: RecordDict, message: Message) -> None:
    """Report as many frames, and send the update turned and five times as long."""
    says(METRICS, num_examples=MANY)(content, message)
    times(-5.0)(content, message)


def weights(of: Callable[[Arrays, Arrays], Arrays], content: RecordDict, message: Message) -> None:
    """Send what a function makes of the global weights and the update, with its SHA-256."""
    began, ended = (messages.unpack_arrays(record[ARRAYS]) for record in (message.content, content))
    sent = of(began, {name: ended[name] - began[name] for name in began})
    hostile.send(content, sent)


def times(factor: float) -> Change:
    """Send the update times a factor."""
    return partial(weights, lambda w, d: {name: w[name] + np.float32(factor) * d[name] for name in w})


def noise(began: Arrays, update: Arrays) -> Arrays:
    """Return noise as long as the update, in each array, in its place."""
    change = hostile.noise_like(update, 1.0, np.random.default_rng(0))
    return {name: began[name] + change[name] for name in began}


def pickled(content: RecordDict, _: Message) -> None:
    """Send the bytes of a pickle as an array."""
    record = dict(content[ARRAYS])
    first = next(iter(record))
    bad = Array(record[first].dtype, record[first].shape, record[first].stype, pickle.dumps(print))
    content[ARRAYS] = ArrayRecord({**record, first: bad})


def again() -> Change:
    """Send the first round's reply in each later round."""
    stored: dict[str, RecordDict] = {}

    def change(content: RecordDict, message: Message) -> None:
        if message.content[messages.CONFIG][messages.ROUND] == 1:
            stored["first"] = content.copy()
        else:
            content.update(stored["first"])

    return change


def fails(*_: object) -> None:
    """Fail with a text that would clear the terminal."""
    raise RuntimeError("\x1b[2J" + "x" * 1_000_000)


def rows(content: RecordDict, _: Message, **values: object) -> None:
    """Say more of each rollout than was asked, or something else."""
    said = [row | values for row in json.loads(content[NOTE]["rollouts"])]
    content[NOTE]["rollouts"] = json.dumps(said)


def files(content: RecordDict, _: Message, name: str = "", film: bytes = b"") -> None:
    """Send rollouts under another file name, or other bytes as their films."""
    note: ConfigRecord = content[NOTE]
    if name:
        note["file-names"] = [name for _ in note["file-names"]]
    note["files"] = [film or file for file in note["files"]]


def twice(content: RecordDict, _: Message) -> None:
    """Send more rollouts than were asked for."""
    content[NOTE]["rollouts"] = json.dumps(2 * json.loads(content[NOTE]["rollouts"]))


ATTACKS: dict[str, dict[str, Change]] = {
    "announces 2^40 frames, sends its update turned, five times": {
        "query": many_frames, "train": many_and_turned,
    },
    "announces a spread of 1e5": {"query": partial(statistics, std=1e5)},
    "announces a mean at the end of each joint's range": {
        "query": partial(statistics, mean=350.0, min=-360.0, max=360.0, std=300.0)
    },
    "claims another's number": {"query": says(NOTE, partition_id=1)},
    "claims a number that there is not": {"query": says(NOTE, partition_id=10**6)},
    "names a task of 10 MB": {"query": says(NOTE, tasks=["x" * 10_000_000])},
    "sends NaN": {"train": times(math.nan)},
    "sends other names": {"train": partial(weights, lambda w, d: {f"{name}.x": w[name] for name in w})},
    "sends arrays of other shapes": {"train": partial(weights, lambda w, d: {name: w[name].ravel()[:1] for name in w})},
    "sends another SHA-256": {"train": says(NOTE, sha256="0" * 64)},
    "sends a pickle": {"train": pickled},
    "reports a million frames": {"train": says(METRICS, num_examples=10**6)},
    "sends the first round's reply again": {"train": again()},
    "sends 300 MB beside its arrays": {"train": says(NOTE, more=bytes(300_000_000))},
    "sends its update a thousand times": {"train": times(1e3)},
    "sends its update turned, ten times": {"train": times(-10.0)},
    "sends its update turned": {"train": times(-1.0)},
    "sends noise as long as its update": {"train": partial(weights, noise)},
    "writes rows as the server's": {"evaluate": partial(rows, round=9, who=GLOBAL, kind="evaluate")},
    "reports text for success": {"evaluate": partial(rows, success="yes")},
    "reports more rollouts than asked": {"evaluate": twice},
    "sends a film that is none": {"evaluate": partial(files, film=bytes(1_000_000))},
    "names a file outside the run folder": {"evaluate": partial(files, name="../../rollout_1.mp4")},
    "fails with a text that clears the terminal": {"train": fails},
}  # fmt: skip

if __name__ == "__main__":
    start(main)
