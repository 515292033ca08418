"""The status page: what a build is made of, what guards it, and how old the results are that it shows."""

import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import nbformat
import papermill

from fedvla_lib import provenance, run_folder
from fedvla_lib.config import from_profile

REPORTS = "_build/tests"  # where make test leaves its reports
UNKNOWN = "–"


def environment(notebook: Path, profile: str) -> dict[str, Any]:
    """Return what is kept of the place where a chapter is executed: seed, time, versions and hardware."""
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
    rows.append(["**together**", f"**{total:.0f}**", "", ""])
    side_by_side = max((stamp.get("at_a_time", 1) for stamp in stamps.values()), default=1)
    shared = f", {side_by_side} chapters at a time: each took longer than alone" if side_by_side > 1 else ""
    return f"Profile `{profile}`{shared}.\n\n" + table(["chapter", "seconds", "seed", "executed (UTC)"], rows)


def _environments(stamps: dict[Path, dict]) -> str:
    """One row for each place where chapters were executed."""
    where: dict[tuple[str, str], list[str]] = {}
    for path, stamp in stamps.items():
        made = stamp.get("environment")
        key = (_machine(made["hardware"]), _versions(made)) if made else (UNKNOWN, UNKNOWN)
        where.setdefault(key, []).append(path.stem.split("_")[0].lstrip("0"))
    rows = [[", ".join(chapters), *key] for key, chapters in where.items()]
    return table(["chapters", "machine", "versions"], rows)


def _machine(hardware: dict[str, Any]) -> str:
    memory = f", {hardware['memory_gb']:.0f} GB" if hardware.get("memory_gb") else ""
    return f"{hardware['system']} {hardware['machine']}, {hardware['cores']} cores{memory}, {hardware['device']}"


def _versions(made: dict[str, Any]) -> str:
    packages = [f"{name} {number}" for name, number in made["versions"].items()]
    return ", ".join([f"Python {made['python']}", *packages])


def _tests(reports: Path) -> str:
    """What the last `make test` in this folder found."""
    if not (reports / "junit.xml").is_file():
        return "No report lies in this folder: `make test` writes one, and the next build shows it here.\n"
    suite = next(ElementTree.parse(reports / "junit.xml").iter("testsuite"))
    count = {name: int(suite.get(name, 0)) for name in ("tests", "failures", "errors", "skipped")}
    passed = count["tests"] - count["failures"] - count["errors"] - count["skipped"]
    row = [passed, count["failures"] + count["errors"], count["skipped"], _coverage(reports / "coverage.xml")]
    head = ["passed", "failed", "skipped", "lines and branches covered", "run (local time)"]
    return table(head, [[*map(str, row), suite.get("timestamp", UNKNOWN)[:16].replace("T", " ")]])


def _coverage(file: Path) -> str:
    if not file.is_file():
        return UNKNOWN
    whole = ElementTree.parse(file).getroot()
    covered, valid = (
        sum(int(whole.get(f"{what}-{how}", 0)) for what in ("lines", "branches")) for how in ("covered", "valid")
    )
    return f"{covered / valid:.0%}" if valid else UNKNOWN


def _reference(folder: Path) -> str:
    """How old the stored experiments are, and whether the library has changed since."""
    from fedvla_lib.experiments import methods  # loads the model's packages, which only this needs

    notes = tomllib.loads((folder / "notes.toml").read_text(encoding="utf-8"))["code"]
    today, rows = methods.trained_by(), []
    for plan in sorted(folder.glob("*.toml")):
        stamps = [run_folder.read_stamp(file.parent) for file in sorted(folder.glob(f"{plan.stem}/*/stamp.json"))]
        if not stamps:
            continue
        older = {stamp["code"] for stamp in stamps} - {today}
        code = "today's" if not older else "earlier, with a note" if older <= set(notes) else "earlier"
        hours = f"{sum(stamp['wall_s'] or 0 for stamp in stamps) / 3600:.1f}"
        last = max(stamp["started"] for stamp in stamps)[:10]
        seeds = str(len({stamp["seed"] for stamp in stamps}))
        rows.append([f"`{plan.stem}`", str(len(stamps)), seeds, hours, last, code])
    head = ["experiment", "runs", "seeds", "hours", "last run", "library code"]
    said = [f"- `{digest}`: {' '.join(text.split())}" for digest, text in notes.items()]
    intro = "What changed in the library since a stored run, by the digest of the code that ran it:"
    return table(head, rows) + f"\n{intro}\n\n" + "\n".join(said) + "\n"


def table(head: list[str], rows: list[list[str]]) -> str:
    """Return a Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "".join("| " + " | ".join(line) + " |\n" for line in lines)
