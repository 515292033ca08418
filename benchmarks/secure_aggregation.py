"""What secure aggregation adds to a round by the number of clients: bytes and seconds, beside sending in the clear.

python benchmarks/secure_aggregation.py --clients 10 100 1000

The clients do not train: they send an update of the nano model's size, and all run one after the other in this process.
"""

import time

import numpy as np
from flwr.app import ConfigRecord, Context, Message, MetricRecord, RecordDict
from flwr.clientapp import ClientApp

from fedvla_lib.config import Config, to_run_config
from fedvla_lib.engines.inline import FIRST_NODE_ID, InlineGrid, claim_identity
from fedvla_lib.federation import messages, secure_round
from fedvla_lib.federation.nodes import Roster
from fedvla_lib.federation.secure_round import SecureGrid
from fedvla_lib.federation.strategies.build import build_strategy
from fedvla_lib.policy.parameters import digest
from report import options, report, start

NUMBERS = {"tiny": 1_000, "laptop": 469_152, "gpu": 469_152}  # in an update, by profile


def main() -> None:
    """Measure and report."""
    parser = options(__doc__.splitlines()[0])
    parser.add_argument("--clients", type=int, nargs="+", default=[10, 100], help="clients in a round")
    chosen = parser.parse_args()
    size, rows = NUMBERS[chosen.profile], []
    claim_identity()
    for clients in chosen.clients:
        clear_s, _ = round_of(clients, size, secure=False)
        secure_s, told = round_of(clients, size, secure=True)
        rows.append({
            "clients": clients, "numbers in an update": size, "in the clear [s]": clear_s, "masked [s]": secure_s,
            "ratio": secure_s / clear_s, "added by a client [ms]": 1000 * (secure_s - clear_s) / clients,
            "added bytes of a client [kB]": told["bytes"] / clients / 1e3,
            "of an update": told["bytes"] / clients / (4 * size),
        })  # fmt: skip
    report("secure_aggregation", rows, chosen.out)


def round_of(clients: int, size: int, secure: bool) -> tuple[float, dict]:
    """Return the seconds of a training round, and what the protocol reports; raise AssertionError for a wrong mean."""
    config = Config(
        num_clients=clients, fraction_train=1.0, fraction_evaluate=0.0, clip_norm=1.0, normalisation="base",
        secure_aggregation=secure,
    )  # fmt: skip
    update = np.full(size, 0.5 / size**0.5, np.float32)
    grid, told = InlineGrid(sending(update, config), clients, to_run_config(config)), []
    shapes = {"w": (size,)}
    if secure:
        grid = SecureGrid(grid, config, shapes, (messages.ARRAYS,), lambda *event: told.append(event[-1]))
    roster = Roster({node: node - FIRST_NODE_ID for node in grid.get_node_ids()})
    strategy = build_strategy(
        config, roster=roster, shapes=shapes, report=lambda *_: None, keep_rollouts=lambda *_: None
    )
    started = time.perf_counter()
    start_of_round = messages.pack_arrays({"w": np.zeros(size, np.float32)})
    sent = strategy.configure_train(1, start_of_round, ConfigRecord(), grid)
    mean, _ = strategy.aggregate_train(1, grid.send_and_receive(sent, timeout=3600.0))
    seconds = time.perf_counter() - started
    assert np.abs(mean["w"].numpy() - update).max() < 1e-6
    return seconds, told[0] if told else {}


def sending(update: np.ndarray, config: Config) -> ClientApp:
    """Return a ClientApp that sends an update, under masks if the settings say so."""
    app = ClientApp()

    @app.train()
    def train(message: Message, context: Context) -> Message:
        metrics = {messages.EXAMPLES: 1, messages.STEPS: 1, "seconds": 0.0}
        arrays = {"w": update}
        if config.secure_aggregation:
            arrays = secure_round.masked_update({messages.ARRAYS: arrays}, message, context, config)
        else:
            metrics["loss"] = 0.0
        content = {messages.ARRAYS: messages.pack_arrays(arrays), messages.METRICS: MetricRecord(metrics)}
        note = messages.make_note(sha256=digest(arrays), **messages.round_of(message.content))
        return Message(RecordDict(content | {messages.NOTE: note}), reply_to=message)

    for name, handler in secure_round.HANDLERS.items():
        app.train(name)(handler)
    return app


if __name__ == "__main__":
    start(main)
