"""The chapters as files: no outputs, one parameters cell, parameters that papermill can reach."""

import re
from pathlib import Path

import nbformat
import papermill
import pytest

import execution

pytestmark = pytest.mark.unit
ROOT = Path(__file__).parent.parent
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
EXERCISES_OF = re.compile(r"\(exercises? [^)]*\)")
each_chapter = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


def cells(path: Path, kind: str = "code") -> list[nbformat.NotebookNode]:
    return [cell for cell in nbformat.read(path, as_version=4).cells if cell.cell_type == kind]


def told_on(front_page: str) -> list[str]:
    """The chapters that the front page lists, each at the margin with its sentence below."""
    return re.findall(r"^\{doc\}`/notebooks/(\w+)`\n: ", front_page, flags=re.MULTILINE)


def has_tag(tag):
    return lambda cell: cell.cell_type == "code" and tag in cell.metadata.get("tags", [])


def says(words):
    return lambda cell: cell.cell_type == "markdown" and words in cell.source


# What every chapter has, in the order in which a reader meets it.
PARTS = {
    "title": lambda cell: cell.cell_type == "markdown" and cell.source.startswith("# "),
    "hero figure or video": has_tag("hero"),
    "box with measured costs": has_tag("cost"),
    "goals": says("**Goals**"),
    "prerequisites": says("**You need**"),
    "parameters": has_tag("parameters"),
    "a section": says("## "),
    "the checklist": says("## Checklist"),
    "its ticks": lambda cell: cell.cell_type == "code" and "checklist(\n" in cell.source,
    "exercises": says("## Exercises"),
    "quiz": says("## Quiz"),
    "take-aways": says("## Take-aways"),
    "further reading": says("## Further reading"),
    "the cost of this run": lambda cell: cell.cell_type == "code" and "cost.spent(" in cell.source,
}
# What every chapter has somewhere in its sections.
INSIDE = {
    "a prediction": says("**Predict before you run**"),
    "a failure made on purpose": has_tag("failure"),
    "a reference result": has_tag("reference"),
}


def test_the_contents_list_every_chapter_and_no_other():
    listed = [page for page in execution.toc_pages(ROOT) if page.startswith("notebooks/")]
    assert listed == [f"notebooks/{path.stem}" for path in NOTEBOOKS]


def test_the_front_page_tells_of_every_chapter_and_no_other():
    assert told_on((ROOT / "book" / "index.md").read_text()) == [path.stem for path in NOTEBOOKS]


@each_chapter
def test_no_outputs_are_committed(path):
    assert not [cell for cell in cells(path) if cell.outputs or cell.execution_count]


@each_chapter
def test_kernel_is_the_one_papermill_and_nbmake_look_for(path):
    kernel = nbformat.read(path, as_version=4).metadata.kernelspec
    assert (kernel.name, kernel.language) == ("python3", "python")


@each_chapter
def test_one_parameters_cell_with_the_profile(path):
    tagged = [cell for cell in cells(path) if "parameters" in cell.metadata.get("tags", [])]
    assert len(tagged) == 1
    assert "profile" in papermill.inspect_notebook(str(path))


@each_chapter
def test_the_profile_follows_the_environment(path):
    (tagged,) = [cell for cell in cells(path) if "parameters" in cell.metadata.get("tags", [])]
    assert "FEDVLA_PROFILE" in tagged.source or "profile = None" in tagged.source


@each_chapter
def test_every_parameter_is_used_below_its_cell(path):
    code = cells(path)
    place = next(i for i, cell in enumerate(code) if "parameters" in cell.metadata.get("tags", []))
    below = "\n".join(cell.source for cell in code[place + 1 :])
    unused = [name for name in papermill.inspect_notebook(str(path)) if not re.search(rf"\b{name}\b", below)]
    assert not unused


@each_chapter
def test_a_title_first_and_one_only(path):
    text = [cell.source for cell in cells(path, "markdown")]
    assert text[0].startswith("# ")
    assert sum(len(re.findall(r"^# ", source, flags=re.MULTILINE)) for source in text) == 1


@each_chapter
def test_no_cell_may_fail(path):
    assert not [cell for cell in cells(path) if "raises-exception" in cell.metadata.get("tags", [])]


@each_chapter
def test_the_parts_of_a_chapter_stand_in_their_order(path):
    everything = nbformat.read(path, as_version=4).cells
    places = {name: [i for i, cell in enumerate(everything) if fits(cell)] for name, fits in PARTS.items()}
    assert not [name for name, found in places.items() if not found]
    first = [found[0] for name, found in places.items() if name != "the cost of this run"]
    assert first == sorted(first), dict(zip(places, first, strict=False))
    assert places["the cost of this run"] == [len(everything) - 1]
    sections = everything[places["a section"][0] : places["the checklist"][0]]
    assert not [name for name, fits in INSIDE.items() if not any(map(fits, sections))]


@each_chapter
def test_the_hero_is_described_and_needs_no_run(path):
    (hero,) = filter(PARTS["hero figure or video"], cells(path))
    look = hero.metadata.get("mystnb", {})
    drawn = bool(look.get("figure", {}).get("caption")) and len(look.get("image", {}).get("alt", "")) > 40
    assert drawn != ("video_figure(" in hero.source)  # whose sentence describes it
    assert "methods." not in hero.source and "load_policy" not in hero.source  # nothing that trains or loads for long


@each_chapter
def test_the_box_is_about_this_chapter(path):
    (box,) = filter(PARTS["box with measured costs"], cells(path))
    assert f'cost.measured("{path.stem}")' in box.source


@each_chapter
def test_every_goal_names_exercises_and_every_exercise_serves_a_goal(path):
    (text,) = [cell.source for cell in cells(path, "markdown") if "**Goals**" in cell.source]
    goals = re.findall(r"^- (.+)$", text.split("**You need**")[0], flags=re.MULTILINE)
    named = [{int(number) for number in re.findall(r"\d+", "".join(EXERCISES_OF.findall(goal)))} for goal in goals]
    assert goals and all(named), goals
    assert set.union(*named) == set(range(1, 1 + len([*filter(has_tag("exercise"), cells(path))])))


@each_chapter
def test_a_failure_and_a_reference_are_read_below(path):
    everything = nbformat.read(path, as_version=4).cells
    for place, cell in enumerate(everything):
        if has_tag("failure")(cell):
            assert any(later.cell_type == "markdown" for later in everything[place + 1 : place + 4]), cell.id
        if has_tag("reference")(cell):
            near = "\n".join(one.source for one in everything[max(0, place - 2) : place + 3])
            assert "../book/reference/" in "\n".join(one.source for one in cells(path)), cell.id
            assert re.search(r"interval|low", near), f"{cell.id}: no interval near the reference result"


@each_chapter
def test_every_quiz_question_has_options_and_an_answer_that_explains(path):
    (quiz,) = [cell.source for cell in cells(path, "markdown") if "## Quiz" in cell.source]
    quiz = quiz.split("## Take-aways")[0]
    asked = re.split(r"^\*\*(?=.*\*\*$)", quiz, flags=re.MULTILINE)[1:]
    assert asked
    for one in asked:
        options = re.findall(r"^- \(?([a-dA-D])[.)]", one, flags=re.MULTILINE)
        (answer,) = re.findall(r"<summary>Answer</summary>\n\n(.+?)\n\n</details>", one, flags=re.DOTALL)
        right = re.match(r"\W*([a-dA-D])\b", answer)
        assert len(options) >= 3 and right and right[1] in options, one
        assert len(answer.split()) > 20, f"an answer that does not explain: {answer}"


@each_chapter
def test_further_reading_cites(path):
    (text,) = [cell.source for cell in cells(path, "markdown") if "## Further reading" in cell.source]
    assert "{cite" in text.split("## Further reading")[1]
