"""Generated pages of the library: public functions with the chapters that use them, and the import graph."""

import ast
from collections.abc import Iterable, Iterator
from html import escape
from pathlib import Path

import nbformat
import networkx
from IPython.core.inputtransformer2 import TransformerManager

PACKAGE = "fedvla_lib"
ROOT_FILES = "root"  # stands for the package of the modules that are in none
ROOT_SAYS = "What every package may use."
ARROWHEAD = (
    '<defs><marker id="head" viewBox="0 0 8 8" refX="2" refY="4" markerWidth="5" markerHeight="5" orient="auto">'
    '<polygon points="0,0 8,4 0,8" fill="#0072b2"/></marker></defs>'
)
LINE_STYLE = 'fill="none" stroke="#0072b2" stroke-width="2" marker-end="url(#head)"'
CHAR, LINE, PAD, GAP, WIDTH = 6.6, 18, 12, 34, 760  # of the figure, in pixels


def modules(root: Path) -> dict[str, ast.Module]:
    """Return the library's modules by name, such as ``robot.sim``, parsed; packages are not among them.

    Raises:
        ValueError: there is none: a check of the modules must not pass on an empty list.
    """
    folder = root / PACKAGE
    files = [file for file in sorted(folder.rglob("*.py")) if not file.name.startswith("__")]
    if not files:
        raise ValueError(f"{folder} holds no module")
    name = {file: ".".join(file.relative_to(folder).with_suffix("").parts) for file in files}
    return {name[file]: ast.parse(file.read_text(encoding="utf-8")) for file in files}


def rooms(root: Path) -> dict[str, str]:
    """Return the library's packages, nested ones too, and what the docstring of each says."""
    files = sorted((root / PACKAGE).rglob("*/__init__.py"))
    name = {file: ".".join(file.parent.relative_to(root / PACKAGE).parts) for file in files}
    return {name[file]: ast.get_docstring(ast.parse(file.read_text(encoding="utf-8"))) or "" for file in files}


def room_of(module: str) -> str:
    """Return the outermost package of a module, or `ROOT_FILES`."""
    return module.split(".")[0] if "." in module else ROOT_FILES


def imports(trees: dict[str, ast.Module]) -> networkx.DiGraph:
    """Return the graph of modules; an arrow goes from a module to one that it imports, anywhere in its code."""
    graph = networkx.DiGraph()
    graph.add_nodes_from(sorted(trees))
    for name, tree in trees.items():
        used = set()
        for full in _imported(tree):
            inside = full.removeprefix(f"{PACKAGE}.")
            used |= {inside, inside.rpartition(".")[0]} & set(trees)
        graph.add_edges_from((name, other) for other in sorted(used))
    return graph


def between_rooms(graph: networkx.DiGraph) -> networkx.DiGraph:
    """Return the graph of packages: an arrow goes from a package to one of which it imports a module."""
    found = networkx.DiGraph()
    found.add_nodes_from(room_of(name) for name in graph)
    found.add_edges_from((room_of(a), room_of(b)) for a, b in graph.edges if room_of(a) != room_of(b))
    return found


def _imported(tree: ast.AST) -> set[str]:
    """Full names of what is imported from the library, at the top or inside functions."""
    nodes = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    froms = [node for node in nodes if (node.module or "").split(".")[0] == PACKAGE]
    plain = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    return {f"{node.module}.{alias.name}" for node in froms for alias in node.names} | plain


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
    """Return which chapters use what of the library, by its full name, in the book's order."""
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


def reference(trees: dict[str, ast.Module], described: dict[str, str]) -> str:
    """Return a section for each package and each of its documented modules, for Sphinx's autodoc to fill."""
    parts, room = [], ""
    for name in sorted(trees, key=lambda name: (room_of(name) != ROOT_FILES, name)):
        public = [node.name for node in trees[name].body if isinstance(node, ast.FunctionDef | ast.ClassDef)]
        if not any(not one.startswith("_") for one in public):
            continue
        if (own := room_of(name)) != room:
            room, told = own, _first_paragraph(described.get(own, ROOT_SAYS))
            parts.append(f"## {own}\n\n{told}\nIts place in the library: {{ref}}`room-{own}`.\n")
        parts.append(f"### {name}\n\n```{{eval-rst}}\n.. automodule:: {PACKAGE}.{name}\n   :members:\n```\n")
    return "\n".join(parts)


def table(trees: dict[str, ast.Module], described: dict[str, str], used: dict[str, list[str]]) -> str:
    """Return a section for each package: its paragraph, and its modules in a table, with the first chapter to use each.

    Nested packages are listed with the one that they are in.
    """
    parts = []
    for room in [ROOT_FILES, *(name for name in described if "." not in name)]:
        words = described.get(room, ROOT_SAYS).replace("\n\n", "\n")
        parts += [f"(room-{room})=", f"### {room}", "", words, ""]
        parts += [described[inner].replace("\n\n", "\n") + "\n" for inner in described if inner.startswith(f"{room}.")]
        parts += ["| module | what it is for | first used in |", "|---|---|---|"]
        parts += [_row(name, tree, used) for name, tree in trees.items() if room_of(name) == room] + [""]
    return "\n".join(parts)


def _row(name: str, tree: ast.Module, used: dict[str, list[str]]) -> str:
    full = f"{PACKAGE}.{name}"
    chapters = sorted({one for key, found in used.items() if f"{key}.".startswith(f"{full}.") for one in found})
    said = _first_paragraph(ast.get_docstring(tree) or "").replace("|", "\\|")
    return f"| `{name}` | {said} | {f'[](../notebooks/{chapters[0]}.ipynb)' if chapters else ''} |"


def _first_paragraph(text: str) -> str:
    return " ".join(text.split("\n\n")[0].split())


def picture(graph: networkx.DiGraph) -> str:
    """Return the packages as an SVG, their modules in them: what a package imports stands above it.

    Only arrows that no longer path implies are drawn.
    """
    house = between_rooms(graph)
    rows = [sorted(row) for row in networkx.topological_generations(house.reverse())]
    inside = {room: [name for name in graph if room_of(name) == room] for room in house}
    boxes, top = {}, PAD
    for row in rows:
        width = (WIDTH - (len(row) - 1) * GAP) / len(row)
        lines = {room: _lines([name.removeprefix(f"{room}.") for name in inside[room]], width) for room in row}
        height = max(map(len, lines.values())) * LINE + LINE + PAD
        for column, room in enumerate(row):
            boxes[room] = (PAD + column * (width + GAP), top, width, height, lines[room])
        top += height + GAP
    arrows = [_arrow(boxes[above], boxes[below]) for below, above in sorted(networkx.transitive_reduction(house).edges)]
    wide = WIDTH + 2 * PAD + GAP
    size = f'width="{wide}" height="{top}" viewBox="0 0 {wide} {top}"'
    ground = f'{ARROWHEAD}<rect width="100%" height="100%" fill="#fff"/>'
    drawn = [*arrows, *(_box(room, *box) for room, box in boxes.items())]
    return f'<svg xmlns="http://www.w3.org/2000/svg" {size}>\n{ground}\n' + "\n".join(drawn) + "\n</svg>\n"


def _lines(names: list[str], width: float) -> list[str]:
    """Module names, as many per line as fit."""
    lines = [""]
    for name in names:
        longer = f"{lines[-1]}   {name}".strip()
        if len(longer) * CHAR > width - 2 * PAD and lines[-1]:
            lines.append(name)
        else:
            lines[-1] = longer
    return lines


Box = tuple[float, float, float, float, list[str]]


def _arrow(above: Box, below: Box) -> str:
    """A line down to the next row, or around the rows between on the right."""
    (x, y, width, height, _), (to_x, to_y, to_width, to_height, _) = above, below
    start, end = (x + width / 2, y + height), (to_x + to_width / 2, to_y - 6)
    bend, to_bend = (start[0], start[1] + GAP / 2), (end[0], end[1] - GAP / 2)
    if to_y - start[1] > GAP:
        start, end = (x + width, y + height / 2), (to_x + to_width + 6, to_y + to_height / 2)
        bend, to_bend = (start[0] + GAP, start[1]), (end[0] + GAP, end[1])
    points = " ".join(f"{px:.0f},{py:.0f}" for px, py in (bend, to_bend, end))
    return f'<path d="M{start[0]:.0f},{start[1]:.0f} C{points}" {LINE_STYLE}/>'


def _box(room: str, x: float, y: float, width: float, height: float, lines: list[str]) -> str:
    texts = [(room, 14, "bold"), *((line, 12, "normal") for line in lines)]
    written = "".join(
        f'<text x="{x + PAD:.0f}" y="{y + LINE * (row + 1):.0f}" font-family="sans-serif" font-size="{size}" '
        f'font-weight="{weight}" xml:space="preserve">{escape(text)}</text>'
        for row, (text, size, weight) in enumerate(texts)
    )
    size = f'x="{x:.0f}" y="{y:.0f}" width="{width:.0f}" height="{height:.0f}"'
    frame = f'<rect {size} rx="6" fill="#f2f2f2" stroke="#444"/>'
    return f"<g>{frame}{written}</g>"
