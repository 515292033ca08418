"""Prose that can be trusted: no acronym without its meaning, and no number with a unit typed where a cell computes it.

Rates and points are looked for in `test_reference`, citations in `test_repo`, spelling by codespell in `make lint`.
"""

import json
import re
from pathlib import Path

import pytest

pytestmark = pytest.mark.unit
ROOT = Path(__file__).parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
PAGES = sorted((ROOT / "book").glob("*.md"))
NO_PROSE = (r"```.*?```", r"~~~.*?~~~", r"`[^`]*`", r"\$\$.*?\$\$", r"\$[^$]*\$", r"<[^>]*>", r"^:\w+:.*$")
ACRONYM = re.compile(r"\b[A-Z]{2,}[0-9]*\b|\b(?:[A-Z][a-z]?){2,}\b")
NO_ACRONYMS = {"MB", "GB", "MuJoCo", "CUDA", "EGL", "WSL"}  # units, and names of programs
NO_ACRONYMS |= {"SO", "ARM100"}  # SO-100 and SO-ARM100, two arms
UNIT = r"(?:MB|GB|kB|bytes|ms|s|seconds?|minutes?|hours?|million|cm|mm|degrees)"
MEASURE = re.compile(rf"(?<![\w.,])\d[\d,.]*\s?{UNIT}\b")
# What may be typed, and why: nothing of it comes out of a run of the book.
TYPED = {
    "450 million": "the published size of SmolVLA",
    "100 million": "of which so many train, as published",
    "399.5 MB": "four bytes times a number of parameters that stands before it",
    "80 GB": "two hundred times the number before it",
    "1,800 MB": "four bytes times 450 million, in a question",
    "200 MB": "the budget that an exercise gives",
    "0.1 degrees": "an example that an exercise makes up",
}


def prose(text):
    for pattern in NO_PROSE:
        text = re.sub(pattern, " ", text, flags=re.DOTALL | re.MULTILINE)
    return text


def of_chapter(path):
    """What a chapter says: its text, and what its figures' captions and descriptions say."""
    for cell in json.loads(path.read_text())["cells"]:
        if cell["cell_type"] == "markdown":
            yield "".join(cell["source"])
        look = cell["metadata"].get("mystnb", {})
        yield look.get("figure", {}).get("caption", "")
        yield look.get("image", {}).get("alt", "")


def in_glossary():
    """Terms of the glossary: the lines at its margin that an explanation follows, or another term."""
    inside = (ROOT / "book" / "glossary.md").read_text().split("```{glossary}")[1].split("```")[0]
    return {word for line in inside.splitlines() if not line.startswith(" ") for word in re.split(r"[\s-]", line)}


def glossary_terms():
    return re.findall(r"^(\S.*)\n(?:\S.*\n)*  ", (ROOT / "book" / "glossary.md").read_text(), flags=re.MULTILINE)


def used_before_defined(terms, texts):
    """Terms whose first use in texts, read in order, is neither a link to the glossary nor bold, as in a definition."""
    text = "\n".join(re.sub(r"^#.*$", "", text, flags=re.MULTILINE) for text in texts)
    text = prose(re.sub(r"\{term\}`(?:[^`<]*<)?([^`<>]*)>?`", r"**\1**", text)).lower()
    for term in terms:
        first = re.search(rf"(?<![\w-]){re.escape(term.lower())}(?:s|es)?(?!\w)", text)
        if first and text[first.start() - 2 : first.start()] != "**":
            yield f"{term}: {text[first.start() - 40 : first.end() + 40]}"


def unexplained(text, known):
    """Acronyms of a text that are neither known nor written out where they come first."""
    written_out = set(re.findall(r"\w+ \(([A-Z][A-Za-z0-9]+)\)", text))
    return set(ACRONYM.findall(text)) - known - written_out


@pytest.mark.parametrize("path", [*PAGES, *NOTEBOOKS], ids=lambda path: path.stem)
def test_every_acronym_is_in_the_glossary_or_written_out(path):
    text = "\n".join(of_chapter(path)) if path.suffix == ".ipynb" else path.read_text()
    assert not unexplained(prose(text), in_glossary() | NO_ACRONYMS)


def test_an_acronym_without_a_meaning_would_be_noticed():
    assert unexplained("An MLP and a PID controller, and radial basis functions (RBF). RBF.", {"MLP"}) == {"PID"}
    assert {"TLS", "VLA", "SCAFFOLD"} <= in_glossary()


def test_a_term_of_the_glossary_is_linked_or_explained_where_a_chapter_uses_it_first():
    found = used_before_defined(glossary_terms(), (text for path in NOTEBOOKS for text in of_chapter(path)))
    assert not list(found)


def test_a_term_used_before_it_is_explained_would_be_noticed():
    text = "## Rounds\n\nA {term}`client <client>` has a server, and **rounds** of {term}`local steps <local step>`."
    (found,) = used_before_defined(["client", "round", "server", "local step"], [text])
    assert found.startswith("server: ")
    assert {"client", "round", "held-out", "Holm's method"} <= set(glossary_terms())


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_no_chapter_types_a_measure_that_a_cell_could_compute(path):
    found = [measure for text in of_chapter(path) for measure in MEASURE.findall(prose(text))]
    assert not [measure for measure in found if measure not in TYPED]


def test_what_may_be_typed_is_typed_somewhere_and_a_measure_would_be_noticed():
    text = prose("\n".join(text for path in NOTEBOOKS for text in of_chapter(path)))
    assert set(TYPED) <= set(MEASURE.findall(text))
    assert MEASURE.findall(prose("It took 12.5 s and 3 MB, round 7 of 9, and `4 s` in code.")) == ["12.5 s", "3 MB"]
