"""Shared by all benchmarks: options, the recording, timing, and the JSON report.

Each script measures both sides in one run on one machine and prints their ratio. The speed of the machine cancels in
the ratio; other load does not, so run nothing else.
"""

import argparse
import json
import platform
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path

from fedvla_lib.cli.main import EXPECTED
from fedvla_lib.config import PROFILES, Config, from_profile, granted_cores
from fedvla_lib.data import recordings
from fedvla_lib.data.frame_store import FrameStore, open_store
from fedvla_lib.files import write_json

RESULTS = Path(__file__).parent / "results"


def options(text: str) -> argparse.ArgumentParser:
    """Return a parser with the options of all benchmarks."""
    parser = argparse.ArgumentParser(description=text, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("--profile", default="laptop", choices=list(PROFILES), help="profile of model and data")
    parser.add_argument("--repeats", type=int, default=5, help="measurements on each side; the median is reported")
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder for the JSON file")
    return parser


def start(main: Callable[[], None]) -> None:
    """Run a script; bad input ends it with one line on stderr and exit status 1."""
    try:
        main()
    except EXPECTED as error:
        sys.exit(f"{Path(sys.argv[0]).name}: {' '.join(str(error).split())}")


def recording(config: Config) -> FrameStore:
    """Return the frames of the profile's recording, recorded now if it is not cached."""
    return open_store(recordings.resolve(config), image_size=config.image_size)


def laptop(profile: str, **overrides: object) -> Config:
    """Return the profile's settings on one thread, so that cores equal processes."""
    return from_profile(profile, **{"num_threads": 1, **overrides})


def median_seconds(work: Callable[[], object], repeats: int) -> float:
    """Return the median wall time of `work` over `repeats` calls, after one warm-up call."""
    work()
    return statistics.median(timed(work) for _ in range(repeats))


def timed(work: Callable[[], object]) -> float:
    """Return the wall time of one call in seconds."""
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


def report(name: str, rows: list[dict[str, object]], out: Path) -> None:
    """Print the rows and write them with a description of the machine to `out/name.json`."""
    for row in rows:
        print("  ".join(f"{key}: {value:.4g}" if isinstance(value, float) else f"{key}: {value}"
                        for key, value in row.items()))  # fmt: skip
    write_json(out / f"{name}.json", {"machine": machine(), "rows": json.loads(json.dumps(rows))})
    print(f"-> {name}.json")


def machine() -> dict[str, object]:
    """Return the description of the machine stored with results."""
    return {"cores": granted_cores(), "python": platform.python_version(), "system": platform.system()}
