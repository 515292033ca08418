"""The zip of a release holds what a chapter needs, and its library works where no checkout is."""

import json
import os
import subprocess
import sys
from pathlib import Path
from zipfile import ZipFile

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


def install(wheel: Path, target: Path) -> None:
    """What the environment has: pip, or uv where it was made without pip."""
    command = [sys.executable, "-m", "pip"]
    if subprocess.run([*command, "--version"], capture_output=True).returncode:
        command = [str(Path(sys.executable).with_name("uv")), "pip"]
    subprocess.run([*command, "install", "--no-deps", "--target", str(target), str(wheel)], check=True)


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


def test_the_imports_of_a_chapter_work_from_the_wheel(unpacked, tmp_path):
    """In a folder of its own and without PYTHONPATH: nothing of the checkout may help."""
    (wheel,) = unpacked.glob("*.whl")
    install(wheel, tmp_path / "installed")
    cells = json.loads((unpacked / "notebooks" / "02_partitioning.ipynb").read_text())["cells"]
    code = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"][:2]  # parameters, imports
    last = "import fedvla_lib\nfrom fedvla_lib.model import nano_base\nprint(nano_base())\nprint(fedvla_lib.__file__)"
    # The environment may hold the checkout as an editable install; what is put first is what is found.
    first = f"import sys; sys.path.insert(0, {str(tmp_path / 'installed')!r})"
    (tmp_path / "empty").mkdir()
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    command = [sys.executable, "-c", "\n".join([first, *code, last])]
    done = subprocess.run(command, cwd=tmp_path / "empty", env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert all(Path(line).is_relative_to(tmp_path / "installed") for line in done.stdout.splitlines()[-2:])


def test_the_wheel_holds_the_model_that_labs_start_from(unpacked):
    (wheel,) = unpacked.glob("*.whl")
    files = [path for path in (ROOT / "fedvla_lib" / "nano_base").rglob("*") if path.is_file()]
    wanted = {path.relative_to(ROOT).as_posix() for path in files}
    assert wanted and wanted <= set(ZipFile(wheel).namelist())
