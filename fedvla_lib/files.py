"""Where files are cached, and how a file or folder appears whole or not at all."""

import json
import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from safetensors import SafetensorError


@contextmanager
def safetensors_errors_named(path: Path) -> Iterator[None]:
    """Make of the error of safetensors at a full disk, which is no OSError, one that names the file to be written."""
    try:
        yield
    except SafetensorError as error:
        raise OSError(f"cannot write {path}: {error}") from error


def cache_dir() -> Path:
    """Return where recordings, decoded frames and meshes are kept: ``$FEDVLA_CACHE``, else ``~/.cache/fedvla``."""
    return Path(os.environ.get("FEDVLA_CACHE") or Path.home() / ".cache" / "fedvla")


def write_json(path: Path, content: Any) -> None:
    """Write `content` as readable JSON, whole or not at all."""
    write_atomically(path, (json.dumps(as_json(content), indent=2) + "\n").encode())


def write_atomically(path: Path, content: bytes) -> None:
    """Write a file beside its place and move it there."""
    scratch = path.with_name(f".{path.name}.{os.getpid()}")
    scratch.write_bytes(content)
    os.replace(scratch, path)


def as_json(value: Any) -> Any:
    """Make `value` valid JSON: NumPy scalars become numbers, numbers that are not finite become null."""
    if isinstance(value, dict):
        return {str(key): as_json(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [as_json(item) for item in value]
    value = value.item() if hasattr(value, "item") else value
    return None if isinstance(value, float) and not math.isfinite(value) else value
