"""The site check finds what a reader would stumble over, and nothing on a sound page."""

from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest

import check_site
import site_scripts

PAGE = """<!DOCTYPE html><html lang="en"><head><meta charset="utf-8"><title>A page</title>
<meta name="viewport" content="width=device-width"><link rel="icon" href="data:,"></head>
<body><main><h1 id="top">A page</h1>{}</main></body></html>"""
SOUND = """<p><a href="#top">To the top</a>, <a href="other.html#part">to a part</a></p>
<img src="figure.png" alt="A line that falls from ten to one"><video src="video.mp4" controls></video>"""
WRONG = {  # page -> its content, and what has to be said of it
    "dead_link": ('<a href="gone.html">there</a>', "links to gone.html, which does not exist"),
    "dead_anchor": ('<a href="other.html#gone">there</a>', "links to other.html#gone, which has no such anchor"),
    "no_alt": ('<img src="figure.png">', "image figure.png has the alt text ''"),
    "no_image": ('<img src="gone.png" alt="A line that falls to one">', "image gone.png does not load"),
    "wide": ('<div style="width: 700px">wide</div>', "px wide on a screen of 360"),
    "console": ("<script>console.error('lost')</script>", "console: lost"),
    "script": ("<script>throw new Error('broken')</script>", "script: broken"),
    "no_video": ('<video src="gone.mp4" controls></video>', "video 1 does not play"),
    "not_answered": ("<script>fetch('gone.json')</script>", "404: http"),
    "not_reached": ("<script>fetch('http://127.0.0.1:9/').catch(() => 0)</script>", "not loaded: http://127.0.0.1:9/"),
    "unreadable": ('<p style="color: #ccc; background: #fff">pale</p>', "light: color-contrast"),
}


def write_site(folder: Path, pages: dict[str, str]) -> Path:
    """A site of these pages and of what every rendered book has."""
    search = f'<ul id="search-results"><li>{check_site.SEARCHED}</li></ul>'
    whole = {"index": SOUND, "other": '<h2 id="part">A part</h2>', "search": search, "404": "<p>Not here</p>", **pages}
    for name, content in whole.items():
        (folder / f"{name}.html").write_text(PAGE.format(content))
    (folder / "sitemap.xml").write_text("<urlset/>")
    frames = np.zeros((8, 64, 64, 3), np.uint8)
    iio.imwrite(folder / "figure.png", frames[0])
    iio.imwrite(folder / "video.mp4", frames, fps=8)
    return folder


@pytest.fixture(scope="module")
def found(tmp_path_factory) -> dict[str, list[str]]:
    """What the check says of a site with sound and wrong pages."""
    try:
        check_site.chromium()
    except ValueError as error:
        pytest.skip(str(error))
    pages = {name: content for name, (content, _) in WRONG.items()}
    return check_site.check(write_site(tmp_path_factory.mktemp("site"), pages))


@pytest.mark.integration
@pytest.mark.parametrize("name", WRONG)
def test_what_is_wrong_is_found(found, name):
    problems = found.get(f"{name}.html", [])
    assert any(WRONG[name][1] in problem for problem in problems), problems


@pytest.mark.integration
def test_sound_pages_are_left_alone(found):
    assert set(found) == {f"{name}.html" for name in WRONG}


@pytest.mark.integration
def test_a_search_without_hits_is_found(found, tmp_path):
    site = write_site(tmp_path, {"search": '<ul id="search-results"></ul>'})
    assert list(check_site.check(site, only="none of them")) == ["search"]


@pytest.mark.unit
@pytest.mark.parametrize("name", check_site.REQUIRED)
def test_files_beside_the_pages_are_required(tmp_path, name):
    site = write_site(tmp_path, {})
    assert not check_site.missing_files(site)
    (site / name).unlink()
    assert check_site.missing_files(site) == [f"{name} is missing"]


@pytest.mark.unit
@pytest.mark.parametrize("inside", [True, False])
def test_a_heavy_video_is_found(tmp_path, inside):
    source = "data:video/mp4;base64," + "A" * check_site.VIDEO_BYTES if inside else "heavy.mp4"
    content = f'<video src="video.mp4"></video><video controls><source src="{source}" type="video/mp4"></video>'
    site = write_site(tmp_path, {"videos": content})
    (site / "heavy.mp4").write_bytes(bytes(check_site.VIDEO_BYTES + 1))
    facts = {page: check_site.read(site, page) for page in ("videos.html", "index.html")}
    assert check_site.heavy_videos(site, "videos.html", facts) == ["video 2 has 1.0 MB"]
    assert not check_site.heavy_videos(site, "index.html", facts)


@pytest.mark.unit
def test_a_folder_without_a_book_is_refused(tmp_path):
    with pytest.raises(ValueError, match="run make book"):
        check_site.pages(tmp_path)


@pytest.mark.unit
def test_the_entries_of_a_bibliography_are_items_of_its_list():
    """As docutils writes them."""
    page = {"body": '<div role="list" class="citation-list"><div class="citation" role="doc-biblioentry"></div></div>'}
    site_scripts.with_list_items(None, "book/bibliography", "page.html", page, None)
    assert page["body"].count('role="listitem"') == 1 and "biblioentry" not in page["body"]
