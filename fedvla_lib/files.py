"""Where files are cached, and how a file or folder appears whole or not at all."""

import json
import math
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from safetensors import SafetensorError


def cache_dir() -> Path:
    """Return where recordings, decoded frames and meshes are kept: ``$FEDVLA_CACHE``, else ``~/.cache/fedvla``."""
    return Path(os.environ.get("FEDVLA_CACHE") or Path.home() / ".cache" / "fedvla")


def write_json(path: Path, content: Any) -> None:
    """Write `content` as readable JSON, whole or not at all."""
    write_atomically(path, (json.dumps(as_json(content), indent=2) + "\n").encode())


def write_atomically(path: Path, content: bytes) -> None:
    """Write a file, whole or not at all."""
    with new_file(path) as draft:
        draft.write_bytes(content)


@contextmanager
def new_file(path: Path) -> Iterator[Path]:
    """Yield a place beside `path` to write to; what is there when the block ends without an error moves to `path`."""
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(f".{os.getpid()}.{path.name}")  # the suffix stays: NumPy would add its own
    try:
        yield draft
        os.replace(draft, path)
    finally:
        draft.unlink(missing_ok=True)


@contextmanager
def new_folder(folder: Path, *, replace: bool = False) -> Iterator[Path]:
    """Yield an empty folder beside `folder`; it moves there when the block ends without an error.

    Args:
        replace: whether a folder that is there by then gives way. If not it stays: another process was faster.

    Raises:
        OSError: safetensors could not write, for which it has an error of its own; the message names `folder`.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    draft = folder.with_name(f".{os.getpid()}.{folder.name}")
    shutil.rmtree(draft, ignore_errors=True)  # left by a process of this number that was killed
    draft.mkdir()
    try:
        yield draft
        if replace:
            shutil.rmtree(folder, ignore_errors=True)
        try:
            os.replace(draft, folder)
        except OSError:
            if not folder.is_dir():
                raise
    except SafetensorError as error:
        raise OSError(f"cannot write {folder}: {error}") from error
    finally:
        shutil.rmtree(draft, ignore_errors=True)


def as_json(value: Any) -> Any:
    """Make `value` valid JSON: NumPy scalars become numbers, numbers that are not finite become null."""
    if isinstance(value, dict):
        return {str(key): as_json(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [as_json(item) for item in value]
    value = value.item() if hasattr(value, "item") else value
    return None if isinstance(value, float) and not math.isfinite(value) else value
