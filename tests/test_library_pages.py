"""The pages about the library say what its code and the chapters say."""

import re
import subprocess
import sys
from pathlib import Path

import nbformat
import networkx
import pytest

import library
from test_fences import ours

ROOT = Path(__file__).parents[1]


@pytest.mark.unit
def test_the_picture_shows_every_module_in_its_room_and_the_arrows_imply_every_import():
    graph = library.imports(library.modules(ROOT))
    assert {name: set(graph.successors(name)) for name in graph} == {name: ours(name) for name in graph}
    drawn = library.picture(graph)
    shown = {word for text in re.findall(r">([\w. ]+)</text>", drawn) for word in text.split()}
    house = library.between_rooms(graph)
    assert shown == set(house) | {name.removeprefix(f"{library.room_of(name)}.") for name in graph}
    assert drawn.count("<path") == networkx.transitive_reduction(house).number_of_edges()


@pytest.mark.unit
def test_a_new_import_between_rooms_changes_the_picture():
    graph = library.imports(library.modules(ROOT))
    before = library.picture(graph)
    graph.add_edge("pretraining.recipe", "federation.drift")
    assert library.picture(graph) != before


@pytest.mark.unit
def test_what_a_room_uses_stands_above_it():
    graph = library.imports(library.modules(ROOT))
    box = r'<rect x="[\d.]+" y="(\d+)"[^>]*/><text[^>]*font-weight="bold"[^>]*>(\w+)<'
    height = {room: int(y) for y, room in re.findall(box, library.picture(graph))}
    house = library.between_rooms(graph)
    assert set(height) == set(house) and not [(a, b) for a, b in house.edges if height[b] >= height[a]]


def notebook(folder: Path, name: str, code: str) -> Path:
    nbformat.write(nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(code)]), folder / f"{name}.ipynb")
    return folder / f"{name}.ipynb"


@pytest.mark.unit
def test_uses_are_found_by_name_and_through_the_module(tmp_path):
    by_name = "from fedvla_lib.policy import model\nfrom fedvla_lib.policy.parameters import average as mean"
    through = "%time 1\nfrom fedvla_lib.policy import model\nmodel.load_policy(3)\nother.load_policy()"
    one, two = notebook(tmp_path, "01", by_name), notebook(tmp_path, "02", through)
    used = library.used_in([one, two])
    assert used["fedvla_lib.policy.parameters.average"] == ["01"] and used["fedvla_lib.policy.model"] == ["01", "02"]
    assert used["fedvla_lib.policy.model.load_policy"] == ["02"] and len(used) == 3


@pytest.mark.integration
def test_a_described_function_links_to_its_chapter_and_its_room_and_equations_have_numbers(tmp_path):
    """With the settings of the book, strictly; a small module, so that nothing heavy is imported."""
    (tmp_path / "notebooks").mkdir()
    notebook(tmp_path / "notebooks", "one", "from fedvla_lib.evaluation.video import read_video")
    tree = {"evaluation.video": library.modules(ROOT)["evaluation.video"]}
    described = library.reference(tree, library.rooms(ROOT))
    (tmp_path / "index.md").write_text(f"# Functions\n\n$$ a = 1 $$\n\n$$\nb = 2\n$$\n\n{described}")
    table = library.table(library.modules(ROOT), library.rooms(ROOT), {})
    house = f"---\norphan: true\n---\n# House\n\n## Rooms\n\n{table}"
    (tmp_path / "architecture.md").write_text(house)
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
    assert 'href="architecture.html#room-evaluation"' in page
    described = page[page.index('id="fedvla_lib.evaluation.video.read_video"') :]
    assert re.search(r'In the book: <a class="reference internal" href="notebooks/one.html"', described)
    assert "uint8 (T, H, W, 3)" in described


@pytest.mark.unit
def test_every_documented_module_has_a_section_and_a_row_in_its_room():
    trees, rooms = library.modules(ROOT), library.rooms(ROOT)
    sections = set(re.findall(r"automodule:: fedvla_lib\.([\w.]+)", library.reference(trees, rooms)))
    assert {"policy.model", "engines.inline", "federation.strategies.scaffold", "config"} <= sections <= set(trees)
    used = {"fedvla_lib.policy.model.load_policy": ["03_local_training"]}
    page = library.table(trees, rooms, used)
    assert re.findall(r"^\(room-(\w+)\)=$", page, re.M) == [library.ROOT_FILES, *(r for r in rooms if "." not in r)]
    rows = re.findall(r"^\| `.*", page, re.M)
    assert len(rows) == len(trees)
    assert [row for row in rows if "03_local_training" in row] == [row for row in rows if "`policy.model`" in row]


@pytest.mark.unit
def test_the_readme_names_every_room_and_the_answers_of_the_architecture_page_exist():
    readme, page = (ROOT / "README.md").read_text(), (ROOT / "book/architecture.md").read_text()
    assert not [room for room in library.rooms(ROOT) if "." not in room and f"`fedvla_lib/{room}/`" not in readme]
    asked, answers = page.split("## Twelve questions")[1].split("<details>")
    assert len(re.findall(r"^\d+\. .*\?$", asked, re.M)) == 12
    files = re.findall(r"^\d+\. `([\w/]+\.py)`$", answers, re.M)
    assert len(files) == 12 and not [file for file in files if not (ROOT / "fedvla_lib" / file).is_file()]
