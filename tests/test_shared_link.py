"""What a shared link shows: Sphinx, with the book's settings, writes whole addresses and the drawn card."""

import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from bs4 import BeautifulSoup

pytestmark = pytest.mark.unit
ROOT = Path(__file__).parents[1]
BOOK = yaml.safe_load((ROOT / "_config.yml").read_text())
OPTIONS = {key: value for key, value in BOOK["sphinx"]["config"].items() if key.startswith("ogp_")}
CARD_BYTES = 200_000  # what readers of shared links still fetch


@pytest.fixture(scope="module")
def shown(tmp_path_factory) -> dict[str, str]:
    """Names and contents of the tags of a page that Sphinx renders with the book's options."""
    source = tmp_path_factory.mktemp("shared")
    lines = ["extensions = ['sphinxext.opengraph']", *(f"{name} = {value!r}" for name, value in OPTIONS.items())]
    # Sphinx ignores a setting that nothing declares; here it is an error.
    strict = f"def setup(app):\n    app.connect('builder-inited', lambda app: [app.config[n] for n in {list(OPTIONS)}])"
    (source / "conf.py").write_text("\n".join([*lines, strict]))
    (source / "index.rst").write_text("A page\n======\n\nIt says something.\n")
    command = [sys.executable, "-m", "sphinx", "-W", "-q", str(source), str(source / "html")]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    tags = BeautifulSoup((source / "html" / "index.html").read_text(), "html.parser").find_all("meta", content=True)
    return {tag.get("property") or tag.get("name"): tag["content"] for tag in tags}


def test_addresses_are_whole_and_below_the_books(shown):
    base = BOOK["html"]["baseurl"]
    assert OPTIONS["ogp_site_url"] == base
    assert shown["og:url"] == f"{base}index.html" and shown["og:image"] == f"{base}_static/card.png"


def test_the_card_is_described_large_and_named_after_the_book(shown):
    assert shown["twitter:card"] == "summary_large_image"
    assert shown["og:image:alt"] == OPTIONS["ogp_image_alt"]
    assert shown["og:site_name"] == BOOK["title"]


def test_the_card_is_a_small_picture():
    card = (ROOT / "book" / OPTIONS["ogp_image"]).read_bytes()
    assert card.startswith(b"\x89PNG") and len(card) < CARD_BYTES
