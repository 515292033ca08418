"""Open every page of the rendered book in a real browser and list what a reader would stumble over.

    python book/tools/check_site.py _build/html/tiny

Chromium is the system's. Exit status 1 if anything is found.
"""

import argparse
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from shutil import which
from urllib.parse import unquote, urljoin, urlparse

from axe_playwright_python.sync_playwright import Axe
from bs4 import BeautifulSoup
from playwright.sync_api import Browser, Page, sync_playwright
from tqdm import tqdm

NARROW = {"width": 360, "height": 740}  # pixels of a small phone
WIDE = {"width": 1280, "height": 900}
SEARCHED = "FedAvg"
SEVERE = {"serious", "critical"}
COLOURS = {"type": "rule", "values": ["color-contrast", "link-in-text-block"]}  # what a change of theme can break
REQUIRED = ("404.html", "sitemap.xml")  # what extensions of _config.yml make beside the pages of the contents
VIDEO_BYTES = 1_000_000  # a video above this makes a reader on a phone wait
# Headless, in a container without a graphics card, and asking the network for nothing but the pages.
FLAGS = [
    "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking", "--disable-component-update",
    "--disable-sync",
]  # fmt: skip
BROWSERS = 2  # that share the pages; each keeps a core busy
Look = Callable[[Page, str], list[str]]
SHORT_ALT = 12  # characters; a shorter text does not say what a figure shows

# Each returns a list of sentences about what is wrong on the page.
FIGURES = """() => [...document.querySelectorAll('main img')].flatMap(img => {
  const name = img.currentSrc.split('/').pop().slice(0, 60);
  if (img.complete && img.naturalWidth === 0) return [`picture ${name} does not load`];
  const alt = (img.getAttribute('alt') || '').trim();
  if (alt.length < SHORT || /\\.(png|svg|jpg)$/.test(alt)) return [`picture ${name} has the alt text '${alt}'`];
  return [];
})""".replace("SHORT", str(SHORT_ALT))
VIDEOS = """async () => (await Promise.all([...document.querySelectorAll('video')].map(async (video, i) => {
  video.preload = 'auto'; video.load();
  for (let t = 0; t < 100 && video.readyState < 2 && !video.error; t++) await new Promise(r => setTimeout(r, 100));
  return video.readyState >= 2 && video.videoWidth > 0 ? [] : [`video ${i + 1} does not play`];
}))).flat()"""
WIDTH = """() => document.documentElement.scrollWidth > innerWidth + 1
  ? [`${document.documentElement.scrollWidth} px wide on a screen of ${innerWidth}`] : []"""
DARK = """() => { document.documentElement.dataset.mode = 'dark'; document.documentElement.dataset.theme = 'dark'; }"""
DARK_FIGURES = """() => [...document.querySelectorAll('main .cell_output img')].flatMap(img => {
  const [r, g, b, a] = getComputedStyle(img).backgroundColor.match(/[\\d.]+/g).map(Number);
  return a !== 0 && Math.min(r, g, b) > 200 ? [] : ['a figure has no light ground in the dark theme'];
})"""


class Quiet(SimpleHTTPRequestHandler):
    """Serves files and says nothing."""

    def log_message(self, *_: object) -> None:
        """Leave the terminal to what is found."""


@contextmanager
def served(folder: Path) -> Iterator[str]:
    """Serve a folder on this machine and yield its address."""
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(folder))) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_address[1]}/"
        server.shutdown()


def pages(folder: Path) -> list[str]:
    """Return the pages of a site as paths below its folder."""
    files = (path.relative_to(folder) for path in folder.rglob("*.html"))
    found = sorted(path.as_posix() for path in files if "_static" not in path.parts)
    if "index.html" not in found:
        raise ValueError(f"{folder} holds no rendered book: run make book, and give the folder that it names")
    return found


@dataclass(frozen=True)
class Facts:
    """What a page's own text says: its anchors, its links, and the sources of its videos."""

    anchors: frozenset[str]
    links: frozenset[str]
    videos: tuple[str, ...]


def read(folder: Path, page: str) -> Facts:
    """Return the facts of a page; films inside a page make it long, so each is read once."""
    soup = BeautifulSoup((folder / page).read_text(encoding="utf-8"), "html.parser")
    return Facts(
        frozenset(tag["id"] for tag in soup.find_all(id=True)),
        frozenset(tag["href"] for tag in soup.find_all("a", href=True)),
        tuple(tag["src"] for tag in soup.select("video[src], video source[src]")),
    )


def dead_links(folder: Path, page: str, site: dict[str, Facts]) -> list[str]:
    """Return the links of a page to files or anchors of its site that do not exist."""
    found = []
    for href in sorted(site[page].links):
        target = urlparse(urljoin(page, href)) if not href.startswith("#") else urlparse(page + href)
        if target.scheme or target.netloc or href in ("", "#"):
            continue
        path, anchor = unquote(target.path).lstrip("/"), unquote(target.fragment)  # 404.html links from the root
        if not (folder / path).is_file():
            found.append(f"links to {href}, which is not there")
        elif anchor and path in site and anchor not in site[path].anchors:
            found.append(f"links to {href}, which has no such anchor")
    return found


def missing_files(folder: Path) -> list[str]:
    """Return which of the files that every rendered book has are not there."""
    return [f"{name} is missing" for name in REQUIRED if not (folder / name).is_file()]


def heavy_videos(folder: Path, page: str, site: dict[str, Facts]) -> list[str]:
    """Return the videos of a page that hold more than `VIDEO_BYTES`; inside the page, its text counts."""
    sizes = [_bytes_of(folder, page, source) for source in site[page].videos]
    return [f"video {i} has {size / 1e6:.1f} MB" for i, size in enumerate(sizes, start=1) if size > VIDEO_BYTES]


def _bytes_of(folder: Path, page: str, source: str) -> int:
    if source.startswith("data:"):
        return len(source)
    file = folder / unquote(urlparse(urljoin(page, source)).path).lstrip("/")
    return file.stat().st_size if file.is_file() else 0  # the browser says that it is missing


def look(page: Page, address: str) -> list[str]:
    """Open a page, wide and narrow, light and dark, and return what is wrong with it."""
    found: list[str] = []
    page.on("console", lambda said: found.append(f"console: {said.text[:160]}") if said.type == "error" else None)
    page.on("pageerror", lambda error: found.append(f"script: {str(error)[:160]}"))
    page.on("requestfailed", lambda request: found.append(f"not loaded: {request.url[:120]}"))
    page.on("response", lambda answer: found.append(f"{answer.status}: {answer.url[:120]}") if not answer.ok else None)
    page.set_viewport_size(WIDE)
    page.goto(address, wait_until="networkidle")
    found += page.evaluate(FIGURES) + page.evaluate(VIDEOS) + [f"light: {line}" for line in barriers(page)]
    page.evaluate(DARK)
    page.wait_for_timeout(500)  # colours fade over
    found += page.evaluate(DARK_FIGURES) + [f"dark: {line}" for line in barriers(page, COLOURS)]
    page.set_viewport_size(NARROW)
    return found + page.evaluate(WIDTH)


def barriers(page: Page, only: dict | None = None) -> list[str]:
    """Return axe-core's serious findings, of all its rules or of those that `only` names."""
    # Without preload: axe would read style sheets itself, from a wrong place, and be told 404.
    options = {"preload": False, "resultTypes": ["violations"], **({"runOnly": only} if only else {})}
    violations = Axe().run(page, options=options).response["violations"]
    severe = [violation for violation in violations if violation["impact"] in SEVERE]
    return [f"{one['id']} ({len(one['nodes'])}x): {one['nodes'][0]['html'][:140]}" for one in severe]


def searched(page: Page, address: str) -> list[str]:
    """Return what is wrong with the search."""
    page.goto(f"{address}search.html?q={SEARCHED}", wait_until="networkidle")
    page.wait_for_timeout(2000)
    hits = page.locator("#search-results li").count()
    return [] if hits else [f"the search does not find {SEARCHED!r}"]


def check(folder: Path, only: str = "") -> dict[str, list[str]]:
    """Return what is wrong with each page of a site; pages with nothing are left out."""
    chosen = [page for page in pages(folder) if only in page]
    site = {page: read(folder, page) for page in pages(folder)}
    found = {page: dead_links(folder, page, site) + heavy_videos(folder, page, site) for page in chosen}
    found["site"] = missing_files(folder)
    with served(folder) as address, ThreadPoolExecutor(BROWSERS) as pool:
        jobs = [(name, look, address + name) for name in chosen] + [("search", searched, address)]
        for seen in pool.map(_in_a_browser, [jobs[start::BROWSERS] for start in range(BROWSERS)]):
            for name, problems in seen.items():
                found.setdefault(name, []).extend(problems)
    return {name: problems for name, problems in found.items() if problems}


def _in_a_browser(jobs: list[tuple[str, Look, str]]) -> dict[str, list[str]]:
    """Do each job on a fresh page of one browser and return what each found."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=_chromium(), args=FLAGS)
        waiting = tqdm(jobs, desc="pages", disable=not sys.stderr.isatty())
        found = {name: _with_new_page(browser, do, address) for name, do, address in waiting}
        browser.close()
    return found


def _with_new_page(browser: Browser, do: Look, address: str) -> list[str]:
    page = browser.new_page()
    try:
        return do(page, address)
    finally:
        page.close()


def _chromium() -> str:
    found = which("chromium") or which("chromium-browser") or which("google-chrome")
    if not found:
        raise ValueError("no Chromium on this machine: apt-get install chromium")
    return found


def main() -> int:
    """Check a site and print what was found."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="the rendered book, such as _build/html/laptop")
    parser.add_argument("--only", default="", help="pages whose path contains this")
    options = parser.parse_args()
    try:
        found = check(options.folder, options.only)
    except ValueError as error:
        print(f"check_site: {error}", file=sys.stderr)
        return 2
    for page, problems in found.items():
        for problem in problems:
            print(f"{page}: {problem}")
    print(f"{len(pages(options.folder))} pages, {sum(map(len, found.values()))} problems")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
