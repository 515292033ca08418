"""Execute chapters as their readers do who took the zip: unpacked in an empty folder, from the library's wheel.

    python book/check_zip.py            every chapter, at the profile tiny
    python book/check_zip.py --only 02

The environment is a new one that sees the packages of this one, but not the source of the library. Recordings in the
cache are used again.
"""

import argparse
import os
import subprocess
import sys
import sysconfig
import tempfile
import time
from importlib.metadata import entry_points
from pathlib import Path
from zipfile import ZipFile

import make_zip
import nbformat

WHERE = "import fedvla_lib\n\nprint(fedvla_lib.__file__)"
PROGRAM = "#!{python}\nimport sys\n\nfrom {module} import {attribute}\n\nsys.exit({attribute}())\n"


def unpack(book: Path, folder: Path) -> Path:
    """Unpack the zip and return the folder that it makes."""
    with ZipFile(book) as packed:
        packed.extractall(folder)
    return folder / book.stem


def new_environment(book: Path) -> Path:
    """Make an environment in an unpacked book and return its Python: the wheel, and the packages that are here.

    A .pth file in the folder of packages that it points to is not read, so an editable install is not followed.
    """
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(book / ".venv")], check=True)
    python = book / ".venv" / "bin" / "python"
    (packages,) = (book / ".venv").glob("lib/python*/site-packages")
    (wheel,) = book.glob("*.whl")
    with ZipFile(wheel) as library:
        library.extractall(packages)
    (packages / "others.pth").write_text(sysconfig.get_path("purelib") + "\n")
    for program in entry_points(group="console_scripts"):
        if program.module.split(".")[0] in ("flwr", "fedvla_lib"):  # what chapters start
            text = PROGRAM.format(python=python, module=program.module, attribute=program.attr)
            (python.parent / program.name).write_text(text)
            (python.parent / program.name).chmod(0o755)
    return python


def execute(notebook: Path, python: Path) -> float:
    """Execute a chapter at the profile tiny in its own folder and return the seconds it took.

    Raises:
        ValueError: a cell failed, or the library did not come from the new environment.
    """
    content, began = nbformat.read(notebook, as_version=4), time.monotonic()
    content.cells.append(nbformat.v4.new_code_cell(WHERE))
    nbformat.write(content, notebook)
    outside = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")}
    environment = outside | {"FEDVLA_PROFILE": "tiny", "PATH": f"{python.parent}{os.pathsep}{outside['PATH']}"}
    done = notebook.with_name(f"{notebook.stem}.done.ipynb")
    command = [python, "-m", "papermill", "--kernel", "python3", "--no-progress-bar", notebook.name, done.name]
    ran = subprocess.run(command, cwd=notebook.parent, env=environment, capture_output=True, text=True, check=False)
    if ran.returncode:
        raise ValueError(f"{notebook.stem} from the zip: {' '.join(ran.stderr.split())[-600:]}")
    file = Path(nbformat.read(done, as_version=4).cells[-1].outputs[0].text.strip())
    if not file.is_relative_to(python.parents[1]):
        raise ValueError(f"{notebook.stem} did not use the library of the zip but {file}")
    return time.monotonic() - began


def check(folder: Path, only: str = "") -> dict[str, float]:
    """Execute the chapters whose name contains `only` in an empty folder; return the seconds of each."""
    book = unpack(make_zip.make(make_zip.ROOT, folder / "fedvla-book.zip"), folder)
    notebooks = [path for path in sorted((book / "notebooks").glob("*.ipynb")) if only in path.stem]
    if not notebooks:
        raise ValueError(f"no chapter of the zip has {only!r} in its name")
    python, seconds = new_environment(book), {}
    for notebook in notebooks:
        seconds[notebook.stem] = execute(notebook, python)
        print(f"{notebook.stem}: {seconds[notebook.stem]:.0f} s", flush=True)
    return seconds


def main() -> int:
    """Check the zip and say what each chapter took."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", default="", metavar="TEXT", help="the chapters whose name contains TEXT")
    try:
        with tempfile.TemporaryDirectory(prefix="fedvla-check-") as folder:
            check(Path(folder), parser.parse_args().only)
    except (ValueError, OSError) as error:
        print(f"check_zip: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
