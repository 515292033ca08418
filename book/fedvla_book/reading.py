"""What a reader sees of a chapter on its page, and how long it takes to read.

Code behind a click (tag ``hide-input``) is not read; what it prints is. Exercises, quiz and folded solutions are extra.
"""

import ast
import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

WORDS_A_MINUTE = 200
SECONDS_A_LINE = 3
HIDDEN = {"hide-input", "hide-cell", "remove-input", "remove-cell"}
SENTENCES = {"say", "print", "display", "Markdown", "HTML"}  # calls that print what their strings say
PICTURES = {"plots", "plt", "ax", "axes", "figure"}  # names whose methods draw


@dataclass(frozen=True)
class Code:
    """One code cell: its lines that are about the subject, those that are not, and whether the page shows them."""

    id: str
    tags: frozenset[str]
    subject: int
    plumbing: int
    words: int

    @property
    def visible(self) -> bool:
        """Whether the page shows the code without a click."""
        return not self.tags & HIDDEN


def minutes(chapter: Path) -> int:
    """Return how many minutes a chapter takes to read: 200 words a minute, and 3 s for each visible line of code."""
    cells = code_cells(chapter)
    words = sum(len(text.split()) for text in prose(chapter)) + sum(cell.words for cell in cells)
    lines = sum(cell.subject + cell.plumbing for cell in cells if cell.visible)
    return round(words / WORDS_A_MINUTE + lines * SECONDS_A_LINE / 60)


def prose(chapter: Path) -> Iterator[str]:
    """Yield the text cells of a chapter up to its exercises, without what is folded."""
    for cell in _read_cells(chapter):
        if cell["cell_type"] == "markdown":
            text = "".join(cell["source"])
            if re.search(r"^## Exercises", text, flags=re.MULTILINE):
                return
            yield re.sub(r"<details>.*?</details>", "", text, flags=re.DOTALL)
        yield cell["metadata"].get("mystnb", {}).get("figure", {}).get("caption", "")


def code_cells(chapter: Path) -> list[Code]:
    """Return the code cells of a chapter without its exercises."""
    found = [_read_code(cell) for cell in _read_cells(chapter) if cell["cell_type"] == "code"]
    return [cell for cell in found if "exercise" not in cell.tags]


def _read_cells(chapter: Path) -> list[dict[str, Any]]:
    return json.loads(chapter.read_text(encoding="utf-8"))["cells"]


def _read_code(cell: dict[str, Any]) -> Code:
    source = "".join(cell["source"])
    tree = ast.parse(source)
    shown = _lines(source) - _docstrings(tree)
    dull = {n for part in tree.body if _is_plumbing(part) for n in _lines_of(part)}
    tags = frozenset(cell["metadata"].get("tags", []))
    return Code(cell["id"], tags, len(shown - dull), len(shown & dull), sum(len(text.split()) for text in _said(tree)))


def _lines(source: str) -> set[int]:
    """Return the numbers of the lines that are neither empty nor a comment."""
    lines = enumerate(source.splitlines(), start=1)
    return {n for n, line in lines if line.strip() and not line.lstrip().startswith("#")}


def _lines_of(part: ast.stmt) -> range:
    return range(part.lineno, part.end_lineno + 1)


def _docstrings(tree: ast.AST) -> set[int]:
    defined = [part for part in ast.walk(tree) if isinstance(part, ast.FunctionDef | ast.ClassDef)]
    return {n for part in defined if ast.get_docstring(part) is not None for n in _lines_of(part.body[0])}


def _is_plumbing(part: ast.stmt) -> bool:
    """Whether a statement imports, prints or draws, and so says nothing of the subject."""
    if isinstance(part, ast.Import | ast.ImportFrom):
        return True
    if isinstance(part, ast.For):
        return all(map(_is_plumbing, part.body))
    value = getattr(part, "value", None)
    if isinstance(value, ast.Call):
        name = ast.unparse(value.func).split(".")[0].split("[")[0]
        return name in PICTURES or (name in SENTENCES and isinstance(part, ast.Expr))
    return False


def _said(tree: ast.AST) -> Iterator[str]:
    """Yield the strings of calls that print them, each once, although `display(Markdown(...))` is two calls."""
    calls = [part for part in ast.walk(tree) if isinstance(part, ast.Call) and ast.unparse(part.func) in SENTENCES]
    constants = {one for call in calls for one in ast.walk(call) if isinstance(one, ast.Constant)}
    yield from (one.value for one in constants if isinstance(one.value, str))
