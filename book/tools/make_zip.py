"""Pack notebooks, stored results and the library into a zip, for readers without git.

    python book/tools/make_zip.py

The wheel is built with setuptools from this environment; nothing is downloaded.
"""

import shutil
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path
from zipfile import ZIP_DEFLATED, ZipFile

from fedvla_lib.files import new_file

ROOT = Path(__file__).resolve().parents[2]
TARGET = "_build/fedvla-book.zip"
# Same layout as the checkout: chapters read ../book/reference.
PACKED = ["notebooks/*.ipynb", "book/reference/**/*", "requirements.lock", "LICENSE"]
BUILD = "import sys; from setuptools import build_meta; build_meta.build_wheel(sys.argv[1])"
# --no-deps: the lock lacks only what `override-dependencies` in pyproject.toml leaves out, which pip would miss.
README = """{title}

The notebooks of the book, the stored results that they read, and the packages that they import. Needs Python {python}.

Install, in this folder:

    python3 -m venv .venv
    .venv/bin/python -m pip install --no-deps --require-hashes -r requirements.lock
    .venv/bin/python -m pip install --no-deps {wheel} plugins/*.whl

Check the machine, record the demonstrations (minutes), and start with chapter 1:

    .venv/bin/fedvla doctor
    .venv/bin/fedvla record
    .venv/bin/jupyter lab notebooks
"""


def build_wheel(root: Path, folder: Path) -> Path:
    """Build the library's wheel into `folder`, from a copy, since setuptools writes build folders next to the source.

    Raises:
        ValueError: the build failed; the message ends with setuptools' output.
    """
    with tempfile.TemporaryDirectory(prefix="fedvla-wheel-") as name:
        source = Path(name)
        for package in ("fedvla_lib", "book/fedvla_book"):
            shutil.copytree(root / package, source / package, ignore=shutil.ignore_patterns("__pycache__"))
        for file in ("pyproject.toml", "README.md", "LICENSE"):
            shutil.copy(root / file, source)
        return _build(source, folder)


def build_plugins(root: Path, folder: Path) -> list[Path]:
    """Build the wheels by which LeRobot finds the simulated arm into `folder`; raise ValueError as `build_wheel`."""
    wheels = []
    for plugin in sorted((root / "plugins").iterdir()):
        with tempfile.TemporaryDirectory(prefix="fedvla-wheel-") as source:
            copied = shutil.copytree(plugin, source, ignore=shutil.ignore_patterns("*.egg-info"), dirs_exist_ok=True)
            wheels.append(_build(copied, folder))
    return wheels


def _build(source: Path, folder: Path) -> Path:
    before = set(folder.glob("*.whl"))
    command = [sys.executable, "-c", BUILD, str(folder.resolve())]
    done = subprocess.run(command, cwd=source, capture_output=True, text=True, check=False)
    if done.returncode:
        raise ValueError(f"the wheel was not built: {' '.join(done.stderr.split())[-400:]}")
    (wheel,) = set(folder.glob("*.whl")) - before
    return wheel


def make(root: Path, target: Path) -> Path:
    """Write the zip and return it; its contents are in one folder of the same name."""
    temporary = tempfile.TemporaryDirectory(prefix="fedvla-zip-")
    with temporary as folder, new_file(target) as draft, ZipFile(draft, "w", ZIP_DEFLATED) as book:
        wheel = build_wheel(root, Path(folder))
        book.write(wheel, f"{target.stem}/{wheel.name}")
        for plugin in build_plugins(root, Path(folder)):
            book.write(plugin, f"{target.stem}/plugins/{plugin.name}")
        for path in _packed(root):
            book.write(path, f"{target.stem}/{path.relative_to(root).as_posix()}")
        book.writestr(f"{target.stem}/README.txt", _readme(root, wheel.name))
    return target


def _packed(root: Path) -> list[Path]:
    found = {path for pattern in PACKED for path in root.glob(pattern) if path.is_file()}
    return sorted(path for path in found if not path.name.startswith(".") and "__pycache__" not in path.parts)


def _readme(root: Path, wheel: str) -> str:
    project = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return README.format(title=project["description"], python=project["requires-python"], wheel=wheel)


def main() -> int:
    """Make the zip and print its path."""
    try:
        target = make(ROOT, ROOT / TARGET)
    except (ValueError, OSError) as error:
        print(f"make_zip: {error}", file=sys.stderr)
        return 2
    print(f"{target} ({target.stat().st_size / 1e6:.1f} MB)")
    return 0


if __name__ == "__main__":
    sys.exit(main())
