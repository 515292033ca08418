"""A Sphinx extension: no script that would fetch code from elsewhere, or twice, ends up on a page.

It also numbers equations, mends what a screen reader is told of the bibliography, links the library's functions to the
chapters that use them, and lets a single page hold the whole book, to be printed.
"""

from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx.application import Sphinx

import library

UNUSED = "thebe"  # Jupyter Book loads it always, and declares its constants twice


def without_unused(app: Sphinx, page: str, template: str, context: dict[str, Any], doctree: object) -> None:
    """Take scripts and styles of what this book does not use out of a page."""
    for kind in ("script_files", "css_files"):
        context[kind] = [file for file in context.get(kind, []) if UNUSED not in _text(file)]


def with_list_items(app: Sphinx, page: str, template: str, context: dict[str, Any], doctree: object) -> None:
    """Make the entries of a bibliography what its list says they are.

    docutils gives entries the role doc-biblioentry, which ARIA 1.2 retired in favour of listitem, inside a list: a
    screen reader then hears of a list without items.
    """
    if "body" in context:  # the index and the search have none
        context["body"] = context["body"].replace('role="doc-biblioentry"', 'role="listitem"')


def number_equations(app: Sphinx, doctree: nodes.document) -> None:
    """Give displayed equations a number and an anchor, without labels in notebooks, where they would be read."""
    domain = app.env.get_domain("math")
    for count, equation in enumerate(doctree.findall(nodes.math_block), 1):
        equation["label"] = f"{app.env.docname}:{count}"
        domain.note_equation(app.env.docname, equation["label"], location=equation)
        equation["number"] = domain.get_equation_number_for(equation["label"])
        equation["ids"].append(f"equation-{count}")


def link_to_chapters(app: Sphinx) -> None:
    """End the description of every function with links to the chapters that use it."""
    if "autodoc-process-docstring" not in app.events.events:
        return  # a book without a page about the library
    used = library.used_in(sorted((Path(app.srcdir) / "notebooks").glob("*.ipynb")))

    def add(app: Sphinx, what: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
        if what == "module" and "" in lines:
            del lines[lines.index("") :]  # the sentence that says what it is for
        elif name in used:
            lines += ["", "In the book: " + ", ".join(f":doc:`/notebooks/{chapter}`" for chapter in used[name]) + "."]

    app.connect("autodoc-process-docstring", add, priority=900)  # behind napoleon, which rewrites the sections


def complete_single_page(app: Sphinx) -> None:
    """Let the single page show all that pages show.

    Sphinx takes what extensions say about HTML for a single page too, unless one of them names the single page, as
    sphinx-exercise does: then the others' nodes, such as drop-downs, are unknown there.
    """
    handlers = app.registry.translation_handlers
    handlers["singlehtml"] = {**handlers.get("html", {}), **handlers.get("singlehtml", {})}


def _text(file: Any) -> str:
    return f"{file} {getattr(file, 'filename', '')} {getattr(file, 'attributes', {}).get('body', '')}".lower()


def setup(app: Sphinx) -> dict[str, bool]:
    """Connect to Sphinx, behind those who add scripts and nodes."""
    app.connect("doctree-read", number_equations)
    app.connect("html-page-context", without_unused, priority=900)
    app.connect("html-page-context", with_list_items)
    app.connect("builder-inited", complete_single_page)
    app.connect("builder-inited", link_to_chapters)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
