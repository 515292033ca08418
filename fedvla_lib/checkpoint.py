"""What a federation needs to go on after the server died: arrays, the strategy's memory and the clients', each round.

::

    <run folder>/checkpoints/round_3/
      arrays.safetensors          the global arrays, unrounded
      strategy.safetensors        momentum, second moments or control variates, as far as the strategy has any
      clients.safetensors         what clients keep from round to round, where the engine can give it
"""

import os
import re
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from fedvla_lib.params import Arrays

KEPT = 2  # rounds: the last, and one before it should the disk have failed under the last
PARTS = ("arrays", "strategy", "clients")
NAME = re.compile(r"round_(\d+)")


@dataclass(frozen=True)
class Checkpoint:
    """A run at the end of a round; arrays by name, the strategy's and clients' names with a path before them."""

    round: int
    arrays: Arrays
    strategy: Arrays
    clients: Arrays


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Make of the error of safetensors at a full disk, which is no OSError, one that names the file to be written."""
    try:
        yield
    except SafetensorError as error:
        raise OSError(f"cannot write {path}: {error}") from error


def save(root: Path, checkpoint: Checkpoint) -> None:
    """Write a checkpoint into the run folder, whole or not at all, and remove those before the last two.

    Raises:
        OSError: it cannot be written; the message names the file.
    """
    folder = root / "checkpoints" / f"round_{checkpoint.round}"
    scratch = folder.with_name(f".{folder.name}.{os.getpid()}")
    shutil.rmtree(scratch, ignore_errors=True)
    try:
        scratch.mkdir(parents=True)
        for part in PARTS:
            with writing(folder / f"{part}.safetensors"):
                save_file(getattr(checkpoint, part), scratch / f"{part}.safetensors")
        shutil.rmtree(folder, ignore_errors=True)
        os.replace(scratch, folder)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
    for old in sorted(_rounds(root))[:-KEPT]:
        shutil.rmtree(root / "checkpoints" / f"round_{old}")


def load(root: Path) -> Checkpoint:
    """Return the last checkpoint of a run folder.

    Raises:
        ValueError: there is none, or it is damaged.
    """
    if not (rounds := _rounds(root)):
        raise ValueError(f"{root} has no checkpoint: no round of it was completed, so start it anew")
    folder = root / "checkpoints" / f"round_{max(rounds)}"
    try:
        parts = {part: load_file(folder / f"{part}.safetensors") for part in PARTS}
    except (SafetensorError, OSError) as error:
        raise ValueError(f"{folder} is damaged ({error}): remove it to go on from the round before") from error
    return Checkpoint(max(rounds), **parts)


def flat(tree: Mapping[str, Arrays]) -> Arrays:
    """Return one mapping of arrays for several, the outer name before a slash."""
    return {f"{outer}/{name}": array for outer, arrays in tree.items() for name, array in arrays.items()}


def nested(arrays: Arrays) -> dict[str, Arrays]:
    """Undo `flat`."""
    tree: dict[str, Arrays] = {}
    for path, array in arrays.items():
        outer, name = path.split("/", 1)
        tree.setdefault(outer, {})[name] = array
    return tree


def _rounds(root: Path) -> list[int]:
    found = [NAME.fullmatch(path.name) for path in (root / "checkpoints").glob("round_*")]
    return [int(match[1]) for match in found if match]
