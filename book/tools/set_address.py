"""Write the address of the repository, and what follows from it, wherever the book needs it.

    python book/tools/set_address.py https://github.com/OWNER/REPOSITORY
    python book/tools/set_address.py https://github.com/OWNER/REPOSITORY --pages https://book.example.org

The setting is `repository.url` in _config.yml. Buttons, sitemap, shared links, the page for missing pages and the
citation follow. Only values change: the files are edited as text, so that their comments and their order stay.
"""

import argparse
import re
import sys
from pathlib import Path
from urllib.parse import urlparse

from fedvla_lib.files import write_atomically

ROOT = Path(__file__).resolve().parents[2]
REPOSITORY = re.compile(r"https://github\.com/([A-Za-z0-9][A-Za-z0-9-]*)/([A-Za-z0-9._-]+?)(?:\.git)?/?")
PAGES = re.compile(r"https?://[A-Za-z0-9.-]+(:[0-9]+)?(/[A-Za-z0-9._~-]+)*/?")
BINDER, COLAB = "https://mybinder.org", "https://colab.research.google.com"
CONFIG, CITATION = "_config.yml", "CITATION.cff"
# Lines of _config.yml, up to the value, and the value that they get.
LINES = {
    "  url:": "repository",
    "  baseurl:": "pages",
    "  binderhub_url:": "binder",
    "  colab_url:": "colab",
    "    ogp_site_url:": "pages",
    "    notfound_urls_prefix:": "folder",
}
NOT_FOUND_LINK = re.compile(r'(?<=<a href=")/[^"]*?([a-z]+\.html)(?=")')  # has to work from any folder of the site


def addresses(repository: str, pages: str = "") -> dict[str, str]:
    """Return all addresses by name; those of folders end with a slash.

    Args:
        pages: where the rendered book is; by default where GitHub Pages puts it.

    Raises:
        ValueError: an address is not usable; the message has the valid form.
    """
    match = REPOSITORY.fullmatch(repository)
    if not match:
        raise ValueError(f"{repository!r} is not the address of a repository: give https://github.com/OWNER/REPOSITORY")
    owner, name = match.groups()
    pages = pages or _github_pages(owner, name)
    if not PAGES.fullmatch(pages):
        raise ValueError(f"{pages!r} is not the address of a website: give https://HOST/ or https://HOST/FOLDER/")
    pages = pages.rstrip("/") + "/"
    found = {"repository": f"https://github.com/{owner}/{name}", "pages": pages, "folder": urlparse(pages).path}
    return found | {"binder": BINDER, "colab": COLAB}


def _github_pages(owner: str, name: str) -> str:
    host = f"{owner.lower()}.github.io"
    return f"https://{host}/" if name.lower() == host else f"https://{host}/{name}/"


def config(text: str, known: dict[str, str]) -> str:
    """Return the text of _config.yml with these addresses."""
    for start, name in LINES.items():
        text = _put(text, rf"^({start} )\S+", rf"\g<1>{known[name]}", start.strip())
    return NOT_FOUND_LINK.sub(rf"{known['folder']}\g<1>", text)


def citation(text: str, known: dict[str, str]) -> str:
    """Return the text of CITATION.cff with these addresses, below the licence."""
    text = re.sub(r"^(?:repository-code|url): .*\n", "", text, flags=re.MULTILINE)
    lines = f"repository-code: {known['repository']}\nurl: {known['pages']}\n"
    return _put(text, r"^(license: .*\n)", rf"\g<1>{lines}", "license:")


def _put(text: str, pattern: str, value: str, name: str) -> str:
    changed, count = re.subn(pattern, value, text, flags=re.MULTILINE)
    if count != 1:
        raise ValueError(f"{count} lines begin with {name!r}, where one was expected: write the address by hand")
    return changed


def set_address(root: Path, repository: str, pages: str = "") -> list[str]:
    """Write the addresses below `root` and return the names of the files that changed.

    Raises:
        ValueError: an address is not usable, or a file has no place for it; then nothing is written.
    """
    known = addresses(repository, pages)
    before = {name: (root / name).read_text(encoding="utf-8") for name in (CONFIG, CITATION)}
    after = {CONFIG: config(before[CONFIG], known), CITATION: citation(before[CITATION], known)}
    changed = [name for name, text in after.items() if text != before[name]]
    for name in changed:
        write_atomically(root / name, after[name].encode())
    return changed


def main(argv: list[str] | None = None) -> int:
    """Set the address and print the changed files."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("repository", help="https://github.com/OWNER/REPOSITORY")
    parser.add_argument("--pages", default="", metavar="URL", help="where the book is (default: on GitHub Pages)")
    options = parser.parse_args(argv)
    try:
        changed = set_address(ROOT, options.repository, options.pages)
    except (ValueError, OSError) as error:
        print(f"set_address: {error}", file=sys.stderr)
        return 2
    print("\n".join(changed) or "nothing to change")
    return 0


if __name__ == "__main__":
    sys.exit(main())
