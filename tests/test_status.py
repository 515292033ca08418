"""The status page says what the files say: chapters' stamps, the tests' reports, the stored runs."""

import json
import platform
from pathlib import Path

import nbformat
import pytest

import status

pytestmark = pytest.mark.unit
ROOT = Path(__file__).parents[1]
JUNIT = """<testsuites>
<testsuite tests="12" failures="1" errors="1" skipped="2" timestamp="2026-01-31T14:25:01" hostname="box"/>
</testsuites>"""
COVERAGE = '<coverage lines-valid="80" lines-covered="70" branches-valid="20" branches-covered="15" line-rate="1"/>'


def chapter(folder: Path, name: str, **stamp) -> Path:
    nbformat.write(nbformat.v4.new_notebook(metadata={"fedvla": stamp}), folder / f"{name}.ipynb")
    return folder / f"{name}.ipynb"


def test_chapters_are_listed_with_their_place(tmp_path):
    notebook = nbformat.v4.new_code_cell('profile = "tiny"\nseed = 7', metadata={"tags": ["parameters"]})
    kernel = {"kernelspec": {"name": "python3", "display_name": "Python 3", "language": "python"}}
    nbformat.write(nbformat.v4.new_notebook(cells=[notebook], metadata=kernel), tmp_path / "source.ipynb")
    where = status.environment(tmp_path / "source.ipynb", "tiny")
    one = chapter(tmp_path, "01_data", seconds=12.4, environment=where)
    two = chapter(tmp_path, "02_partitioning", seconds=3.0)  # of a build that kept no place
    text = status.status(ROOT, [one, two], "tiny")
    when = where["started"][:16].replace("T", " ")
    assert f"| [](../notebooks/01_data.ipynb) | 12 | 7 | {when} |" in text
    assert "| **total** | **15** |" in text and "| 2 | – | – |" in text and "chapters in parallel" not in text
    assert f"torch {where['versions']['torch']}" in text and f"{where['hardware']['cores']} cores" in text
    assert platform.node() not in json.dumps(where), "no host names"
    shared = chapter(tmp_path, "03_local_training", seconds=30.0, at_a_time=2)
    assert "Profile `tiny`, 2 chapters in parallel" in status.status(ROOT, [one, shared], "tiny")


def test_reports_of_the_tests_are_shown_where_they_are(tmp_path):
    assert "make test" in status._tests(tmp_path)
    (tmp_path / "junit.xml").write_text(JUNIT)
    assert "| 8 | 2 | 2 | – | 2026-01-31 14:25 |" in status._tests(tmp_path)
    (tmp_path / "coverage.xml").write_text(COVERAGE)
    assert "| 85% |" in status._tests(tmp_path) and "box" not in status._tests(tmp_path)


def test_stored_experiments_are_dated():
    text = status._reference(ROOT / "book" / "reference")
    stamps = [json.loads(file.read_text()) for file in (ROOT / "book/reference/comparison").glob("*/stamp.json")]
    row = next(line for line in text.splitlines() if line.startswith("| `comparison` |"))
    assert f"| {len(stamps)} |" in row and max(stamp["started"] for stamp in stamps)[:10] in row
    assert "`replay`" not in text, "cells for a test are no result"
    assert "earlier |" not in row, "a stored run of other code has a note"
