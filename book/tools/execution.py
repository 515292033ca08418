"""Execute the chapters that changed, and find the executed copies again.

Jupyter Book's execution cache ignores changes of the library. Here a chapter is executed again if its key changes,
which covers notebook, library, requirements.lock and profile. papermill executes it with the profile as parameter.
"""

import argparse
import hashlib
import json
import math
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from graphlib import TopologicalSorter
from pathlib import Path
from typing import Any

import nbformat
import papermill
import yaml
from papermill.exceptions import PapermillExecutionError

import status
from fedvla_lib.config import PROFILES
from fedvla_lib.workers import processes

PACKAGES = ("fedvla_lib", "book/fedvla_book")  # what chapters import
REFERENCE = re.compile(rb"\.\./book/reference/\w+")  # a folder of stored results in a chapter's code
COSTS = "book/reference/costs"  # kept by keep_costs.py
CELL_TIMEOUT_S = {"tiny": 300, "laptop": 1800, "gpu": None}


class BookError(ValueError):
    """The book cannot be built; the message is one line and names the chapter or page."""


@dataclass(frozen=True)
class Chapter:
    """One executed notebook: its file, key and execution time."""

    name: str
    executed: Path
    key: str
    seconds: float
    reused: bool


def library_key(root: Path, profile: str) -> str:
    """Return a digest of all that a chapter's results depend on, except the notebook."""
    packages = [path for name in PACKAGES for path in (root / name).rglob("*") if "__pycache__" not in path.parts]
    files = [*sorted(packages), root / "requirements.lock"]
    return digest([profile.encode(), *(named_bytes(root, path) for path in files if path.is_file())])


def notebook_key(notebook: Path, library: str) -> str:
    """Return the digest of `notebook`, the library and the stored results that it reads."""
    source = notebook.read_bytes()
    folders = sorted({notebook.parent / name.decode() for name in REFERENCE.findall(source)})
    files = [path for folder in folders for path in sorted(folder.rglob("*")) if path.is_file()]
    stored = [named_bytes(notebook.parent.parent, path.resolve()) for path in files]
    return digest([library.encode(), notebook.name.encode(), source, *stored])


def named_bytes(root: Path, path: Path) -> bytes:
    """Return a file's path below `root` and its content."""
    return path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes()


def digest(parts: Iterable[bytes]) -> str:
    """Return the digest of a list of contents."""
    whole = hashlib.sha256()
    for part in parts:
        whole.update(hashlib.sha256(part).digest())  # of fixed length, so that no two lists collide
    return whole.hexdigest()


def toc_pages(root: Path) -> list[str]:
    """Return the pages of the table of contents, in order and without suffix."""
    toc = yaml.safe_load((root / "_toc.yml").read_text(encoding="utf-8"))
    return [toc["root"], *_files_under({key: value for key, value in toc.items() if key != "root"})]


def notebooks_of(root: Path) -> list[Path]:
    """Return the notebooks of the chapters, in the order of the table of contents."""
    return [path for page in toc_pages(root) if (path := root / f"{page}.ipynb").is_file()]


def executed_folder(root: Path, profile: str) -> Path:
    """Return the folder of the chapters' executed copies."""
    return root / "_build" / profile / "executed"


def add_profile(parser: argparse.ArgumentParser) -> None:
    """Add the option of the profile that chapters are executed with."""
    parser.add_argument("--profile", default=os.environ.get("FEDVLA_PROFILE", "laptop"), choices=list(PROFILES))


def _files_under(node: object) -> list[str]:
    if isinstance(node, list):
        return [name for item in node for name in _files_under(item)]
    if not isinstance(node, dict):
        return []
    own = [node["file"]] if "file" in node else []
    return own + [name for value in node.values() for name in _files_under(value)]


def check_parameters(notebook: Path, parameters: dict[str, object]) -> None:
    """Raise BookError if the parameters cell of `notebook` lacks a parameter; papermill only warns."""
    known = papermill.inspect_notebook(str(notebook))
    for name in parameters:
        if name not in known:
            raise BookError(f"{notebook.name} has no parameter {name!r}: its parameters cell has {sorted(known)}")


def reuse(notebook: Path, folder: Path, library: str) -> Chapter | None:
    """Return the executed copy of `notebook` in `folder` if its key is unchanged, else None."""
    target, key = folder / notebook.name, notebook_key(notebook, library)
    if not target.is_file() or (stamp := _metadata(target)).get("key") != key:
        return None
    return Chapter(notebook.stem, target, key, stamp["seconds"], reused=True)


def execute(
    notebook: Path, folder: Path, profile: str, library: str, at_a_time: int = 1, inside: Path | None = None
) -> Chapter:
    """Execute `notebook` with `profile` and write the executed copy to `folder`.

    Args:
        at_a_time: number of chapters executed in parallel, for the status page.
        inside: an unpacked book, whose copy of the notebook is executed; None: the notebook, in its folder.

    Raises:
        BookError: a parameter is missing or a cell failed; the message names the copy that shows the failure.
    """
    target, key = folder / notebook.name, notebook_key(notebook, library)
    parameters = {"profile": profile}
    check_parameters(notebook, parameters)
    environment = status.environment(notebook, profile)
    copy = inside / "notebooks" / notebook.name if inside else notebook
    seconds = _execute(copy, target, parameters, has_bar=at_a_time == 1 and sys.stderr.isatty())
    cost = {"seconds": round(seconds, 1), "at_a_time": at_a_time}
    _finish(target, {"key": key, "profile": profile, **cost, "environment": environment})
    return Chapter(notebook.stem, target, key, seconds, reused=False)


def _metadata(notebook: Path) -> dict:
    return nbformat.read(notebook, as_version=4).metadata.get("fedvla", {})


def log_of(target: Path) -> Path:
    """Return the file with all that the cells of an executed copy print, progress bars too, as they run."""
    return target.parents[1] / "logs" / f"{target.stem}.log"


def _execute(notebook: Path, target: Path, parameters: dict[str, object], has_bar: bool) -> float:
    """Run `notebook` in its folder, as nbmake and readers do; return the wall time in seconds."""
    start = time.monotonic()
    for folder in (target.parent, log_of(target).parent):
        folder.mkdir(parents=True, exist_ok=True)
    target.unlink(missing_ok=True)
    try:
        with open(log_of(target), "w", encoding="utf-8") as log:
            papermill.execute_notebook(
                str(notebook), str(_unfinished(target)), parameters=parameters, cwd=str(notebook.parent),
                kernel_name="python3", progress_bar=has_bar, stdout_file=log, stderr_file=log,
                execution_timeout=CELL_TIMEOUT_S[str(parameters["profile"])],
                extra_arguments=["--log-level=CRITICAL"],  # silences log messages of kernels; cells still show errors
            )  # fmt: skip
    except PapermillExecutionError as error:
        copy = os.path.relpath(_unfinished(target))
        raise BookError(f"{notebook.name}: {error.ename}: {error.evalue.strip()} (see {copy})") from error
    return time.monotonic() - start


def _unfinished(target: Path) -> Path:
    return target.with_name(f"{target.stem}.unfinished.ipynb")


def _finish(target: Path, stamp: dict[str, object]) -> None:
    """Turn papermill's output into the rendered copy, without the injected cell and local paths."""
    notebook = nbformat.read(_unfinished(target), as_version=4)
    notebook.cells = [cell for cell in notebook.cells if "injected-parameters" not in cell.metadata.get("tags", [])]
    notebook.metadata.pop("papermill", None)
    for cell in notebook.cells:
        cell.metadata.pop("papermill", None)
    notebook.metadata["fedvla"] = stamp
    nbformat.write(notebook, _unfinished(target))
    os.replace(_unfinished(target), target)


def execute_chapters(
    root: Path, profile: str, only: str = "", prepare: Callable[[str], None] = lambda profile: None, jobs: int = 1,
    inside: Path | None = None,
) -> list[Chapter]:  # fmt: skip
    """Execute the changed chapters of the table of contents whose name contains `only`, and print their times.

    Args:
        prepare: called with the profile if any chapter has to be executed, before the first.
        jobs: chapters executed at a time; one that uses another's run (``fedvla.after`` in its metadata) waits for it.
        inside: an unpacked book whose copies are executed.
    """
    library, folder = library_key(root, profile), executed_folder(root, profile)
    notebooks = [path for path in notebooks_of(root) if only in path.stem]
    if not notebooks:
        raise BookError(f"no chapter in _toc.yml has {only!r} in its name")
    chapters = {path: None if inside else reuse(path, folder, library) for path in notebooks}
    changed = [path for path in notebooks if chapters[path] is None]
    if changed:
        prepare(profile)
    place = {path: f"[{number}/{len(notebooks)}] {path.stem}" for number, path in enumerate(notebooks, start=1)}
    for path in notebooks:
        if chapters[path]:
            print(f"{place[path]}: {_cost(chapters[path])}", flush=True)
    needed = {path: {path.with_stem(name) for name in _metadata(path).get("after", [])} for path in changed}
    work = partial(_announced, place, folder=folder, profile=profile, library=library, at_a_time=jobs, inside=inside)
    order = _longest_first(changed, needed, root / COSTS / f"{profile}.json") if jobs > 1 else changed
    for path, chapter in _one_after_another(work, order, jobs, needed):
        chapters[path] = chapter
        print(f"{place[path]}: {_cost(chapters[path])}", flush=True)
    return list(chapters.values())


def _longest_first(notebooks: list[Path], needed: dict[Path, set[Path]], costs: Path) -> list[Path]:
    """Return chapters that others wait for, then the rest, the longest first by their kept costs.

    The shortest is the second, while the first computes what most chapters find in the cache.
    """
    kept = json.loads(costs.read_text(encoding="utf-8"))["chapters"] if costs.is_file() else {}
    awaited = set().union(*needed.values())
    seconds = {path: kept.get(path.stem, {}).get("seconds") or math.inf for path in notebooks}
    longest = sorted(notebooks, key=lambda path: (path not in awaited, -seconds[path]))
    return [*longest[:1], *longest[-1:], *longest[1:-1]] if len(longest) > 1 else longest


def _one_after_another(
    work: Callable[[Path], Chapter], notebooks: list[Path], jobs: int, needed: dict[Path, set[Path]]
) -> Iterator[tuple[Path, Chapter]]:
    """Yield each notebook and its chapter as they complete, `jobs` at a time, each after those that it needs."""
    order = TopologicalSorter({path: needed[path] & set(notebooks) for path in notebooks})
    order.prepare()
    jobs, ready, running = min(jobs, len(notebooks)), [], {}
    with processes(jobs, preload=()) if jobs > 1 else nullcontext() as pool:
        while order.is_active():
            ready = sorted([*ready, *order.get_ready()], key=notebooks.index)
            while ready and len(running) < max(1, jobs):
                path = ready.pop(0)
                running[pool.submit(work, path) if pool else _here(work, path)] = path
            for done in wait(running, return_when=FIRST_COMPLETED).done:
                path = running.pop(done)
                yield path, done.result()
                order.done(path)


def _here(work: Callable[[Path], Chapter], notebook: Path) -> Future:
    """Execute a notebook in this process."""
    done: Future = Future()
    done.set_result(work(notebook))
    return done


def _announced(place: dict[Path, str], notebook: Path, profile: str, **options: Any) -> Chapter:
    log = os.path.relpath(log_of(options["folder"] / notebook.name))
    print(f"{place[notebook]}, profile {profile}, log in {log} ...", flush=True)
    return execute(notebook, profile=profile, **options)


def record_data(profile: str) -> None:
    """Record the demonstrations that the chapters share, so that recording does not count towards a chapter's time."""
    command = [sys.executable, "-m", "fedvla_lib.cli", "record", "--profile", profile]
    if subprocess.run(command, check=False).returncode:
        raise BookError("the demonstrations could not be recorded")


def _cost(chapter: Chapter) -> str:
    return f"unchanged, took {chapter.seconds:.0f} s" if chapter.reused else f"executed in {chapter.seconds:.0f} s"
