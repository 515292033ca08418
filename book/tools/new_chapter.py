"""Make a chapter from the template: notebook, exercise checks and wrong answers, and list it in the book.

python book/tools/new_chapter.py 12_force
"""

import argparse
import re
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
NAME = re.compile(r"(\d\d)_([a-z][a-z0-9_]*)")
TEMPLATE = {
    "notebooks/{name}.ipynb": "chapter.ipynb",
    "book/fedvla_book/exercises/chapter_{number}.py": "checks.py",
    "tests/wrong_answers/chapter_{number}.py": "wrong_answers.py",
}


def make(root: Path, name: str) -> list[Path]:
    """Write the files of chapter `name` under `root` and return them.

    Raises:
        ValueError: the name is not of the form 12_force, or its number is taken.
    """
    match = NAME.fullmatch(name)
    if not match:
        raise ValueError(f"{name!r} is not a chapter name: give two digits and words, such as 12_force")
    number, words = match.groups()
    taken = sorted(path.name for path in (root / "notebooks").glob(f"{number}_*.ipynb"))
    if taken:
        raise ValueError(f"number {number} is taken by {taken[0]}: choose another")
    title = words.replace("_", " ").capitalize()
    replacements = {"CHAPTER_NAME": name, "CHAPTER": name.replace("_", "-"), "TITLE": title, "NN.": f"{number}."}
    written = []
    for place, source in TEMPLATE.items():
        text = (ROOT / "book" / "template" / source).read_text(encoding="utf-8")
        for old, new in replacements.items():
            text = text.replace(old, new)
        path = root / place.format(name=name, number=number)
        path.write_text(text, encoding="utf-8")
        written.append(path)
    _list(root / "_toc.yml", name)
    _announce(root / "book" / "index.md", name)
    return written


def _list(contents: Path, name: str) -> None:
    """Add the chapter after the last one of the table of contents."""
    lines = contents.read_text(encoding="utf-8").splitlines(keepends=True)
    last = max(place for place, line in enumerate(lines) if "file: notebooks/" in line)
    indent = lines[last][: lines[last].index("-")]
    lines.insert(last + 1, f"{indent}- file: notebooks/{name}\n")
    contents.write_text("".join(lines), encoding="utf-8")


def _announce(front_page: Path, name: str) -> None:
    """Add the chapter, with a placeholder sentence, after the last one of the front page."""
    before, last, after = front_page.read_text(encoding="utf-8").rpartition("{doc}`/notebooks/")
    told, end, rest = after.partition("\n\n")
    added = f"{last}{name}`\n: Say in one sentence what the reader builds here."
    front_page.write_text(f"{before}{last}{told}{end}{added}{end}{rest}", encoding="utf-8")


def main() -> int:
    """Make the chapter and print the written files."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("name", help="two digits and words, such as 12_force")
    try:
        written = make(ROOT, parser.parse_args().name)
    except ValueError as error:
        print(f"new_chapter: {error}", file=sys.stderr)
        return 2
    print("\n".join(str(path.relative_to(ROOT)) for path in written))
    return 0


if __name__ == "__main__":
    sys.exit(main())
