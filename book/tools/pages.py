"""Write the sources of the book's pages: the pages as they are, executed chapters, and generated parts."""

import json
from collections.abc import Callable, Iterable
from pathlib import Path

import yaml

import cost_page
import joining
import library
import status
from execution import Chapter
from fedvla_lib.files import write_atomically
from front_page import COMPARISON, OUTCOME, VIDEO_CHAPTER, compared, headline, outcome, video

PAGE_SUFFIXES = (".md", ".bib", ".png", ".svg", ".jpg", ".css", ".js", ".mp4", ".vtt")
STATUS_PAGE = "book/run_times.md"
STATUS = b"<!-- status -->"  # replaced by the status of the build
MODEL_CARD = "book/nano_base.md"  # ends with generated results of the nano base
FRONT_PAGE = "book/index.md"
MARKED = {"book/joining.md": joining.parts, "book/costs.md": cost_page.parts}  # have the marks of these
HEADLINE = b"<!-- headline -->"  # on the front page: replaced by the result of the comparison
ARCHITECTURE, MODULES, IMPORTS = "book/architecture.md", b"<!-- modules -->", "book/_static/imports.svg"
FUNCTIONS_PAGE, FUNCTIONS = "book/library.md", b"<!-- functions -->"
VIDEO = b"<!-- video -->"  # on the front page: replaced by a video of this build's federated policy
ACCOUNT = "fedvla_lib/nano_base/pretraining.json"
INSTRUCTION = {"right": "this cube's colour", "other": "the other cube's colour"}
# Pages that end with stored results of benchmarks.
RESULTS_ON = {
    MODEL_CARD: ["fine_tuning"],
    "book/speed.md": [
        "local_training", "random_access", "control_steps", "peers", "rollouts", "federation", "floor", "busy",
        "start_up",
    ],
    "book/scale.md": ["scale", "secure_aggregation", "soak"],
    "book/deployment.md": ["network", "attacks"],
    "book/costs.md": ["operations"],
}  # fmt: skip
TITLES = {
    "fine_tuning": "fine-tuning: each task alone from the base, on one core",
    "floor": "the floor",
    "soak": "a long run",
    "attacks": "attacks tried",
    "network": "on a bad network",
}
BENCHMARKS = "benchmarks/results"


def lay_out(root: Path, source: Path, chapters: list[Chapter], profile: str) -> None:
    """Write pages, executed chapters and configuration to `source`.

    Unchanged files keep their time stamp, so that Sphinx rebuilds only the pages that differ.
    """
    wanted = {Path("_toc.yml"): (root / "_toc.yml").read_bytes(), Path("_config.yml"): _rendering_config(root)}
    pages = [path for path in (root / "book").rglob("*") if path.suffix in PAGE_SUFFIXES]
    wanted |= {path.relative_to(root): path.read_bytes() for path in pages}
    wanted |= {Path("notebooks") / chapter.executed.name: chapter.executed.read_bytes() for chapter in chapters}
    executed = {chapter.name: chapter.executed for chapter in chapters}
    _put(wanted, STATUS_PAGE, STATUS, lambda: status.status(root, executed.values(), profile))
    _put(wanted, FRONT_PAGE, VIDEO, lambda: video(executed[VIDEO_CHAPTER], profile))
    if HEADLINE in wanted.get(Path(FRONT_PAGE), b""):
        rows = compared(root / COMPARISON)
        _put(wanted, FRONT_PAGE, HEADLINE, lambda: headline(rows))
        wanted[Path(OUTCOME)] = outcome(rows)
    for page, parts in MARKED.items():
        for mark, text in parts(root).items() if Path(page) in wanted else ():
            _put(wanted, page, mark, text)
    if Path(MODEL_CARD) in wanted:
        wanted[Path(MODEL_CARD)] += _card_tables(json.loads((root / ACCOUNT).read_text(encoding="utf-8"))).encode()
    wanted |= _library_pages(root, wanted, executed.values())
    for page, names in RESULTS_ON.items():
        if Path(page) in wanted:
            wanted[Path(page)] += _benchmark_tables([root / BENCHMARKS / f"{name}.json" for name in names]).encode()
    for path, content in wanted.items():
        if not (source / path).is_file() or (source / path).read_bytes() != content:
            write_atomically(source / path, content)
    for path in [path for path in source.rglob("*") if path.is_file() and path.relative_to(source) not in wanted]:
        path.unlink()


def _put(wanted: dict[Path, bytes], page: str, mark: bytes, text: Callable[[], str]) -> None:
    """Replace a page's mark by generated text, if the page has it."""
    if mark in wanted.get(Path(page), b""):
        wanted[Path(page)] = wanted[Path(page)].replace(mark, text().encode())


def _library_pages(root: Path, wanted: dict[Path, bytes], chapters: Iterable[Path]) -> dict[Path, bytes]:
    """Fill the pages about the library and return the figure of its imports."""
    if Path(ARCHITECTURE) not in wanted:
        return {}
    trees, described = library.modules(root), library.rooms(root)
    _put(wanted, ARCHITECTURE, MODULES, lambda: library.table(trees, described, library.used_in(chapters)))
    _put(wanted, FUNCTIONS_PAGE, FUNCTIONS, lambda: library.reference(trees, described))
    return {Path(IMPORTS): library.picture(library.imports(trees)).encode()}


def _rendering_config(root: Path) -> bytes:
    """Return the book's configuration with execution off, since its chapters are already executed."""
    config = yaml.safe_load((root / "_config.yml").read_text(encoding="utf-8"))
    config["execute"] |= {"execute_notebooks": "off"}
    if config.get("repository", {}).get("url"):
        config["html"] |= dict.fromkeys(("use_edit_page_button", "use_repository_button", "use_issues_button"), True)
    return yaml.safe_dump(config, sort_keys=False, allow_unicode=True).encode()


def _card_tables(account: dict) -> str:
    """Results of pretraining the nano base, for the end of its page."""
    recipe, stamp = account["recipe"], account["stamp"]
    seen = account["grounding"]
    batch, cores = recipe["batch_size"], _cores(recipe["num_threads"])
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
        f"## Pretraining\n\n{made}\n## Success\n\nIn the reference lab, with seeds that no demonstration used. "
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
        machine = f"On {_cores(result['machine']['cores'])} ({result['machine']['system']})."
        parts.append(f"## {title[0].upper()}{title[1:]}\n\n{machine}\n\n{status.table(list(result['rows'][0]), rows)}")
    return "\n".join(parts)


def _cores(count: int) -> str:
    return "one core" if count == 1 else f"{count} cores"


def _number(value: object) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if not isinstance(value, float):
        return str(value)
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def _rate(row: dict, name: str) -> list[str]:
    interval = f"{row['low']:.0%} to {row['high']:.0%}"
    return [row[name], f"{row['successes']} of {row['n']}", f"{row['success_rate']:.0%}", interval]
