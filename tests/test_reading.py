"""What a reader sees of a chapter: one question, few sections, code about the subject, an hour at most."""

import re
from pathlib import Path

import nbformat
import pytest
from nbformat import v4

from fedvla_book import reading

pytestmark = pytest.mark.unit
ROOT = Path(__file__).parents[1]
CHAPTERS = sorted((ROOT / "notebooks").glob("*.ipynb"))
LINES = 10  # of the subject, in a visible cell
PLUMBING = 0.15  # of all visible lines
MINUTES = 60
each_chapter = pytest.mark.parametrize("path", CHAPTERS, ids=lambda path: path.stem)


def written(folder, *cells):
    path = folder / "chapter.ipynb"
    nbformat.write(v4.new_notebook(cells=list(cells)), path)
    return path


@each_chapter
def test_a_chapter_takes_at_most_an_hour_to_read(path):
    assert reading.minutes(path) <= MINUTES


def test_written_chapters_take_their_time():
    """On average: a chapter just made from the template is short."""
    assert sum(map(reading.minutes, CHAPTERS)) > 5 * len(CHAPTERS)


@each_chapter
def test_a_chapter_has_one_question_and_few_sections(path):
    text = [cell.source for cell in nbformat.read(path, as_version=4).cells if cell.cell_type == "markdown"]
    assert len(re.findall(r"^\*\*The question\*\*: .+\?$", text[0], flags=re.MULTILINE)) == 1
    sections = re.findall(r"^## (.+)$", "\n".join(text), flags=re.MULTILINE)
    assert 3 <= sections.index("Checklist") <= 5, sections


@each_chapter
def test_one_figure_or_table_answers_the_question(path):
    assert sum("answer" in cell.tags for cell in reading.code_cells(path)) == 1


@each_chapter
def test_visible_code_is_short_and_about_the_subject(path):
    visible = [cell for cell in reading.code_cells(path) if cell.visible]
    assert not [(cell.id, cell.subject) for cell in visible if cell.subject > LINES]
    assert not [cell.id for cell in visible if cell.plumbing and not cell.subject and "parameters" not in cell.tags]
    plumbing = sum(cell.plumbing for cell in visible)
    assert plumbing <= PLUMBING * (plumbing + sum(cell.subject for cell in visible))


def test_lines_of_a_cell_are_told_apart(tmp_path):
    code = '''import numpy as np

def double(x):
    """Return twice x.

    At any time."""
    # a comment
    return 2 * x

y = double(np.ones(3))
say("Two words and", f"three more words {y}")
plots.curves(y)
display(Markdown("Once"))
'''
    hidden = v4.new_code_cell("print('one two')", metadata={"tags": ["hide-input"]})
    exercise = v4.new_code_cell("x = 1", metadata={"tags": ["exercise"]})
    shown, behind = reading.code_cells(written(tmp_path, v4.new_code_cell(code), hidden, exercise))
    assert (shown.subject, shown.plumbing, shown.words, shown.visible) == (3, 4, 7, True)
    assert (behind.words, behind.visible) == (2, False)


def test_minutes_are_those_of_words_and_visible_lines(tmp_path):
    text = v4.new_markdown_cell("word " * 400 + "\n<details>\n" + "word " * 4000 + "</details>")
    after = [v4.new_markdown_cell("## Exercises\n\n" + "word " * 4000)]
    lines = v4.new_code_cell("x = 1\n" * 40)
    hidden = v4.new_code_cell("x = 1\n" * 4000, metadata={"tags": ["hide-input"]})
    assert reading.minutes(written(tmp_path, text, lines, hidden, *after)) == 4
