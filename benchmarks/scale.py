"""What a round costs with 10, 100 and 1,000 clients, in time and memory: in this process, and on Flower's runtime.

    python benchmarks/scale.py --profile tiny

Every client trains in every round, on one episode, so the work grows with the clients. Scale needs episodes, not
variety: the profile's recording is repeated until there is one for each client. Rows that are measured replace those
of the same engine and number of clients; the others stay, if they are of a machine like this one.
"""

import json
import os
import statistics
import subprocess
import sys
import tempfile
import threading
import uuid
from datetime import datetime
from pathlib import Path

import pandas as pd
import psutil
from lerobot.datasets.dataset_tools import merge_datasets
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from fedvla_lib.config import Config, task_names
from fedvla_lib.data import recordings
from fedvla_lib.engines import inline, simulation
from fedvla_lib.run_folder import GLOBAL, read_events
from report import laptop, machine, options, report, start

MARK = "FEDVLA_BENCHMARK"  # in the environment of every process of one measurement
ENGINES = {"inline": inline.run_inline, "simulation": simulation.run_simulation}
MERGED_AT_ONCE = 6
PER_CLIENT, RATIO = "later, per client [ms]", "against fewer clients"


def main() -> None:
    """Measure each engine with each number of clients, in processes of their own, and report."""
    parser = options(__doc__.splitlines()[0])
    parser.add_argument("--clients", type=int, nargs="+", default=[10, 100, 1000], help="numbers of clients")
    parser.add_argument("--engines", nargs="+", choices=ENGINES, default=list(ENGINES), help="who calls the clients")
    parser.add_argument("--rounds", type=int, default=2, help="rounds; the first, which starts workers, is apart")
    parser.add_argument("--alone", help="used by this script: the settings of one measurement, as JSON")
    chosen = parser.parse_args()
    if chosen.alone:
        wanted = json.loads(chosen.alone)
        ENGINES[wanted.pop("engine")](laptop(chosen.profile, **wanted))
        return
    again = {(name, count) for name in chosen.engines for count in chosen.clients}
    rows = [row for row in kept(chosen.out) if (row["engine"], row["clients"]) not in again]
    with tempfile.TemporaryDirectory() as folder:
        for count in chosen.clients:
            episodes = repeated(laptop(chosen.profile), count, Path(folder) / f"for_{count}")
            for name in chosen.engines:
                settings = light(episodes, count, chosen.rounds, Path(folder) / f"{name}_{count}")
                rows.append({"engine": name, "clients": count, **measure({"engine": name, **settings}, chosen.profile)})
                report("scale", compared(rows), chosen.out)  # each time: the last are long, what is known is kept


def kept(out: Path) -> list[dict[str, object]]:
    """Return the rows of an earlier call on a machine like this one."""
    file = out / "scale.json"
    earlier = json.loads(file.read_text()) if file.is_file() else {"machine": machine(), "rows": []}
    return earlier["rows"] if earlier["machine"] == machine() else []


def compared(rows: list[dict[str, object]]) -> list[dict[str, object]]:
    """Sort rows by engine and clients, and set each one's cost by client against that of the row with fewer clients.

    One is a flat cost; ten times the clients at a cost that grows with their square would give ten.
    """
    whole, before = [], {}
    for row in sorted(rows, key=lambda row: (list(ENGINES).index(row["engine"]), row["clients"])):
        cost = row[PER_CLIENT]
        ratio = cost / before[row["engine"]] if row["engine"] in before else None
        whole.append({**row, RATIO: ratio})
        before[row["engine"]] = cost
    return whole


def repeated(config: Config, count: int, folder: Path) -> Path:
    """Write a data set that repeats the profile's recording until `count` clients have an episode to train on."""
    path, k = Path(recordings.resolve(config)), 0
    wanted = count + len(task_names(config))  # of each task one is held out
    while (have := LeRobotDataset("local/part", root=path)).num_episodes < wanted:
        times = min(MERGED_AT_ONCE, -(-wanted // have.num_episodes))
        k += 1
        path = folder / f"data_{k}"
        merge_datasets([have] * times, f"local/merged_{k}", path)
        _say_where_episodes_are(path)
    return path


def _say_where_episodes_are(root: Path) -> None:
    """Correct each episode's note of the metadata file it is in, which LeRobot's merge leaves wrong."""
    for file in root.glob("meta/episodes/chunk-*/file-*.parquet"):
        chunk, number = (int(name.split("-")[1]) for name in (file.parent.name, file.stem))
        table = pd.read_parquet(file)
        table["meta/episodes/chunk_index"], table["meta/episodes/file_index"] = chunk, number
        table.to_parquet(file)


def light(episodes: Path, count: int, rounds: int, out: Path) -> dict[str, object]:
    """Return settings under which clients do one local step, and nobody drives the arm.

    Pictures are jittered, which turns the store of prefixes off: for one step a client it is more work than it saves.
    """
    return {
        "data": str(episodes), "num_clients": count, "num_server_rounds": rounds, "fraction_train": 1.0,
        "fraction_evaluate": 0.0, "local_steps": 1, "eval_rollouts": 0, "eval_every": 0, "client_rollouts": 0,
        "val_fraction": 1e-4, "augment": True, "out": str(out),
    }  # fmt: skip


def measure(settings: dict, profile: str) -> dict[str, float]:
    """Run one federation in processes of its own; return seconds of its rounds and the most memory they held."""
    environment = {**os.environ, MARK: (mark := uuid.uuid4().hex)}
    command = [sys.executable, __file__, "--profile", profile, "--alone", json.dumps(settings)]
    process = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    peaks = [0.0]
    done = threading.Event()
    watcher = threading.Thread(target=_watch, args=(mark, peaks, done))
    watcher.start()
    _, said = process.communicate()
    done.set()
    watcher.join()
    if process.returncode:
        raise RuntimeError(f"{settings['engine']} with {settings['num_clients']} clients: {said.splitlines()[-1]}")
    (run,) = Path(settings["out"]).glob("*/")
    first, *later = round_seconds(run)
    warm, count = statistics.median(later), settings["num_clients"]
    return {
        "first round [s]": first, "later rounds [s]": warm, "peak memory [MB]": max(peaks),
        PER_CLIENT: 1000 * warm / count,
    }  # fmt: skip


def round_seconds(run: Path) -> list[float]:
    """Return how long each round took, from the end of the one before to its own."""
    events = read_events(run)
    measured = [event for event in events if (event["who"], event["kind"]) == (GLOBAL, "evaluate")]
    ends = [datetime.fromisoformat(event["time"]) for event in measured]
    return [(end - begin).total_seconds() for begin, end in zip(ends, ends[1:], strict=False)]


def _watch(mark: str, peaks: list[float], done: threading.Event) -> None:
    while not done.wait(1.0):
        peaks.append(sum(_memory_mb(process, mark) for process in psutil.process_iter()))


def _memory_mb(process: psutil.Process, mark: str) -> float:
    """Return a marked process's memory, its part of what it shares with others included once; else 0."""
    try:
        if process.environ().get(MARK) != mark:
            return 0.0
        held = process.memory_full_info()
    except (psutil.Error, OSError):  # it ended meanwhile, or is not ours to look into
        return 0.0
    return getattr(held, "pss", held.uss) / 1e6


if __name__ == "__main__":
    start(main)
