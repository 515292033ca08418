"""Copy the chapters for Google Colab: each copy has a first cell that gets the book and installs its library.

    python3 book/tools/colab.py --zip https://OWNER.github.io/REPOSITORY/fedvla-book.zip FOLDER

The chapters themselves stay without that cell, since nobody needs it anywhere else. Needs no package, so that a job can
run it before anything is installed.
"""

import argparse
import json
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
SYSTEM_PACKAGES = "binder/apt.txt"
CELL_ID = "colab"
# The lock's versions go to pip without their hashes, which it would also demand for the local wheel. They differ from
# what Colab has imported already, hence the new kernel.
SETUP = r"""# On Google Colab, gets the book and installs its library, which takes a few
# minutes and ends with a new kernel. Anywhere else, this cell does nothing.
try:
    import google.colab as colab
except ImportError:
    colab = None

if colab:
    import os
    import re
    import subprocess
    import sys
    import time
    from importlib.util import find_spec
    from pathlib import Path
    from urllib.request import urlretrieve
    from zipfile import ZipFile

    book = "{zip}"
    drawing = "{packages}"
    if not Path("../book/reference").is_dir():
        if not Path("fedvla-book").is_dir():
            ZipFile(urlretrieve(book)[0]).extractall()
        os.chdir("fedvla-book/notebooks")
    if find_spec("fedvla_lib") is None:
        lock = Path("../requirements.lock").read_text()
        pins = re.findall(r"^[a-z0-9].*?==[^\\\n]+", lock, re.MULTILINE)
        Path("../pins.txt").write_text("\n".join(pins))
        wheel = next(Path("..").glob("*.whl"))
        apt = ["apt-get", "-qq", "-y"]
        subprocess.run([*apt, "update"], check=True)
        subprocess.run([*apt, "install", *drawing.split()], check=True)
        pip = [sys.executable, "-m", "pip", "install", "--quiet"]
        subprocess.run([*pip, "-c", "../pins.txt", str(wheel)], check=True)
        print("Installed. Colab starts a new kernel: run all cells again.")
        time.sleep(2)
        os.kill(os.getpid(), 9)
"""


def setup(address: str, root: Path = ROOT) -> str:
    """Return the source of the first cell.

    Args:
        address: where the zip of `make zip` can be fetched.
    """
    packages = (root / SYSTEM_PACKAGES).read_text(encoding="utf-8").split()
    return SETUP.format(zip=address, packages=" ".join(packages))


def with_setup(notebook: dict, source: str) -> dict:
    """Return a copy of a notebook whose first code cell, below the title, is `source`; one from before is replaced."""
    cells = [cell for cell in notebook["cells"] if cell.get("id") != CELL_ID]
    first = next(place for place, cell in enumerate(cells) if cell["cell_type"] == "code")
    cell = {
        "cell_type": "code",
        "execution_count": None,
        "id": CELL_ID,
        "metadata": {"tags": ["remove-cell"]},
        "outputs": [],
        "source": source.splitlines(keepends=True),
    }
    return {**notebook, "cells": [*cells[:first], cell, *cells[first:]]}


def copy_chapters(root: Path, folder: Path, address: str) -> list[Path]:
    """Write the copies to `folder`/notebooks, where the book's button for Colab expects them, and return them."""
    source, written = setup(address, root), []
    (folder / "notebooks").mkdir(parents=True, exist_ok=True)
    for path in sorted((root / "notebooks").glob("*.ipynb")):
        copy = with_setup(json.loads(path.read_text(encoding="utf-8")), source)
        text = json.dumps(copy, indent=1, ensure_ascii=False) + "\n"
        (folder / "notebooks" / path.name).write_text(text, encoding="utf-8")
        written.append(folder / "notebooks" / path.name)
    return written


def main(argv: list[str] | None = None) -> int:
    """Copy the chapters and print how many there are."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="where the folder notebooks is written")
    parser.add_argument("--zip", required=True, metavar="URL", help="where the zip of `make zip` can be fetched")
    options = parser.parse_args(argv)
    try:
        written = copy_chapters(ROOT, options.folder, options.zip)
    except (ValueError, OSError) as error:
        print(f"colab: {error}", file=sys.stderr)
        return 2
    print(f"{len(written)} chapters for Colab in {options.folder}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
