"""Execute the chapters that changed and build the HTML book from the executed copies.

    python book/tools/build_book.py --profile laptop
    python book/tools/build_book.py --profile tiny --from-zip    the chapters unpacked, the library from the wheel

The executed copies and the pages go to `_build/<profile>/source`, which Jupyter Book renders: execution off, warnings
as errors.
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import check_zip
import fedvla_lib
from execution import (
    BookError,
    Chapter,
    add_profile,
    digest,
    execute_chapters,
    library_key,
    named_bytes,
    record_data,
    toc_pages,
)
from fedvla_lib.config import from_profile
from fedvla_lib.files import write_atomically
from fedvla_lib.workers import default_jobs
from status import REPORTS

ROOT = Path(__file__).resolve().parents[2]
# Jupyter Book's own page at the root names no icon, so browsers ask for a favicon.ico, which does not exist. An icon
# in a file would be loaded while the browser already goes on to the next page.
FRONT_DOOR = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>Federated robot learning you can run</title>
<link rel="icon" href="data:,"><meta http-equiv="refresh" content="0; url=book/index.html"></head>
<body><a href="book/index.html">The front page</a></body></html>
"""
STATIC = "book/_static"  # html_static_path in _config.yml
BUILT_FROM = ".built-from"  # file next to the pages with the digest of their sources


def render(source: Path, output: Path) -> Path:
    """Build the HTML book with warnings as errors and return the folder of its pages."""
    # Warnings are on stderr.
    built = jupyter_book(source, output, "-W", "-n", "--keep-going", stdout=subprocess.DEVNULL)
    if built.returncode:
        raise BookError("jupyter-book reported the warnings above, which are errors")
    html = output / "_build" / "html"
    if (static := source / STATIC).is_dir():  # Sphinx copies it only when a page changed
        shutil.copytree(static, html / static.name, dirs_exist_ok=True)
    write_atomically(html / "index.html", FRONT_DOOR.encode())
    return html


def jupyter_book(source: Path, output: Path, *options: str, **streams: Any) -> subprocess.CompletedProcess:
    """Run `jupyter-book build`, in a subprocess: Sphinx patches docutils globally and changes sys.path."""
    command = [str(Path(sys.executable).with_name("jupyter-book")), "build", str(source), "--path-output", str(output)]
    # For site_scripts.py and the documented packages.
    path = os.pathsep.join([str(Path(__file__).parent), str(ROOT), str(ROOT / "book")])
    environment = {**os.environ, "PYTHONPATH": path}
    return subprocess.run([*command, *options, "--quiet"], env=environment, check=False, **streams)


def check_pages(root: Path, html: Path) -> int:
    """Check that each page of the contents exists and each image has alternative text; return the number of pages.

    Raises:
        BookError: a page is missing, or an image has no alternative text; the message names them.
    """
    pages = toc_pages(root)
    if missing := [page for page in pages if not (html / f"{page}.html").is_file()]:
        raise BookError(f"{len(missing)} of {len(pages)} pages were not built: {', '.join(missing)}")
    bare = {page: count for page in pages if (count := _undescribed_images(html / f"{page}.html"))}
    if bare:
        found = ", ".join(f"{page} ({count})" for page, count in bare.items())
        raise BookError(f"images without alternative text (set mystnb.image.alt in the cell's metadata): {found}")
    return len(pages)


def _undescribed_images(page: Path) -> int:
    """Count the images whose alternative text is missing or, the default, the path of the image."""
    images = re.findall(r"<img\b[^>]*>", page.read_text(encoding="utf-8"))
    texts = [re.search(r'\balt="([^"]*)"', image) for image in images]
    return sum(text is None or not text[1] or "_images/" in text[1] for text in texts)


def execute_from_zip(profile: str, only: str, jobs: int) -> None:
    """Execute the changed chapters as readers of the zip have them: unpacked, with the library of the wheel.

    In a process of its own, whose Python sees that library and not the source.
    """
    with tempfile.TemporaryDirectory(prefix="fedvla-book-") as folder:
        book, python = check_zip.prepared(Path(folder))
        command = [
            str(python),
            str(Path(__file__).resolve()),
            "--profile",
            profile,
            "--only",
            only,
            "--jobs",
            str(jobs),
        ]
        done = subprocess.run(
            [*command, "--execute-only", "--inside", str(book)], cwd=book,
            env=check_zip.surroundings(python, profile) | {"FEDVLA_CACHE": str(book / ".cache")},
            check=False,
        )  # fmt: skip
    if done.returncode:
        raise BookError("a chapter of the unpacked zip failed, see above")


def build(
    root: Path, profile: str, only: str, execute_only: bool, jobs: int = 1, inside: Path | None = None
) -> Path | None:
    """Execute changed chapters and, unless `execute_only`, build the book; return its front page.

    Args:
        inside: an unpacked book whose copies of the chapters are executed.
    """
    start = time.monotonic()
    if inside and not Path(fedvla_lib.__file__).is_relative_to(sys.prefix):
        raise BookError(f"{fedvla_lib.__file__} is not the library of the wheel")
    chapters = execute_chapters(root, profile, only, prepare=record_data, jobs=jobs, inside=inside)
    if execute_only:
        print(f"{len(chapters)} chapters executed with profile {profile}", flush=True)
        return None
    work, published = root / "_build" / profile, root / "_build" / "html" / profile
    made_from = sources(root, profile, chapters)
    if not is_published(published, made_from):
        from pages import lay_out  # loads PyTorch and Matplotlib, which an unchanged book does not need

        lay_out(root, work / "source", chapters, profile)
        html = render(work / "source", work)
        check_pages(root, html)
        publish(html, published, made_from)
    count = check_pages(root, published)
    print(f"{count} pages, {len(chapters)} chapters, profile {profile}, {time.monotonic() - start:.0f} s")
    return published / "index.html"


def sources(root: Path, profile: str, chapters: list[Chapter]) -> str:
    """Return a digest of all that the pages are made from: executed chapters, pages, stored results, library, tools."""
    folders = [root / name for name in ("book", "benchmarks/results", REPORTS)]
    files = [path for folder in folders for path in sorted(folder.rglob("*")) if path.is_file()]
    files += [root / "_toc.yml", root / "_config.yml", *(chapter.executed for chapter in chapters)]
    named = (named_bytes(root, path) for path in files if "__pycache__" not in path.parts)
    return digest([library_key(root, profile).encode(), *named])


def is_published(target: Path, digest: str) -> bool:
    """Return whether the pages at `target` were built from the sources with this digest."""
    mark = target / BUILT_FROM
    return mark.is_file() and mark.read_text() == digest


def publish(html: Path, target: Path, digest: str) -> None:
    """Replace the pages at `target` in one step, so that a failed build keeps the last good book."""
    target.parent.mkdir(parents=True, exist_ok=True)
    fresh, old = target.with_name(target.name + ".new"), target.with_name(target.name + ".old")
    shutil.rmtree(fresh, ignore_errors=True)
    shutil.rmtree(old, ignore_errors=True)
    shutil.copytree(html, fresh)
    (fresh / BUILT_FROM).write_text(digest)
    if target.exists():
        os.replace(target, old)
    os.replace(fresh, target)
    shutil.rmtree(old, ignore_errors=True)


def main(argv: list[str] | None = None) -> int:
    """Run the command; errors are one line on stderr and exit status 2."""
    parser = argparse.ArgumentParser(description="Execute the chapters that changed and build the HTML book.")
    add_profile(parser)
    parser.add_argument("--only", default="", metavar="TEXT", help="execute the chapters whose name contains TEXT")
    parser.add_argument("--execute-only", action="store_true", help="execute the chapters, build no pages")
    parser.add_argument("--jobs", type=int, metavar="N", help="chapters executed at once (default: one per core)")
    parser.add_argument("--from-zip", action="store_true", help="execute the chapters as readers of the zip do")
    parser.add_argument("--inside", type=Path, help=argparse.SUPPRESS)  # for the process that --from-zip starts
    options = parser.parse_args(argv)
    if options.jobs is not None and options.jobs < 1:
        parser.error(f"--jobs {options.jobs} is not usable: give a whole number of 1 or more")
    try:
        whole = not (options.execute_only or options.only)
        jobs = options.jobs or default_jobs(from_profile(options.profile).device)
        if options.from_zip:
            execute_from_zip(options.profile, options.only, jobs)
        front_page = build(ROOT, options.profile, options.only, not whole, jobs, options.inside)
    except (ValueError, OSError) as error:
        print(f"the book was not built: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted: the chapters executed so far are kept", file=sys.stderr)
        return 130
    if front_page:
        print(f"Open {front_page}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
