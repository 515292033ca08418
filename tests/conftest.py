"""What all tests share: a quiet, offline, single-threaded process, its own cache, and one small recording."""

import json
import os
import shutil
import signal
import sys
import time

# Before the first import of torch, MuJoCo or the hub's client: each reads its variables once.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("FEDVLA_JOBS", "1")  # tests run side by side already
os.environ.setdefault("HF_HUB_OFFLINE", "1")
os.environ.setdefault("FLWR_TELEMETRY_ENABLED", "0")
os.environ.setdefault("FLWR_DISABLE_UPDATE_CHECK", "1")
os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
os.environ.setdefault("TOKENIZERS_PARALLELISM", "false")
os.environ.setdefault("MPLBACKEND", "agg")

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

TASKS = ["lift", "place", "push"]
EPISODES_PER_TASK = 4
IMAGE_SIZE = 64


def heed_interrupts() -> None:
    """For a child process: what a shell starts in the background, or nohup, inherits that these are ignored."""
    for sign in (signal.SIGINT, signal.SIGHUP):
        signal.signal(sign, signal.SIG_DFL)


def wait_for_interrupted(root: Path) -> None:
    """Return once a run whose server was ended reads so: that server is no child of this process, and takes a moment.

    Nobody was left to say so in the stamp itself.
    """
    from fedvla_lib import run_folder

    deadline = time.monotonic() + 30
    while (status := run_folder.read_stamp(root)["status"]) == "running" and time.monotonic() < deadline:
        time.sleep(0.1)
    assert status == "interrupted" and json.loads((root / "stamp.json").read_text())["status"] == "running"


@pytest.fixture
def faulty(monkeypatch: pytest.MonkeyPatch) -> None:
    """Flower's engines run the ClientApp of `faulty.py` in place of the library's."""
    from fedvla_lib.engines import app_bundle

    stage = app_bundle.stage_app

    def stage_faulty(folder: Path, config) -> Path:
        app = stage(folder, config)
        shutil.copy(Path(__file__).with_name("faulty.py"), app)
        project = app / "pyproject.toml"
        told = project.read_text().replace("fedvla_lib.federation.client_app:app", "faulty:app")
        project.write_text(told.replace("fab-include = [", 'fab-include = ["faulty.py", '))
        return app

    monkeypatch.setattr(app_bundle, "stage_app", stage_faulty)


def assert_faults_were_survived(root: Path, config) -> None:
    """A run of the faulty app left out what was wrong, by name and reason, and ended as on the inline engine."""
    import numpy as np
    from safetensors.numpy import load_file

    from faulty import app
    from fedvla_lib import run_folder
    from fedvla_lib.engines.inline import run_inline

    rejected, trained = (run_folder.read_metrics(root, kind) for kind in ("rejected", "train"))
    found = rejected[["round", "who", "to", "reason"]].values.tolist()
    assert found == [[1, "client_0", "train", "error"], [2, "client_1", "train", "non-finite"]]
    assert "no space left on device" in rejected.detail[0]
    everybody = {f"client_{k}" for k in range(config.num_clients)}
    assert trained.groupby("round").who.agg(set).tolist() == [everybody - {"client_0"}, everybody - {"client_1"}]
    inline = run_inline(config, clients_app=app, progress=False)
    left, right = (load_file(one / "global_model/round_2/model.safetensors") for one in (root, inline))
    assert left.keys() == right.keys() and max(np.abs(left[name] - right[name]).max() for name in left) <= 1e-6


@contextmanager
def short_rollouts() -> Iterator[None]:
    """Rollouts take two simulated seconds, where they are counted and how they end does not matter.

    An expert needs all of its time: recordings have to be there before.
    """
    from fedvla_lib.robot import tasks

    with pytest.MonkeyPatch.context() as patch:
        for name, task in tasks.ALL_TASKS.items():
            patch.setitem(tasks.ALL_TASKS, name, replace(task, horizon_steps=20))
        yield


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files with slow tests first: dealt out last, one of them would keep a worker busy that all others wait for."""
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: item.path not in slow)


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


@pytest.fixture(scope="module")
def warm_python(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """A program that runs a Python script in a process of its own, and need not wait until PyTorch is loaded.

    As Ray's workers are started in `engines`. Where that cannot be, the Python that runs the tests. It ends with a
    module, since others look for a fork server of their own among this process's children.
    """
    from fedvla_lib.engines.warm_start import PYTHON, warm_start

    with warm_start(dict(os.environ), tmp_path_factory.mktemp("warm") / "log") as environment:
        yield shutil.which(PYTHON, path=environment["PATH"]) or sys.executable


@pytest.fixture(scope="session")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A real recording of 3 tasks x 4 episodes at 64 pixels, made once. Copy it before damaging it."""
    from fedvla_lib.data.record import record

    root = tmp_path_factory.mktemp("recording") / "data"
    return record(TASKS, EPISODES_PER_TASK, root, image_size=IMAGE_SIZE, progress=False)


@pytest.fixture(scope="session")
def store(recording: Path):
    """The frames of `recording`."""
    from fedvla_lib.data.frame_store import open_store

    return open_store(recording, image_size=IMAGE_SIZE, progress=False)
