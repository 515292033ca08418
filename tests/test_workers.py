"""Work side by side: results as in one process, and nothing left after an error or Ctrl-C."""

import os
import signal
import subprocess
import sys
import time
from functools import partial

import psutil
import pytest
import torch

from conftest import heed_interrupts
from fedvla_lib import workers

pytestmark = pytest.mark.integration
INTERRUPTED = """
import os, sys, time
from fedvla_lib import workers
def work(item):
    open(f"{sys.argv[1]}/{item}", "w").write(str(os.getpid()))
    time.sleep(60)
if __name__ == "__main__":
    sys.path.insert(0, os.path.dirname(__file__))
    list(workers.side_by_side(work, range(3), 2, preload=()))
"""

UNGUARDED = """
import sys
from fedvla_lib.data.record import record
record(["lift"], 30, sys.argv[1], image_size=16, progress=False)
"""


def square(number: int) -> tuple[int, int, int, str]:
    return number**2, os.getpid(), torch.get_num_threads(), os.environ["FEDVLA_JOBS"]


def slow_if_even(number: int) -> int:
    if number % 2:
        raise ValueError(f"{number} is odd")
    time.sleep(30)
    return number


def in_a_moment(number: int) -> int:
    time.sleep(0.5)
    return os.getpid()


def shifted(weights: torch.Tensor, number: int) -> float:
    return float((weights + number).sum())


@pytest.mark.parametrize("jobs", [1, 2])
def test_every_item_has_its_result(jobs):
    found = dict(workers.side_by_side(square, list(range(5)), jobs))
    assert {item: result[0] for item, result in found.items()} == {i: i * i for i in range(5)}
    assert jobs > 1 or list(found) == list(range(5))
    processes = {result[1] for result in found.values()}
    assert (processes == {os.getpid()}) == (jobs == 1) and len(processes) == jobs
    assert jobs == 1 or {result[2:] for result in found.values()} == {(1, "1")}


def test_this_process_works_while_the_others_start():
    found = dict(workers.side_by_side(in_a_moment, list(range(10)), 2, preload=(), here=True))
    assert sorted(found) == list(range(10)) and len(set(found.values())) == 2
    assert found[2] == os.getpid() not in (found[0], found[1])  # the first go to the other process


def test_arrays_of_torch_reach_every_worker():
    work = partial(shifted, torch.ones(10_000))
    assert dict(workers.side_by_side(work, [0, 1, 2], 2)) == {0: 10_000.0, 1: 20_000.0, 2: 30_000.0}


def test_an_error_is_raised_at_once_and_ends_the_others():
    began = time.monotonic()
    with pytest.raises(ValueError, match="1 is odd"):
        list(workers.side_by_side(slow_if_even, [0, 1, 2, 4], 2, preload=()))
    assert time.monotonic() - began < 25
    assert not [child for child in psutil.Process().children(recursive=True) if "slow_if_even" in str(child.cmdline())]


@pytest.mark.parametrize("sign", [signal.SIGINT, signal.SIGKILL])
def test_workers_end_with_their_parent(tmp_path, sign):
    script = tmp_path / "interrupted.py"
    script.write_text(INTERRUPTED)
    command = [sys.executable, script, tmp_path]
    parent = subprocess.Popen(command, stderr=subprocess.DEVNULL, preexec_fn=heed_interrupts)
    while len(list(tmp_path.glob("[01]"))) < 2 or not all(p.read_text() for p in tmp_path.glob("[01]")):
        assert parent.poll() is None
        time.sleep(0.05)
    children = [int(path.read_text()) for path in tmp_path.glob("[01]")]
    parent.send_signal(sign)
    parent.wait(20)
    deadline = time.monotonic() + 10
    while any(psutil.pid_exists(pid) for pid in children):
        assert time.monotonic() < deadline, "a worker outlived its parent"
        time.sleep(0.1)
    assert not (tmp_path / "2").exists()


def test_a_script_that_workers_would_start_again_is_told_so_and_ends(tmp_path):
    """They import it, so a call outside `if __name__ == "__main__":` would wait for the lock of the script itself."""
    (tmp_path / "unguarded.py").write_text(UNGUARDED)
    command = [sys.executable, tmp_path / "unguarded.py", tmp_path / "recording"]
    environment = {**os.environ, "FEDVLA_JOBS": "2"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 1 and "put its calls below if __name__ == '__main__':" in done.stderr


def test_the_number_of_jobs_is_set_by_the_environment_or_the_machine(monkeypatch):
    monkeypatch.setenv("FEDVLA_JOBS", "5")
    assert workers.default_jobs() == workers.default_jobs("cuda") == 5
    monkeypatch.delenv("FEDVLA_JOBS")
    assert 1 <= workers.default_jobs() <= workers.granted_cores()
    assert workers.default_jobs("cuda") == 1
    for wrong in ("0", "two", "-1"):
        monkeypatch.setenv("FEDVLA_JOBS", wrong)
        with pytest.raises(ValueError, match=f"FEDVLA_JOBS='{wrong}' is not usable"):
            workers.default_jobs()
