"""Open every page of the rendered book in a browser and list its problems.

    python book/tools/check_site.py _build/html/tiny

Needs the system's Chromium. Exit status 1 if anything is found.
"""

import argparse
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from shutil import which
from urllib.parse import unquote, urljoin, urlparse

import yaml
from axe_playwright_python.sync_playwright import Axe
from bs4 import BeautifulSoup
from playwright.sync_api import Browser, Page, sync_playwright
from tqdm import tqdm

ROOT = Path(__file__).resolve().parents[2]
NARROW = {"width": 360, "height": 740}  # pixels of a small phone
WIDE = {"width": 1280, "height": 900}
SEARCHED = "FedAvg"
SEVERE = {"serious", "critical"}
COLOURS = {"type": "rule", "values": ["color-contrast", "link-in-text-block"]}  # rules that a theme can break
REQUIRED = ("404.html", "sitemap.xml")  # made by extensions of _config.yml
VIDEO_BYTES = 1_000_000  # larger videos load slowly on a phone
# For a container without a GPU, and without network requests except for the pages.
FLAGS = [
    "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking", "--disable-component-update",
    "--disable-sync",
]  # fmt: skip
BROWSERS = 2  # in parallel; each uses a core
Check = Callable[[Page, str], list[str]]
SHORT_ALT = 12  # characters; shorter alternative texts do not describe a figure

# JavaScript functions that return a list of problems of the page. Pictures on the theme's buttons are not figures.
FIGURES = """() => [...document.querySelectorAll('main img:not(.bd-header-article img)')].flatMap(img => {
  const name = img.currentSrc.split('/').pop().slice(0, 60);
  if (img.complete && img.naturalWidth === 0) return [`image ${name} does not load`];
  const alt = (img.getAttribute('alt') || '').trim();
  if (alt.length < SHORT || /\\.(png|svg|jpg)$/.test(alt)) return [`image ${name} has the alt text '${alt}'`];
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
  return a !== 0 && Math.min(r, g, b) > 200 ? [] : ['a figure has no light background in the dark theme'];
})"""


@cache
def prefix() -> str:
    """Return the folder below which 404.html expects the site, since it is shown for any address: / or /REPOSITORY/."""
    config = yaml.safe_load((ROOT / "_config.yml").read_text(encoding="utf-8"))
    return config["sphinx"]["config"]["notfound_urls_prefix"]


class Quiet(SimpleHTTPRequestHandler):
    """Request handler without log messages; the site is at the root and in the folder where it expects to be."""

    def translate_path(self, path: str) -> str:
        """Return the file of an address."""
        return super().translate_path("/" + path.removeprefix(prefix()))

    def log_message(self, *_: object) -> None:
        """Print nothing."""


@contextmanager
def served(folder: Path) -> Iterator[str]:
    """Serve a folder on localhost and yield its URL."""
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
    """Anchors, links and video sources of a page."""

    anchors: frozenset[str]
    links: frozenset[str]
    videos: tuple[str, ...]


def read(folder: Path, page: str) -> Facts:
    """Parse a page; embedded videos make pages large, so each is parsed once."""
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
        path = unquote(target.path).removeprefix(prefix()).lstrip("/")  # 404.html links from the root
        anchor = unquote(target.fragment)
        if not (folder / path).is_file():
            found.append(f"links to {href}, which does not exist")
        elif anchor and path in site and anchor not in site[path].anchors:
            found.append(f"links to {href}, which has no such anchor")
    return found


def missing_files(folder: Path) -> list[str]:
    """Return which of the `REQUIRED` files are missing."""
    return [f"{name} is missing" for name in REQUIRED if not (folder / name).is_file()]


def heavy_videos(folder: Path, page: str, site: dict[str, Facts]) -> list[str]:
    """Return the videos of a page above `VIDEO_BYTES`; for embedded videos, the size of the data URI."""
    sizes = [_bytes_of(folder, page, source) for source in site[page].videos]
    return [f"video {i} has {size / 1e6:.1f} MB" for i, size in enumerate(sizes, start=1) if size > VIDEO_BYTES]


def _bytes_of(folder: Path, page: str, source: str) -> int:
    if source.startswith("data:"):
        return len(source)
    file = folder / unquote(urlparse(urljoin(page, source)).path).lstrip("/")
    return file.stat().st_size if file.is_file() else 0  # a missing file is found by the browser


def look(page: Page, address: str) -> list[str]:
    """Open a page, wide and narrow, in light and dark theme, and return its problems."""
    found: list[str] = []
    page.on("console", lambda said: found.append(f"console: {said.text[:160]}") if said.type == "error" else None)
    page.on("pageerror", lambda error: found.append(f"script: {str(error)[:160]}"))
    page.on("requestfailed", lambda request: found.append(f"not loaded: {request.url[:120]}"))
    page.on("response", lambda answer: found.append(f"{answer.status}: {answer.url[:120]}") if not answer.ok else None)
    page.set_viewport_size(WIDE)
    page.goto(address, wait_until="networkidle")
    found += page.evaluate(FIGURES) + page.evaluate(VIDEOS) + [f"light: {line}" for line in barriers(page)]
    page.evaluate(DARK)
    page.wait_for_timeout(500)  # colours change gradually
    found += page.evaluate(DARK_FIGURES) + [f"dark: {line}" for line in barriers(page, COLOURS)]
    page.set_viewport_size(NARROW)
    return found + page.evaluate(WIDTH)


def barriers(page: Page, only: dict | None = None) -> list[str]:
    """Return axe-core's serious findings, of all rules or of those in `only`."""
    # Without preload: axe would fetch style sheets from a wrong path and get 404.
    options = {"preload": False, "resultTypes": ["violations"], **({"runOnly": only} if only else {})}
    violations = Axe().run(page, options=options).response["violations"]
    severe = [violation for violation in violations if violation["impact"] in SEVERE]
    return [f"{one['id']} ({len(one['nodes'])}x): {one['nodes'][0]['html'][:140]}" for one in severe]


def searched(page: Page, address: str) -> list[str]:
    """Return the problems of the search."""
    page.goto(f"{address}search.html?q={SEARCHED}", wait_until="networkidle")
    page.wait_for_timeout(2000)
    hits = page.locator("#search-results li").count()
    return [] if hits else [f"the search does not find {SEARCHED!r}"]


def check(folder: Path, only: str = "") -> dict[str, list[str]]:
    """Return the problems of each page of a site that has any."""
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


def _in_a_browser(jobs: list[tuple[str, Check, str]]) -> dict[str, list[str]]:
    """Run each job on a fresh page of one browser and return the problems of each."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium(), args=FLAGS)
        waiting = tqdm(jobs, desc="pages", disable=not sys.stderr.isatty())
        found = {name: _with_new_page(browser, do, address) for name, do, address in waiting}
        browser.close()
    return found


def _with_new_page(browser: Browser, do: Check, address: str) -> list[str]:
    page = browser.new_page()
    try:
        return do(page, address)
    finally:
        page.close()


def chromium() -> str:
    """Return the path of the system's Chromium.

    Raises:
        ValueError: there is none.
    """
    found = which("chromium") or which("chromium-browser") or which("google-chrome")
    if not found:
        raise ValueError("no Chromium on this machine: apt-get install chromium")
    return found


def main() -> int:
    """Check a site and print its problems."""
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
