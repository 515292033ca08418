"""A Sphinx extension: no script that would fetch code from elsewhere, or twice, ends up on a page."""

from typing import Any

from sphinx.application import Sphinx

UNUSED = "thebe"  # Jupyter Book loads it always, and declares its constants twice


def without_unused(app: Sphinx, page: str, template: str, context: dict[str, Any], doctree: object) -> None:
    """Take scripts and styles of what this book does not use out of a page."""
    for kind in ("script_files", "css_files"):
        context[kind] = [file for file in context.get(kind, []) if UNUSED not in _text(file)]


def _text(file: Any) -> str:
    return f"{file} {getattr(file, 'filename', '')} {getattr(file, 'attributes', {}).get('body', '')}".lower()


def setup(app: Sphinx) -> dict[str, bool]:
    """Connect to Sphinx, behind those who add scripts."""
    app.connect("html-page-context", without_unused, priority=900)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
