"""A chapter made from the template: its files, its entries in the contents, and the tests that every chapter passes."""

import inspect
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import new_chapter
import test_exercises
import test_notebooks
import test_reading
from execution import toc_pages

ROOT = Path(__file__).parents[1]
NAME = "97_made_by_a_test"


@pytest.fixture(scope="module")
def copy(tmp_path_factory):
    """Return a copy of the files that a chapter needs, with one more chapter."""
    root = tmp_path_factory.mktemp("project")
    (root / "notebooks").mkdir()
    for package in ("fedvla_lib", "book/fedvla_book"):
        shutil.copytree(ROOT / package, root / package, ignore=shutil.ignore_patterns("__pycache__"))
    (root / "tests" / "wrong_answers").mkdir(parents=True)
    shutil.copy(ROOT / "_toc.yml", root)
    shutil.copytree(ROOT / "book" / "reference" / "comparison", root / "book" / "reference" / "comparison")
    shutil.copy(ROOT / "book" / "index.md", root / "book")
    new_chapter.make(root, NAME)
    return root


@pytest.mark.unit
def test_the_contents_list_it_after_the_last_chapter(copy):
    before = [page for page in toc_pages(ROOT) if page.startswith("notebooks/")]
    assert [page for page in toc_pages(copy) if page.startswith("notebooks/")] == [*before, f"notebooks/{NAME}"]


@pytest.mark.unit
def test_the_front_page_lists_it_after_the_last_chapter(copy):
    before, after = ((root / "book" / "index.md").read_text() for root in (ROOT, copy))
    assert test_notebooks.told_on(after) == [*test_notebooks.told_on(before), NAME]
    added = f"{{doc}}`/notebooks/{NAME}`\n: Say in one sentence what the reader builds here.\n\n"
    assert after.replace(added, "") == before


@pytest.mark.unit
def test_it_passes_the_tests_of_every_chapter(copy):
    notebook = copy / "notebooks" / f"{NAME}.ipynb"
    checks = [
        test for name, test in vars(test_notebooks).items() if name.startswith("test_") and "no_other" not in name
    ]
    for check in checks:
        check(notebook)
    for name, test in vars(test_reading).items():
        if name.startswith("test_") and "path" in inspect.signature(test).parameters:
            test(notebook)
    exercises = list(test_exercises.met(notebook))
    assert len(exercises) >= test_exercises.AT_LEAST
    text = " ".join(before for _, _, before, _, _ in exercises)
    assert all(f"({grade})" in text for grade in test_exercises.GRADES)


@pytest.mark.integration
def test_it_runs_and_its_solutions_pass_their_checks(copy):
    notebook = copy / "notebooks" / f"{NAME}.ipynb"
    answers = [
        solution + f'\nassert check("97.{name}", {name}).passed\n'
        for _, name, _, _, solution in test_exercises.met(notebook)
    ]
    script = copy / "notebooks" / "answers.py"
    script.write_text("import numpy as np\nfrom fedvla_book.exercises import check\n\n" + "\n".join(answers))
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(copy), str(copy / "book")]),
        "FEDVLA_PROFILE": "tiny",
    }
    subprocess.run([sys.executable, str(script)], env=environment, check=True, cwd=copy / "notebooks")
    options = ["-q", "-p", "no:cacheprovider", "-c", os.devnull, "--rootdir", str(copy)]
    command = [sys.executable, "-m", "pytest", *options, "--nbmake", str(notebook)]
    assert subprocess.run(command, env=environment, cwd=copy).returncode == 0


@pytest.mark.unit
@pytest.mark.parametrize(
    ("name", "message"), [("privacy", "'privacy' is not a chapter name"), ("02_again", "taken by 02_partitioning")]
)
def test_an_invalid_name_is_refused(name, message):
    with pytest.raises(ValueError, match=message):
        new_chapter.make(ROOT, name)
    assert not list((ROOT / "notebooks").glob("*again*"))
