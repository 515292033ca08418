"""A chapter opens and runs in JupyterLab, in a browser, away from the checkout."""

import os
import re
import shutil
import socket
import subprocess
import sys
import time
from pathlib import Path

import nbformat
import pytest
from playwright.sync_api import Page, sync_playwright

import check_site

pytestmark = pytest.mark.slow
ROOT = Path(__file__).parents[1]
CHAPTER = "02_partitioning"
TOKEN = "only-for-this-test"
LIMIT_S = 240  # a cold start of JupyterLab, then a chapter on a shared core


@pytest.fixture
def chapter(tmp_path: Path) -> Path:
    """A chapter and the stored results that it reads, laid out as in the zip."""
    (tmp_path / "notebooks").mkdir()
    shutil.copytree(ROOT / "book" / "reference", tmp_path / "book" / "reference")
    return Path(shutil.copy(ROOT / "notebooks" / f"{CHAPTER}.ipynb", tmp_path / "notebooks"))


@pytest.fixture
def lab(chapter: Path):
    """The address of a JupyterLab in the chapter's folder, stopped afterwards."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    options = [f"--port={port}", f"--IdentityProvider.token={TOKEN}", "--no-browser", "--allow-root"]
    quiet = ["--LabApp.check_for_updates_class=jupyterlab.NeverCheckForUpdate", "--LabApp.news_url=None"]
    settings = {f"JUPYTER_{name}_DIR": str(chapter.parent / f".{name}") for name in ("CONFIG", "DATA", "RUNTIME")}
    environment = os.environ | settings | {"FEDVLA_PROFILE": "tiny", "JUPYTER_PREFER_ENV_PATH": "1"}
    log = (chapter.parent / ".log").open("w")
    command = [sys.executable, "-m", "jupyterlab", *options, *quiet]
    server = subprocess.Popen(command, cwd=chapter.parent, env=environment, stdout=log, stderr=subprocess.STDOUT)
    try:
        wait_for(lambda: answers(port) or server.poll() is not None, "JupyterLab answers")
        yield f"http://127.0.0.1:{port}/lab/tree/{chapter.name}?token={TOKEN}"
    finally:
        server.terminate()
        server.wait(timeout=30)
        log.close()


def answers(port: int) -> bool:
    with socket.socket() as caller:
        return caller.connect_ex(("127.0.0.1", port)) == 0


def wait_for(holds, what: str) -> None:
    """Raise if something does not become true in time."""
    until = time.monotonic() + LIMIT_S
    while not holds():
        assert time.monotonic() < until, f"not within {LIMIT_S} s: {what}"
        time.sleep(0.5)


def code_cells(chapter: Path) -> list[nbformat.NotebookNode]:
    return [cell for cell in nbformat.read(chapter, as_version=4).cells if cell.cell_type == "code"]


def saved_as_executed(page: Page, chapter: Path) -> bool:
    """Save, then tell from the file whether every cell has run, or one has failed."""
    page.keyboard.press("Control+s")
    page.wait_for_timeout(1000)
    cells = code_cells(chapter)
    failed = any(output.output_type == "error" for cell in cells for output in cell.outputs)
    return failed or all(cell.execution_count for cell in cells if cell.source)


def open_chapter(page: Page, address: str) -> None:
    page.goto(address)
    page.locator(".jp-Notebook .jp-Cell").first.wait_for(timeout=LIMIT_S * 1000)
    page.get_by_text(re.compile(r"Python 3.*\| Idle")).first.wait_for(timeout=LIMIT_S * 1000)


def test_a_chapter_opens_reads_and_runs(lab, chapter):
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=check_site.chromium(), args=check_site.FLAGS)
        page = browser.new_page()
        open_chapter(page, lab)
        shown = page.locator(".jp-Notebook").inner_text()
        page.get_by_role("menuitem", name="Run", exact=True).click()
        page.get_by_text("Run All Cells", exact=True).click()
        wait_for(lambda: saved_as_executed(page, chapter), "every cell has run")
        browser.close()
    errors = [output for cell in code_cells(chapter) for output in cell.outputs if output.output_type == "error"]
    assert errors == []
    assert "{doc}" not in shown and "{term}" not in shown  # roles are shown as what they stand for
