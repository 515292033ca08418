"""The book on paper: printed by Chromium, from chapters that were executed."""

import re
import zlib
from pathlib import Path

import pytest
import yaml

import check_site
import execution
import make_pdf
from test_build_book import project  # noqa: F401 - a fixture

PAGE = """<!DOCTYPE html><html lang="en"><title>A page</title><h1>A page</h1>
<details><summary>More</summary><div style="break-before: page">Only when opened</div></details></html>"""


@pytest.mark.integration
def test_a_page_is_printed_with_what_folds_out(tmp_path):
    try:
        check_site.chromium()
    except ValueError as error:
        pytest.skip(str(error))
    (tmp_path / "page.html").write_text(PAGE)
    printed = make_pdf.print_page(tmp_path / "page.html", tmp_path / "new" / "book.pdf").read_bytes()
    assert printed.startswith(b"%PDF")
    assert number_of_pages(printed) == 2
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["book.pdf"]


@pytest.mark.integration
def test_a_chapter_begins_a_page_and_a_short_cell_stays_on_one(tmp_path):
    """The second chapter's text leaves room for half of its cell."""
    cell = "<div class='cell_input' style='height: 160mm'>code</div>"
    chapter = "<section class='mathjax_ignore'><h2>Chapter</h2><div style='height: {}mm'></div>" + cell + "</section>"
    (tmp_path / "page.html").write_text(f"<!DOCTYPE html><h1>Book</h1>{chapter.format(1)}{chapter.format(260)}")
    assert number_of_pages(make_pdf.print_page(tmp_path / "page.html", tmp_path / "book.pdf").read_bytes()) == 4


@pytest.mark.unit
def test_chapters_that_were_not_executed_are_named(project):  # noqa: F811
    with pytest.raises(execution.BookError, match="profile tiny.*: one; run make book"):
        make_pdf.executed_chapters(project, "tiny")


@pytest.mark.integration
def test_all_pages_become_one(project: Path, tmp_path):  # noqa: F811
    """With a drop-down and an exercise, whose extensions know the single page only with site_scripts."""
    config = {"extra_extensions": ["sphinx_exercise", "site_scripts"]}
    (project / "_config.yml").write_text(yaml.safe_dump({"title": "A book", "sphinx": config}))
    text = "# Front\n\n```{exercise}\nThink.\n```\n\n```{dropdown} Solution\nDone.\n```\n"
    (project / "book" / "index.md").write_text(text)
    (project / "_toc.yml").write_text("format: jb-book\nroot: book/index\nchapters:\n  - file: book/run_times\n")
    file = make_pdf.render_single(project, tmp_path / "single")
    page = file.read_text()
    styles = re.findall(r'href="([^":?]*\.css)', page)
    assert styles and all((file.parent / style).is_file() for style in styles)
    assert "Front" in page and "Run times" in page and "Think." in page and "Done." in page


def number_of_pages(pdf: bytes) -> int:
    """Count page objects, also inside compressed streams."""
    streams = re.findall(rb"stream\r?\n(.*?)\r?\nendstream", pdf, flags=re.DOTALL)
    parts = [pdf]
    for stream in streams:
        try:
            parts.append(zlib.decompress(stream))
        except zlib.error:
            continue  # a picture
    return len(re.findall(rb"/Type\s*/Page\b", b"\n".join(parts)))
