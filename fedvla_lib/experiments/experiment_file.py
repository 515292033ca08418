"""Read an experiment file (TOML) into the cells of a grid: methods x partitions x seeds.

::

    profile = "laptop"          # defaults of all settings
    seeds = [0, 1, 2]           # a seed fixes partition, client sampling, batches and noise
    rollouts = 50               # per task and cell; for kind "clients", per client
    first_rollout_seed = 2_000_000

    [settings]                  # of every cell
    local_steps = 20

    [partitions.by_task]        # every method runs on every partition
    partition = "task"

    [methods.fedavg]            # a kind of training and its settings
    kind = "federated"          # or base; centralized; local-only: each client alone, the rollouts divided among them;
                                # or clients: each client's model after a federated run, on the client's tasks

    [[only]]                    # optional: keep only cells that match one of these rules
    method = "fedavg"
    partition = "by_task"
"""

import re
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

from fedvla_lib.config import Config, from_profile
from fedvla_lib.evaluation.rollouts import rollout_seeds

FILE_NAME = re.compile(r"[\w-]+", re.ASCII)
# What a file may hold: by name, a test of the value, and usable values in words.
CONTENT = {
    "seeds": (lambda it: isinstance(it, list) and all(type(seed) is int for seed in it), "a list of whole numbers"),
    "rollouts": (lambda it: type(it) is int and it > 0, "a number above 0"),
    "first_rollout_seed": (lambda it: type(it) is int, "a whole number"),
    "settings": (lambda it: isinstance(it, dict), "a table"),
    "methods": (lambda it: isinstance(it, dict) and all(isinstance(one, dict) for one in it.values()), "tables"),
    "partitions": (lambda it: isinstance(it, dict) and all(isinstance(one, dict) for one in it.values()), "tables"),
    "only": (lambda it: isinstance(it, list) and all(isinstance(rule, dict) for rule in it), "tables [[only]]"),
    "profile": (lambda it: isinstance(it, str), "a name"),
}
KINDS = ("base", "federated", "centralized", "local-only", "clients")
RULES = ("method", "partition", "seed", "kind")  # what a rule under [[only]] may name
# A cell has an evaluation of its own; evaluations inside its training would cost time and decide nothing.
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
        """Name of the cell's run folder."""
        return f"{self.partition}_{self.method}_{self.seed}"


@dataclass(frozen=True)
class Plan:
    """The cells of an experiment and the seeds of their rollouts."""

    cells: list[Cell]
    rollout_seeds: list[int]


def read_plan(file: Path) -> Plan:
    """Return the cells of an experiment file, ordered by seed so that an early stop leaves complete seeds.

    Raises:
        ValueError: the file cannot be parsed, or has an unknown name or a bad value.
    """
    try:
        content = tomllib.loads(Path(file).read_text())
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"{file}: {error}") from error
    for name in ("methods", "partitions", "seeds", "rollouts"):
        if not content.get(name):
            raise ValueError(f"{file} lacks {name!r}: give one of each of methods, partitions, seeds and rollouts")
    if unknown := sorted(set(content) - set(CONTENT)):
        raise ValueError(f"{file}: unknown name {unknown[0]!r}: choose from {', '.join(sorted(CONTENT))}")
    _check_types(content, Path(file))
    cells, only = list(_cells(content, Path(file))), content.get("only", [])
    if only:
        cells = [c for c in cells if any(all(getattr(c, key) == rule[key] for key in rule) for rule in only)]
    return Plan(cells, rollout_seeds(content["rollouts"], first=content.get("first_rollout_seed", 2_000_000)))


def _check_types(content: dict[str, Any], file: Path) -> None:
    for name, (fits, wanted) in CONTENT.items():
        if name in content and not fits(content[name]):
            raise ValueError(f"{file}: {name}={content[name]!r} is not usable: give {wanted}")
    for rule in content.get("only", []):
        if unknown := sorted(set(rule) - set(RULES)):
            raise ValueError(f"{file}: unknown name {unknown[0]!r} under [[only]]: choose from {', '.join(RULES)}")


def _cells(content: dict[str, Any], file: Path) -> Iterator[Cell]:
    partitions, methods = content["partitions"].items(), content["methods"].items()
    for seed, (partition, of_partition), (method, of_method) in product(content["seeds"], partitions, methods):
        own = dict(of_method)
        kind = own.pop("kind", "federated")
        if bad := [name for name in (partition, method) if not FILE_NAME.fullmatch(name)]:
            raise ValueError(f"{file}: {bad[0]!r} becomes part of a file name: use letters, digits, - and _")
        if kind not in KINDS:
            raise ValueError(f"{file}: method {method!r} has kind {kind!r}: choose one of {', '.join(KINDS)}")
        settings = QUIET | content.get("settings", {}) | of_partition | own | {"seed": seed}
        yield Cell(method, kind, partition, seed, from_profile(content.get("profile"), **settings))
