"""Overhead of a federation over its clients' own work, in wall time and memory, on the inline engine.

python benchmarks/federation.py
"""

import argparse
import json
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

from flwr.app import Context, Message
from flwr.clientapp import ClientApp

from fedvla_book.chapter_cost import peak_memory_mb
from fedvla_lib.config import Config
from fedvla_lib.engines import inline
from fedvla_lib.federation import client, client_app
from fedvla_lib.run_folder import read_metrics
from report import laptop, options, recording, report, start, timed


def main() -> None:
    """Measure and report; each number of clients runs in its own process, so that memory peaks are separate."""
    parser = options(__doc__.splitlines()[0])
    parser.add_argument("--clients", type=int, default=10, help="number of clients")
    parser.add_argument("--rounds", type=int, nargs="+", default=[2, 10], help="numbers of rounds")
    parser.add_argument("--python", default=sys.executable, help="what runs a measurement in a process of its own")
    parser.add_argument("--alone", type=int, help="used internally: run with this many clients and print the numbers")
    chosen = parser.parse_args()
    config = replace(laptop(chosen.profile), eval_rollouts=0, eval_every=0)
    if chosen.alone:
        print(json.dumps(measure(replace(config, num_clients=chosen.alone, num_server_rounds=chosen.rounds[0]))))
        return
    recording(config)
    report("federation", [compared(rounds, chosen) for rounds in chosen.rounds], chosen.out)


def compared(rounds: int, chosen: argparse.Namespace) -> dict[str, float]:
    """Measure federations of `rounds` rounds, of one client and of many."""
    one, many = (in_own_process(count, rounds, chosen) for count in (1, chosen.clients))
    return {
        "clients": chosen.clients,
        "rounds": rounds,
        "wall time [s]": many["wall"],
        "clients' training and evaluation [s]": many["clients"],
        "ratio of times": many["wall"] / many["clients"],
        "server's own evaluation [s]": many["evaluation"],
        "ratio without it": (many["wall"] - many["evaluation"]) / many["clients"],
        "peak memory [MB]": many["memory"],
        "peak memory with one client [MB]": one["memory"],
        "ratio of memories": many["memory"] / one["memory"],
    }


def in_own_process(count: int, rounds: int, chosen: argparse.Namespace) -> dict[str, float]:
    """Measure a federation of `count` clients."""
    measured = ["--alone", str(count), "--rounds", str(rounds), "--profile", chosen.profile]
    command = [chosen.python, __file__, *measured]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    return json.loads(done.stdout.splitlines()[-1])


def measure(config: Config) -> dict[str, float]:
    """Run a federation; return its wall time, the time inside its clients, and peak memory."""
    seconds: list[float] = []
    tools = inline.cached(client.LOADERS)
    with tempfile.TemporaryDirectory() as out:
        app = TimedApp(client_app.build(tools), seconds)
        wall = timed(lambda: inline.run_inline(replace(config, out=out), clients_app=app, progress=False))
        (run,) = Path(out).iterdir()
        evaluation = read_metrics(run, "evaluate").query("who == 'global'").seconds.sum()
    return {"wall": wall, "clients": sum(seconds), "evaluation": float(evaluation), "memory": peak_memory_mb()}


class TimedApp:
    """A ClientApp that records the time of each message."""

    def __init__(self, app: ClientApp, seconds: list[float]) -> None:
        self._app, self._seconds = app, seconds

    def __call__(self, message: Message, context: Context) -> Message:
        replies: list[Message] = []
        self._seconds.append(timed(lambda: replies.append(self._app(message, context))))
        return replies[0]


if __name__ == "__main__":
    start(main)
