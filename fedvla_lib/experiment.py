"""A grid of arms, partitions and seeds from one small file, one result file a cell, resumable.

::

    profile = "laptop"          # settings that no cell names
    seeds = [0, 1, 2]           # a seed fixes the partition, the clients drawn, batches and noise
    rollouts = 50               # attempts at each task for each cell; for kind "clients", of each client
    first_rollout_seed = 2_000_000

    [settings]                  # of every cell
    local_steps = 20

    [partitions.by_task]        # every arm runs on every partition
    partition = "task"

    [arms.fedavg]               # a kind of training, and settings of its own
    kind = "federated"          # or base, centralized, local-only (of `client`, default 0); or clients: what each
                                # ends with, on its own tasks

    [[only]]                    # if there are any: cells that match none of them are left out
    arm = "fedavg"
    partition = "by_task"
"""

import json
import re
import time
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from fedvla_lib import arms, clients, data, run_folder
from fedvla_lib.config import Config, from_profile
from fedvla_lib.evaluate import rollout_seeds
from fedvla_lib.model import Bundle

KINDS = ("base", "federated", "centralized", "local-only", "clients")
FILE_NAME = re.compile(r"[\w-]+", re.ASCII)
NAMES = {"profile", "seeds", "rollouts", "first_rollout_seed", "settings", "partitions", "arms", "only"}
RULES = ("arm", "partition", "seed", "kind")  # what a rule under [[only]] may name
# A cell's own evaluation is larger than the one inside a run, which would cost time and decide nothing.
QUIET = {"fraction_evaluate": 0.0, "eval_every": 0, "eval_rollouts": 0, "client_rollouts": 0, "checkpoint_every": 0}


@dataclass(frozen=True)
class Cell:
    """One training and its evaluation."""

    arm: str
    kind: str
    partition: str
    seed: int
    config: Config
    client: int = 0  # of a local-only cell

    @property
    def name(self) -> str:
        """Name of the cell's file."""
        return f"{self.partition}_{self.arm}_{self.seed}"


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
    for name in ("arms", "partitions", "seeds", "rollouts"):
        if not told.get(name):
            raise ValueError(f"{file} lacks {name!r}: give one of each of arms, partitions, seeds and rollouts")
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
    for name in ("arms", "partitions"):
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
            for arm, of_arm in told["arms"].items():
                own = dict(of_arm)
                kind, client = own.pop("kind", "federated"), own.pop("client", 0)
                if bad := [name for name in (partition, arm) if not FILE_NAME.fullmatch(name)]:
                    raise ValueError(f"{file}: {bad[0]!r} becomes part of a file name: use letters, digits, - and _")
                if kind not in KINDS:
                    raise ValueError(f"{file}: arm {arm!r} has kind {kind!r}: choose one of {', '.join(KINDS)}")
                settings = QUIET | told.get("settings", {}) | of_partition | own | {"seed": seed}
                yield Cell(arm, kind, partition, seed, from_profile(told.get("profile"), **settings), client)


def _wanted(cell: Cell, only: list[dict[str, Any]]) -> bool:
    return not only or any(all(getattr(cell, key) == value for key, value in rule.items()) for rule in only)


def run_plan(plan: Plan, out: Path, say: Callable[[str], None] = print) -> None:
    """Measure every cell that has no file in `out` yet; a file appears when its cell is complete."""
    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    todo = [cell for cell in plan.cells if not (out / f"{cell.name}.json").exists()]
    say(f"{len(plan.cells)} cells, {len(plan.cells) - len(todo)} of them in {out}")
    for number, cell in enumerate(todo, 1):
        began = time.perf_counter()
        result = measure(cell, plan.rollout_seeds)
        run_folder.write_atomically(out / f"{cell.name}.json", (json.dumps(result) + "\n").encode())  # on one line
        rate = sum(result["rollouts"]["success"]) / len(result["rollouts"]["success"])
        say(f"[{number}/{len(todo)}] {cell.name}: {rate:.0%} in {time.perf_counter() - began:.0f} s")


def measure(cell: Cell, seeds: list[int]) -> dict[str, Any]:
    """Train a cell's model, or find it in the cache, and return what is known of it and of its rollouts."""
    config = with_recording(cell.config)
    found = _of_clients(config, len(seeds)) if cell.kind == "clients" else _of_model(cell, config, seeds)
    rows = found.pop("rows")
    steps = {"base": 0, "local-only": arms.steps_per_client(config)}.get(cell.kind, arms.total_steps(config))
    return {
        "arm": cell.arm, "kind": cell.kind, "partition": cell.partition, "seed": cell.seed,
        "config": asdict(cell.config), "gradient_steps": steps, "samples": steps * config.batch_size, **found,
        "stamp": run_folder.first_stamp(cell.config, cell.kind) | {"status": "completed"},
        "rollouts": {key: [row[key] for row in rows] for key in ("task", "lab", "seed", "success", "steps")},
    }  # fmt: skip


def _of_model(cell: Cell, config: Config, seeds: list[int]) -> dict[str, Any]:
    """Measure the one model that comes out of a training, on all tasks."""
    began = time.perf_counter()
    bundle, travelled = _train(cell, config)
    trained = time.perf_counter()
    store = clients.open_frames(config)
    frames, held_out = clients.validate(bundle, store, clients.held_out_episodes(store, config), config)
    rows = clients.roll_out(bundle, config, seeds)
    return {
        "held_out_frames": frames, "held_out": held_out, "bytes": travelled, "rows": rows,
        "train_s": trained - began, "evaluate_s": time.perf_counter() - trained,
    }  # fmt: skip


def _of_clients(config: Config, rollouts: int) -> dict[str, Any]:
    """Measure what each client ends with, its own parts included, on its own tasks and held-out episodes."""
    began = time.perf_counter()
    run = arms.federated(replace(config, fraction_evaluate=1.0, client_rollouts=rollouts), progress=False)
    events = {kind: run_folder.read_metrics(run, kind) for kind in ("rollout", "evaluate", "replies")}
    own = {kind: of_kind[of_kind.who != run_folder.GLOBAL] for kind, of_kind in events.items()}
    last = own["evaluate"][own["evaluate"]["round"] == config.num_server_rounds]
    last = last[last.num_examples > 0]
    training = events["replies"][events["replies"]["to"] == "train"]
    return {
        "held_out_frames": int(last.num_examples.sum()),
        "held_out": {"loss": float(np.average(last.loss, weights=last.num_examples))},
        "bytes": int(training.sent_bytes.sum() + training.received_bytes.sum()),
        "rows": own["rollout"].to_dict("records"),
        "train_s": time.perf_counter() - began, "evaluate_s": 0.0,
    }  # fmt: skip


def _train(cell: Cell, config: Config) -> tuple[Bundle, int]:
    """Return the model of a cell and the bytes that travelled for its training."""
    if cell.kind == "federated":
        folder = arms.federated(config, progress=False)
        replies = run_folder.read_metrics(folder, "replies")
        return arms.federated_policy(config), int(replies.sent_bytes.sum() + replies.received_bytes.sum())
    if cell.kind == "centralized":
        return arms.centralized(config, progress=False), 0
    if cell.kind == "local-only":
        return arms.local_only(config, cell.client, progress=False), 0
    return arms.base(config), 0


def with_recording(config: Config) -> Config:
    """Return settings that name the recording: one for all seeds, since a run's seed fixes training alone."""
    return config if config.data else replace(config, data=str(data.resolve(replace(config, seed=0))))


def read_results(folder: Path) -> pd.DataFrame:
    """Return a row for each rollout of each cell in `folder`, with what is known of the cell.

    Raises:
        ValueError: there is no result.
    """
    files = sorted(Path(folder).glob("*.json"))
    if not files:
        raise ValueError(f"no results in {folder}: make some with fedvla experiment")
    tables = []
    for file in files:
        cell = json.loads(file.read_text())
        known = {key: cell[key] for key in ("arm", "kind", "partition", "gradient_steps", "bytes", "train_s")}
        known |= {"run": cell["seed"], "loss": cell["held_out"].get("loss")}
        tables.append(pd.DataFrame(cell["rollouts"]).assign(**known))
    return pd.concat(tables, ignore_index=True)
