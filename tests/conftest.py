"""What all tests share: a quiet, offline, single-threaded process, its own cache, and one small recording."""

import os
import signal

# Before the first import of torch, MuJoCo or the hub's client: each reads its variables once.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("HF_HUB_OFFLINE", "1")
os.environ.setdefault("FLWR_TELEMETRY_ENABLED", "0")
os.environ.setdefault("FLWR_DISABLE_UPDATE_CHECK", "1")
os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
os.environ.setdefault("TOKENIZERS_PARALLELISM", "false")
os.environ.setdefault("MPLBACKEND", "agg")

from collections.abc import Iterator
from pathlib import Path

import pytest

TASKS = ["lift", "place", "push"]
EPISODES_PER_TASK = 4
IMAGE_SIZE = 64


def heed_interrupts() -> None:
    """For a child process: what a shell starts in the background inherits that Ctrl-C is ignored."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


@pytest.fixture(scope="session", autouse=True)
def cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """An empty cache for this run of the tests, so that nothing on the machine decides what they see."""
    folder = tmp_path_factory.mktemp("cache")
    before = os.environ.get("FEDVLA_CACHE")
    os.environ["FEDVLA_CACHE"] = str(folder)
    yield folder
    if before is None:
        os.environ.pop("FEDVLA_CACHE")
    else:
        os.environ["FEDVLA_CACHE"] = before


@pytest.fixture(scope="session", autouse=True)
def one_thread() -> None:
    """More torch threads than free cores make every step many times slower."""
    import torch

    torch.set_num_threads(int(os.environ["OMP_NUM_THREADS"]))


@pytest.fixture(scope="session")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A real recording of 3 tasks x 4 episodes at 64 pixels, made once. Copy it before damaging it."""
    from fedvla_lib.record import record

    root = tmp_path_factory.mktemp("recording") / "data"
    return record(TASKS, EPISODES_PER_TASK, root, image_size=IMAGE_SIZE, progress=False)


@pytest.fixture(scope="session")
def store(recording: Path):
    """The frames of `recording`."""
    from fedvla_lib.store import open_store

    return open_store(recording, image_size=IMAGE_SIZE, progress=False)
