"""The pages about the library say what its code and the chapters say."""

import re
import subprocess
import sys
from pathlib import Path

import nbformat
import networkx
import pytest

import library
from test_fences import MODULES, ours

ROOT = Path(__file__).parents[1]


@pytest.mark.unit
def test_the_picture_shows_every_module_and_implies_every_import():
    graph = library.imports(library.modules(ROOT))
    assert {name: set(graph.successors(name)) for name in graph} == {name: ours(name) for name in graph}
    assert set(graph) == set(MODULES) - {"__init__"}
    drawn = library.picture(graph)
    assert set(re.findall(r">(\w+)</text>", drawn)) == set(graph) - library.ABOVE_ALL
    shown = networkx.transitive_reduction(graph.subgraph(set(graph) - library.ABOVE_ALL))
    assert drawn.count("<path") == shown.number_of_edges()


@pytest.mark.unit
def test_a_new_import_changes_the_picture():
    graph = library.imports(library.modules(ROOT))
    before = library.picture(graph)
    graph.add_edge("spec", "player")  # two modules that import nothing
    assert library.picture(graph) != before


@pytest.mark.unit
def test_what_a_module_uses_stands_above_it():
    graph = library.imports(library.modules(ROOT))
    places = re.findall(r'<rect x="\d+" y="(\d+)".*?>(\w+)</text>', library.picture(graph))
    height = {name: int(y) for y, name in places}
    upward = [(a, b) for a, b in graph.edges if a in height and b in height and height[b] >= height[a]]
    assert not upward


def notebook(folder: Path, name: str, code: str) -> Path:
    nbformat.write(nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(code)]), folder / f"{name}.ipynb")
    return folder / f"{name}.ipynb"


@pytest.mark.unit
def test_uses_are_found_by_name_and_through_the_module(tmp_path):
    one = notebook(
        tmp_path, "01", "from fedvla_lib import model\nfrom fedvla_lib.policy.parameters import average as mean"
    )
    two = notebook(tmp_path, "02", "%time 1\nfrom fedvla_lib import model\nmodel.load_policy(3)\nother.load_policy()")
    used = library.used_in([one, two])
    assert used["fedvla_lib.policy.parameters.average"] == ["01"] and used["fedvla_lib.policy.model"] == ["01", "02"]
    assert used["fedvla_lib.policy.model.load_policy"] == ["02"] and len(used) == 3


@pytest.mark.integration
def test_a_described_function_links_to_its_chapter_and_equations_have_numbers(tmp_path):
    """With the settings of the book, strictly; a small module, so that nothing heavy is imported."""
    (tmp_path / "notebooks").mkdir()
    notebook(tmp_path / "notebooks", "one", "from fedvla_book.video_player import video_figure")
    tree = {"player": library.modules(ROOT)["player"]}
    (tmp_path / "index.md").write_text(f"# Functions\n\n$$ a = 1 $$\n\n$$\nb = 2\n$$\n\n{library.reference(tree)}")
    (tmp_path / "notebooks" / "one.md").write_text("---\norphan: true\n---\n# The chapter\n")
    (tmp_path / "conf.py").write_text(
        "extensions = ['myst_parser', 'sphinx.ext.autodoc', 'sphinx.ext.napoleon', 'site_scripts']\n"
        "myst_enable_extensions = ['dollarmath']\nnumfig = True\n"
        "exclude_patterns = ['*/*.ipynb']\nnitpick_ignore_regex = [['py:.*', '.*']]\n"
    )
    environment = {
        "PYTHONPATH": f"{ROOT / 'book/tools'}:{ROOT}:{ROOT / 'book'}",
        "PATH": str(Path(sys.executable).parent),
    }
    command = [sys.executable, "-m", "sphinx", "-q", "-n", "-W", str(tmp_path), str(tmp_path / "html")]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "html" / "index.html").read_text()
    assert re.findall(r'class="eqno">\(([^<]*)\)<a class="headerlink" href="(#[^"]*)"', page) == [
        ("1", "#equation-1"), ("2", "#equation-2")
    ]  # fmt: skip
    described = page[page.index('id="fedvla_book.video_player.video_figure"') :]
    assert re.search(r'In the book: <a class="reference internal" href="notebooks/one.html"', described)
    assert "no frames that can be read" in described


@pytest.mark.unit
def test_every_documented_module_has_a_section_and_a_row():
    trees = library.modules(ROOT)
    sections = set(re.findall(r"automodule:: fedvla_lib\.(\w+)", library.reference(trees)))
    assert {"model", "engine", "strategies", "player"} <= sections <= set(trees)
    used = {"fedvla_lib.policy.model.load_policy": ["03_local_training"]}
    rows = library.table(ROOT, used).splitlines()[2:]
    assert len(rows) == len(trees)
    assert [row for row in rows if "03_local_training" in row] == [row for row in rows if row.startswith("| `model` |")]
