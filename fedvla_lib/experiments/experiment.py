"""A grid of methods, partitions and seeds from one small file, one run folder a cell, resumable.

::

    profile = "laptop"          # settings that no cell names
    seeds = [0, 1, 2]           # a seed fixes the partition, the clients drawn, batches and noise
    rollouts = 50               # rollouts at each task for each cell; for kind "clients", of each client
    first_rollout_seed = 2_000_000

    [settings]                  # of every cell
    local_steps = 20

    [partitions.by_task]        # every method runs on every partition
    partition = "task"

    [methods.fedavg]               # a kind of training, and settings of its own
    kind = "federated"          # or base, centralized, local-only: every client for itself, the rollouts dealt out
                                # over them; or clients: what each ends with, on its own tasks

    [[only]]                    # if there are any: cells that match none of them are left out
    method = "fedavg"
    partition = "by_task"
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from fedvla_lib import files, provenance, run_folder
from fedvla_lib.config import Config
from fedvla_lib.data import recordings
from fedvla_lib.evaluation import measure
from fedvla_lib.experiments import methods
from fedvla_lib.experiments.plan import Cell, Plan
from fedvla_lib.federation.nodes import client_name
from fedvla_lib.policy.model import Bundle
from fedvla_lib.run_folder import GLOBAL, RunFolder


@dataclass(frozen=True)
class Measured:
    """What training and evaluating a cell brought."""

    rows: list[dict[str, Any]]  # the rollouts
    held_out: dict[str, float]  # averages over held-out frames, and num_examples
    episodes: list[dict[str, float]] = field(default_factory=list)  # the same, of each held-out episode
    rounds: list[dict[str, Any]] = field(default_factory=list)  # events of a federated run before its last round
    # Gradient steps that each model counted while it trained, by its name: global, or client_K where each has its own.
    steps: dict[str, dict[str, int]] = field(default_factory=lambda: {GLOBAL: {"in_all": 0, "in_a_row": 0}})
    bytes: int = 0  # that travelled
    train_s: float = 0.0


def run_plan(plan: Plan, out: Path, say: Callable[[str], None] = print) -> None:
    """Measure every cell that has no folder in `out` yet; a folder appears when its cell is complete."""
    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    todo = [cell for cell in plan.cells if not (out / cell.name).exists()]
    say(f"{len(plan.cells)} cells, {len(plan.cells) - len(todo)} of them in {out}")
    for number, cell in enumerate(todo, 1):
        began = time.perf_counter()
        rate = measure_cell(cell, plan.rollout_seeds, out)
        say(f"[{number}/{len(todo)}] {cell.name}: {rate:.0%} in {time.perf_counter() - began:.0f} s")


def measure_cell(cell: Cell, seeds: Sequence[int], out: Path) -> float:
    """Measure a cell, write its run folder, whole or not at all, and return the success rate."""
    config, began = with_recording(cell.config), time.perf_counter()
    stamp = provenance.first_stamp(cell.config, cell.kind)
    found = MEASURES[cell.kind](config, seeds)
    steps = sum(of_model["in_all"] for of_model in found.steps.values())
    known = {"method": cell.method, "kind": cell.kind, "partition": cell.partition, "steps": found.steps,
             "gradient_steps": steps, "samples": steps * config.batch_size, "bytes": found.bytes,
             "train_s": found.train_s}  # fmt: skip
    ended = {"status": "completed", "wall_s": time.perf_counter() - began, "code": methods.trained_by()}
    with files.new_folder(out / cell.name) as draft:
        files.write_json(draft / "config.json", asdict(cell.config))
        _log(RunFolder(draft), found, 0 if cell.kind == "base" else config.num_server_rounds, steps)
        files.write_json(draft / "stamp.json", stamp | ended | known)
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
    return _of_model(methods.base(config), config, seeds)


def _centralized(config: Config, seeds: Sequence[int]) -> Measured:
    began = time.perf_counter()
    bundle = methods.centralized(config, progress=False)
    seconds = time.perf_counter() - began
    return replace(_of_model(bundle, config, seeds), steps={GLOBAL: methods.counted(config)}, train_s=seconds)


def _federated(config: Config, seeds: Sequence[int]) -> Measured:
    """Measure the last global model; what the run measured of earlier ones is kept, videos left out."""
    folder = methods.federated(config, progress=False)
    events = [event for event in run_folder.read_events(folder) if event["who"] == GLOBAL]
    earlier = [event for event in events if event["round"] < config.num_server_rounds]
    for event in earlier:
        event["values"].pop("video", None)
    return replace(
        _of_model(methods.federated_policy(config), config, seeds),
        rounds=[event for event in earlier if event["kind"] in ("evaluate", "rollout")],
        steps={GLOBAL: run_folder.counted_steps(folder)},
        bytes=_travelled(folder),
        train_s=run_folder.read_stamp(folder)["wall_s"],
    )


def _travelled(folder: Path) -> int:
    replies = run_folder.read_metrics(folder, "replies")
    return int(replies.sent_bytes.sum() + replies.received_bytes.sum())


def _local_only(config: Config, seeds: Sequence[int]) -> Measured:
    """Measure every client's own model: all held-out episodes for each, the rollouts dealt out over them."""
    each, steps, seconds = [], {}, 0.0
    for client in range(config.num_clients):
        began = time.perf_counter()
        bundle = methods.local_only(config, client, progress=False)
        seconds += time.perf_counter() - began
        steps[client_name(client)] = methods.counted(config, client)
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
    found = measure.measure(bundle, recordings.open_frames(config), config, seeds=seeds)
    averages = {"num_examples": found.num_examples, **found.averages} if found.episodes else {}
    return Measured(found.rollouts, averages, found.episodes)


def _clients(config: Config, seeds: Sequence[int]) -> Measured:
    """Measure what each client ends with, its own parts included, on its own tasks and held-out episodes."""
    run = methods.federated(replace(config, fraction_evaluate=1.0, client_rollouts=len(seeds)), progress=False)
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
    return config if config.data else replace(config, data=str(recordings.resolve(replace(config, seed=0))))
