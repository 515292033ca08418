"""A Sphinx extension: no script that would fetch code from elsewhere, or twice, ends up on a page.

It also mends what a screen reader is told of the bibliography, and lets a single page hold the whole book, to be
printed.
"""

from typing import Any

from sphinx.application import Sphinx

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
    app.connect("html-page-context", without_unused, priority=900)
    app.connect("html-page-context", with_list_items)
    app.connect("builder-inited", complete_single_page)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
