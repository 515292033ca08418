"""Checkpoints of a federated run, one per round: global arrays, the strategy's state and the clients' states.

::

    <run folder>/checkpoints/round_3/
      arrays.safetensors          the global arrays, unrounded
      strategy.safetensors        momentum, second moments or control variates, if the strategy has them
      clients.safetensors         state that clients keep between rounds, if the engine can read it

Each file carries the SHA-256 of its arrays: safetensors notices a truncated file, but not a flipped bit.
"""

import logging
import re
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from fedvla_lib.files import new_folder
from fedvla_lib.policy.parameters import Arrays, ParameterError, check_digest, digest

logger = logging.getLogger(__name__)
KEPT = 2  # rounds: the last, and the one before in case the last is damaged
HASH = "sha256"  # in the header of a file
PARTS = ("arrays", "strategy", "clients")
NAME = re.compile(r"round_(\d+)")


@dataclass(frozen=True)
class Checkpoint:
    """A run at the end of a round: arrays by name; names of strategy and client arrays have a path in front."""

    round: int
    arrays: Arrays
    strategy: Arrays
    clients: Arrays


def save(root: Path, checkpoint: Checkpoint) -> None:
    """Write a checkpoint atomically, and remove all but the last two; raise OSError, naming the file, if that fails."""
    folder = root / "checkpoints" / f"round_{checkpoint.round}"
    with new_folder(folder, replace=True) as draft:
        for part in PARTS:
            arrays, name = getattr(checkpoint, part), f"{part}.safetensors"
            try:
                save_file(arrays, draft / name, metadata={HASH: digest(arrays)})
            except SafetensorError as error:  # of a full disk
                raise OSError(f"cannot write {folder / name}: {error}") from error
    for old in rounds(root)[:-KEPT]:
        shutil.rmtree(root / "checkpoints" / f"round_{old}")


def load(root: Path) -> Checkpoint:
    """Return a run's last intact checkpoint, warning of each damaged one after it; raise ValueError if none is left."""
    if not (found := rounds(root)):
        raise ValueError(f"{root} has no checkpoint: no round was completed; start a new run")
    for number in reversed(found):
        folder = root / "checkpoints" / f"round_{number}"
        try:
            return Checkpoint(number, **{part: _read(folder / f"{part}.safetensors") for part in PARTS})
        except (SafetensorError, OSError, ParameterError) as error:
            damage = f"{folder} is damaged ({error})"
            logger.warning("%s: trying the round before", damage)
    raise ValueError(f"{damage}, and there is no intact checkpoint before it: start a new run")


def _read(file: Path) -> Arrays:
    with safe_open(file, framework="numpy") as content:
        arrays = {name: content.get_tensor(name) for name in content.keys()}
        check_digest(arrays, (content.metadata() or {}).get(HASH, ""))
    return arrays


def flat(tree: Mapping[str, Arrays]) -> Arrays:
    """Join mappings of arrays into one; the outer name comes before a slash."""
    return {f"{outer}/{name}": array for outer, arrays in tree.items() for name, array in arrays.items()}


def nested(arrays: Arrays) -> dict[str, Arrays]:
    """Undo `flat`."""
    tree: dict[str, Arrays] = {}
    for path, array in arrays.items():
        outer, name = path.split("/", 1)
        tree.setdefault(outer, {})[name] = array
    return tree


def rounds(root: Path) -> list[int]:
    """Return the rounds that have a checkpoint, in order."""
    found = [NAME.fullmatch(path.name) for path in (root / "checkpoints").glob("round_*")]
    return sorted(int(match[1]) for match in found if match)
