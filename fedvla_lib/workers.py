"""Independent pieces of work side by side, each in a process of its own that computes on one thread.

The results are those of one process, bit for bit: a piece of work depends on its arguments only.
"""

import multiprocessing
import os
import pickle
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, ProcessPoolExecutor, ThreadPoolExecutor, wait
from contextlib import contextmanager
from typing import Any

import psutil

from fedvla_lib.config import granted_cores

GIB_A_JOB = 2.0  # memory of a process that trains or evaluates at nano size
HEAVY = ("lerobot.policies.smolvla",)  # takes seconds to import; not MuJoCo, whose display must not be shared
GRACE_S = 5.0  # to clean up, after its parent was killed
TERMINATED = 143  # exit status after SIGTERM, as shells report it


def default_jobs(device: str = "cpu") -> int:
    """Return ``$FEDVLA_JOBS``, or else one job for each core, as many as free memory allows; one on a GPU.

    Raises:
        RuntimeError: a worker is importing the script that started it, and would start workers of its own.
    """
    if getattr(multiprocessing.current_process(), "_inheriting", False):
        raise RuntimeError("a script's workers import it: put its calls below if __name__ == '__main__':")
    chosen = os.environ.get("FEDVLA_JOBS", "")
    if chosen and not (chosen.isdecimal() and int(chosen)):
        raise ValueError(f"FEDVLA_JOBS={chosen!r} is not usable: give a whole number from 1")
    if chosen or device != "cpu":  # processes would share the GPU
        return int(chosen or 1)
    return max(1, min(granted_cores(), int(psutil.virtual_memory().available / 2**30 / GIB_A_JOB)))


def side_by_side(
    function: Callable[[Any], Any], items: Sequence[Any], jobs: int, preload: Sequence[str] = HEAVY, here: bool = False
) -> Iterator[tuple[Any, Any]]:
    """Yield (item, result) for each item, as they complete; with one job in this process, one after the other.

    Args:
        function: of one item; with several jobs both are pickled, so `function` is defined in a module.
        items: the earlier ones start first.
        jobs: the most processes at a time.
        preload: modules that the processes share, imported once.
        here: this process is one of them, and works while the others start; for pieces that take equally long.

    Raises:
        Exception: what `function` raised, at once; pieces of work that still run are ended.
    """
    if min(jobs, len(items)) <= 1:
        yield from ((item, function(item)) for item in items)
        return
    # Pickled here: PyTorch would put a policy's arrays into shared memory, which goes wrong between two forks.
    work, waiting, running = pickle.dumps(function), list(items), {}
    others = min(jobs, len(items)) - here
    # In threads, since the start of a process blocks.
    with ThreadPoolExecutor(others) as threads, processes(others, preload) as pool:
        while waiting or running:
            while waiting and len(running) < others + here:  # no more: results not yet taken stay in memory
                item = waiting.pop(0)
                running[threads.submit(lambda item=item: pool.submit(_unpickled, work, item).result())] = item
            if here and waiting:
                yield waiting[0], function(waiting.pop(0))
            for done in wait(running, 0 if here and waiting else None, FIRST_COMPLETED).done:
                yield running.pop(done), done.result()


def _unpickled(function: bytes, item: Any) -> Any:
    """Call a pickled function in a worker process."""
    return pickle.loads(function)(item)


@contextmanager
def processes(jobs: int, preload: Sequence[str] = HEAVY) -> Iterator[Executor]:
    """Yield a pool of processes with one thread each; an exception, Ctrl-C too, ends those that still work."""
    # A fork of a process that has only imported starts at once. Not everywhere, and never a fork of this process.
    method = "forkserver" if "forkserver" in multiprocessing.get_all_start_methods() else "spawn"
    context = multiprocessing.get_context(method)
    if method == "forkserver":
        context.set_forkserver_preload(list(preload))
    ended = context.Event()  # reaches a worker that is just starting too, unlike a signal
    with _one_thread():
        pool = ProcessPoolExecutor(jobs, context, _begin, (os.getpid(), ended))
        try:
            yield pool
        except BaseException:
            ended.set()
            raise
        finally:
            pool.shutdown(cancel_futures=True)


@contextmanager
def _one_thread() -> Iterator[None]:
    """Numerical libraries of processes started meanwhile use one thread: they read the variable when they load."""
    before = os.environ.get("OMP_NUM_THREADS")
    os.environ["OMP_NUM_THREADS"] = "1"
    try:
        yield
    finally:
        os.environ.pop("OMP_NUM_THREADS") if before is None else os.environ.update(OMP_NUM_THREADS=before)


def _begin(parent: int, ended: Any) -> None:
    """Prepare a worker process: it leaves Ctrl-C to its parent, cleans up when told to end, and never outlives it."""
    os.environ["FEDVLA_JOBS"] = "1"  # commands that it runs start no processes of their own
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(TERMINATED))
    threading.Thread(target=_end_with, args=(parent, ended), daemon=True).start()


def _end_with(parent: int, ended: Any) -> None:
    while not ended.wait(1.0) and psutil.pid_exists(parent):
        continue
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(GRACE_S)
    os._exit(TERMINATED)  # it cleaned up, and waits for more work
