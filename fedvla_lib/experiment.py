"""A grid of arms, partitions and seeds from one small file, one run folder a cell, resumable.

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
    kind = "federated"          # or base, centralized, local-only: every client for itself, the attempts dealt out
                                # over them; or clients: what each ends with, on its own tasks

    [[only]]                    # if there are any: cells that match none of them are left out
    arm = "fedavg"
    partition = "by_task"
"""

import os
import re
import shutil
import time
import tomllib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from fedvla_lib import arms, clients, data, run_folder, train
from fedvla_lib.config import Config, from_profile
from fedvla_lib.evaluate import rollout_seeds
from fedvla_lib.model import Bundle
from fedvla_lib.roster import client_name
from fedvla_lib.run_folder import GLOBAL, RunFolder

FILE_NAME = re.compile(r"[\w-]+", re.ASCII)
NAMES = {"profile", "seeds", "rollouts", "first_rollout_seed", "settings", "partitions", "arms", "only"}
KINDS = ("base", "federated", "centralized", "local-only", "clients")  # of training, and of what is measured of it
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

    @property
    def name(self) -> str:
        """Name of the cell's folder."""
        return f"{self.partition}_{self.arm}_{self.seed}"


@dataclass(frozen=True)
class Measured:
    """What training and evaluating a cell brought."""

    rows: list[dict[str, Any]]  # the attempts
    held_out: dict[str, float]  # averages over held-out frames, and num_examples
    episodes: list[dict[str, float]] = field(default_factory=list)  # the same, of each held-out episode
    rounds: list[dict[str, Any]] = field(default_factory=list)  # events of a federated run before its last round
    # Gradient steps that each model counted while it trained, by its name: global, or client_K where each has its own.
    steps: dict[str, dict[str, int]] = field(default_factory=lambda: {GLOBAL: {"in_all": 0, "in_a_row": 0}})
    bytes: int = 0  # that travelled
    train_s: float = 0.0


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
                kind = own.pop("kind", "federated")
                if bad := [name for name in (partition, arm) if not FILE_NAME.fullmatch(name)]:
                    raise ValueError(f"{file}: {bad[0]!r} becomes part of a file name: use letters, digits, - and _")
                if kind not in KINDS:
                    raise ValueError(f"{file}: arm {arm!r} has kind {kind!r}: choose one of {', '.join(KINDS)}")
                settings = QUIET | told.get("settings", {}) | of_partition | own | {"seed": seed}
                yield Cell(arm, kind, partition, seed, from_profile(told.get("profile"), **settings))


def _wanted(cell: Cell, only: list[dict[str, Any]]) -> bool:
    return not only or any(all(getattr(cell, key) == value for key, value in rule.items()) for rule in only)


def run_plan(plan: Plan, out: Path, say: Callable[[str], None] = print) -> None:
    """Measure every cell that has no folder in `out` yet; a folder appears when its cell is complete."""
    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    todo = [cell for cell in plan.cells if not (out / cell.name).exists()]
    say(f"{len(plan.cells)} cells, {len(plan.cells) - len(todo)} of them in {out}")
    for number, cell in enumerate(todo, 1):
        began = time.perf_counter()
        rate = keep(cell, plan.rollout_seeds, out)
        say(f"[{number}/{len(todo)}] {cell.name}: {rate:.0%} in {time.perf_counter() - began:.0f} s")


def keep(cell: Cell, seeds: Sequence[int], out: Path) -> float:
    """Measure a cell, write its run folder, whole or not at all, and return the success rate."""
    config, began = with_recording(cell.config), time.perf_counter()
    stamp = run_folder.first_stamp(cell.config, cell.kind)
    found = MEASURES[cell.kind](config, seeds)
    scratch = RunFolder(out / f".{cell.name}.{os.getpid()}")
    shutil.rmtree(scratch.root, ignore_errors=True)
    scratch.root.mkdir()
    steps = sum(of_model["in_all"] for of_model in found.steps.values())
    run_folder.write_json(scratch.root / "config.json", asdict(cell.config))
    _log(scratch, found, 0 if cell.kind == "base" else config.num_server_rounds, steps)
    known = {"arm": cell.arm, "kind": cell.kind, "partition": cell.partition, "steps": found.steps,
             "gradient_steps": steps, "samples": steps * config.batch_size, "bytes": found.bytes,
             "train_s": found.train_s}  # fmt: skip
    ended = {"status": "completed", "wall_s": time.perf_counter() - began, "code": arms.trained_by()}
    run_folder.write_json(scratch.root / "stamp.json", stamp | ended | known)
    os.replace(scratch.root, out / cell.name)
    return sum(row["success"] for row in found.rows) / len(found.rows)


def _log(run: RunFolder, found: Measured, round_number: int, steps: int) -> None:
    for event in found.rounds:
        run.log(event["round"], event["who"], event["kind"], event["values"])
    for of_episode in found.episodes:
        run.log(round_number, GLOBAL, "held-out", of_episode)
    for row in found.rows:
        values = {key: row[key] for key in ("task", "lab", "seed", "success", "steps", "client") if key in row}
        run.log(round_number, row.get("who", GLOBAL), "rollout", values)
    run.log(round_number, GLOBAL, "evaluate", {**found.held_out, "gradient_steps": steps})


def _base(config: Config, seeds: Sequence[int]) -> Measured:
    return _of_model(arms.base(config), config, seeds)


def _centralized(config: Config, seeds: Sequence[int]) -> Measured:
    began = time.perf_counter()
    bundle = arms.centralized(config, progress=False)
    seconds = time.perf_counter() - began
    return replace(_of_model(bundle, config, seeds), steps={GLOBAL: arms.counted(config)}, train_s=seconds)


def _federated(config: Config, seeds: Sequence[int]) -> Measured:
    """Measure the last global model; what the run measured of earlier ones is kept, videos left out."""
    folder = arms.federated(config, progress=False)
    events = [event for event in run_folder.read_events(folder / "metrics.jsonl") if event["who"] == GLOBAL]
    earlier = [event for event in events if event["round"] < config.num_server_rounds]
    for event in earlier:
        event["values"].pop("video", None)
    return replace(
        _of_model(arms.federated_policy(config), config, seeds),
        rounds=[event for event in earlier if event["kind"] in ("evaluate", "rollout")],
        steps={GLOBAL: run_folder.counted_steps(folder)},
        bytes=_travelled(folder),
        train_s=run_folder.read_stamp(folder)["wall_s"],
    )


def _travelled(folder: Path) -> int:
    replies = run_folder.read_metrics(folder, "replies")
    return int(replies.sent_bytes.sum() + replies.received_bytes.sum())


def _local_only(config: Config, seeds: Sequence[int]) -> Measured:
    """Measure every client's own model: all held-out episodes for each, the attempts dealt out over them."""
    each, steps, seconds = [], {}, 0.0
    for client in range(config.num_clients):
        began = time.perf_counter()
        bundle = arms.local_only(config, client, progress=False)
        seconds += time.perf_counter() - began
        steps[client_name(client)] = arms.counted(config, client)
        found = _of_model(bundle, config, seeds[client :: config.num_clients])
        each.append(replace(found, rows=[{**row, "client": client} for row in found.rows]))
    episodes = pd.DataFrame([of_episode for found in each for of_episode in found.episodes])
    return Measured(
        rows=[row for found in each for row in found.rows],
        held_out=pd.DataFrame([found.held_out for found in each]).mean().to_dict(),
        episodes=episodes.groupby("episode_id", as_index=False).mean().to_dict("records") if len(episodes) else [],
        steps=steps,
        train_s=seconds,
    )


def _of_model(bundle: Bundle, config: Config, seeds: Sequence[int]) -> Measured:
    """Measure one model on all held-out episodes and all tasks."""
    store = clients.open_frames(config)
    held_out = clients.held_out_episodes(store, config)
    frames = clients.held_out_frames(bundle, store, held_out, config)
    episodes = clients.by_episode(frames, store, held_out) if frames else []
    averages = {"num_examples": len(frames["loss"]), **train.average(frames)} if frames else {}
    return Measured(clients.roll_out(bundle, config, seeds) if len(seeds) else [], averages, episodes)


def _clients(config: Config, seeds: Sequence[int]) -> Measured:
    """Measure what each client ends with, its own parts included, on its own tasks and held-out episodes."""
    run = arms.federated(replace(config, fraction_evaluate=1.0, client_rollouts=len(seeds)), progress=False)
    events = {kind: run_folder.read_metrics(run, kind) for kind in ("rollout", "evaluate", "replies")}
    own = {kind: of_kind[of_kind.who != GLOBAL] for kind, of_kind in events.items()}
    last = own["evaluate"][own["evaluate"]["round"] == config.num_server_rounds]
    last = last[last.num_examples > 0]
    training = events["replies"][events["replies"]["to"] == "train"]
    return Measured(
        rows=own["rollout"].to_dict("records"),
        held_out={"num_examples": int(last.num_examples.sum()),
                  "loss": float(np.average(last.loss, weights=last.num_examples))},
        steps={GLOBAL: run_folder.counted_steps(run)},  # what the clients share; their own parts took some of them
        bytes=int(training.sent_bytes.sum() + training.received_bytes.sum()),
        train_s=run_folder.read_stamp(run)["wall_s"],
    )  # fmt: skip


MEASURES = {
    "base": _base, "federated": _federated, "centralized": _centralized, "local-only": _local_only,
    "clients": _clients,
}  # fmt: skip


def with_recording(config: Config) -> Config:
    """Return settings that name the recording: one for all seeds, since a run's seed fixes training alone."""
    return config if config.data else replace(config, data=str(data.resolve(replace(config, seed=0))))
