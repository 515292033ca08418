"""TODO what this file is for."""

import re
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fedvla_lib.config import Config, from_profile
from fedvla_lib.evaluation.rollouts import rollout_seeds

FILE_NAME = re.compile(r"[\w-]+", re.ASCII)
NAMES = {"profile", "seeds", "rollouts", "first_rollout_seed", "settings", "partitions", "methods", "only"}
KINDS = ("base", "federated", "centralized", "local-only", "clients")  # of training, and of what is measured of it
RULES = ("method", "partition", "seed", "kind")  # what a rule under [[only]] may name
# A cell's own evaluation is larger than the one inside a run, which would cost time and decide nothing.
QUIET = {"fraction_evaluate": 0.0, "eval_every": 0, "eval_rollouts": 0, "client_rollouts": 0, "checkpoint_every": 0}


@dataclass(frozen=True)
class Cell:
    """One training and its evaluation."""

    method: str
    kind: str
    partition: str
    seed: int
    config: Config

    @property
    def name(self) -> str:
        """Name of the cell's folder."""
        return f"{self.partition}_{self.method}_{self.seed}"


@dataclass(frozen=True)
class Plan:
    """What an experiment file asks for."""

    cells: list[Cell]
    rollout_seeds: list[int]


def read_plan(file: Path) -> Plan:
    """Return the cells that an experiment file describes, seed by seed, so that an early stop leaves whole seeds.

    Raises:
        ValueError: the file cannot be parsed, or holds a name or value that cannot be used.
    """
    try:
        told = tomllib.loads(Path(file).read_text())
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"{file}: {error}") from error
    for name in ("methods", "partitions", "seeds", "rollouts"):
        if not told.get(name):
            raise ValueError(f"{file} lacks {name!r}: give one of each of methods, partitions, seeds and rollouts")
    if unknown := sorted(set(told) - NAMES):
        raise ValueError(f"{file}: unknown name {unknown[0]!r}: choose from {', '.join(sorted(NAMES))}")
    _check_types(told, Path(file))
    cells = [cell for cell in _cells(told, Path(file)) if _wanted(cell, told.get("only", []))]
    return Plan(cells, rollout_seeds(told["rollouts"], first=told.get("first_rollout_seed", 2_000_000)))


def _check_types(told: dict[str, Any], file: Path) -> None:
    """Raise ValueError where a name holds another kind of thing than the example above, or a rule names no property."""
    seeds = told["seeds"]
    usable = {
        "seeds": (isinstance(seeds, list) and all(type(seed) is int for seed in seeds), "a list of whole numbers"),
        "rollouts": (type(told["rollouts"]) is int and told["rollouts"] > 0, "a number above 0"),
        "first_rollout_seed": (type(told.get("first_rollout_seed", 0)) is int, "a whole number"),
    }
    for name in ("methods", "partitions"):
        tables = told[name]
        usable[name] = (isinstance(tables, dict) and all(isinstance(t, dict) for t in tables.values()), "tables")
    usable["settings"] = (isinstance(told.get("settings", {}), dict), "a table")
    for name, (fits, wanted) in usable.items():
        if not fits:
            raise ValueError(f"{file}: {name}={told[name]!r} is not usable: give {wanted}")
    for rule in told.get("only", []):
        if unknown := sorted(set(rule) - set(RULES)):
            raise ValueError(f"{file}: unknown name {unknown[0]!r} under [[only]]: choose from {', '.join(RULES)}")


def _cells(told: dict[str, Any], file: Path) -> Iterator[Cell]:
    for seed in told["seeds"]:
        for partition, of_partition in told["partitions"].items():
            for method, of_method in told["methods"].items():
                own = dict(of_method)
                kind = own.pop("kind", "federated")
                if bad := [name for name in (partition, method) if not FILE_NAME.fullmatch(name)]:
                    raise ValueError(f"{file}: {bad[0]!r} becomes part of a file name: use letters, digits, - and _")
                if kind not in KINDS:
                    raise ValueError(f"{file}: method {method!r} has kind {kind!r}: choose one of {', '.join(KINDS)}")
                settings = QUIET | told.get("settings", {}) | of_partition | own | {"seed": seed}
                yield Cell(method, kind, partition, seed, from_profile(told.get("profile"), **settings))


def _wanted(cell: Cell, only: list[dict[str, Any]]) -> bool:
    return not only or any(all(getattr(cell, key) == value for key, value in rule.items()) for rule in only)
