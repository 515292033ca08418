"""Store the costs that the last build measured, for the boxes at the tops of chapters.

    python book/tools/keep_costs.py --profile laptop

Reads the executed copies of `make book` and writes `book/reference/costs/<profile>.json`. Measure on an idle
machine, one chapter at a time: ``make book BOOK_JOBS=1``.
"""

import argparse
import os
import sys
import time
from pathlib import Path

import nbformat

from execution import COSTS, add_profile, executed_folder, notebooks_of
from fedvla_book.chapter_cost import MEASURED
from fedvla_lib.files import write_json

ROOT = Path(__file__).resolve().parents[2]


def measured_in(executed: Path) -> dict[str, float | None]:
    """Return seconds, memory and exchanged MB of an executed chapter; None if not measured.

    Raises:
        ValueError: not executed by a build of the book, or in parallel with other chapters.
    """
    notebook = nbformat.read(executed, as_version=4)
    if "fedvla" not in notebook.metadata:
        raise ValueError(f"{executed.name} was not executed by make book")
    if (together := notebook.metadata["fedvla"].get("at_a_time", 1)) > 1:
        text = "remove it, and run make book BOOK_JOBS=1 first"
        raise ValueError(f"{executed.name} was executed as one of {together} at a time: {text}")
    costs = [
        output["metadata"][MEASURED]
        for cell in notebook.cells
        for output in cell.get("outputs", [])
        if MEASURED in output.get("metadata", {})
    ]
    last = costs[-1] if costs else {}
    others = {name: last.get(name) for name in ("memory_mb", "exchanged_mb")}
    return {"seconds": notebook.metadata["fedvla"]["seconds"], **others}


def keep(root: Path, profile: str) -> Path:
    """Write the costs of the build with `profile` and return the file.

    Raises:
        ValueError: a chapter was not executed; nothing is written.
    """
    files = [executed_folder(root, profile) / path.name for path in notebooks_of(root)]
    if missing := [file.stem for file in files if not file.is_file()]:
        raise ValueError(f"not executed at profile {profile}: {', '.join(missing)}; run make book first")
    date = time.strftime("%Y-%m-%d", time.gmtime(max(file.stat().st_mtime for file in files)))
    chapters = {file.stem: measured_in(file) for file in files}
    target = root / COSTS / f"{profile}.json"
    write_json(target, {"cores": os.cpu_count(), "date": date, "chapters": chapters})
    return target


def main() -> int:
    """Store the costs and print the path."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add_profile(parser)
    try:
        target = keep(ROOT, parser.parse_args().profile)
    except ValueError as error:
        print(f"keep_costs: {error}", file=sys.stderr)
        return 2
    print(target.relative_to(ROOT))
    return 0


if __name__ == "__main__":
    sys.exit(main())
