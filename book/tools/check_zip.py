"""Execute chapters as readers of the zip do: unpacked in an empty folder, with the library installed from its wheel.

    python book/tools/check_zip.py              every chapter, with profile tiny
    python book/tools/check_zip.py --only 02 05
    python book/tools/check_zip.py -n 2         other options are passed to pytest: here, two chapters in parallel

A new environment sees this one's packages, but not the source of the library; pytest --nbmake runs in it. Cached
recordings are reused.
"""

import argparse
import os
import shlex
import subprocess
import sys
import sysconfig
import tempfile
from collections.abc import Sequence
from importlib.metadata import entry_points
from pathlib import Path
from zipfile import ZipFile

import nbformat

import make_zip

CELL_TIMEOUT_S = 300
# Appended to each chapter: kernel and library must be those of the new environment.
FROM_THE_WHEEL = """import sys
from pathlib import Path

import fedvla_book
import fedvla_lib

installed = all(Path(one.__file__).is_relative_to(sys.prefix) for one in (fedvla_lib, fedvla_book))
assert installed and sys.prefix == {prefix!r}, f"{{fedvla_lib.__file__}}, run by {{sys.prefix}}"
"""
PROGRAM = "#!{python}\nimport sys\n\nfrom {module} import {attribute}\n\nsys.exit({attribute}())\n"


def unpack(book: Path, folder: Path) -> Path:
    """Unpack the zip and return its folder."""
    with ZipFile(book) as packed:
        packed.extractall(folder)
    return folder / book.stem


def new_environment(book: Path) -> Path:
    """Make an environment with the wheels and this environment's packages in an unpacked book, and return its Python.

    .pth files in the folder that others.pth points to are not read, so an editable install is not followed.
    """
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(book / ".venv")], check=True)
    python = book / ".venv" / "bin" / "python"
    (packages,) = (book / ".venv").glob("lib/python*/site-packages")
    for wheel in book.rglob("*.whl"):
        with ZipFile(wheel) as library:
            library.extractall(packages)
    (packages / "others.pth").write_text(sysconfig.get_path("purelib") + "\n")
    for program in entry_points(group="console_scripts"):
        if program.module.split(".")[0] in ("flwr", "fedvla_lib"):  # programs that chapters start
            text = PROGRAM.format(python=python, module=program.module, attribute=program.attr)
            (python.parent / program.name).write_text(text)
            (python.parent / program.name).chmod(0o755)
    return python


def prepared(folder: Path) -> tuple[Path, Path]:
    """Make and unpack the zip in an empty folder; return the unpacked book and the Python of its environment."""
    book = unpack(make_zip.make(make_zip.ROOT, folder / "fedvla-book.zip"), folder)
    return book, new_environment(book)


def surroundings(python: Path, profile: str = "tiny") -> dict[str, str]:
    """Return the environment variables of a shell with that Python's environment activated.

    Chapters compute on one thread and in one process, so that several can run in parallel.
    """
    outside = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")}
    path = f"{python.parent}{os.pathsep}{outside['PATH']}"
    return {"OMP_NUM_THREADS": "1", "FEDVLA_JOBS": "1"} | outside | {"FEDVLA_PROFILE": profile, "PATH": path}


def execute(notebooks: Sequence[Path], python: Path, options: Sequence[str] = ()) -> int:
    """Execute chapters of an unpacked book with `pytest --nbmake` and return its exit status.

    A chapter also fails if its library is not that of the environment of `python`.
    """
    for notebook in notebooks:
        content = nbformat.read(notebook, as_version=4)
        content.cells.append(nbformat.v4.new_code_cell(FROM_THE_WHEEL.format(prefix=str(python.parents[1]))))
        nbformat.write(content, notebook)
    book = python.parents[2]
    alone = ["-c", os.devnull, "--rootdir", str(book), "-p", "no:cacheprovider"]  # no settings from parent folders
    nbmake = ["--nbmake", "--nbmake-timeout", str(CELL_TIMEOUT_S), "--durations", "0", *options]
    command = [str(python), "-m", "pytest", *alone, *nbmake, *map(str, notebooks)]
    return subprocess.run(command, cwd=book, env=surroundings(python), check=False).returncode


def check(folder: Path, only: Sequence[str] = (), options: Sequence[str] = ()) -> int:
    """Execute the chapters whose name contains one of `only`, or all, in an empty folder; return pytest's exit status.

    Raises:
        ValueError: there is no such chapter, or the demonstrations could not be recorded.
    """
    book, python = prepared(folder)
    every = sorted((book / "notebooks").glob("*.ipynb"))
    notebooks = [path for path in every if not only or any(text in path.stem for text in only)]
    if not notebooks:
        raise ValueError(f"no chapter of the zip has one of {list(only)} in its name")
    notebooks.reverse()  # the last chapters take longest, so start them first
    record = [str(python.parent / "fedvla"), "record", "--profile", "tiny"]  # as the zip's README says
    if subprocess.run(record, cwd=book, env=surroundings(python), check=False).returncode:
        raise ValueError(f"{shlex.join(record[1:])} failed in the unpacked book")
    return execute(notebooks, python, options)


def main(argv: list[str] | None = None) -> int:
    """Check the zip; pytest prints the time of each chapter."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0], allow_abbrev=False)
    parser.add_argument("--only", nargs="+", default=(), metavar="TEXT", help="chapters whose name contains a TEXT")
    known, options = parser.parse_known_args(argv)
    try:
        with tempfile.TemporaryDirectory(prefix="fedvla-check-") as folder:
            return check(Path(folder), known.only, options)
    except (ValueError, OSError) as error:
        print(f"check_zip: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
