"""Time and memory of a round with 10, 100 and 1,000 clients: inline, and on Flower's simulation runtime.

    python benchmarks/scale.py --profile tiny

Every client trains in every round, on one episode. The profile's recording is repeated until there is an episode for
each client. Measured rows replace those of the same engine and number of clients; the others are kept if they are from
a machine like this one.
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

MARK = "FEDVLA_BENCHMARK"  # environment variable that marks the processes of one measurement
ENGINES = {"inline": inline.run_inline, "simulation": simulation.run_simulation}
MERGED_AT_ONCE = 6
PER_CLIENT, RATIO = "later, per client [ms]", "against fewer clients"


def main() -> None:
    """Measure each engine with each number of clients, in separate processes, and report."""
    parser = options(__doc__.splitlines()[0])
    parser.add_argument("--clients", type=int, nargs="+", default=[10, 100, 1000], help="numbers of clients")
    parser.add_argument("--engines", nargs="+", choices=ENGINES, default=list(ENGINES), help="engines")
    parser.add_argument(
        "--rounds", type=int, default=2, help="rounds; the first, which starts workers, is reported separately"
    )
    parser.add_argument("--alone", help="used internally: the settings of one measurement, as JSON")
    chosen = parser.parse_args()
    if chosen.alone:
        settings = json.loads(chosen.alone)
        ENGINES[settings.pop("engine")](laptop(chosen.profile, **settings))
        return
    again = {(name, count) for name in chosen.engines for count in chosen.clients}
    rows = [row for row in kept(chosen.out) if (row["engine"], row["clients"]) not in again]
    with tempfile.TemporaryDirectory() as folder:
        for count in chosen.clients:
            episodes = repeated(laptop(chosen.profile), count, Path(folder) / f"for_{count}")
            for name in chosen.engines:
                settings = light(episodes, count, chosen.rounds, Path(folder) / f"{name}_{count}")
                rows.append({"engine": name, "clients": count, **measure({"engine": name, **settings}, chosen.profile)})
                report("scale", compared(rows), chosen.out)  # each time, because the last rows take long


def kept(out: Path) -> list[dict[str, object]]:
    """Return the rows of an earlier call on a machine like this one."""
    file = out / "scale.json"
    earlier = json.loads(file.read_text()) if file.is_file() else {"machine": machine(), "rows": []}
    return earlier["rows"] if earlier["machine"] == machine() else []


def compared(rows: list[dict[str, object]]) -> list[dict[str, object]]:
    """Sort rows by engine and clients, and add each one's cost per client relative to the row with fewer clients.

    1 is a constant cost per client; with ten times the clients, a quadratic cost would give 10.
    """
    table, before = [], {}
    for row in sorted(rows, key=lambda row: (list(ENGINES).index(row["engine"]), row["clients"])):
        cost = row[PER_CLIENT]
        ratio = cost / before[row["engine"]] if row["engine"] in before else None
        table.append({**row, RATIO: ratio})
        before[row["engine"]] = cost
    return table


def repeated(config: Config, count: int, folder: Path) -> Path:
    """Write a data set that repeats the profile's recording until `count` clients have an episode to train on."""
    path, k = Path(recordings.resolve(config)), 0
    wanted = count + len(task_names(config))  # one episode per task is held out
    while (have := LeRobotDataset("local/part", root=path)).num_episodes < wanted:
        times = min(MERGED_AT_ONCE, -(-wanted // have.num_episodes))
        k += 1
        path = folder / f"data_{k}"
        merge_datasets([have] * times, f"local/merged_{k}", path)
        _correct_file_index(path)
    return path


def _correct_file_index(root: Path) -> None:
    """Correct the metadata file index of each episode, which LeRobot's merge leaves wrong."""
    for file in root.glob("meta/episodes/chunk-*/file-*.parquet"):
        chunk, number = (int(name.split("-")[1]) for name in (file.parent.name, file.stem))
        table = pd.read_parquet(file)
        table["meta/episodes/chunk_index"], table["meta/episodes/file_index"] = chunk, number
        table.to_parquet(file)


def light(episodes: Path, count: int, rounds: int, out: Path) -> dict[str, object]:
    """Return settings with one local step per client and no rollouts.

    Image augmentation disables the prefix cache, which for one step per client costs more than it saves.
    """
    return {
        "data": str(episodes), "num_clients": count, "num_server_rounds": rounds, "fraction_train": 1.0,
        "fraction_evaluate": 0.0, "local_steps": 1, "eval_rollouts": 0, "eval_every": 0, "client_rollouts": 0,
        "val_fraction": 1e-4, "augment": True, "out": str(out),
    }  # fmt: skip


def measure(settings: dict, profile: str) -> dict[str, float]:
    """Run one federation in separate processes; return the seconds of its rounds and peak memory."""
    environment = {**os.environ, MARK: (mark := uuid.uuid4().hex)}
    command = [sys.executable, __file__, "--profile", profile, "--alone", json.dumps(settings)]
    process = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    peaks = [0.0]
    done = threading.Event()
    watcher = threading.Thread(target=_watch, args=(mark, peaks, done))
    watcher.start()
    _, stderr = process.communicate()
    done.set()
    watcher.join()
    if process.returncode:
        raise RuntimeError(f"{settings['engine']} with {settings['num_clients']} clients: {stderr.splitlines()[-1]}")
    (run,) = Path(settings["out"]).glob("*/")
    first, *later = round_seconds(run)
    warm, count = statistics.median(later), settings["num_clients"]
    return {
        "first round [s]": first, "later rounds [s]": warm, "peak memory [MB]": max(peaks),
        PER_CLIENT: 1000 * warm / count,
    }  # fmt: skip


def round_seconds(run: Path) -> list[float]:
    """Return the seconds of each round, from the end of the previous one to its own."""
    events = read_events(run)
    measured = [event for event in events if (event["who"], event["kind"]) == (GLOBAL, "evaluate")]
    ends = [datetime.fromisoformat(event["time"]) for event in measured]
    return [(end - begin).total_seconds() for begin, end in zip(ends, ends[1:], strict=False)]


def _watch(mark: str, peaks: list[float], done: threading.Event) -> None:
    while not done.wait(1.0):
        peaks.append(sum(_memory_mb(process, mark) for process in psutil.process_iter()))


def _memory_mb(process: psutil.Process, mark: str) -> float:
    """Return a marked process's memory in MB, shared pages counted proportionally (PSS); 0 for other processes."""
    try:
        if process.environ().get(MARK) != mark:
            return 0.0
        memory = process.memory_full_info()
    except (psutil.Error, OSError):  # it has ended, or access is denied
        return 0.0
    return getattr(memory, "pss", memory.uss) / 1e6


if __name__ == "__main__":
    start(main)
