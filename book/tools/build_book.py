"""Execute the chapters that changed and build the HTML book from the executed copies.

    python book/tools/build_book.py --profile laptop

Jupyter Book's own execution cache looks at a notebook's cells only: after a change of the library it would show old
results. Here a chapter is executed again exactly when its key changes; the key covers notebook, library, lock and
profile. papermill executes it with the profile as an injected parameter; the executed copies and the pages go to
`_build/<profile>/source`, and Jupyter Book builds them from there: execution off, warnings as errors.
"""

import argparse
import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import nbformat
import pandas as pd
import papermill
import yaml
from papermill.exceptions import PapermillExecutionError

import library
import status
from fedvla_book import plots, tables
from fedvla_lib.evaluation import statistics
from fedvla_lib.experiments import results

ROOT = Path(__file__).resolve().parents[2]
PAGE_SUFFIXES = (".md", ".bib", ".png", ".svg", ".jpg", ".css", ".js", ".mp4", ".vtt")
STATUS_PAGE = "book/run_times.md"
STATUS = b"<!-- status -->"  # there: what this build is made of takes this line's place
MODEL_CARD = "book/nano_base.md"  # the page that ends with what was measured of the nano base
FRONT_PAGE = "book/index.md"
HEADLINE = b"<!-- headline -->"  # on the front page: what the comparison found takes this line's place
ARCHITECTURE, MODULES, IMPORTS = "book/architecture.md", b"<!-- modules -->", "book/_static/imports.svg"
FUNCTIONS_PAGE, FUNCTIONS = "book/library.md", b"<!-- functions -->"
FILM = b"<!-- film -->"  # on the front page: the federated policy in this build
FILMED_IN = "05_evaluation_videos"
COMPARISON = "book/reference/comparison"
OUTCOME = "book/_static/outcome.png"  # the figure of it
FEDERATED, POOLED, ALONE, LONGER = (
    "fedavg-200x2x2",
    "centralized",
    "local-only",
    "local-only-800",
)  # methods it tells of
NEARLY_SOLVED = 0.8  # success of labs alone above which their tasks leave little for a federation to add
DEALT = {"iid": "the same mix of tasks in every lab", "dirichlet-0_5": "uneven mixes (Dirichlet, 0.5)",
         "dirichlet-0_1": "very uneven mixes (Dirichlet, 0.1)", "task": "one task a lab",
         "lab": "labs that differ in camera, light and calibration"}  # fmt: skip
ACCOUNT = "fedvla_lib/nano_base/pretraining.json"
TOLD = {"right": "this cube's colour", "other": "the other cube's colour"}
# Pages that end with results of benchmarks that were kept.
RESULTS_ON = {
    MODEL_CARD: ["fine_tuning"],
    "book/reference_runs.md": ["four_methods"],
    "book/speed.md": [
        "local_training", "random_access", "control_steps", "peers", "rollouts", "federation", "floor",
    ],
    "book/scale.md": ["scale"],
}  # fmt: skip
TITLES = {
    "fine_tuning": "what it is worth: each task learned alone from the base, on one core",
    "floor": "the floor",
    "four_methods": "one federation after another, its clients alone with their share of the steps, and centralized",
}
PACKAGES = ("fedvla_lib", "book/fedvla_book")  # what chapters import
BENCHMARKS = "benchmarks/results"
REFERENCE = re.compile(rb"\.\./book/reference/\w+")  # a folder of stored results, as chapters name it
BUILT_FROM = ".built-from"  # beside the pages: the digest of what they were built from
CELL_TIMEOUT_S = {"tiny": 300, "laptop": 1800, "gpu": None}


class BookError(ValueError):
    """The book cannot be built; the message is one line that names the chapter or page."""


@dataclass(frozen=True)
class Chapter:
    """One executed notebook: where it is, what it was made from and what it cost."""

    name: str
    executed: Path
    key: str
    seconds: float
    reused: bool


def library_key(root: Path, profile: str) -> str:
    """Return a digest of everything but the notebook that a chapter's results depend on."""
    packages = [path for name in PACKAGES for path in (root / name).rglob("*") if "__pycache__" not in path.parts]
    files = [*sorted(packages), root / "requirements.lock"]
    return _digest([profile.encode(), *(_named_bytes(root, path) for path in files if path.is_file())])


def notebook_key(notebook: Path, library: str) -> str:
    """Return the digest that decides whether `notebook` has to be executed again: it, the library, what it reads."""
    source = notebook.read_bytes()
    folders = sorted({notebook.parent / name.decode() for name in REFERENCE.findall(source)})
    files = [path for folder in folders for path in sorted(folder.rglob("*")) if path.is_file()]
    stored = [_named_bytes(notebook.parent.parent, path.resolve()) for path in files]
    return _digest([library.encode(), notebook.name.encode(), source, *stored])


def _named_bytes(root: Path, path: Path) -> bytes:
    return path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes()


def _digest(parts: Iterable[bytes]) -> str:
    whole = hashlib.sha256()
    for part in parts:
        whole.update(hashlib.sha256(part).digest())  # fixed length each, so that no two lists collide
    return whole.hexdigest()


def toc_pages(root: Path) -> list[str]:
    """Return the pages of the table of contents, in order and without suffix."""
    toc = yaml.safe_load((root / "_toc.yml").read_text(encoding="utf-8"))
    return [toc["root"], *_files_under({key: value for key, value in toc.items() if key != "root"})]


def _files_under(node: object) -> list[str]:
    if isinstance(node, list):
        return [name for item in node for name in _files_under(item)]
    if not isinstance(node, dict):
        return []
    own = [node["file"]] if "file" in node else []
    return own + [name for value in node.values() for name in _files_under(value)]


def check_parameters(notebook: Path, parameters: dict[str, object]) -> None:
    """Raise BookError unless the parameters cell of `notebook` has every parameter; papermill itself only warns."""
    known = papermill.inspect_notebook(str(notebook))
    for name in parameters:
        if name not in known:
            raise BookError(f"{notebook.name} has no parameter {name!r}: its parameters cell has {sorted(known)}")


def reuse(notebook: Path, folder: Path, library: str) -> Chapter | None:
    """Return the executed copy of `notebook` in `folder` if nothing it depends on has changed since, else None."""
    target, key = folder / notebook.name, notebook_key(notebook, library)
    if not target.is_file() or (stamp := _stamp(target)).get("key") != key:
        return None
    return Chapter(notebook.stem, target, key, stamp["seconds"], reused=True)


def execute(notebook: Path, folder: Path, profile: str, library: str, at_a_time: int = 1) -> Chapter:
    """Execute `notebook` at `profile` and put the copy with its results into `folder`.

    Args:
        at_a_time: how many chapters are executed side by side, for the status page.

    Raises:
        BookError: a parameter is missing or a cell failed; the message names the copy that shows the failure.
    """
    target, key = folder / notebook.name, notebook_key(notebook, library)
    parameters = {"profile": profile}
    check_parameters(notebook, parameters)
    where = status.environment(notebook, profile)
    seconds = _execute(notebook, target, parameters)
    cost = {"seconds": round(seconds, 1), "at_a_time": at_a_time}
    _finish(target, {"key": key, "profile": profile, **cost, "environment": where})
    return Chapter(notebook.stem, target, key, seconds, reused=False)


def _stamp(executed: Path) -> dict:
    return nbformat.read(executed, as_version=4).metadata.get("fedvla", {})


def _execute(notebook: Path, target: Path, parameters: dict[str, object]) -> float:
    """Run `notebook` in its own folder, as nbmake and a reader do; return the wall time in seconds."""
    start = time.monotonic()
    target.parent.mkdir(parents=True, exist_ok=True)
    target.unlink(missing_ok=True)
    try:
        papermill.execute_notebook(
            str(notebook),
            str(_unfinished(target)),
            parameters=parameters,
            cwd=str(notebook.parent),
            kernel_name="python3",
            progress_bar=sys.stderr.isatty(),
            execution_timeout=CELL_TIMEOUT_S[str(parameters["profile"])],
            extra_arguments=["--log-level=CRITICAL"],  # kernels talk about their sockets; cells still show errors
        )
    except PapermillExecutionError as error:
        where = os.path.relpath(_unfinished(target))
        raise BookError(f"{notebook.name}: {error.ename}: {error.evalue.strip()} (see {where})") from error
    return time.monotonic() - start


def _unfinished(target: Path) -> Path:
    return target.with_name(f"{target.stem}.unfinished.ipynb")


def _finish(target: Path, stamp: dict[str, object]) -> None:
    """Turn papermill's output into the copy that is rendered, without its injected cell and this machine's paths."""
    notebook = nbformat.read(_unfinished(target), as_version=4)
    notebook.cells = [cell for cell in notebook.cells if "injected-parameters" not in cell.metadata.get("tags", [])]
    notebook.metadata.pop("papermill", None)
    for cell in notebook.cells:
        cell.metadata.pop("papermill", None)
    notebook.metadata["fedvla"] = stamp
    nbformat.write(notebook, _unfinished(target))
    os.replace(_unfinished(target), target)


def execute_chapters(
    root: Path, profile: str, only: str = "", prepare: Callable[[str], None] = lambda profile: None, jobs: int = 1
) -> list[Chapter]:
    """Execute the chapters of the contents whose name contains `only` and that changed, saying what each costs.

    Args:
        prepare: called with the profile before the first chapter that has to be executed.
        jobs: how many are executed at a time; each takes longer then than alone.
    """
    library, folder = library_key(root, profile), root / "_build" / profile / "executed"
    notebooks = [path for page in toc_pages(root) if (path := root / f"{page}.ipynb").is_file() and only in page]
    if not notebooks:
        raise BookError(f"no chapter in _toc.yml has {only!r} in its name")
    chapters = {path: reuse(path, folder, library) for path in notebooks}
    if not all(chapters.values()):
        prepare(profile)
    place = {path: f"[{number}/{len(notebooks)}] {path.stem}" for number, path in enumerate(notebooks, start=1)}
    order = notebooks if jobs == 1 else notebooks[::-1]  # the last are the longest: none is left when others are done
    with _workers(jobs) as give:
        changed = [path for path in order if chapters[path] is None]
        said = {path: f"{place[path]}, profile {profile} ..." for path in changed}
        work = {path: give(_announced, said[path], path, folder, profile, library, jobs) for path in changed}
        for path in order:
            chapters[path] = chapters[path] or work[path]()
            print(f"{place[path]}: {_cost(chapters[path])}", flush=True)
    return list(chapters.values())


def _announced(words: str, notebook: Path, *how: Any) -> Chapter:
    print(words, flush=True)
    return execute(notebook, *how)


def _on_one_thread() -> None:
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # of the kernels that this process will start


@contextmanager
def _workers(jobs: int) -> Iterator[Callable[..., Callable[[], Chapter]]]:
    """Yield a function that takes work and returns what to call for its result.

    One at a time, the work is done here, when its result is asked for. Otherwise it begins at once, in other processes:
    papermill works in the folder of the notebook, which threads could not do side by side.
    """
    if jobs == 1:
        yield partial
        return
    pool = ProcessPoolExecutor(jobs, get_context("spawn"), _on_one_thread)
    try:
        yield lambda *work: pool.submit(*work).result
    finally:
        pool.shutdown(cancel_futures=True)


def record_data(profile: str) -> None:
    """Record the demonstrations that the chapters share, so that no chapter's time contains it."""
    command = [sys.executable, "-m", "fedvla_lib.cli", "record", "--profile", profile]
    if subprocess.run(command, check=False).returncode:
        raise BookError("the demonstrations could not be recorded")


def _cost(chapter: Chapter) -> str:
    return f"unchanged, took {chapter.seconds:.0f} s" if chapter.reused else f"executed in {chapter.seconds:.0f} s"


def lay_out(root: Path, source: Path, chapters: list[Chapter], profile: str) -> str:
    """Lay pages, executed chapters and configuration into `source` and return a digest of it all.

    Unchanged files keep their time stamp, so that Sphinx reads and writes only the pages that differ.
    """
    wanted = {Path("_toc.yml"): (root / "_toc.yml").read_bytes(), Path("_config.yml"): _rendering_config(root)}
    pages = [path for path in (root / "book").rglob("*") if path.suffix in PAGE_SUFFIXES]
    wanted |= {path.relative_to(root): path.read_bytes() for path in pages}
    wanted |= {Path("notebooks") / chapter.executed.name: chapter.executed.read_bytes() for chapter in chapters}
    executed = {chapter.name: chapter.executed for chapter in chapters}
    _put(wanted, STATUS_PAGE, STATUS, lambda: status.status(root, executed.values(), profile))
    _put(wanted, FRONT_PAGE, FILM, lambda: _film(executed[FILMED_IN], profile))
    if HEADLINE in wanted.get(Path(FRONT_PAGE), b""):
        wanted[Path(OUTCOME)] = _outcome(root / COMPARISON)
    _put(wanted, FRONT_PAGE, HEADLINE, lambda: _headline(root / COMPARISON))
    if Path(MODEL_CARD) in wanted:
        wanted[Path(MODEL_CARD)] += _card_tables(json.loads((root / ACCOUNT).read_text(encoding="utf-8"))).encode()
    wanted |= _library_pages(root, wanted, executed.values())
    for page, names in RESULTS_ON.items():
        if Path(page) in wanted:
            wanted[Path(page)] += _benchmark_tables([root / BENCHMARKS / f"{name}.json" for name in names]).encode()
    for path, content in wanted.items():
        _write_if_changed(source / path, content)
    for path in [path for path in source.rglob("*") if path.is_file() and path.relative_to(source) not in wanted]:
        path.unlink()
    parts = [path.as_posix().encode() + b"\0" + content for path, content in sorted(wanted.items())]
    return _digest([Path(__file__).read_bytes(), *parts])


def _put(wanted: dict[Path, bytes], page: str, mark: bytes, text: Callable[[], str]) -> None:
    """Put generated text in the place of a page's mark, if the page has it."""
    if mark in wanted.get(Path(page), b""):
        wanted[Path(page)] = wanted[Path(page)].replace(mark, text().encode())


def _library_pages(root: Path, wanted: dict[Path, bytes], chapters: Iterable[Path]) -> dict[Path, bytes]:
    """Fill the pages about the library and return the picture of its imports."""
    if Path(ARCHITECTURE) not in wanted:
        return {}
    trees, used = library.modules(root), library.used_in(chapters)
    _put(wanted, ARCHITECTURE, MODULES, lambda: library.table(root, used))
    _put(wanted, FUNCTIONS_PAGE, FUNCTIONS, lambda: library.reference(trees, library.rooms(root)))
    return {Path(IMPORTS): library.picture(library.imports(trees)).encode()}


def _rendering_config(root: Path) -> bytes:
    """Return the book's configuration with execution off: the chapters it renders are executed already."""
    config = yaml.safe_load((root / "_config.yml").read_text(encoding="utf-8"))
    config["execute"] |= {"execute_notebooks": "off"}
    if config.get("repository", {}).get("url"):
        config["html"] |= dict.fromkeys(("use_edit_page_button", "use_repository_button", "use_issues_button"), True)
    return yaml.safe_dump(config, sort_keys=False, allow_unicode=True).encode()


def _write_if_changed(path: Path, content: bytes) -> None:
    if path.is_file() and path.read_bytes() == content:
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(path.name + ".unfinished")
    unfinished.write_bytes(content)
    os.replace(unfinished, path)


def _film(chapter: Path, profile: str) -> str:
    """The federated policy's first rollout of the last evaluated round, as a chapter shows it, whatever came of it."""
    outputs = [output for cell in nbformat.read(chapter, as_version=4).cells for output in cell.get("outputs", [])]
    pages = [output.get("data", {}).get("text/html", "") for output in outputs]
    films = [film for page in pages for film in re.findall(r"<figure.*?</figure>", page, flags=re.DOTALL)]
    by_round = {film: int(told[1]) for film in films if (told := re.search(r'aria-label="Round (\d+)\.', film))}
    if not by_round:
        raise BookError(f"{chapter.name} shows no film of a round, which the front page needs")
    return (
        f"{max(by_round, key=by_round.get)}\n\nThe federated policy in this build, profile `{profile}`: overhead "
        "camera left, front camera right. {doc}`/notebooks/05_evaluation_videos` shows the others, failures included."
    )


def _headline(comparison: Path) -> str:
    """What the stored comparison says, one sentence a line, and a figure of it, for the front page.

    Raises:
        BookError: federated and pooled training differ in their steps in all, so that the first sentence is wrong.
    """
    rows = tables.repeat_partition_free(results.read_results(comparison))
    of_task = rows[rows.partition == "task"]
    of_method = results.summary(of_task).set_index("method")
    labs, tasks = of_task.client.nunique(), of_task.task.nunique()
    return "\n".join([
        f"**What comes out.** Each of {labs} labs holds demonstrations of one of {tasks} tasks.",
        *_at_equal_total(of_method), _gaps(rows), *_with_its_share(of_method), *_with_steps_of_its_own(of_task),
        _counting(of_method), "", _outcome_figure(of_method),
    ])  # fmt: skip


def _at_equal_total(of_method: pd.DataFrame) -> list[str]:
    federated, pooled = of_method.loc[FEDERATED], of_method.loc[POOLED]
    if federated.steps_in_all != pooled.steps_in_all or federated.rollouts != pooled.rollouts:
        raise BookError(f"{FEDERATED} and {POOLED} differ in steps in all or in rollouts: the front page says equal")
    return [
        f"After {federated.steps_in_all:,.0f} gradient steps in all, the federated model succeeds in "
        f"{_rate_of(federated)} of rollouts, and training on all demonstrations in one place in {_rate_of(pooled)}, "
        f"each in {federated.rollouts:,} rollouts over {federated.seeds} training seeds.",
        f"The labs of a round train side by side, so the federated model has walked {federated.steps_in_a_row:,.0f} "
        f"steps in a row, the pooled one {pooled.steps_in_a_row:,.0f}.",
    ]


def _gaps(rows: pd.DataFrame) -> str:
    found = tables.differences(rows, [(FEDERATED, POOLED)], seed=0).set_index("partition")
    gaps = [_gap(words, found.loc[name]) for name, words in DEALT.items() if name in found.index]
    return f"Federated minus pooled: {'; '.join(gaps)}."


def _with_its_share(of_method: pd.DataFrame) -> list[str]:
    alone = of_method.loc[ALONE]
    return [
        f"A lab alone with only its share of the steps, {alone.steps_in_all:,.0f}, succeeds in {_rate_of(alone)} of "
        f"{alone.rollouts:,} rollouts over {alone.seeds} training seeds.",
        "It was judged on all tasks, most of which it never saw: this number is no measure of what a lab can do alone.",
    ]


def _with_steps_of_its_own(of_task: pd.DataFrame) -> list[str]:
    """Labs alone after as many steps as the federation, at their own task, and the federated model beside them."""
    longer = of_task[of_task.method == LONGER]
    steps, elsewhere = longer.steps_in_all.mean(), longer[~tables.at_own_task(longer)]
    found = tables.beside_own_tasks(of_task, LONGER, FEDERATED, seed=0)
    rates = [_percent(*(found[f"{who}_{end}"] for end in ("rate", "low", "high"))) for who in ("success", "other")]
    gap = _points(*(-100 * found[end] for end in ("difference", "high", "low")), " points")
    others = _percent(elsewhere.success.mean(), *statistics.success_interval(elsewhere))
    once = "That is one training seed, so these intervals are for other rollouts, not for other trainings."
    easy = found["success_rate"] > NEARLY_SOLVED
    why = "few demonstrations nearly solve these tasks" if easy else "one lab holds few demonstrations of few tasks"
    return [
        f"After {steps:,.0f} steps each, labs alone succeed in {rates[0]} of {found['n']:,} rollouts at their own "
        f"task, and the federated model in {rates[1]} of the same rollouts: federated minus alone, {gap}.",
        f"At the other labs' tasks labs alone succeed in {others} of {len(elsewhere):,} rollouts; "
        "the federated model is one model for all tasks.",
        once if found["seeds"] == 1 else f"These are {found['seeds']} training seeds.",
        f"Whether federating is worth it is not answered by this grid: {why}.",
    ]


def _counting(of_method: pd.DataFrame) -> str:
    told = "Brackets are 95 % intervals, and {doc}`/notebooks/06_federated_vs_centralized` says how they were made."
    planned = [f"`{method}`" for method, counted in of_method.counted.items() if not counted]
    if not planned:
        return told
    return f"{told}\nThe steps of {', '.join(planned)} follow from their settings: those runs are older than counting."


def _outcome_figure(of_method: pd.DataFrame) -> str:
    few = [f"`{method}`" for method, seeds in of_method.seeds.items() if seeds == 1]
    once = f" Of one training seed, with intervals for other rollouts only: {', '.join(few)}." if few else ""
    return (
        f"```{{figure}} {Path(OUTCOME).relative_to('book').as_posix()}\n"
        ":alt: Points with intervals, one row a method with the gradient steps of its model: success rates of the base, "
        "of labs alone at their own task and at other tasks, of two federations and of centralized training.\n"
        ":width: 100%\n\n"
        "Success of each method with one task a lab, and the gradient steps of one model of it. Of labs alone, rollouts "
        f"at their own task and at other tasks stand apart.{once}\n```"
    )


def _outcome(comparison: Path) -> bytes:
    """The figure under the front page's sentences, as PNG."""
    rows = tables.repeat_partition_free(results.read_results(comparison))
    plots.use_style()
    axes = plots.success_intervals(results.summary(tables.by_steps(rows[rows.partition == "task"])), ylabel="method")
    with tempfile.TemporaryDirectory() as folder:
        plots.save(axes, Path(folder) / "outcome.png")
        return (Path(folder) / "outcome.png").read_bytes()


def _rate_of(found: pd.Series) -> str:
    return _percent(found.success_rate, found.low, found.high)


def _percent(rate: float, low: float, high: float) -> str:
    return _points(100 * rate, 100 * low, 100 * high, " %")


def _gap(words: str, found: pd.Series) -> str:
    gap = _points(100 * found.difference, 100 * found.low, 100 * found.high, " points")
    return f"{words}, {gap}, {found.seeds} seeds"


def _points(value: float, low: float, high: float, unit: str) -> str:
    return f"{value:.1f}{unit} [{low:.1f}, {high:.1f}]"


def _card_tables(account: dict) -> str:
    """What was measured of the nano base, as the end of its page."""
    recipe, stamp = account["recipe"], account["stamp"]
    seen = account["grounding"]
    batch, cores = recipe["batch_size"], "one core" if recipe["num_threads"] == 1 else f"{recipe['num_threads']} cores"
    facts = {
        "parameters": f"{account['parameters']:,}",
        "scenes for learning to see": f"{recipe['scenes']:,}",
        "steps of the vision-language part": f"{recipe['grounding_steps']:,} of {batch} scenes",
        "time to learn to see": f"{seen['seconds'] / 60:.0f} minutes on {cores}",
        "pointing, median error": f"{1000 * seen['median_error_m']:.0f} mm",
        "pointing, 90 % within": f"{1000 * seen['p90_error_m']:.0f} mm",
        "demonstrations": f"{account['episodes']:,} ({account['frames']:,} frames)",
        "steps of the action expert": f"{recipe['steps']:,} of {batch} samples",
        "time to learn to act": f"{account['training_seconds'] / 60:.0f} minutes on {cores}",
        "mean loss of the last 100 steps": f"{account['last_loss']:.3f}",
        "seed": str(recipe["seed"]),
        "made": f"{stamp['started'][:10]}, torch {stamp['versions']['torch']}, lerobot {stamp['versions']['lerobot']}",
    }
    made = status.table(["what", "measured"], [[name, value] for name, value in facts.items()])
    rates = [_rate(row, "task") for row in account["success"]]
    success = status.table(["task", "successes", "rate", "95 % interval"], rates)
    told = status.table(
        ["task", "told", "successes", "rate", "95 % interval"],
        [[row["task"], TOLD[row["told"]], *_rate(row, "task")[1:]] for row in account["language"]],
    )
    return (
        f"## The account\n\n{made}\n## Success\n\nIn the reference laboratory, on seeds that no demonstration has. "
        "The first tasks are the pretraining tasks; from `lift` on they are those of the labs, never seen, "
        f"so this is what the base can do before any lab has trained.\n\n{success}\n## Does the sentence decide?\n\n"
        "Two cubes of different colours stand on the table. Success is counted for one of them, while the method is told "
        f"its colour or the other one's.\n\n{told}\n"
    )


def _benchmark_tables(files: list[Path]) -> str:
    """The results of benchmarks that were kept, one section each."""
    parts = []
    for path in filter(Path.is_file, files):
        result = json.loads(path.read_text(encoding="utf-8"))
        rows = [[_number(value) for value in row.values()] for row in result["rows"]]
        title = TITLES.get(path.stem, path.stem.replace("_", " "))
        where = f"On {result['machine']['cores']} cores ({result['machine']['system']})."
        parts.append(f"## {title[0].upper()}{title[1:]}\n\n{where}\n\n{status.table(list(result['rows'][0]), rows)}")
    return "\n".join(parts)


def _number(value: object) -> str:
    if value is None:
        return ""
    if not isinstance(value, float):
        return str(value)
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def _rate(row: dict, name: str) -> list[str]:
    interval = f"{row['low']:.0%} to {row['high']:.0%}"
    return [row[name], f"{row['successes']} of {row['n']}", f"{row['success_rate']:.0%}", interval]


def render(source: Path, output: Path) -> Path:
    """Build the HTML book strictly and return the folder of its pages."""
    # In a process of its own: Sphinx patches docutils globally and changes sys.path.
    command = [str(Path(sys.executable).with_name("jupyter-book")), "build", str(source), "--path-output", str(output)]
    options = ["-W", "-n", "--keep-going", "--quiet"]
    # Where site_scripts.py lies, and the library whose functions are described.
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), str(ROOT), str(ROOT / "book")]),
    }
    # Warnings are on stderr.
    built = subprocess.run([*command, *options], stdout=subprocess.DEVNULL, env=environment, check=False)
    if built.returncode:
        raise BookError("jupyter-book reported the warnings above; the book is built strictly, so they are errors")
    return output / "_build" / "html"


def check_pages(root: Path, html: Path) -> int:
    """Return the number of pages, after checking that each page of the contents is there and each image is described.

    Raises:
        BookError: a page is missing, or an image has no alternative text; the message names them.
    """
    pages = toc_pages(root)
    if missing := [page for page in pages if not (html / f"{page}.html").is_file()]:
        raise BookError(f"{len(missing)} of {len(pages)} pages were not built: {', '.join(missing)}")
    bare = {page: count for page in pages if (count := _undescribed_images(html / f"{page}.html"))}
    if bare:
        found = ", ".join(f"{page} ({count})" for page, count in bare.items())
        raise BookError(f"images without alternative text, set it in the cell's metadata mystnb.image.alt: {found}")
    return len(pages)


def _undescribed_images(page: Path) -> int:
    """Count the images whose alternative text is missing or, as by default, the path of the image."""
    images = re.findall(r"<img\b[^>]*>", page.read_text(encoding="utf-8"))
    texts = [re.search(r'\balt="([^"]*)"', image) for image in images]
    return sum(text is None or not text[1] or "_images/" in text[1] for text in texts)


def build(root: Path, profile: str, only: str, execute_only: bool, jobs: int = 1) -> Path | None:
    """Execute what changed and, unless `execute_only`, build the book; return its front page."""
    start = time.monotonic()
    chapters = execute_chapters(root, profile, only, prepare=record_data, jobs=jobs)
    if execute_only:
        print(f"{len(chapters)} chapters executed at profile {profile}", flush=True)
        return None
    work, published = root / "_build" / profile, root / "_build" / "html" / profile
    digest = lay_out(root, work / "source", chapters, profile)
    if not is_published(published, digest):
        html = render(work / "source", work)
        check_pages(root, html)
        publish(html, published, digest)
    count = check_pages(root, published)
    print(f"{count} pages, {len(chapters)} chapters, profile {profile}, {time.monotonic() - start:.0f} s")
    return published / "index.html"


def is_published(target: Path, digest: str) -> bool:
    """Return whether the pages at `target` were built from the sources with this digest."""
    mark = target / BUILT_FROM
    return mark.is_file() and mark.read_text() == digest


def publish(html: Path, target: Path, digest: str) -> None:
    """Put the finished pages at `target` in one step: a build that fails leaves the last good book in place."""
    target.parent.mkdir(parents=True, exist_ok=True)
    fresh, old = target.with_name(target.name + ".new"), target.with_name(target.name + ".old")
    shutil.rmtree(fresh, ignore_errors=True)
    shutil.rmtree(old, ignore_errors=True)
    shutil.copytree(html, fresh)
    (fresh / BUILT_FROM).write_text(digest)
    if target.exists():
        os.replace(target, old)
    os.replace(fresh, target)
    shutil.rmtree(old, ignore_errors=True)


def main(argv: list[str] | None = None) -> int:
    """Run the command; bad input and a failing chapter are one line on stderr and exit status 2."""
    parser = argparse.ArgumentParser(description="Execute the chapters that changed and build the HTML book.")
    parser.add_argument("--profile", default=os.environ.get("FEDVLA_PROFILE", "laptop"), choices=list(CELL_TIMEOUT_S))
    parser.add_argument("--only", default="", metavar="TEXT", help="execute the chapters whose name contains TEXT")
    parser.add_argument("--execute-only", action="store_true", help="execute the chapters, build no pages")
    parser.add_argument("--jobs", default=1, type=int, metavar="N", help="chapters at a time; above 1 only at tiny")
    options = parser.parse_args(argv)
    if options.jobs < 1 or (options.jobs > 1 and options.profile != "tiny"):
        parser.error(f"--jobs {options.jobs}: what a chapter costs at {options.profile} is measured one at a time")
    try:
        whole = not (options.execute_only or options.only)
        front_page = build(ROOT, options.profile, options.only, not whole, options.jobs)
    except (ValueError, OSError) as error:
        print(f"the book was not built: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted: the chapters executed so far are kept", file=sys.stderr)
        return 130
    if front_page:
        print(f"Open {front_page}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
