"""Data sets in LeRobot's format v2.1, converted by LeRobot into the cache; the original is only read."""

import contextlib
import hashlib
import io
import json
import shutil
import tempfile
from pathlib import Path

from filelock import FileLock

from fedvla_lib.data.lerobot_reader import OLD_FORMAT, DataError, locate
from fedvla_lib.files import cache_dir, new_folder, read_json

PARTS = ("meta", "data", "videos")  # folders of a data set
COMMAND = "python -m lerobot.scripts.convert_dataset_v21_to_v30 --repo-id=local/data --root=COPY --push-to-hub=false"


def find(source: str | Path) -> Path:
    """Return the folder of a data set (`lerobot_reader.locate`), or of its copy in today's format.

    Raises:
        DataError: it cannot be found, or LeRobot cannot convert it.
    """
    root = locate(source)
    if not _is_old(root):
        return root
    folder = cache_dir() / "converted" / fingerprint(root)
    folder.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(folder.with_suffix(".lock")):  # so that concurrent processes convert a data set once
        if not folder.is_dir():
            _convert(root, folder)
    return folder


def fingerprint(root: Path, *settings: object) -> str:
    """Return a hash of a data set's files (name, size, time) and of settings."""
    paths = sorted(path for part in PARTS for path in (root / part).rglob("*") if path.is_file())
    files = [(str(path.relative_to(root)), path.stat().st_size, path.stat().st_mtime_ns) for path in paths]
    return hashlib.sha256(json.dumps([*settings, files]).encode()).hexdigest()[:24]


def _is_old(root: Path) -> bool:
    try:
        return read_json(root / "meta/info.json").get("codebase_version") == OLD_FORMAT
    except (OSError, ValueError):  # the reader says what is wrong
        return False


def _convert(root: Path, folder: Path) -> None:
    """Let LeRobot convert a folder of links, since it renames the folder and writes beside it."""
    from lerobot.scripts.convert_dataset_v21_to_v30 import convert_dataset

    with tempfile.TemporaryDirectory(dir=folder.parent) as scratch, new_folder(folder) as draft:
        links = Path(scratch) / "data"
        links.mkdir()
        for part in PARTS:
            if (root / part).is_dir():
                (links / part).symlink_to((root / part).resolve())
        try:
            with contextlib.redirect_stderr(io.StringIO()):  # a bar for each step
                convert_dataset("local/data", root=links, push_to_hub=False)
        except Exception as error:  # what its libraries raise
            raise DataError(
                f"{root} is in format {OLD_FORMAT}, and LeRobot's converter ends with {type(error).__name__}: {error}; "
                f"mend a copy of the folder, convert it in place with `{COMMAND}`, and give COPY"
            ) from error
        shutil.copytree(links, draft, dirs_exist_ok=True)
