"""The way out: one address for all places that need it, workflows that call what exists, Binder and Colab."""

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from zipfile import ZipFile

import nbformat
import pytest
import yaml

import check_release
import check_site
import colab
import set_address
import site_scripts

pytestmark = pytest.mark.unit
ROOT = Path(__file__).parents[1]
FILES = (set_address.CONFIG, set_address.CITATION)
URL, PAGES = "https://github.com/Some-Lab/fedvla", "https://some-lab.github.io/fedvla/"
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
PROGRAMS = {"make", "python3", "git", "gh", "sudo", "xargs", "cp", "mkdir", "unzip", ".ci/run"}
PINNED = re.compile(r"actions/[a-z-]+@v\d+")  # GitHub's own, at a major version
each_workflow = pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.stem)


@pytest.fixture
def copy(tmp_path) -> Path:
    """A copy of the files that hold the address, as they are without one."""
    for name in FILES:
        shutil.copy(ROOT / name, tmp_path)
    return tmp_path


def settings(root: Path) -> tuple[dict, dict]:
    """The book's configuration and the citation."""
    book, cited = (yaml.safe_load((root / name).read_text()) for name in FILES)
    return book, cited


def test_every_place_has_the_address(copy):
    assert set_address.set_address(copy, URL) == list(FILES)
    book, cited = settings(copy)
    assert book["repository"]["url"] == cited["repository-code"] == URL
    options = book["sphinx"]["config"]
    assert {book["html"]["baseurl"], options["ogp_site_url"], cited["url"]} == {PAGES}
    assert book["launch_buttons"]["binderhub_url"] == "https://mybinder.org"
    assert book["launch_buttons"]["colab_url"] == "https://colab.research.google.com"
    assert options["notfound_urls_prefix"] == "/fedvla/"
    links = re.findall(r'href="([^"]*)"', options["notfound_context"]["body"])
    assert links == ["/fedvla/index.html", "/fedvla/search.html"]


def test_nothing_but_addresses_changes(copy):
    before = {name: (copy / name).read_text().splitlines() for name in FILES}
    set_address.set_address(copy, URL)
    for name, old in before.items():
        new = (copy / name).read_text().splitlines()
        added = [line for line in new if line not in old]
        kept = [line for line in old if line in new]
        assert added and all(re.search(r"https://|/fedvla/", line) for line in added)
        assert [line for line in new if line not in added] == kept, "the rest, in its order"
        assert [line.partition("#")[2] for line in new if "#" in line] == [
            line.partition("#")[2] for line in old if "#" in line
        ]


def test_a_second_time_changes_nothing_and_another_address_leaves_nothing_of_the_first(copy):
    set_address.set_address(copy, URL)
    first = [(copy / name).read_text() for name in FILES]
    assert set_address.set_address(copy, f"{URL}.git") == []
    set_address.set_address(copy, "https://github.com/other/book", "https://book.example.org")
    second = [(copy / name).read_text() for name in FILES]
    assert not [text for text in second if "fedvla" in "".join(re.findall(r"https?://\S+", text))]
    assert settings(copy)[0]["sphinx"]["config"]["notfound_urls_prefix"] == "/"
    assert set_address.set_address(copy, URL) == list(FILES)
    assert [(copy / name).read_text() for name in FILES] == first


def test_pages_of_an_owner_are_at_the_root():
    assert set_address.addresses("https://github.com/Lab/lab.github.io")["pages"] == "https://lab.github.io/"


@pytest.mark.parametrize(
    ("words", "form"),
    [
        ([""], "https://github.com/OWNER/REPOSITORY"),
        (["github.com/lab/book"], "https://github.com/OWNER/REPOSITORY"),
        (["https://github.com/lab"], "https://github.com/OWNER/REPOSITORY"),
        (["https://github.com/lab/book/tree/main"], "https://github.com/OWNER/REPOSITORY"),
        (["https://github.com/lab/book\nurl: x"], "https://github.com/OWNER/REPOSITORY"),
        ([URL, "--pages", "book.example.org"], "https://HOST/"),
        ([URL, "--pages", "https://host/a b"], "https://HOST/"),
    ],
)
def test_a_bad_address_is_refused_in_one_line(copy, monkeypatch, capsys, words, form):
    monkeypatch.setattr(set_address, "ROOT", copy)
    before = [(copy / name).read_bytes() for name in FILES]
    assert set_address.main(words) == 2
    said = capsys.readouterr()
    assert not said.out and said.err.count("\n") == 1 and form in said.err
    assert [(copy / name).read_bytes() for name in FILES] == before


def test_a_file_without_a_place_for_it_is_named_and_none_is_written(copy):
    (copy / set_address.CITATION).write_text("title: a book\n")
    before = (copy / set_address.CONFIG).read_text()
    with pytest.raises(ValueError, match="'license:'"):
        set_address.set_address(copy, URL)
    assert (copy / set_address.CONFIG).read_text() == before


def test_the_site_check_follows_the_page_for_missing_pages_into_its_folder(copy, tmp_path, monkeypatch):
    set_address.set_address(copy, URL)
    monkeypatch.setattr(check_site, "ROOT", copy)
    check_site.prefix.cache_clear()
    (tmp_path / "index.html").write_text("<p>The book</p>")
    (tmp_path / "404.html").write_text('<a href="/fedvla/index.html">a</a> <a href="/fedvla/gone.html">b</a>')
    site = {page: check_site.read(tmp_path, page) for page in ("404.html", "index.html")}
    found = check_site.dead_links(tmp_path, "404.html", site)
    check_site.prefix.cache_clear()
    assert found == ["links to /fedvla/gone.html, which does not exist"]


@each_workflow
def test_a_workflow_may_do_little_and_not_for_ever(path):
    workflow = yaml.safe_load(path.read_text())
    assert workflow["permissions"] == {"contents": "read"}, "what a job needs beyond that, the job says"
    for job in workflow["jobs"].values():
        assert job["timeout-minutes"] <= 90
        writes = "write" in job.get("permissions", {}).values()
        assert not (writes and runs_code_of_the_repository(job))
        assert all(PINNED.fullmatch(step["uses"]) for step in job["steps"] if "uses" in step)
    assert "secrets." not in path.read_text()


def runs_code_of_the_repository(job: dict) -> bool:
    return any(step.get("uses", "").startswith("actions/checkout@") for step in job["steps"])


def commands(path: Path) -> list[list[str]]:
    """The words of each line that a workflow runs."""
    jobs = yaml.safe_load(path.read_text())["jobs"].values()
    scripts = [step["run"].replace("\\\n", " ") for job in jobs for step in job["steps"] if "run" in step]
    return [shlex.split(line) for script in scripts for line in script.splitlines()]


@each_workflow
def test_a_workflow_runs_what_exists(path):
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), flags=re.MULTILINE))
    lines = commands(path)
    programs = {words[0] for words in lines}
    assert programs and programs <= PROGRAMS
    assert {words[1] for words in lines if words[0] == "make"} <= targets
    named = {word for words in lines for word in words if word.startswith((".ci/", "book/", "binder/"))}
    assert not [name for name in named if not (ROOT / name).is_file()]
    keyed = re.findall(r"hashFiles\(([^)]*)\)", path.read_text())
    hashed = {name for names in keyed for name in re.findall(r"'([^']+)'", names)}
    assert not [name for name in hashed if not list(ROOT.glob(name))]


def test_each_workflow_does_what_it_is_for():
    done = {path.stem: [" ".join(words) for words in commands(path)] for path in WORKFLOWS}
    assert done["ci"] == [".ci/run"]
    assert [line for line in done["pages"] if line.startswith("make ")] == ["make address", "make book", "make zip"]
    assert [line for line in done["release"] if line.startswith("make ")] == [
        "make book",
        "make zip",
        "make pdf",
        "make sbom",
    ]
    assert "_build/html/laptop" in (ROOT / ".github/workflows/pages.yml").read_text()


def debian_packages(text: str) -> set[str]:
    return set(re.findall(r"\blib[a-z0-9-]*gl[a-z0-9-]*", text))


def test_packages_for_drawing_are_the_same_everywhere():
    listed = (ROOT / "binder" / "apt.txt").read_text().split()
    (wanted,) = re.findall(r"^packages=\((.*)\)$", (ROOT / ".ci" / "run").read_text(), flags=re.MULTILINE)
    assert listed == wanted.split()
    assert debian_packages((ROOT / "flower" / "Dockerfile").read_text()) == set(listed)


def test_binder_has_the_python_of_the_book_and_makes_its_environment():
    assert (ROOT / "binder" / "runtime.txt").read_text() == f"python-{(ROOT / '.python-version').read_text()}"
    assert not (ROOT / ".binder").exists(), "Binder refuses both"
    for name in ("postBuild", "start"):
        subprocess.run(["bash", "-n", ROOT / "binder" / name], check=True)
    script = (ROOT / "binder" / "postBuild").read_text()
    assert "make env" in script and "requirements.lock" in script


def test_binder_starts_what_it_is_given_at_the_small_size():
    command = ["bash", ROOT / "binder" / "start", "printenv", "FEDVLA_PROFILE"]
    assert subprocess.run(command, capture_output=True, text=True, check=True).stdout == "tiny\n"


def test_copies_for_colab_begin_with_their_set_up_and_are_else_the_chapters(tmp_path):
    address = f"{PAGES}fedvla-book.zip"
    written = colab.copy_chapters(ROOT, tmp_path, address)
    assert len(written) == len(list((ROOT / "notebooks").glob("*.ipynb")))
    for path in written:
        copied, chapter = (nbformat.read(one, as_version=4) for one in (path, ROOT / "notebooks" / path.name))
        nbformat.validate(copied)
        code = [cell for cell in copied.cells if cell.cell_type == "code"]
        assert code[0].id == colab.CELL_ID and address in code[0].source
        assert [cell for cell in copied.cells if cell.id != colab.CELL_ID] == chapter.cells
        assert copied.cells[0].source.startswith("# ")


def test_the_cell_is_there_once():
    chapter = {"cells": [{"cell_type": "markdown", "id": "a"}, {"cell_type": "code", "id": "b"}]}
    once = colab.with_setup(chapter, "1\n")
    assert [cell["id"] for cell in once["cells"]] == ["a", colab.CELL_ID, "b"] and len(chapter["cells"]) == 2
    again = colab.with_setup(once, "2\n")
    assert [cell["id"] for cell in again["cells"]] == ["a", colab.CELL_ID, "b"]
    assert again["cells"][1]["source"] == ["2\n"]


def run_cell(folder: Path, address: str, **environment: str) -> str:
    """Run the cell as a script in a folder and return where it ends."""
    code = colab.setup(address) + "\nfrom pathlib import Path\nprint(Path.cwd())\n"
    command, variables = [sys.executable, "-c", code], {**os.environ, **environment}
    return subprocess.run(command, cwd=folder, env=variables, capture_output=True, text=True, check=True).stdout.strip()


def test_the_cell_does_nothing_elsewhere(tmp_path):
    assert run_cell(tmp_path, "http://127.0.0.1:9/none.zip") == str(tmp_path) and not list(tmp_path.iterdir())


def test_on_colab_the_cell_gets_the_book_once_and_goes_to_its_chapters(tmp_path):
    """With a package of Colab's name, and the library installed already, as after the new kernel."""
    package = tmp_path / "site" / "google" / "colab"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("")
    book, work = tmp_path / "book.zip", tmp_path / "content"
    work.mkdir()
    with ZipFile(book, "w") as packed:
        packed.writestr("fedvla-book/notebooks/01_data.ipynb", "{}")
        packed.writestr("fedvla-book/book/reference/notes.toml", "")
    chapters = work / "fedvla-book" / "notebooks"
    site = str(tmp_path / "site")
    assert run_cell(work, book.as_uri(), PYTHONPATH=site) == str(chapters)
    book.unlink()
    assert run_cell(work, book.as_uri(), PYTHONPATH=site) == str(chapters)
    assert run_cell(chapters, book.as_uri(), PYTHONPATH=site) == str(chapters)


def test_the_button_for_colab_opens_the_copies_on_the_branch_that_holds_them():
    address = "https://colab.research.google.com/github/lab/book/blob/{}/notebooks/01_data.ipynb"
    binder = {"text": "Binder", "url": "https://mybinder.org/v2/gh/lab/book/main"}
    buttons = [binder, {"text": "Colab", "url": address.format("main")}]
    context = {"header_buttons": [{"type": "button"}, {"type": "group", "buttons": buttons}]}
    site_scripts.with_colab_copies(None, "notebooks/01_data", "page.html", context, None)
    assert [one["url"] for one in buttons] == [binder["url"], address.format(site_scripts.COLAB_BRANCH)]
    assert f'--force "$REPOSITORY" {site_scripts.COLAB_BRANCH}' in (ROOT / ".github/workflows/pages.yml").read_text()


@pytest.fixture
def ready(tmp_path) -> Path:
    """Files of a release 1.2.3."""
    (tmp_path / "pyproject.toml").write_text('[project]\nversion = "1.2.3"\n')
    (tmp_path / "CITATION.cff").write_text("version: 1.2.3\ndate-released: 2026-12-01\n")
    (tmp_path / "CHANGELOG.md").write_text("# Changes\n\n## 1.2.3\n\n- New.\n\n## 1.2.2\n\n- Old.\n")
    return tmp_path


def test_a_release_says_what_changed_in_it(ready):
    assert check_release.changes(ready, "v1.2.3") == "- New."


@pytest.mark.parametrize(
    ("name", "old", "new", "message"),
    [
        ("pyproject.toml", "1.2.3", "1.2.4", "the tag is v1.2.3"),
        ("CITATION.cff", "1.2.3", "1.2.2", "CITATION.cff has the version 1.2.2"),
        ("CITATION.cff", "date-released", "released", "no date-released"),
        ("CHANGELOG.md", "## 1.2.3", "## 1.3", "no section on 1.2.3"),
        ("CHANGELOG.md", "## 1.2.3", "## 1.2.3, not released yet", "not released yet"),
    ],
)
def test_a_release_whose_files_disagree_is_refused_in_one_line(ready, monkeypatch, capsys, name, old, new, message):
    (ready / name).write_text((ready / name).read_text().replace(old, new))
    monkeypatch.setattr(check_release, "ROOT", ready)
    assert check_release.main(["v1.2.3"]) == 2
    said = capsys.readouterr()
    assert not said.out and said.err.count("\n") == 1 and message in said.err


def test_the_files_of_this_repository_name_one_version():
    with pytest.raises(ValueError, match="CITATION|CHANGELOG|tag v"):
        check_release.changes(ROOT, "v0.0.0")
    version = re.search(r'^version = "(.*)"$', (ROOT / "pyproject.toml").read_text(), flags=re.MULTILINE)[1]
    assert str(settings(ROOT)[1]["version"]) == version
