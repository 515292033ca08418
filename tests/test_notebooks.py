"""The chapters as files: no outputs, one parameters cell, parameters that papermill can reach."""

import re
from pathlib import Path

import build_book
import nbformat
import papermill
import pytest

pytestmark = pytest.mark.unit
ROOT = Path(__file__).parent.parent
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
each_chapter = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


def cells(path: Path, kind: str = "code") -> list[nbformat.NotebookNode]:
    return [cell for cell in nbformat.read(path, as_version=4).cells if cell.cell_type == kind]


def test_the_contents_list_every_chapter_and_no_other():
    listed = [page for page in build_book.toc_pages(ROOT) if page.startswith("notebooks/")]
    assert listed == [f"notebooks/{path.stem}" for path in NOTEBOOKS]


@each_chapter
def test_no_outputs_are_committed(path):
    assert not [cell for cell in cells(path) if cell.outputs or cell.execution_count]


@each_chapter
def test_kernel_is_the_one_papermill_and_nbmake_look_for(path):
    kernel = nbformat.read(path, as_version=4).metadata.kernelspec
    assert (kernel.name, kernel.language) == ("python3", "python")


@each_chapter
def test_one_parameters_cell_with_the_profile(path):
    tagged = [cell for cell in cells(path) if "parameters" in cell.metadata.get("tags", [])]
    assert len(tagged) == 1
    assert "profile" in papermill.inspect_notebook(str(path))


@each_chapter
def test_the_profile_follows_the_environment(path):
    (tagged,) = [cell for cell in cells(path) if "parameters" in cell.metadata.get("tags", [])]
    assert "FEDVLA_PROFILE" in tagged.source or "profile = None" in tagged.source


@each_chapter
def test_every_parameter_is_used_below_its_cell(path):
    code = cells(path)
    place = next(i for i, cell in enumerate(code) if "parameters" in cell.metadata.get("tags", []))
    below = "\n".join(cell.source for cell in code[place + 1 :])
    unused = [name for name in papermill.inspect_notebook(str(path)) if not re.search(rf"\b{name}\b", below)]
    assert not unused


@each_chapter
def test_a_title_first_and_one_only(path):
    text = [cell.source for cell in cells(path, "markdown")]
    assert text[0].startswith("# ")
    assert sum(len(re.findall(r"^# ", source, flags=re.MULTILINE)) for source in text) == 1


@each_chapter
def test_no_cell_may_fail(path):
    assert not [cell for cell in cells(path) if "raises-exception" in cell.metadata.get("tags", [])]
