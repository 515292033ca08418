"""The zip of a release holds what a chapter needs, and its library works where no checkout is."""

from pathlib import Path
from zipfile import ZipFile

import check_zip
import make_zip
import pytest

pytestmark = pytest.mark.integration
ROOT = Path(__file__).parents[1]


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
    assert wheel.name in text and "requirements.lock" in text and (unpacked / "requirements.lock").is_file()


def test_a_chapter_runs_from_the_zip_and_the_wheel(tmp_path):
    """In an empty folder and a new environment; `make check-zip` does it with every chapter."""
    assert list(check_zip.check(tmp_path, only="02_partitioning")) == ["02_partitioning"]


def test_the_wheel_holds_the_model_that_labs_start_from(unpacked):
    (wheel,) = unpacked.glob("*.whl")
    files = [path for path in (ROOT / "fedvla_lib" / "nano_base").rglob("*") if path.is_file()]
    wanted = {path.relative_to(ROOT).as_posix() for path in files}
    assert wanted and wanted <= set(ZipFile(wheel).namelist())
