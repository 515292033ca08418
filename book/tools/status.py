"""The status page: times and environments of a build, test results, and the age of stored results."""

import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import nbformat
import papermill

from fedvla_lib import provenance, run_folder
from fedvla_lib.config import from_profile

REPORTS = "_build/tests"  # written by make test
REPLAYED = "replay.toml"  # tiny cells for a test, no result
UNKNOWN = "–"


def environment(notebook: Path, profile: str) -> dict[str, Any]:
    """Return seed, start time, versions and hardware of a chapter's execution."""
    stamp = provenance.first_stamp(from_profile(profile), "notebook")
    parameters = papermill.inspect_notebook(str(notebook))
    seed = parameters["seed"]["default"] if "seed" in parameters else str(stamp["seed"])
    return {name: stamp[name] for name in ("started", "python", "versions", "hardware")} | {"seed": seed}


def status(root: Path, executed: Iterable[Path], profile: str) -> str:
    """Return the generated sections of the status page as Markdown."""
    stamps = {path: nbformat.read(path, as_version=4).metadata.get("fedvla", {}) for path in executed}
    parts = {
        "Chapters": _chapters(stamps, profile),
        "Machines and versions": _environments(stamps),
        "Tests": _tests(root / REPORTS),
        "Reference results": _reference(root / "book" / "reference"),
    }
    return "\n".join(f"## {title}\n\n{text}" for title, text in parts.items())


def _chapters(stamps: dict[Path, dict], profile: str) -> str:
    rows = []
    for path, stamp in stamps.items():
        made = stamp.get("environment", {})
        when = made.get("started", UNKNOWN)[:16].replace("T", " ")
        seconds, seed = f"{stamp.get('seconds', 0):.0f}", made.get("seed", UNKNOWN)
        rows.append([f"[](../notebooks/{path.name})", seconds, seed, when])
    total = sum(stamp.get("seconds", 0) for stamp in stamps.values())
    rows.append(["**total**", f"**{total:.0f}**", "", ""])
    side_by_side = max((stamp.get("at_a_time", 1) for stamp in stamps.values()), default=1)
    shared = f", {side_by_side} chapters in parallel: each took longer than it would alone" if side_by_side > 1 else ""
    return f"Profile `{profile}`{shared}.\n\n" + table(["chapter", "seconds", "seed", "executed (UTC)"], rows)


def _environments(stamps: dict[Path, dict]) -> str:
    """One row for each environment in which chapters were executed."""
    chapters_of: dict[tuple[str, str], list[str]] = {}
    for path, stamp in stamps.items():
        made = stamp.get("environment")
        key = (_machine(made["hardware"]), _versions(made)) if made else (UNKNOWN, UNKNOWN)
        chapters_of.setdefault(key, []).append(path.stem.split("_")[0].lstrip("0"))
    rows = [[", ".join(chapters), *key] for key, chapters in chapters_of.items()]
    return table(["chapters", "machine", "versions"], rows)


def _machine(hardware: dict[str, Any]) -> str:
    memory = f", {hardware['memory_gb']:.0f} GB" if hardware.get("memory_gb") else ""
    return f"{hardware['system']} {hardware['machine']}, {hardware['cores']} cores{memory}, {hardware['device']}"


def _versions(made: dict[str, Any]) -> str:
    packages = [f"{name} {number}" for name, number in made["versions"].items()]
    return ", ".join([f"Python {made['python']}", *packages])


def _tests(reports: Path) -> str:
    """Results of the last `make test` in this checkout."""
    if not (reports / "junit.xml").is_file():
        return "No test report: `make test` writes one, and the next build shows it here.\n"
    suite = next(ElementTree.parse(reports / "junit.xml").iter("testsuite"))
    count = {name: int(suite.get(name, 0)) for name in ("tests", "failures", "errors", "skipped")}
    passed = count["tests"] - count["failures"] - count["errors"] - count["skipped"]
    row = [passed, count["failures"] + count["errors"], count["skipped"], _coverage(reports / "coverage.xml")]
    head = ["passed", "failed", "skipped", "lines and branches covered", "run (local time)"]
    return table(head, [[*map(str, row), suite.get("timestamp", UNKNOWN)[:16].replace("T", " ")]])


def _coverage(file: Path) -> str:
    if not file.is_file():
        return UNKNOWN
    root = ElementTree.parse(file).getroot()
    covered, valid = (
        sum(int(root.get(f"{what}-{how}", 0)) for what in ("lines", "branches")) for how in ("covered", "valid")
    )
    return f"{covered / valid:.0%}" if valid else UNKNOWN


def _reference(folder: Path) -> str:
    """Age of the stored experiments, and whether the library has changed since."""
    from fedvla_lib.experiments import methods  # loads torch, which only this function needs

    notes = tomllib.loads((folder / "notes.toml").read_text(encoding="utf-8"))["code"]
    today, rows = methods.trained_by(), []
    for plan in sorted(set(folder.glob("*.toml")) - {folder / REPLAYED}):
        stamps = [run_folder.read_stamp(file.parent) for file in sorted(folder.glob(f"{plan.stem}/*/stamp.json"))]
        if not stamps:
            continue
        older = {stamp["code"] for stamp in stamps} - {today}
        code = "current" if not older else "earlier, with a note" if older <= set(notes) else "earlier"
        hours = f"{sum(stamp['wall_s'] or 0 for stamp in stamps) / 3600:.1f}"
        last = max(stamp["started"] for stamp in stamps)[:10]
        seeds = str(len({stamp["seed"] for stamp in stamps}))
        rows.append([f"`{plan.stem}`", str(len(stamps)), seeds, hours, last, code])
    head = ["experiment", "runs", "seeds", "hours", "last run", "library code"]
    changes = [f"- `{digest}`: {' '.join(text.split())}" for digest, text in notes.items()]
    intro = "Changes of the library since a stored run, by the digest of the code that ran it:"
    return table(head, rows) + f"\n{intro}\n\n" + "\n".join(changes) + "\n"


def table(head: list[str], rows: list[list[str]]) -> str:
    """Return a Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "".join("| " + " | ".join(line) + " |\n" for line in lines)
