"""The checklist ticks only what was tested, and chapters show the library's own source."""

import ast
import inspect
import re
from importlib import import_module
from pathlib import Path

import nbformat
import pytest

import library
from fedvla_book import checklist
from fedvla_lib.federation.strategies import fedprox

pytestmark = pytest.mark.unit
ROOT = Path(__file__).parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
LINES = 60  # more than a reader takes in at once


def test_a_tick_needs_a_test_that_holds():
    shown = repr(checklist.checklist(data=True, global_update=True))
    assert shown.count("☑") == 2 and "☑ data" in shown and "☑ global update" in shown and "model" not in shown
    with pytest.raises(AssertionError, match="'training'"):
        checklist.checklist(data=True, training=False)
    with pytest.raises(ValueError, match="'dta'.*environment"):
        checklist.checklist(dta=True)


def test_the_page_on_reading_explains_every_step():
    page = (ROOT / "book" / "how_to_read.md").read_text()
    steps = page.split("(checklist)=")[1].split("\n## ")[1]
    assert re.findall(r"^- \*\*([a-z ]+)\*\*: ", steps, flags=re.MULTILINE) == [
        step.replace("_", " ") for step in checklist.STEPS
    ]


def test_what_is_shown_is_what_runs_and_only_the_librarys():
    shown = checklist.show(fedprox.Proximal)._repr_markdown_()
    module = Path(fedprox.__file__).read_text()
    assert shown.startswith("```python\nclass Proximal") and shown.removeprefix("```python\n")[:-3] in module
    with pytest.raises(ValueError, match="Path is in pathlib"):
        checklist.show(Path)


def code_of(path):
    cells = [cell.source for cell in nbformat.read(path, as_version=4).cells if cell.cell_type == "code"]
    return "\n".join(cells)


def named(name, imports):
    """The object that a dotted name stands for, given (module, name in it) of each imported name."""
    first, *rest = name.split(".")
    module, inside = imports[first]
    try:
        found = getattr(import_module(module), inside)
    except AttributeError:
        found = import_module(f"{module}.{inside}")
    for part in rest:
        found = getattr(found, part)
    return found


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_chapter_shows_the_source_of_what_it_teaches(path):
    """Through `show` alone: code of the library typed into a chapter could differ from what runs."""
    code = code_of(path)
    tree = ast.parse(code)
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call)]
    shown = [ast.unparse(call.args[0]) for call in calls if getattr(call.func, "id", "") == "show"]
    assert shown and "getsource" not in code
    froms = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    imports = {alias.asname or alias.name: (node.module, alias.name) for node in froms for alias in node.names}
    for name in shown:
        found = named(name, imports)
        assert found.__module__.startswith("fedvla_lib."), name
        assert len(inspect.getsource(found).splitlines()) <= LINES, name


def test_no_chapter_retypes_a_function_of_the_library():
    book = [ast.parse(file.read_text()) for file in (ROOT / "book" / "fedvla_book").rglob("*.py")]
    trees = [*library.modules(ROOT).values(), *book]
    functions = {ast.dump(node) for tree in trees for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}
    assert len(functions) > 500
    for path in NOTEBOOKS:
        own = [node for node in ast.walk(ast.parse(code_of(path))) if isinstance(node, ast.FunctionDef)]
        assert not [node.name for node in own if ast.dump(node) in functions], path.name
