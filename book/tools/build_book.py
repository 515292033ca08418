"""Execute the chapters that changed and build the HTML book from the executed copies.

    python book/tools/build_book.py --profile laptop

Jupyter Book's execution cache ignores changes of the library. Here a chapter is executed again if its key changes,
which covers notebook, library, requirements.lock and profile. papermill executes it with the profile as parameter; the
executed copies and the pages go to `_build/<profile>/source`, which Jupyter Book renders: execution off, warnings as
errors.
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
from fedvla_lib.evaluation import figures, statistics
from fedvla_lib.experiments import results

ROOT = Path(__file__).resolve().parents[2]
PAGE_SUFFIXES = (".md", ".bib", ".png", ".svg", ".jpg", ".css", ".js", ".mp4", ".vtt")
STATUS_PAGE = "book/run_times.md"
STATUS = b"<!-- status -->"  # replaced by the status of the build
MODEL_CARD = "book/nano_base.md"  # ends with generated results of the nano base
FRONT_PAGE = "book/index.md"
HEADLINE = b"<!-- headline -->"  # on the front page: replaced by the result of the comparison
ARCHITECTURE, MODULES, IMPORTS = "book/architecture.md", b"<!-- modules -->", "book/_static/imports.svg"
FUNCTIONS_PAGE, FUNCTIONS = "book/library.md", b"<!-- functions -->"
VIDEO = b"<!-- video -->"  # on the front page: replaced by a video of this build's federated policy
VIDEO_CHAPTER = "05_evaluation_videos"
COMPARISON = "book/reference/comparison"
OUTCOME = "book/_static/outcome.png"  # its figure
# Methods in the headline.
FEDERATED, POOLED, LOCAL, LOCAL_LONGER = "fedavg-200x2x2", "centralized", "local-only", "local-only-800"
NEARLY_SOLVED = 0.8  # success rate of local-only labs above which federating can add little
DEALT = {"iid": "the same mix of tasks in every lab", "dirichlet-0_5": "uneven mixes (Dirichlet, 0.5)",
         "dirichlet-0_1": "very uneven mixes (Dirichlet, 0.1)", "task": "one task per lab",
         "lab": "labs that differ in camera, light and calibration"}  # fmt: skip
ACCOUNT = "fedvla_lib/nano_base/pretraining.json"
INSTRUCTION = {"right": "this cube's colour", "other": "the other cube's colour"}
# Pages that end with stored results of benchmarks.
RESULTS_ON = {
    MODEL_CARD: ["fine_tuning"],
    "book/reference_runs.md": ["four_methods"],
    "book/speed.md": [
        "local_training", "random_access", "control_steps", "peers", "rollouts", "federation", "floor",
    ],
    "book/scale.md": ["scale"],
}  # fmt: skip
TITLES = {
    "fine_tuning": "fine-tuning: each task alone from the base, on one core",
    "floor": "the floor",
    "four_methods": "base, federated, local-only with its share of the steps, and centralized",
}
PACKAGES = ("fedvla_lib", "book/fedvla_book")  # what chapters import
BENCHMARKS = "benchmarks/results"
REFERENCE = re.compile(rb"\.\./book/reference/\w+")  # a folder of stored results in a chapter's code
BUILT_FROM = ".built-from"  # file next to the pages with the digest of their sources
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
    return _digest([profile.encode(), *(_named_bytes(root, path) for path in files if path.is_file())])


def notebook_key(notebook: Path, library: str) -> str:
    """Return the digest of `notebook`, the library and the stored results that it reads."""
    source = notebook.read_bytes()
    folders = sorted({notebook.parent / name.decode() for name in REFERENCE.findall(source)})
    files = [path for folder in folders for path in sorted(folder.rglob("*")) if path.is_file()]
    stored = [_named_bytes(notebook.parent.parent, path.resolve()) for path in files]
    return _digest([library.encode(), notebook.name.encode(), source, *stored])


def _named_bytes(root: Path, path: Path) -> bytes:
    return path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes()


def _digest(parts: Iterable[bytes]) -> str:
    digest = hashlib.sha256()
    for part in parts:
        digest.update(hashlib.sha256(part).digest())  # of fixed length, so that no two lists collide
    return digest.hexdigest()


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
    """Raise BookError if the parameters cell of `notebook` lacks a parameter; papermill only warns."""
    known = papermill.inspect_notebook(str(notebook))
    for name in parameters:
        if name not in known:
            raise BookError(f"{notebook.name} has no parameter {name!r}: its parameters cell has {sorted(known)}")


def reuse(notebook: Path, folder: Path, library: str) -> Chapter | None:
    """Return the executed copy of `notebook` in `folder` if its key is unchanged, else None."""
    target, key = folder / notebook.name, notebook_key(notebook, library)
    if not target.is_file() or (stamp := _stamp(target)).get("key") != key:
        return None
    return Chapter(notebook.stem, target, key, stamp["seconds"], reused=True)


def execute(notebook: Path, folder: Path, profile: str, library: str, at_a_time: int = 1) -> Chapter:
    """Execute `notebook` with `profile` and write the executed copy to `folder`.

    Args:
        at_a_time: number of chapters executed in parallel, for the status page.

    Raises:
        BookError: a parameter is missing or a cell failed; the message names the copy that shows the failure.
    """
    target, key = folder / notebook.name, notebook_key(notebook, library)
    parameters = {"profile": profile}
    check_parameters(notebook, parameters)
    environment = status.environment(notebook, profile)
    seconds = _execute(notebook, target, parameters)
    cost = {"seconds": round(seconds, 1), "at_a_time": at_a_time}
    _finish(target, {"key": key, "profile": profile, **cost, "environment": environment})
    return Chapter(notebook.stem, target, key, seconds, reused=False)


def _stamp(executed: Path) -> dict:
    return nbformat.read(executed, as_version=4).metadata.get("fedvla", {})


def _execute(notebook: Path, target: Path, parameters: dict[str, object]) -> float:
    """Run `notebook` in its folder, as nbmake and readers do; return the wall time in seconds."""
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
            extra_arguments=["--log-level=CRITICAL"],  # silences log messages of kernels; cells still show errors
        )
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
    root: Path, profile: str, only: str = "", prepare: Callable[[str], None] = lambda profile: None, jobs: int = 1
) -> list[Chapter]:
    """Execute the changed chapters of the table of contents whose name contains `only`, and print their times.

    Args:
        prepare: called with the profile if any chapter has to be executed, before the first.
        jobs: number of chapters executed in parallel; each then takes longer than alone.
    """
    library, folder = library_key(root, profile), root / "_build" / profile / "executed"
    notebooks = [path for page in toc_pages(root) if (path := root / f"{page}.ipynb").is_file() and only in page]
    if not notebooks:
        raise BookError(f"no chapter in _toc.yml has {only!r} in its name")
    chapters = {path: reuse(path, folder, library) for path in notebooks}
    if not all(chapters.values()):
        prepare(profile)
    place = {path: f"[{number}/{len(notebooks)}] {path.stem}" for number, path in enumerate(notebooks, start=1)}
    order = notebooks if jobs == 1 else notebooks[::-1]  # the last chapters take longest, so start them first
    with _workers(jobs) as submit:
        changed = [path for path in order if chapters[path] is None]
        lines = {path: f"{place[path]}, profile {profile} ..." for path in changed}
        work = {path: submit(_announced, lines[path], path, folder, profile, library, jobs) for path in changed}
        for path in order:
            chapters[path] = chapters[path] or work[path]()
            print(f"{place[path]}: {_cost(chapters[path])}", flush=True)
    return list(chapters.values())


def _announced(line: str, notebook: Path, *options: Any) -> Chapter:
    print(line, flush=True)
    return execute(notebook, *options)


def _on_one_thread() -> None:
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # inherited by the kernels


@contextmanager
def _workers(jobs: int) -> Iterator[Callable[..., Callable[[], Chapter]]]:
    """Yield a function that submits work and returns a function for its result.

    With one job the work runs here when its result is requested. Otherwise it starts at once in other processes:
    papermill changes the working directory, which threads share.
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
    """Record the demonstrations that the chapters share, so that it does not count in a chapter's time."""
    command = [sys.executable, "-m", "fedvla_lib.cli", "record", "--profile", profile]
    if subprocess.run(command, check=False).returncode:
        raise BookError("the demonstrations could not be recorded")


def _cost(chapter: Chapter) -> str:
    return f"unchanged, took {chapter.seconds:.0f} s" if chapter.reused else f"executed in {chapter.seconds:.0f} s"


def lay_out(root: Path, source: Path, chapters: list[Chapter], profile: str) -> str:
    """Write pages, executed chapters and configuration to `source` and return a digest of all.

    Unchanged files keep their time stamp, so that Sphinx rebuilds only the pages that differ.
    """
    wanted = {Path("_toc.yml"): (root / "_toc.yml").read_bytes(), Path("_config.yml"): _rendering_config(root)}
    pages = [path for path in (root / "book").rglob("*") if path.suffix in PAGE_SUFFIXES]
    wanted |= {path.relative_to(root): path.read_bytes() for path in pages}
    wanted |= {Path("notebooks") / chapter.executed.name: chapter.executed.read_bytes() for chapter in chapters}
    executed = {chapter.name: chapter.executed for chapter in chapters}
    _put(wanted, STATUS_PAGE, STATUS, lambda: status.status(root, executed.values(), profile))
    _put(wanted, FRONT_PAGE, VIDEO, lambda: _video(executed[VIDEO_CHAPTER], profile))
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
    """Replace a page's mark by generated text, if the page has it."""
    if mark in wanted.get(Path(page), b""):
        wanted[Path(page)] = wanted[Path(page)].replace(mark, text().encode())


def _library_pages(root: Path, wanted: dict[Path, bytes], chapters: Iterable[Path]) -> dict[Path, bytes]:
    """Fill the pages about the library and return the figure of its imports."""
    if Path(ARCHITECTURE) not in wanted:
        return {}
    trees, used = library.modules(root), library.used_in(chapters)
    _put(wanted, ARCHITECTURE, MODULES, lambda: library.table(root, used))
    _put(wanted, FUNCTIONS_PAGE, FUNCTIONS, lambda: library.reference(trees, library.rooms(root)))
    return {Path(IMPORTS): library.picture(library.imports(trees)).encode()}


def _rendering_config(root: Path) -> bytes:
    """Return the book's configuration with execution off, since its chapters are already executed."""
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


def _video(chapter: Path, profile: str) -> str:
    """The first video of the last evaluated round in a chapter, success or failure."""
    outputs = [output for cell in nbformat.read(chapter, as_version=4).cells for output in cell.get("outputs", [])]
    pages = [output.get("data", {}).get("text/html", "") for output in outputs]
    figures = [figure for page in pages for figure in re.findall(r"<figure.*?</figure>", page, flags=re.DOTALL)]
    by_round = {one: int(label[1]) for one in figures if (label := re.search(r'aria-label="Round (\d+)\.', one))}
    if not by_round:
        raise BookError(f"{chapter.name} shows no video of a round, which the front page needs")
    return (
        f"{max(by_round, key=by_round.get)}\n\nThe federated policy in this build, profile `{profile}`: overhead "
        "camera left, front camera right. {doc}`/notebooks/05_evaluation_videos` shows the others, failures included."
    )


def _headline(comparison: Path) -> str:
    """The result of the stored comparison for the front page: one sentence per line, and a figure.

    Raises:
        BookError: federated and centralized training differ in total steps, which makes the first sentence wrong.
    """
    rows = tables.repeat_partition_free(results.read_results(comparison))
    of_task = rows[rows.partition == "task"]
    of_method = results.summary(of_task).set_index("method")
    labs, tasks = of_task.client.nunique(), of_task.task.nunique()
    return "\n".join([
        f"**Result.** Each of {labs} labs holds demonstrations of one of {tasks} tasks.",
        *_at_equal_total(of_method), _gaps(rows), *_local_share(of_method), *_local_longer(of_task),
        _counting(of_method), "", _outcome_figure(of_method),
    ])  # fmt: skip


def _at_equal_total(of_method: pd.DataFrame) -> list[str]:
    federated, pooled = of_method.loc[FEDERATED], of_method.loc[POOLED]
    if federated.steps_in_all != pooled.steps_in_all or federated.rollouts != pooled.rollouts:
        raise BookError(f"{FEDERATED} and {POOLED} differ in total steps or rollouts, and the front page says equal")
    return [
        f"After {federated.steps_in_all:,.0f} gradient steps in total, the success rate of the federated model is "
        f"{_rate_of(federated)} and that of centralized training on all demonstrations {_rate_of(pooled)}, "
        f"each over {federated.rollouts:,} rollouts and {federated.seeds} training seeds.",
        f"The labs of a round train in parallel, so the federated model took {federated.steps_in_a_row:,.0f} "
        f"sequential steps, the centralized one {pooled.steps_in_a_row:,.0f}.",
    ]


def _gaps(rows: pd.DataFrame) -> str:
    found = tables.differences(rows, [(FEDERATED, POOLED)], seed=0).set_index("partition")
    gaps = [_gap(words, found.loc[name]) for name, words in DEALT.items() if name in found.index]
    return f"Federated minus centralized: {'; '.join(gaps)}."


def _local_share(of_method: pd.DataFrame) -> list[str]:
    local = of_method.loc[LOCAL]
    return [
        f"A lab that trains alone for its share of the steps, {local.steps_in_all:,.0f}, reaches {_rate_of(local)} "
        f"over {local.rollouts:,} rollouts and {local.seeds} training seeds.",
        "It was evaluated on all tasks, most of which it has no demonstrations of: "
        "this number does not measure what a lab can do alone.",
    ]


def _local_longer(of_task: pd.DataFrame) -> list[str]:
    """Labs alone with as many steps as the federation, at their own task, next to the federated model."""
    longer = of_task[of_task.method == LOCAL_LONGER]
    steps, elsewhere = longer.steps_in_all.mean(), longer[~tables.at_own_task(longer)]
    found = tables.beside_own_tasks(of_task, LOCAL_LONGER, FEDERATED, seed=0)
    rates = [_percent(*(found[f"{who}_{end}"] for end in ("rate", "low", "high"))) for who in ("success", "other")]
    gap = _points(*(-100 * found[end] for end in ("difference", "high", "low")), " points")
    others = _percent(elsewhere.success.mean(), *statistics.success_interval(elsewhere))
    once = "That is one training seed, so these intervals cover other rollouts, not other training seeds."
    easy = found["success_rate"] > NEARLY_SOLVED
    why = "few demonstrations nearly solve these tasks" if easy else "one lab has few demonstrations of few tasks"
    return [
        f"After {steps:,.0f} steps each, labs alone reach {rates[0]} over {found['n']:,} rollouts at their own "
        f"task, and the federated model {rates[1]} over the same rollouts: federated minus alone, {gap}.",
        f"At the other labs' tasks labs alone reach {others} over {len(elsewhere):,} rollouts; "
        "the federated model is one model for all tasks.",
        once if found["seeds"] == 1 else f"These are {found['seeds']} training seeds.",
        f"This grid does not answer whether federating is worth it: {why}.",
    ]


def _counting(of_method: pd.DataFrame) -> str:
    text = "Brackets are 95 % intervals; {doc}`/notebooks/06_federated_vs_centralized` explains them."
    planned = [f"`{method}`" for method, counted in of_method.counted.items() if not counted]
    if not planned:
        return text
    return f"{text}\nThe steps of {', '.join(planned)} are derived from settings: those runs did not count their steps."


def _outcome_figure(of_method: pd.DataFrame) -> str:
    few = [f"`{method}`" for method, seeds in of_method.seeds.items() if seeds == 1]
    once = f" With one training seed, hence intervals over rollouts only: {', '.join(few)}." if few else ""
    return (
        f"```{{figure}} {Path(OUTCOME).relative_to('book').as_posix()}\n"
        ":alt: Points with intervals, a row per method with the gradient steps of its model: success rates of the "
        "base, of labs alone at their own task and at other tasks, of two federations and of centralized training.\n"
        ":width: 100%\n\n"
        "Success rate of each method with one task per lab, and the gradient steps of one model. For labs alone, "
        f"rollouts at their own task and at other tasks are shown separately.{once}\n```"
    )


def _outcome(comparison: Path) -> bytes:
    """The figure below the headline, as PNG."""
    rows = tables.repeat_partition_free(results.read_results(comparison))
    plots.use_style()
    axes = plots.success_intervals(results.summary(tables.by_steps(rows[rows.partition == "task"])), ylabel="method")
    with tempfile.TemporaryDirectory() as folder:
        figures.save(axes, Path(folder) / "outcome.png")
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
    """Results of pretraining the nano base, for the end of its page."""
    recipe, stamp = account["recipe"], account["stamp"]
    seen = account["grounding"]
    batch, cores = recipe["batch_size"], "one core" if recipe["num_threads"] == 1 else f"{recipe['num_threads']} cores"
    facts = {
        "parameters": f"{account['parameters']:,}",
        "grounding scenes": f"{recipe['scenes']:,}",
        "grounding steps (vision-language part)": f"{recipe['grounding_steps']:,} of {batch} scenes",
        "grounding time": f"{seen['seconds'] / 60:.0f} minutes on {cores}",
        "pointing, median error": f"{1000 * seen['median_error_m']:.0f} mm",
        "pointing, 90 % within": f"{1000 * seen['p90_error_m']:.0f} mm",
        "demonstrations": f"{account['episodes']:,} ({account['frames']:,} frames)",
        "steps of the action expert": f"{recipe['steps']:,} of {batch} samples",
        "training time of the action expert": f"{account['training_seconds'] / 60:.0f} minutes on {cores}",
        "mean loss of the last 100 steps": f"{account['last_loss']:.3f}",
        "seed": str(recipe["seed"]),
        "made": f"{stamp['started'][:10]}, torch {stamp['versions']['torch']}, lerobot {stamp['versions']['lerobot']}",
    }
    made = status.table(["quantity", "value"], [[name, value] for name, value in facts.items()])
    rates = [_rate(row, "task") for row in account["success"]]
    success = status.table(["task", "successes", "rate", "95 % interval"], rates)
    language = status.table(
        ["task", "instruction names", "successes", "rate", "95 % interval"],
        [[row["task"], INSTRUCTION[row["told"]], *_rate(row, "task")[1:]] for row in account["language"]],
    )
    return (
        f"## Pretraining\n\n{made}\n## Success\n\nIn the reference lab, on seeds that no demonstration has. "
        "The first tasks are the pretraining tasks; from `lift` on they are those of the labs, without demonstrations, "
        f"so this is the base before any lab has trained.\n\n{success}\n## Does it follow instructions?\n\n"
        "Two cubes of different colours are on the table. Success is counted for one of them; the instruction names "
        f"its colour or the other one's.\n\n{language}\n"
    )


def _benchmark_tables(files: list[Path]) -> str:
    """Stored results of benchmarks, a section each."""
    parts = []
    for path in filter(Path.is_file, files):
        result = json.loads(path.read_text(encoding="utf-8"))
        rows = [[_number(value) for value in row.values()] for row in result["rows"]]
        title = TITLES.get(path.stem, path.stem.replace("_", " "))
        machine = f"On {result['machine']['cores']} cores ({result['machine']['system']})."
        parts.append(f"## {title[0].upper()}{title[1:]}\n\n{machine}\n\n{status.table(list(result['rows'][0]), rows)}")
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
    """Build the HTML book with warnings as errors and return the folder of its pages."""
    # In a subprocess: Sphinx patches docutils globally and changes sys.path.
    command = [str(Path(sys.executable).with_name("jupyter-book")), "build", str(source), "--path-output", str(output)]
    options = ["-W", "-n", "--keep-going", "--quiet"]
    # For site_scripts.py and the documented packages.
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), str(ROOT), str(ROOT / "book")]),
    }
    # Warnings are on stderr.
    built = subprocess.run([*command, *options], stdout=subprocess.DEVNULL, env=environment, check=False)
    if built.returncode:
        raise BookError("jupyter-book reported the warnings above, which are errors")
    return output / "_build" / "html"


def check_pages(root: Path, html: Path) -> int:
    """Check that each page of the contents exists and each image has alternative text; return the number of pages.

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
    """Count the images whose alternative text is missing or, the default, the path of the image."""
    images = re.findall(r"<img\b[^>]*>", page.read_text(encoding="utf-8"))
    texts = [re.search(r'\balt="([^"]*)"', image) for image in images]
    return sum(text is None or not text[1] or "_images/" in text[1] for text in texts)


def build(root: Path, profile: str, only: str, execute_only: bool, jobs: int = 1) -> Path | None:
    """Execute changed chapters and, unless `execute_only`, build the book; return its front page."""
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
    """Replace the pages at `target` in one step, so that a failed build keeps the last good book."""
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
    """Run the command; errors are one line on stderr and exit status 2."""
    parser = argparse.ArgumentParser(description="Execute the chapters that changed and build the HTML book.")
    parser.add_argument("--profile", default=os.environ.get("FEDVLA_PROFILE", "laptop"), choices=list(CELL_TIMEOUT_S))
    parser.add_argument("--only", default="", metavar="TEXT", help="execute the chapters whose name contains TEXT")
    parser.add_argument("--execute-only", action="store_true", help="execute the chapters, build no pages")
    parser.add_argument(
        "--jobs", default=1, type=int, metavar="N", help="chapters in parallel; above 1 only with profile tiny"
    )
    options = parser.parse_args(argv)
    if options.jobs < 1 or (options.jobs > 1 and options.profile != "tiny"):
        parser.error(f"--jobs {options.jobs}: chapters of profile {options.profile} are timed one at a time")
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
