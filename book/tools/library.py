"""The library as pages: every public function with the chapters that use it, and which module imports which.

Both are read from the code and from the chapters each time that the book is built, so they cannot be out of date.
"""

import ast
from collections.abc import Iterable, Iterator
from html import escape
from pathlib import Path

import nbformat
import networkx
from IPython.core.inputtransformer2 import TransformerManager

PACKAGE = "fedvla_lib"
ABOVE_ALL = {"cli", "doctor"}  # look at everything, from inside functions: their arrows would hide the others
BOX, GAP, ROW, PAD = 112, 10, 64, 16  # of the picture, in pixels


def modules(root: Path) -> dict[str, ast.Module]:
    """Return the library's modules by name, parsed."""
    files = sorted((root / PACKAGE).glob("*.py"))
    return {file.stem: ast.parse(file.read_text(encoding="utf-8")) for file in files if file.stem != "__init__"}


def imports(trees: dict[str, ast.Module]) -> networkx.DiGraph:
    """Return the graph of modules; an arrow goes from a module to one that it imports, anywhere in its code."""
    graph = networkx.DiGraph()
    graph.add_nodes_from(sorted(trees))
    for name, tree in trees.items():
        used = {full.split(".")[1] for full in _names(tree).values() if full.count(".")}
        graph.add_edges_from((name, other) for other in sorted(used & set(trees)))
    return graph


def _names(tree: ast.AST) -> dict[str, str]:
    """What the names that are imported from the library stand for, such as ``model -> fedvla_lib.policy.model``."""
    found = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == PACKAGE:
            found |= {alias.asname or alias.name: f"{node.module}.{alias.name}" for alias in node.names}
        if isinstance(node, ast.Import):
            found |= {a.asname or a.name: a.name for a in node.names if a.name.split(".")[0] == PACKAGE}
    return found


def used_in(notebooks: Iterable[Path]) -> dict[str, list[str]]:
    """Return by the full name of everything of the library that chapters use, which ones do, in the book's order."""
    found: dict[str, list[str]] = {}
    for path in notebooks:
        cells = nbformat.read(path, as_version=4).cells
        python = TransformerManager().transform_cell  # magics as calls
        trees = [ast.parse(python(cell.source)) for cell in cells if cell.cell_type == "code"]
        for full in sorted(_uses(trees)):
            found.setdefault(full, []).append(path.stem)
    return found


def _uses(trees: list[ast.Module]) -> Iterator[str]:
    """Yield the full names of what code takes from the library: imported by name, or through its module."""
    names = {name: full for tree in trees for name, full in _names(tree).items()}
    yield from set(names.values())
    nodes = [node for tree in trees for node in ast.walk(tree) if isinstance(node, ast.Attribute)]
    through = {(node.value.id, node.attr) for node in nodes if isinstance(node.value, ast.Name)}
    yield from {f"{names[name]}.{attribute}" for name, attribute in through if name in names}


def reference(trees: dict[str, ast.Module]) -> str:
    """Return a section for each module that documents something, for Sphinx's autodoc to fill."""
    parts = []
    for name, tree in trees.items():
        public = [node.name for node in tree.body if isinstance(node, ast.FunctionDef | ast.ClassDef)]
        if any(not one.startswith("_") for one in public):
            directive = f".. automodule:: {PACKAGE}.{name}\n   :members:\n"
            parts.append(f"## {name}\n\n```{{eval-rst}}\n{directive}```\n")
    return "\n".join(parts)


def table(root: Path, used: dict[str, list[str]]) -> str:
    """Return the modules as a Markdown table: what each is for, and the first chapter that uses it."""
    lines = ["| module | what it is for | first used in |", "|---|---|---|"]
    for name, tree in modules(root).items():
        said = " ".join((ast.get_docstring(tree) or "").split("\n\n")[0].split()).replace("|", "\\|")
        full = f"{PACKAGE}.{name}"
        chapters = sorted({one for key, found in used.items() if f"{key}.".startswith(f"{full}.") for one in found})
        lines.append(f"| `{name}` | {said} | {f'[](../notebooks/{chapters[0]}.ipynb)' if chapters else ''} |")
    return "\n".join(lines) + "\n"


def picture(graph: networkx.DiGraph) -> str:
    """Return the imports as an SVG: what a module imports, directly or through others, stands above it.

    Only arrows that no longer path implies are drawn.
    """
    shown = networkx.transitive_reduction(graph.subgraph(set(graph) - ABOVE_ALL))
    rows = [sorted(row) for row in networkx.topological_generations(shown.reverse())]
    rows = _untangled([part for row in rows for part in _parts(row)], shown)
    width = max(map(len, rows)) * (BOX + GAP) - GAP + 2 * PAD
    numbered = [(row, len(names), *one) for row, names in enumerate(rows) for one in enumerate(names)]
    place = {name: _corner(row, column, columns, width) for row, columns, column, name in numbered}
    arrows = [_arrow(place[above], place[below]) for below, above in sorted(shown.edges)]
    boxes = [_box(name, *place[name]) for name in sorted(place)]
    size = f'width="{width}" height="{len(rows) * ROW + PAD}" viewBox="0 0 {width} {len(rows) * ROW + PAD}"'
    ground = '<rect width="100%" height="100%" fill="#fff"/>'
    return f'<svg xmlns="http://www.w3.org/2000/svg" {size}>\n{ground}\n' + "\n".join([*arrows, *boxes]) + "\n</svg>\n"


def _parts(row: list[str], most: int = 8) -> list[list[str]]:
    return [row[start : start + most] for start in range(0, len(row), most)]


def _untangled(rows: list[list[str]], graph: networkx.DiGraph) -> list[list[str]]:
    """Order each row by the mean place of what its modules import, so that arrows cross less."""
    place: dict[str, float] = {}
    for row in rows:
        mean = {name: _mean([place[above] for above in graph.successors(name)]) for name in row}
        row.sort(key=lambda name, mean=mean: (mean[name], name))
        place |= {name: (column + 0.5) / len(row) for column, name in enumerate(row)}
    return rows


def _mean(values: list[float]) -> float:
    return sum(values) / len(values) if values else 0.5


def _corner(row: int, column: int, columns: int, width: int) -> tuple[float, float]:
    left = (width - columns * (BOX + GAP) + GAP) / 2
    return left + column * (BOX + GAP), PAD + row * ROW


def _arrow(above: tuple[float, float], below: tuple[float, float]) -> str:
    start, end = (above[0] + BOX / 2, above[1] + 26), (below[0] + BOX / 2, below[1])
    return (
        f'<path d="M{start[0]:.0f},{start[1]:.0f} C{start[0]:.0f},{start[1] + 24:.0f} {end[0]:.0f},{end[1] - 24:.0f} '
        f'{end[0]:.0f},{end[1]:.0f}" fill="none" stroke="#0072b2" stroke-opacity="0.45"/>'
    )


def _box(name: str, x: float, y: float) -> str:
    return (
        f'<g><rect x="{x:.0f}" y="{y:.0f}" width="{BOX}" height="26" rx="4" fill="#f2f2f2" stroke="#444"/>'
        f'<text x="{x + BOX / 2:.0f}" y="{y + 17:.0f}" text-anchor="middle" font-family="sans-serif" font-size="12">'
        f"{escape(name)}</text></g>"
    )
