"""Sphinx extension of the book.

It removes unused scripts, numbers equations, fixes the ARIA roles of the bibliography, links the library's functions to
the chapters that use them, lets Colab open copies of the chapters, and completes the single page that is printed.
"""

import re
from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx.application import Sphinx

import library

UNUSED = "thebe"  # Jupyter Book always loads it, and declares its constants twice
COLAB_BRANCH = "colab"  # holds the copies of colab.py; .github/workflows/pages.yml writes it


def without_unused(app: Sphinx, page: str, template: str, context: dict[str, Any], doctree: object) -> None:
    """Remove scripts and styles that this book does not use."""
    for kind in ("script_files", "css_files"):
        context[kind] = [file for file in context.get(kind, []) if UNUSED not in _text(file)]


def with_list_items(app: Sphinx, page: str, template: str, context: dict[str, Any], doctree: object) -> None:
    """Give entries of a bibliography the role listitem.

    docutils uses doc-biblioentry, which ARIA 1.2 deprecated: screen readers then announce a list without items.
    """
    if "body" in context:  # the index and the search have none
        context["body"] = context["body"].replace('role="doc-biblioentry"', 'role="listitem"')


def with_colab_copies(app: Sphinx, page: str, template: str, context: dict[str, Any], doctree: object) -> None:
    """Let the button for Colab open the copy of a chapter, whose first cell installs the library."""
    for button in (one for group in context.get("header_buttons", []) for one in group.get("buttons", [])):
        if button.get("text") == "Colab":
            button["url"] = re.sub(r"/blob/[^/]+/", f"/blob/{COLAB_BRANCH}/", button["url"])


def number_equations(app: Sphinx, doctree: nodes.document) -> None:
    """Number displayed equations and give them anchors; labels in notebooks would be visible there."""
    domain = app.env.get_domain("math")
    for count, equation in enumerate(doctree.findall(nodes.math_block), 1):
        equation["label"] = f"{app.env.docname}:{count}"
        domain.note_equation(app.env.docname, equation["label"], location=equation)
        equation["number"] = domain.get_equation_number_for(equation["label"])
        equation["ids"].append(f"equation-{count}")


def link_to_chapters(app: Sphinx) -> None:
    """Append links to the chapters that use a function to its description."""
    if "autodoc-process-docstring" not in app.events.events:
        return  # a book without a page about the library
    used = library.used_in(sorted((Path(app.srcdir) / "notebooks").glob("*.ipynb")))

    def add(app: Sphinx, what: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
        if what == "module" and "" in lines:
            del lines[lines.index("") :]  # keep the first sentence
        elif name in used:
            lines += ["", "In the book: " + ", ".join(f":doc:`/notebooks/{chapter}`" for chapter in used[name]) + "."]

    app.connect("autodoc-process-docstring", add, priority=900)  # after napoleon, which rewrites the sections


def complete_single_page(app: Sphinx) -> None:
    """Use the HTML handlers for the single page too.

    Sphinx falls back to them only if no extension registers handlers for singlehtml, as sphinx-exercise does; then
    other extensions' nodes, such as drop-downs, are unknown.
    """
    handlers = app.registry.translation_handlers
    handlers["singlehtml"] = {**handlers.get("html", {}), **handlers.get("singlehtml", {})}


def _text(file: Any) -> str:
    return f"{file} {getattr(file, 'filename', '')} {getattr(file, 'attributes', {}).get('body', '')}".lower()


def setup(app: Sphinx) -> dict[str, bool]:
    """Connect the handlers to Sphinx."""
    app.connect("doctree-read", number_equations)
    app.connect("html-page-context", without_unused, priority=900)
    app.connect("html-page-context", with_list_items)
    app.connect("html-page-context", with_colab_copies, priority=900)  # after the theme, which makes the buttons
    app.connect("builder-inited", complete_single_page)
    app.connect("builder-inited", link_to_chapters)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
