"""The cache folder, atomic writes of files and folders, and JSON that is checked when it is read."""

import json
import math
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any


def cache_dir() -> Path:
    """Return the folder of cached recordings, frames, meshes and models: ``$FEDVLA_CACHE`` or ``~/.cache/fedvla``."""
    return Path(os.environ.get("FEDVLA_CACHE") or Path.home() / ".cache" / "fedvla")


@cache
def _checker(shape: Any) -> Any:
    from pydantic import TypeAdapter  # here, since the doctor imports this module where packages may be missing

    return TypeAdapter(shape)


def read_json(path: Path, shape: Any = dict[str, Any]) -> Any:
    """Return what a JSON file holds, see `parse_json`."""
    return parse_json(Path(path).read_bytes(), shape, str(path))


def parse_json(text: str | bytes, shape: Any, name: str) -> Any:
    """Return what a JSON text holds.

    Args:
        shape: the type that the content must have; a TypedDict names what has to be there, and there may be more.
        name: of the text, for the message.

    Raises:
        ValueError: it is not JSON, or not of that type.
    """
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:  # also for text that is not UTF-8, and for deep nesting
        raise ValueError(f"{name} is damaged: {error}") from error
    return checked(content, shape, name)


def checked(content: Any, shape: Any, name: str) -> Any:
    """Return `content` as it is if it has the type `shape`; raise ValueError that says where it has not."""
    try:
        _checker(shape).validate_python(content, strict=True)
        return content
    except ValueError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(map(str, first["loc"]))
        raise ValueError(f"{name} is damaged: {where + ': ' if where else ''}{first['msg']}") from error


def write_json(path: Path, content: Any) -> None:
    """Write `content` as indented JSON, atomically."""
    write_atomically(path, (json.dumps(as_json(content), indent=2) + "\n").encode())


def write_atomically(path: Path, content: bytes) -> None:
    """Write a file that is either complete or absent."""
    with new_file(path) as draft:
        draft.write_bytes(content)


@contextmanager
def new_file(path: Path) -> Iterator[Path]:
    """Yield a temporary path next to `path`, renamed to `path` if the block ends without an error."""
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(f".{path.name}.{os.getpid()}")  # other suffix: readers of *.parquet do not see it
    try:
        yield draft
        os.replace(draft, path)
    finally:
        draft.unlink(missing_ok=True)


@contextmanager
def new_folder(folder: Path, *, replace: bool = False) -> Iterator[Path]:
    """Yield an empty temporary folder, renamed to `folder` if the block ends without an error.

    Args:
        replace: replace an existing folder. Otherwise it is kept: another process was faster.

    Raises:
        OSError: also for write errors of safetensors, which has its own exception; the message names `folder`.
    """
    from safetensors import SafetensorError  # here, since the doctor imports this module where packages may be missing

    folder.parent.mkdir(parents=True, exist_ok=True)
    hidden = {"dir": folder.parent, "prefix": f".{folder.name}.", "ignore_cleanup_errors": True}
    with tempfile.TemporaryDirectory(**hidden) as scratch:
        draft = Path(scratch) / folder.name
        draft.mkdir()
        try:
            yield draft
        except SafetensorError as error:
            raise OSError(f"cannot write {folder}: {error}") from error
        if replace:
            shutil.rmtree(folder, ignore_errors=True)
        try:
            os.replace(draft, folder)
        except OSError:
            if replace or not folder.is_dir():
                raise


def as_json(value: Any) -> Any:
    """Convert `value` to valid JSON: NumPy scalars become numbers, non-finite numbers become null."""
    if isinstance(value, dict):
        return {str(key): as_json(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [as_json(item) for item in value]
    value = value.item() if hasattr(value, "item") else value
    return None if isinstance(value, float) and not math.isfinite(value) else value
