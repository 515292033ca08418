"""Print the book, executed chapters and all other pages, as one PDF.

    python book/tools/make_pdf.py --profile laptop

Chapters are executed by `make book`. Sphinx renders one single page and the system's Chromium prints it; LaTeX would
take another gigabyte.
"""

import argparse
import sys
from pathlib import Path

from playwright.sync_api import sync_playwright

from build_book import ROOT, jupyter_book
from check_site import FLAGS, chromium
from execution import (
    BookError,
    Chapter,
    add_profile,
    executed_folder,
    library_key,
    notebooks_of,
    reuse,
    toc_pages,
)
from fedvla_lib.files import new_file
from pages import lay_out

TARGET = "_build/fedvla-book.pdf"
LOAD_S = 600  # seconds for a page with all figures and videos of the book
MARGIN = {"top": "18mm", "bottom": "18mm", "left": "16mm", "right": "16mm"}
SCALE = 0.75  # so that lines of code fit
# No scrolling on paper, and no page breaks inside figures.
STYLE = """
td, th { white-space: normal !important; }
pre, pre code { white-space: pre-wrap !important; overflow-wrap: anywhere; }
figure, img, video, tr, div.math, div.cell_input, div.admonition { break-inside: avoid; }
div.cell, div.cell_output, .table-wrapper { overflow: visible !important; }
h1, h2, h3, h4, summary { break-after: avoid; }
section.mathjax_ignore > h2 { break-before: page; } /* a chapter */
"""
# Open all details, and load lazy images that were never in view.
PREPARE = """async () => {
  document.documentElement.dataset.mode = document.documentElement.dataset.theme = 'light';
  document.querySelectorAll('details').forEach(one => { one.open = true; });
  const images = [...document.images];
  images.forEach(one => { one.loading = 'eager'; });
  await Promise.all(images.map(one => one.decode().catch(() => 0)));
}"""


def executed_chapters(root: Path, profile: str) -> list[Chapter]:
    """Return the executed copies of `make book`.

    Raises:
        BookError: one is missing or outdated; the message names it.
    """
    library, folder = library_key(root, profile), executed_folder(root, profile)
    chapters = {path.stem: reuse(path, folder, library) for path in notebooks_of(root)}
    if stale := [name for name, chapter in chapters.items() if chapter is None]:
        raise BookError(f"not executed at profile {profile}, or changed since: {', '.join(stale)}; run make book")
    return list(chapters.values())


def render_single(source: Path, output: Path) -> Path:
    """Render the book's source as a single page and return it; warnings are errors in `make book` only."""
    done = jupyter_book(source, output, "--builder", "singlehtml", capture_output=True, text=True)
    page = output / "_build" / "singlehtml" / f"{toc_pages(source)[0]}.html"
    if done.returncode or not page.is_file():
        raise BookError(f"jupyter-book made no single page: {' '.join(done.stderr.split())[-800:]}")
    # Sphinx writes paths of styles and images relative to the top folder.
    return page.replace(output / "_build" / "singlehtml" / "printed.html")


def print_page(page: Path, target: Path) -> Path:
    """Print an HTML file with Chromium and return the PDF."""
    with new_file(target) as draft, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium(), args=FLAGS)
        shown = browser.new_page()
        shown.set_default_timeout(1000 * LOAD_S)
        shown.goto(page.resolve().as_uri(), wait_until="networkidle")
        shown.add_style_tag(content=STYLE)
        shown.evaluate(PREPARE)
        paper = {"format": "A4", "margin": MARGIN, "scale": SCALE}
        shown.pdf(path=draft, print_background=True, outline=True, tagged=True, **paper)
        browser.close()
    return target


def make(root: Path, profile: str) -> Path:
    """Print the book that was executed with `profile`."""
    chapters, work = executed_chapters(root, profile), root / "_build" / profile / "single"
    lay_out(root, work / "source", chapters, profile)
    return print_page(render_single(work / "source", work), root / TARGET)


def main() -> int:
    """Make the PDF and print its path."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add_profile(parser)
    try:
        target = make(ROOT, parser.parse_args().profile)
    except (ValueError, OSError) as error:
        print(f"make_pdf: {error}", file=sys.stderr)
        return 2
    print(f"{target} ({target.stat().st_size / 1e6:.1f} MB)")
    return 0


if __name__ == "__main__":
    sys.exit(main())
