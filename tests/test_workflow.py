"""The checklist ticks what was tested, and nothing else; source that is shown is the library's."""

import ast
import inspect
from pathlib import Path

import nbformat
import pytest

from fedvla_book import checklist
from fedvla_lib.federation.strategies import fedprox

pytestmark = pytest.mark.unit
NOTEBOOKS = sorted((Path(__file__).parents[1] / "notebooks").glob("*.ipynb"))
LINES = 60  # more than a reader takes in at once


def test_a_tick_needs_a_test_that_holds():
    shown = repr(checklist.checklist(data=True, global_update=True))
    assert shown.count("☑") == 2 and "☑ data" in shown and "☑ global update" in shown and "☐ model" in shown
    with pytest.raises(AssertionError, match="'training'"):
        checklist.checklist(data=True, training=False)
    with pytest.raises(ValueError, match="'dta'.*environment"):
        checklist.checklist(dta=True)


def test_what_is_shown_is_what_runs_and_only_the_librarys():
    shown = checklist.show(fedprox.Proximal)._repr_markdown_()
    module = Path(training.__file__).read_text()
    assert shown.startswith("```python\nclass Proximal") and shown.removeprefix("```python\n")[:-3] in module
    with pytest.raises(ValueError, match="Path is of pathlib"):
        checklist.show(Path)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_chapter_shows_the_source_of_what_it_teaches(path):
    """Through `show` alone: code of the library typed into a chapter could differ from what runs."""
    cells = [cell.source for cell in nbformat.read(path, as_version=4).cells if cell.cell_type == "code"]
    code = "\n".join(cells)
    tree = ast.parse(code)
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call)]
    shown = [ast.unparse(call.args[0]) for call in calls if getattr(call.func, "id", "") == "show"]
    assert shown and "getsource" not in code
    from_where = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    names = {alias.name: node.module for node in from_where for alias in node.names}
    for name in shown:
        module, _, inside = name.rpartition(".")
        file = module or names[inside].removeprefix("fedvla_lib.")
        assert _lines(file, inside) <= LINES, name


def _lines(module, name):
    """How long a function or class of the library is."""
    body = ast.parse((Path(inspect.getfile(checklist)).parent / f"{module}.py").read_text()).body
    (found,) = [node for node in body if getattr(node, "name", "") == name]
    return found.end_lineno - found.lineno + 1


def test_no_chapter_retypes_a_function_of_the_library():
    library = set()
    for module in Path(inspect.getfile(checklist)).parent.glob("*.py"):
        functions = [node for node in ast.walk(ast.parse(module.read_text())) if isinstance(node, ast.FunctionDef)]
        library |= {ast.dump(node) for node in functions}
    for path in NOTEBOOKS:
        cells = [cell.source for cell in nbformat.read(path, as_version=4).cells if cell.cell_type == "code"]
        own = [node for node in ast.walk(ast.parse("\n".join(cells))) if isinstance(node, ast.FunctionDef)]
        assert not [node.name for node in own if ast.dump(node) in library], path.name
