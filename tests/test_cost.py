"""Cost of a chapter: measured at its end, stored from a build, shown at its top; a dash is what was not measured."""

import json
import subprocess
import sys
from pathlib import Path

import nbformat
import pytest
from nbformat import v4

import keep_costs
from fedvla_book import chapter_cost

pytestmark = pytest.mark.unit
ROOT = Path(__file__).parents[1]


def logged(folder, **replies):
    folder.mkdir(parents=True)
    event = {"round": 1, "who": "global", "kind": "replies", "time": "", "values": replies}
    (folder / "metrics.jsonl").write_text(json.dumps(event) + "\n")


def test_spent_adds_up_what_the_federations_exchanged_each_once(tmp_path):
    logged(tmp_path / "runs" / "one", to="train", sent_bytes=2_000_000, received_bytes=500_000)
    logged(tmp_path / "runs" / "two", to="train", sent_bytes=1_000_000, received_bytes=0)
    folders = [tmp_path / "runs", tmp_path / "runs" / "one"]
    found = chapter_cost.spent(12.34, "tiny", 3, folders)
    assert found.exchanged_mb == 3.5 and found.seconds == 12.3
    assert "3.5 MB" in repr(found) and "profile tiny, seed 3" in repr(found).lower()
    assert "exchanged" not in repr(chapter_cost.spent(1, "tiny", 0))


HOLDS = """
import numpy as np
from fedvla_book import chapter_cost
before = chapter_cost.spent(0, "tiny", 0).memory_mb
held = np.ones(80_000_000)  # 640 MB
del held
print(before, chapter_cost.spent(0, "tiny", 0).memory_mb)
"""


def test_memory_is_the_most_that_was_held():
    """In a process of its own: this one may have held more before."""
    said = subprocess.run([sys.executable, "-c", HOLDS], check=True, capture_output=True, text=True).stdout
    before, after = map(float, said.split())
    assert 600 < after - before < 700


def executed(folder, name, *, built=True, said=True):
    """An executed chapter as a build leaves it."""
    data, metadata = chapter_cost.spent(5, "tiny", 0)._repr_mimebundle_()
    shown = v4.new_output("execute_result", data=data, metadata=metadata)
    cell = v4.new_code_cell("chapter_cost.spent()", outputs=[shown] if said else [])
    notebook = v4.new_notebook(cells=[cell], metadata={"fedvla": {"seconds": 7.5}} if built else {})
    folder.mkdir(parents=True, exist_ok=True)
    nbformat.write(notebook, folder / f"{name}.ipynb")


def test_what_a_build_measured_is_kept_and_shown(tmp_path):
    chapters = "".join(f"- file: notebooks/{name}\n" for name in ("01_a", "02_b"))
    (tmp_path / "_toc.yml").write_text(f"format: jb-book\nroot: a\nchapters:\n{chapters}")
    (tmp_path / "notebooks").mkdir()
    text = v4.new_notebook(cells=[v4.new_markdown_cell("word " * 1000)])
    for name in ("01_a", "02_b", "03_c"):
        nbformat.write(text, tmp_path / "notebooks" / f"{name}.ipynb")
    folder = tmp_path / "_build" / "tiny" / "executed"
    executed(folder, "01_a")
    with pytest.raises(ValueError, match=r"not executed at profile tiny: 02_b"):
        keep_costs.keep(tmp_path, "tiny")
    executed(folder, "02_b", said=False)
    kept = keep_costs.keep(tmp_path, "tiny")

    def box(chapter):
        return chapter_cost.measured(chapter, kept.parent, tmp_path / "notebooks")

    shown = box("01_a")
    assert shown.loc["tiny", "time [s]"] == "8" and float(shown.loc["tiny", "memory [MB]"].replace(",", "")) > 10
    assert set(shown.loc["laptop"]) == {5, "–"}, "five minutes of reading"
    assert shown.to_html().split("</thead>")[0].count("<tr") == 1, "one row of heads, in a small box"
    assert box("02_b").loc["tiny"].tolist()[:4] == [5, "8", "–", "–"]
    assert set(box("03_c").to_numpy().ravel()) == {5, "–"}


def test_a_copy_that_no_build_made_is_refused(tmp_path):
    executed(tmp_path, "01_a", built=False)
    with pytest.raises(ValueError, match="01_a.ipynb was not executed by make book"):
        keep_costs.measured_in(tmp_path / "01_a.ipynb")


def test_the_cost_of_chapters_that_ran_side_by_side_is_not_kept(tmp_path):
    executed(tmp_path, "01_a")
    notebook = nbformat.read(tmp_path / "01_a.ipynb", as_version=4)
    notebook.metadata["fedvla"]["at_a_time"] = 2
    nbformat.write(notebook, tmp_path / "01_a.ipynb")
    with pytest.raises(ValueError, match="01_a.ipynb was executed as one of 2 at a time"):
        keep_costs.measured_in(tmp_path / "01_a.ipynb")


def test_the_kept_costs_are_of_the_chapters_that_there_are():
    chapters = {path.stem for path in (ROOT / "notebooks").glob("*.ipynb")}
    files = sorted((ROOT / "book" / "reference" / "costs").glob("*.json"))
    assert "laptop" in {file.stem for file in files}
    for file in files:
        assert set(json.loads(file.read_text())["chapters"]) == chapters, file.name
