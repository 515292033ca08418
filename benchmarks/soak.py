"""Many rounds with clients that come and go: seconds, memory, open files and disk, early and late in one run.

    python benchmarks/soak.py --profile tiny

In each round a tenth of the clients is away, others each time, as nodes are that were switched off and on again. The
run folder keeps its last three models. Flat is what has a ratio of one.
"""

import tempfile
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import psutil
from flwr.app import Context, Message, MessageType, RecordDict
from flwr.common.constant import SUPERLINK_NODE_ID

from fedvla_lib.config import to_run_config
from fedvla_lib.engines.inline import RUN_ID, InlineGrid, claim_identity
from fedvla_lib.federation import client, client_app, server_app
from fedvla_lib.run_folder import disk_bytes, read_metrics
from report import laptop, options, report, start

PART = 5  # the first and the last fifth of the rounds are compared; the first begins after `WARM_UP`
WARM_UP = 2
MEASURES = {"seconds": "a round [s]", "memory": "memory [MB]", "files": "open files", "disk": "run folder [MB]"}


def main() -> None:
    """Run and report."""
    parser = options(__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=500, help="rounds of the run")
    parser.add_argument("--clients", type=int, default=10, help="clients, a tenth of which is away")
    chosen = parser.parse_args()
    if chosen.rounds < WARM_UP + PART:
        raise ValueError(f"--rounds {chosen.rounds} is not usable: give {WARM_UP + PART} or more")
    with tempfile.TemporaryDirectory() as folder:
        report("soak", [soaked(chosen.profile, chosen.rounds, chosen.clients, Path(folder))], chosen.out)


def soaked(profile: str, rounds: int, clients: int, folder: Path) -> dict[str, object]:
    """Return medians of the first and the last rounds of a run, and their ratios."""
    config = laptop(
        profile, num_clients=clients, num_server_rounds=rounds, fraction_train=1.0, fraction_evaluate=0.0,
        local_steps=1, eval_every=0, eval_rollouts=0, client_rollouts=0, keep_last=3, out=str(folder),
    )  # fmt: skip
    claim_identity()
    loaders = client.cached(client.LOADERS)
    grid = ComingAndGoing(client_app.build(loaders), clients, to_run_config(config))
    grid.folder = folder
    context = Context(RUN_ID, SUPERLINK_NODE_ID, {}, RecordDict(), to_run_config(config))
    server_app.build(loaders, engine="inline")(grid, context)
    (run,) = folder.iterdir()
    silent = read_metrics(run, "rejected")
    seen = pd.DataFrame(grid.seen).iloc[WARM_UP:]
    part = max(1, len(seen) // PART)
    early, late = seen.iloc[:part].median(), seen.iloc[-part:].median()
    row: dict[str, object] = {
        "rounds": rounds,
        "clients": clients,
        "away": len(silent),
        "clients away": silent.who.nunique(),
    }
    for key, name in MEASURES.items():
        row |= {f"{name} early": early[key], f"{name} late": late[key], f"{name} ratio": late[key] / early[key]}
    return row


@dataclass
class Seen:
    """What a round left behind."""

    seconds: float
    memory: float
    files: int
    disk: float


class ComingAndGoing(InlineGrid):
    """A grid on which a tenth of the nodes does not answer a round of training, and which measures this process."""

    folder: Path

    def __init__(self, *args: object) -> None:
        super().__init__(*args)
        self.seen: list[Seen] = []
        self._rng, self._began, self._process = np.random.default_rng(0), time.perf_counter(), psutil.Process()

    def push_messages(self, messages: Iterable[Message]) -> list[str]:
        """Handle the messages to the nodes that are there."""
        messages = list(messages)
        if not messages or messages[0].metadata.message_type != MessageType.TRAIN:
            return super().push_messages(messages)
        now = time.perf_counter()
        memory, disk = self._process.memory_info().rss / 1e6, disk_bytes(self.folder) / 1e6
        self.seen.append(Seen(now - self._began, memory, self._process.num_fds(), disk))
        self._began = now
        away = self._rng.choice(len(messages), max(1, len(messages) // 10), replace=False)
        return super().push_messages([message for k, message in enumerate(messages) if k not in away])


if __name__ == "__main__":
    start(main)
