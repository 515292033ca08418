"""The zip of a release holds what a chapter needs, and its library works where no checkout is."""

import shutil
from pathlib import Path
from zipfile import ZipFile

import nbformat
import pytest
from nbformat.v4 import new_code_cell, new_notebook

import check_zip
import make_zip

pytestmark = pytest.mark.integration
ROOT = Path(__file__).parents[1]
KERNEL = {"name": "python3", "display_name": "Python 3", "language": "python"}
SEES_THE_SOURCE = f"import sys\nsys.path.insert(0, {str(ROOT)!r})"


@pytest.fixture(scope="module")
def unpacked(tmp_path_factory) -> Path:
    """The folder that unpacking the zip makes."""
    folder = tmp_path_factory.mktemp("zip")
    with ZipFile(make_zip.make(ROOT, folder / "fedvla-book.zip")) as book:
        book.extractall(folder)
    return folder / "fedvla-book"


def test_chapters_and_stored_results_lie_as_in_the_checkout(unpacked):
    for folder, ending in (("notebooks", "*.ipynb"), ("book/reference", "*")):
        wanted = {path.relative_to(ROOT) for path in (ROOT / folder).rglob(ending) if path.is_file()}
        assert wanted and {path for path in wanted if not (unpacked / path).is_file()} == set()
    texts = "".join(path.read_text() for path in (unpacked / "notebooks").glob("*.ipynb"))
    assert "../book/reference" in texts


def test_its_readme_names_what_is_there(unpacked):
    text = (unpacked / "README.txt").read_text()
    (wheel,) = unpacked.glob("*.whl")
    assert f"{wheel.name} plugins/*.whl" in text and len([*unpacked.glob("plugins/lerobot_*.whl")]) == 3
    assert "requirements.lock" in text and (unpacked / "requirements.lock").is_file()


def test_chapters_run_from_the_wheel_and_one_that_does_not_fails(unpacked, tmp_path, capfd):
    """In an empty folder and a new environment; `make test` does it with some chapters."""
    book = shutil.copytree(unpacked, tmp_path / "book", ignore=shutil.ignore_patterns("*.ipynb"))
    python, codes = check_zip.new_environment(book), {"wheel": "import fedvla_lib", "source": SEES_THE_SOURCE}
    for name, code in codes.items():
        (chapter := new_notebook(cells=[new_code_cell(code)])).metadata["kernelspec"] = KERNEL
        nbformat.write(chapter, book / "notebooks" / f"{name}.ipynb")
    paths = [book / "notebooks" / f"{name}.ipynb" for name in codes]
    assert check_zip.execute(paths, python) == 1
    said = capfd.readouterr().out
    assert "1 failed, 1 passed" in said and f"{ROOT / 'fedvla_lib' / '__init__.py'}, run by " in said


def test_the_wheel_holds_the_model_that_labs_start_from(unpacked):
    (wheel,) = unpacked.glob("*.whl")
    files = [path for path in (ROOT / "fedvla_lib" / "nano_base").rglob("*") if path.is_file()]
    wanted = {path.relative_to(ROOT).as_posix() for path in files}
    held = set(ZipFile(wheel).namelist())
    assert wanted and wanted <= held
    assert {"fedvla_lib/engines/connections.toml", "fedvla_lib/federation/strategies/scaffold.py"} <= held
    assert {"fedvla_book/plots/clients.py", "fedvla_book/exercises/chapter_01.py"} <= held
