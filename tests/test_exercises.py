"""Exercises as the reader meets them: the solution passes, the stub and known mistakes get the promised hint."""

import importlib.util
import re
from pathlib import Path

import nbformat
import numpy as np
import pytest

from fedvla_book import exercises

pytestmark = pytest.mark.unit
ROOT = Path(__file__).parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
CHECK = re.compile(r"^check\(\"(\d\d)\.(\w+)\", (\w+)\)$", re.MULTILINE)
# HTML, as a directive of the book's would stand there open in JupyterLab; blank lines, for the Markdown inside.
HIDDEN = re.compile(r"^<details>\n<summary>(Solution|Answer)</summary>\n\n(.+?)\n\n</details>$", re.S | re.M)
SOLUTION = re.compile(r"<summary>Solution</summary>\n\n.*?~~~python\n(.*?)~~~", re.DOTALL)
GRADES = ("easy", "medium", "hard")
AT_LEAST = 4


def met(notebook):
    """Yield (chapter, name, text before, stub, solution) of each exercise with a checker."""
    cells = nbformat.read(notebook, as_version=4).cells
    for before, cell, after in zip(cells, cells[1:], cells[2:], strict=False):
        if "exercise" in cell.metadata.get("tags", []):
            ((chapter, name, _),) = CHECK.findall(cell.source)
            found = SOLUTION.search(after.source)
            assert found, f"{chapter}.{name}: no solution folds out below it"
            yield chapter, name, before.source, CHECK.sub("", cell.source), found[1]


def answer(code, name):
    """Run an answer as it stands, with NumPy as the chapters have it, and return what it defines."""
    space = {"np": np}
    exec(compile(code, name, "exec"), space)
    return space[name]


def wrong_answers(chapter):
    path = ROOT / "tests" / "wrong_answers" / f"chapter_{chapter}.py"
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.WRONG


EXERCISES = [exercise for notebook in NOTEBOOKS for exercise in met(notebook)]
each = pytest.mark.parametrize("exercise", EXERCISES, ids=lambda exercise: f"{exercise[0]}.{exercise[1]}")


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_chapter_has_exercises_of_every_grade_and_all_its_checks_are_used(notebook):
    here = list(met(notebook))
    assert len(here) >= AT_LEAST
    text = " ".join(before for _, _, before, _, _ in here)
    assert all(f"({grade})" in text for grade in GRADES)
    assert sorted(f"{chapter}.{name}" for chapter, name, *_ in here) == sorted(exercises.known(here[0][0]))
    assert notebook.name.startswith(here[0][0])


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_solutions_and_answers_are_closed_until_clicked_in_the_book_and_in_jupyterlab(notebook):
    cells = [cell.source for cell in nbformat.read(notebook, as_version=4).cells if cell.cell_type == "markdown"]
    hidden = [found for source in cells for found in HIDDEN.findall(source)]
    text = "\n".join(cells)
    assert len(hidden) == text.count("<details") == text.count("</details>")
    assert not re.search(r"\bSolution\b|\{dropdown\}", HIDDEN.sub("", text))


@each
def test_the_solution_passes(exercise):
    chapter, name, _, _, solution = exercise
    verdict = exercises.check(f"{chapter}.{name}", answer(solution, name))
    assert verdict.passed, verdict


@each
def test_the_stub_is_told_to_be_filled(exercise):
    chapter, name, _, stub, _ = exercise
    assert "..." in stub
    assert exercises.check(f"{chapter}.{name}", answer(stub, name)).hint == exercises.EMPTY


@each
def test_known_mistakes_get_the_promised_hint(exercise):
    chapter, name = exercise[:2]
    known = wrong_answers(chapter)[name]
    assert len(known) >= 2
    for code, promised in known:
        hint = exercises.check(f"{chapter}.{name}", answer(code, name)).hint
        assert promised in hint, f"{code}\n-> {hint!r}"


def test_an_error_in_an_answer_is_a_hint_and_an_unknown_exercise_is_named():
    def broken(*_):
        raise KeyError("joint")

    assert "KeyError: 'joint'" in exercises.check("02.lacking", broken).hint
    assert "array of numbers" in exercises.check("02.pooled_std", lambda *_: ["a"] * 6).hint
    with pytest.raises(ValueError, match=r"'02.nothing'.*02.lacking"):
        exercises.check("02.nothing", 1)


def test_a_verdict_reads_as_a_line():
    assert "right" in repr(exercises.Verdict("lacking", ""))
    assert "not yet. Look." in repr(exercises.Verdict("lacking", "Look."))
