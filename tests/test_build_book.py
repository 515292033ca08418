"""The book's builder executes a chapter exactly when something it depends on changed, and lets no failure through."""

import json
import subprocess
import sys
from pathlib import Path

import nbformat
import pytest
import yaml

import build_book
import execution
import front_page
import pages
from execution import BookError, Chapter
from fedvla_book import tables
from fedvla_book.video_player import AT_ONCE, CONTROLS

ROOT = Path(__file__).parent.parent
CODE = "import pathlib\nwith open('ran.txt', 'a') as log:\n    log.write(profile + '\\n')\nprint(profile)"


def write_notebook(path: Path, code: str = CODE, parameters: str = 'profile = "laptop"') -> Path:
    kernel = {"name": "python3", "display_name": "Python 3", "language": "python"}
    notebook = nbformat.v4.new_notebook(metadata={"kernelspec": kernel})
    tagged = nbformat.v4.new_code_cell(parameters, metadata={"tags": ["parameters"]})
    notebook.cells = [nbformat.v4.new_markdown_cell("# A chapter"), tagged, nbformat.v4.new_code_cell(code)]
    path.parent.mkdir(parents=True, exist_ok=True)
    nbformat.write(notebook, path)
    return path


@pytest.fixture
def project(tmp_path) -> Path:
    """A book of two pages with a library of one line."""
    (tmp_path / "fedvla_lib").mkdir()
    (tmp_path / "fedvla_lib" / "spec.py").write_text("FPS = 10\n")
    (tmp_path / "requirements.lock").write_text("numpy==2.2.6\n")
    (tmp_path / "_toc.yml").write_text(
        "format: jb-book\nroot: book/index\nparts:\n  - caption: All\n    chapters:\n      - file: notebooks/one\n"
    )
    (tmp_path / "_config.yml").write_text("title: A book\nexecute: {execute_notebooks: force}\n")
    (tmp_path / "book" / "fedvla_book").mkdir(parents=True)
    (tmp_path / "book" / "fedvla_book" / "plots.py").write_text("WIDTH = 7\n")
    (tmp_path / "book" / "index.md").write_text("# Front\n")
    (tmp_path / "book" / "run_times.md").write_text("# Run times\n\n<!-- status -->\n")
    (tmp_path / "book" / "reference").mkdir()
    (tmp_path / "book" / "reference" / "notes.toml").write_text("[code]\n")
    write_notebook(tmp_path / "notebooks" / "one.ipynb")
    return tmp_path


@pytest.mark.unit
def test_key_changes_with_everything_a_chapter_depends_on(project):
    keys = {execution.library_key(project, profile) for profile in ("tiny", "laptop")}
    for path in ("fedvla_lib/spec.py", "book/fedvla_book/plots.py", "requirements.lock"):
        (project / path).write_text((project / path).read_text() + "# changed\n")
        keys.add(execution.library_key(project, "tiny"))
    (project / "fedvla_lib" / "new.py").write_text("")
    keys.add(execution.library_key(project, "tiny"))
    assert len(keys) == 6
    notebook = project / "notebooks" / "one.ipynb"
    before = execution.notebook_key(notebook, "library")
    assert execution.notebook_key(write_notebook(notebook, code="1 + 1"), "library") != before


@pytest.mark.unit
def test_key_changes_with_the_stored_results_that_a_chapter_reads(project):
    stored = project / "book" / "reference" / "runs" / "task_fedavg_0"
    stored.mkdir(parents=True)
    (stored / "a.json").write_text("1")
    notebook = project / "notebooks" / "one.ipynb"
    keys = {}
    for code in ("1 + 1", "'../book/reference/runs'"):
        write_notebook(notebook, code=code)
        (stored / "a.json").write_text("1")
        before = execution.notebook_key(notebook, "library")
        (stored / "a.json").write_text("2")
        keys[code] = execution.notebook_key(notebook, "library") != before
    assert list(keys.values()) == [False, True]


@pytest.mark.unit
def test_key_does_not_change_by_itself(project):
    assert execution.library_key(project, "tiny") == execution.library_key(project, "tiny")


@pytest.mark.unit
@pytest.mark.parametrize(("url", "buttons"), [("", False), ("https://example.org/book", True)])
def test_one_setting_switches_the_buttons_to_the_source_on(tmp_path, url, buttons):
    config = yaml.safe_load((ROOT / "_config.yml").read_text())
    config["repository"]["url"] = url
    (tmp_path / "_config.yml").write_text(yaml.safe_dump(config))
    html = yaml.safe_load(pages._rendering_config(tmp_path))["html"]
    assert {html[f"use_{kind}_button"] for kind in ("edit_page", "repository", "issues")} == {buttons}


@pytest.mark.unit
def test_pages_of_the_real_contents_exist():
    names = execution.toc_pages(ROOT)
    assert names[0] == "book/index" and len(names) == len(set(names)) > 6
    assert not [page for page in names if page.startswith("book/") and not (ROOT / f"{page}.md").is_file()]


@pytest.mark.unit
def test_nested_sections_are_found(tmp_path):
    (tmp_path / "_toc.yml").write_text(
        "format: jb-book\nroot: a\nparts:\n  - chapters:\n      - file: b\n        sections:\n          - file: c\n"
    )
    assert execution.toc_pages(tmp_path) == ["a", "b", "c"]


@pytest.mark.integration
def test_executes_once_then_only_after_a_change(project, capsys):
    ran, prepared = project / "notebooks" / "ran.txt", []
    first = execution.execute_chapters(project, "tiny", prepare=prepared.append)[0]
    again = execution.execute_chapters(project, "tiny", prepare=prepared.append)[0]
    assert prepared == ["tiny"]
    assert (first.reused, again.reused) == (False, True) and again.seconds == pytest.approx(first.seconds, abs=0.1)
    assert ran.read_text() == "tiny\n", "papermill injects the profile, in the notebook's own folder"
    (project / "fedvla_lib" / "spec.py").write_text("FPS = 20\n")
    assert not execution.execute_chapters(project, "tiny")[0].reused
    assert ran.read_text() == "tiny\n" * 2
    assert "unchanged" in capsys.readouterr().out


@pytest.mark.integration
def test_chapters_of_an_unpacked_book_are_executed_there_whatever_was_executed_before(project):
    execution.execute_chapters(project, "tiny")
    there = write_notebook(project / "unpacked" / "notebooks" / "one.ipynb")
    (chapter,) = execution.execute_chapters(project, "tiny", inside=project / "unpacked")
    assert not chapter.reused and (there.parent / "ran.txt").read_text() == "tiny\n"
    assert (project / "notebooks" / "ran.txt").read_text() == "tiny\n"  # and not here once more
    assert execution.execute_chapters(project, "tiny")[0].reused  # the pages show that copy


@pytest.mark.integration
def test_executed_copy_shows_results_but_neither_injection_nor_paths(project):
    chapter = execution.execute_chapters(project, "tiny")[0]
    text = chapter.executed.read_text()
    notebook = nbformat.read(chapter.executed, as_version=4)
    assert len(notebook.cells) == 3 and notebook.cells[2].outputs[0].text == "tiny\n"
    assert "papermill" not in text and str(project) not in text


@pytest.mark.integration
@pytest.mark.parametrize("jobs", [1, 2])
def test_failing_cell_names_chapter_and_error_and_leaves_no_copy(project, jobs):
    """Also where chapters are executed side by side, in other processes."""
    (chapter,) = execution.execute_chapters(project, "tiny", jobs=jobs)
    assert nbformat.read(chapter.executed, as_version=4).metadata["fedvla"]["at_a_time"] == jobs
    write_notebook(project / "notebooks" / "one.ipynb", code="raise KeyError('no such episode')")
    with pytest.raises(BookError, match=r"one.ipynb: KeyError: 'no such episode'"):
        execution.execute_chapters(project, "tiny", jobs=jobs)
    assert not (project / "_build" / "tiny" / "executed" / "one.ipynb").exists()


@pytest.mark.integration
@pytest.mark.parametrize("jobs", [1, 2])
def test_a_chapter_waits_for_the_one_whose_run_it_uses_and_each_has_a_log(project, jobs, capsys):
    toc = (project / "_toc.yml").read_text()
    names = ("early", "user", "maker")
    (project / "_toc.yml").write_text(toc.replace("notebooks/one", "notebooks/early") + "".join(
        f"      - file: notebooks/{name}\n" for name in names[1:]))  # fmt: skip
    code = "import pathlib, time\nassert pathlib.Path('made').exists()\nprint('used')"
    write_notebook(project / "notebooks" / "early.ipynb")
    write_notebook(project / "notebooks" / "maker.ipynb", "import pathlib\npathlib.Path('made').touch()")
    user = nbformat.read(write_notebook(project / "notebooks" / "user.ipynb", code), as_version=4)
    user.metadata["fedvla"] = {"after": ["maker"]}
    nbformat.write(user, project / "notebooks" / "user.ipynb")
    chapters = execution.execute_chapters(project, "tiny", jobs=jobs)
    assert [chapter.name for chapter in chapters] == list(names)
    log = execution.log_of(chapters[1].executed)
    assert log.read_text() == "used\n" and log.parent == project / "_build" / "tiny" / "logs"
    said = capsys.readouterr().out
    assert said.index("maker: executed") < said.index("user: executed")


@pytest.mark.unit
def test_the_longest_chapters_start_first_after_an_awaited_one_and_a_short_one(tmp_path):
    seconds = {"a": 10, "b": 30, "c": 20, "d": 40, "awaited": 5, "new": None}
    costs = tmp_path / "costs.json"
    costs.write_text(json.dumps({"chapters": {name: {"seconds": took} for name, took in seconds.items()}}))
    chapters = [Path(f"{name}.ipynb") for name in seconds]
    order = execution._longest_first(chapters, {chapters[0]: {Path("awaited.ipynb")}}, costs)
    assert [path.stem for path in order] == ["awaited", "a", "new", "d", "b", "c"]
    assert execution._longest_first(chapters[:1], {}, costs) == chapters[:1]


@pytest.mark.unit
def test_chapters_wait_for_chapters_of_the_book():
    after = {path.stem: execution._metadata(path).get("after", []) for path in execution.notebooks_of(ROOT)}
    assert after["06_federated_vs_centralized"] == ["04_fedavg"]
    assert {name for names in after.values() for name in names} <= set(after)


@pytest.mark.unit
def test_a_number_of_jobs_is_a_whole_number_from_one(capsys):
    with pytest.raises(SystemExit, match="2"):
        build_book.main(["--profile", "laptop", "--jobs", "0"])
    assert "--jobs 0 is not usable" in capsys.readouterr().err


@pytest.mark.unit
def test_parameter_that_the_chapter_does_not_have(project):
    notebook = write_notebook(project / "notebooks" / "one.ipynb", parameters="size = 3")
    with pytest.raises(BookError, match="one.ipynb has no parameter 'profile'.*'size'"):
        execution.check_parameters(notebook, {"profile": "tiny"})


@pytest.mark.unit
def test_no_chapter_of_that_name(project):
    with pytest.raises(BookError, match="no chapter in _toc.yml has 'zero'"):
        execution.execute_chapters(project, "tiny", only="zero")


@pytest.mark.unit
def test_lay_out_touches_only_what_changed(project):
    source = project / "_build" / "tiny" / "source"
    chapter = Chapter("one", project / "notebooks" / "one.ipynb", "key", 12.4, reused=False)
    pages.lay_out(project, source, [chapter], "tiny")
    times = {path: path.stat().st_mtime_ns for path in source.rglob("*") if path.is_file()}
    assert "execute_notebooks: 'off'" in (source / "_config.yml").read_text()
    assert "[](../notebooks/one.ipynb)" in (source / "book" / "run_times.md").read_text()
    (source / "old.md").write_text("a page of an earlier build")
    (project / "book" / "index.md").write_text("# New front\n")
    pages.lay_out(project, source, [chapter], "tiny")
    changed = {path.name for path, time in times.items() if path.stat().st_mtime_ns != time}
    assert changed == {"index.md"} and not (source / "old.md").exists()


@pytest.mark.unit
def test_pages_are_made_again_when_anything_that_they_show_has_changed(project):
    chapter = Chapter("one", project / "notebooks" / "one.ipynb", "key", 12.4, reused=False)
    found = [build_book.sources(project, "tiny", [chapter])]
    assert build_book.sources(project, "tiny", [chapter]) == found[0]
    for name in ("notebooks/one.ipynb", "book/index.md", "book/tools/pages.py", "benchmarks/results/a.json",
                 "_build/tests/junit.xml", "book/reference/notes.toml", "fedvla_lib/spec.py", "_toc.yml"):  # fmt: skip
        (project / name).parent.mkdir(parents=True, exist_ok=True)
        with (project / name).open("a") as file:
            file.write("\n")
        found.append(build_book.sources(project, "tiny", [chapter]))
    assert len(set(found)) == len(found)


def showing(html: str, path: Path) -> Path:
    """Write an executed notebook with one cell, which shows `html`."""
    output = nbformat.v4.new_output("display_data", {"text/html": html})
    cells = [nbformat.v4.new_code_cell("show", outputs=[output])] if html else []
    nbformat.write(nbformat.v4.new_notebook(cells=cells), path)
    return path


@pytest.mark.unit
def test_every_generated_part_of_the_real_pages_is_filled_in(tmp_path):
    """From the chapters as they are in git, without outputs, but for the one whose video the front page shows."""
    executed = {path.stem: path for path in execution.notebooks_of(ROOT)}
    executed[pages.VIDEO_CHAPTER] = showing(figure(1, "worked"), tmp_path / f"{pages.VIDEO_CHAPTER}.ipynb")
    chapters = [Chapter(name, path, "key", 1.0, reused=True) for name, path in executed.items()]
    source = tmp_path / "source"
    pages.lay_out(ROOT, source, chapters, "tiny")
    texts = {path.name: path.read_text() for path in (source / "book").rglob("*.md")}
    assert "run_times.md" in texts and not [name for name, text in texts.items() if "<!--" in text]
    assert (source / pages.OUTCOME).read_bytes().startswith(b"\x89PNG")
    assert (source / pages.IMPORTS).read_text().startswith("<svg")
    assert "\n## Pretraining\n" in texts["nano_base.md"] and "\n## Local training\n" in texts["speed.md"]


@pytest.mark.unit
def test_the_builder_loads_nothing_that_trains():
    """Whether a chapter changed is known at once."""
    code = "import sys, build_book; sys.exit(' '.join({'torch', 'lerobot', 'flwr'} & set(sys.modules)) or 0)"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT / "book/tools", capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def write_pages(html: Path, one: str) -> None:
    for name, text in (("book/index", "<p>front</p>"), ("notebooks/one", one)):
        (html / name).parent.mkdir(parents=True, exist_ok=True)
        (html / f"{name}.html").write_text(text)


@pytest.mark.unit
@pytest.mark.parametrize("image", ['<img src="a.png">', '<img alt="" src="a.png">', '<img alt="../_images/a.png">'])
def test_images_need_a_description(project, image):
    write_pages(project / "html", one=image)
    with pytest.raises(BookError, match=r"cell's metadata\): notebooks/one \(1\)"):
        build_book.check_pages(project, project / "html")


@pytest.mark.unit
def test_pages_are_counted_and_missed(project):
    write_pages(project / "html", one='<img src="a.png" alt="loss falls over 300 steps">')
    assert build_book.check_pages(project, project / "html") == 2
    (project / "html" / "notebooks" / "one.html").unlink()
    with pytest.raises(BookError, match="1 of 2 pages were not built: notebooks/one"):
        build_book.check_pages(project, project / "html")


@pytest.mark.unit
def test_publishing_replaces_the_whole_book(tmp_path):
    (tmp_path / "html").mkdir()
    (tmp_path / "html" / "index.html").write_text("new")
    target = tmp_path / "published"
    target.mkdir()
    (target / "stale.html").write_text("old")
    build_book.publish(tmp_path / "html", target, "digest")
    assert sorted(path.name for path in target.iterdir()) == [".built-from", "index.html"]
    assert build_book.is_published(target, "digest") and not build_book.is_published(target, "another")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["html", "published"]


@pytest.mark.integration
def test_warnings_of_the_book_are_errors(project, capfd):
    (project / "book" / "index.md").write_text("# Front\n\nSee {doc}`nowhere`.\n")
    source = project / "_build" / "tiny" / "source"
    pages.lay_out(project, source, [], "tiny")
    with pytest.raises(BookError, match="warnings above, which are errors"):
        build_book.render(source, project / "_build" / "tiny")
    assert "nowhere" in capfd.readouterr().err


@pytest.mark.integration
def test_a_changed_stylesheet_alone_reaches_the_pages_and_the_root_leads_to_the_front_page(project):
    with (project / "_config.yml").open("a") as config:
        config.write("sphinx: {config: {html_static_path: [book/_static]}}\n")
    (project / "book" / "run_times.md").unlink()  # no page of the contents
    style, source, output = project / build_book.STATIC / "book.css", project / "source", project / "output"
    style.parent.mkdir()
    for rule in ("p {color: red}", "p {color: blue}"):
        style.write_text(rule)
        pages.lay_out(project, source, [Chapter("one", project / "notebooks" / "one.ipynb", "", 1.0, True)], "tiny")
        html = build_book.render(source, output)
        assert (html / "_static" / "book.css").read_text() == rule
    front_door = (html / "index.html").read_text()
    assert "url=book/index.html" in front_door and 'rel="icon" href="data:,"' in front_door


def figure(number: int, ending: str, how: str = CONTROLS) -> str:
    return f'<figure><video {how} aria-label="Round {number}. Lift the red cube. {ending}"></video></figure>'


@pytest.mark.unit
def test_the_front_page_shows_the_first_video_of_the_last_round(tmp_path):
    html = "".join([figure(0, "no"), figure(10, "failed"), figure(0, "no"), figure(10, "worked")])
    said = front_page.video(showing(f"<div>{html}</div>", tmp_path / "videos.ipynb"), "tiny")
    assert said.startswith(figure(10, "failed", AT_ONCE) + "\n\n") and "profile `tiny`" in said
    with pytest.raises(BookError, match="videos.ipynb shows no video"):
        front_page.video(showing("", tmp_path / "videos.ipynb"), "tiny")
    assert pages.VIDEO in (ROOT / pages.FRONT_PAGE).read_bytes()


@pytest.fixture(scope="module")
def ten_labs():
    """The stored runs of the front page."""
    return front_page.compared(ROOT / front_page.COMPARISON)


@pytest.fixture(scope="module")
def headline(ten_labs):
    return front_page.headline(ten_labs)


@pytest.mark.unit
def test_the_front_page_says_what_the_main_comparison_found_whoever_is_ahead(ten_labs, headline):
    home = ten_labs[ten_labs.place == "own"]
    alone, federated = (home[home.method == name] for name in ("local-only-400", "federated"))
    said = headline
    for count in (4, 8):
        rates = [part[part.demonstrations == count].success.mean() for part in (alone, federated)]
        part = said.split(f"with {count} demonstrations a lab, in {rates[0]:.0%} [")[1].split(";")[0]
        assert f"in {rates[1]:.0%} [" in part and f"{100 * (rates[1] - rates[0]):+.1f} points [" in part
    swapped = {"local-only-400": "federated", "federated": "local-only-400"}
    kinds = ten_labs.method.map({"local-only-400": "federated", "federated": "local-only"}).fillna(ten_labs.kind)
    names = ten_labs.method.replace(swapped)
    reverse = ten_labs.assign(method=names, kind=kinds)
    main = home[home.demonstrations.isin([4, 8])]
    gap = tables.differences(main, [("federated", "local-only-400")], seed=0)
    if (gap.p_holm < 0.05).all():
        assert said.count(": ahead, ") >= 2
        assert "**behind**" in front_page.main_comparison(reverse[reverse.place == "own"])
    assert pages.HEADLINE in (ROOT / pages.FRONT_PAGE).read_bytes()


@pytest.mark.unit
def test_the_front_page_says_where_federation_stays_behind_pooled_training(ten_labs, headline):
    home = ten_labs[ten_labs.place == "own"]
    fair = front_page.alone_at_best(ten_labs)
    fair = fair[fair.place == "own"]
    both = tables.differences(fair, [("federated", "centralized"), ("federated", "local-only")], seed=0)
    gaps, alone = (both[both.other == name] for name in ("centralized", "local-only"))
    behind = [((table.p_holm < 0.05) & (table.difference < 0)).sum() for table in (gaps, alone)]
    said = headline
    assert f"behind pooled training with {behind[0]} of {len(gaps)} numbers of demonstrations" in said
    assert f"behind labs alone with {behind[1]} of {len(alone)}" in said
    assert f"{100 * alone.difference.min():+.1f} points [" in said  # whether or not it is clear
    (table,) = (part for part in said.split("\n\n") if part.startswith("| demonstrations"))
    rows = [[cell.strip() for cell in line[1:-1].split("|")] for line in table.splitlines()[2:]]
    assert [float(row[0]) for row in rows] == sorted(home.demonstrations.unique())
    assert [row[5].split("\N{NO-BREAK SPACE}")[0] for row in rows] == [f"{100 * gap:+.0f}" for gap in gaps.difference]


def at_home(rows):
    fair = front_page.alone_at_best(rows)
    return fair[fair.place == "own"]


@pytest.mark.unit
def test_the_front_page_says_where_labs_alone_took_more_steps_in_a_row(ten_labs):
    words = "Labs alone took more steps in a row than the federation"
    twice = ten_labs.assign(steps_in_a_row=ten_labs.steps_in_a_row.where(ten_labs.kind != "local-only", 1600))
    steps = ten_labs[ten_labs.kind == "federated"].groupby("demonstrations").steps_in_a_row.first()
    wanted = "; ".join(f"1,600 against {taken:,.0f} with {count:.0f} demonstrations" for count, taken in steps.items())
    assert f"{words}: {wanted}." in front_page.behind(at_home(twice))
    few = ten_labs.assign(steps_in_a_row=ten_labs.steps_in_a_row.where(ten_labs.kind != "local-only", 1))
    assert words not in front_page.behind(at_home(few))


@pytest.mark.unit
def test_the_front_page_draws_a_line_for_each_method(ten_labs, headline, monkeypatch):
    drawn, draw = [], front_page.plots.success_by_demonstrations
    keep = lambda *of, **how: drawn.append(draw(*of, **how)) or drawn[-1]  # noqa: E731
    monkeypatch.setattr(front_page.plots, "success_by_demonstrations", keep)
    image = front_page.outcome(ten_labs)
    assert image.startswith(b"\x89PNG") and image == front_page.outcome(ten_labs)
    names = {text.get_text() for text in drawn[0].get_legend().get_texts()}
    assert names == set(front_page.METHODS)
    assert front_page.OUTCOME.removeprefix("book/") in headline


@pytest.mark.unit
def test_the_front_page_is_not_built_over_methods_that_saw_other_numbers_of_samples(ten_labs):
    other = ten_labs.assign(samples=ten_labs.samples.where(ten_labs.method != "centralized", ten_labs.samples + 1))
    with pytest.raises(BookError, match="federated and centralized differ in samples"):
        front_page.headline(other)
