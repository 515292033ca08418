"""Run the cells of a `Plan`: train, evaluate and write one run folder per cell; finished cells are skipped."""

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from fedvla_lib import files, provenance, run_folder
from fedvla_lib.config import Config, task_names
from fedvla_lib.data import recordings
from fedvla_lib.evaluation import measure
from fedvla_lib.evaluation.rollouts import roll_out_in_places, success_rate
from fedvla_lib.experiments import methods
from fedvla_lib.experiments.experiment_file import KINDS, Cell, Plan
from fedvla_lib.federation.nodes import client_name
from fedvla_lib.policy.model import Bundle
from fedvla_lib.run_folder import GLOBAL, RunFolder
from fedvla_lib.workers import side_by_side

FRESH_SEED = 10_000  # added to the seed of a recording, for another one in the same labs
FRESH_PER_LAB = 2  # its demonstrations in each lab


@dataclass(frozen=True)
class Measured:
    """Results of training and evaluating a cell."""

    rows: list[dict[str, Any]]  # the rollouts
    held_out: dict[str, float]  # averages over held-out frames, and num_examples (frames)
    episodes: list[dict[str, float]] = field(default_factory=list)  # the same for each held-out episode
    rounds: list[dict[str, Any]] = field(default_factory=list)  # events of a federated run's earlier rounds
    # Gradient steps as counted while training, by model: global, or client_K where each client has one.
    steps: dict[str, dict[str, int]] = field(default_factory=lambda: {GLOBAL: {"in_all": 0, "in_a_row": 0}})
    bytes: int = 0  # exchanged, both directions
    train_s: float = 0.0
    in_a_row_s: float = 0.0  # the same on as many machines as clients, from the seconds that each client measured


def run_plan(plan: Plan, out: Path, say: Callable[[str], None] = print, jobs: int = 1) -> None:
    """Measure every cell that has no run folder in `out` yet, `jobs` of them at a time, each in its own process.

    Raises:
        ValueError: a cell in `out` has other settings or rollouts than the plan's, or was made by other code.
    """
    out.mkdir(parents=True, exist_ok=True)
    todo = [cell for cell in plan.cells if not (out / cell.name).exists()]
    for cell in plan.cells:
        if cell not in todo:
            _check_stored(out / cell.name, cell, plan)
    say(f"{len(plan.cells)} cells, {len(plan.cells) - len(todo)} of them in {out}")
    measured = side_by_side(partial(_timed, measure_cell, seeds=plan.rollout_seeds, out=out), todo, jobs)
    for number, (cell, (rate, seconds)) in enumerate(measured, 1):
        say(f"[{number}/{len(todo)}] {cell.name}: {rate:.0%} in {seconds:.0f} s")


def _check_stored(folder: Path, cell: Cell, plan: Plan) -> None:
    stamp, stored = run_folder.read_stamp(folder), run_folder.read_config(folder)
    found = {name: stamp.get(name) for name in ("kind", "code", "rollout_seeds")} | provenance.deciding(stored)
    wanted = {"kind": cell.kind, "code": methods.trained_by(), "rollout_seeds": _ends(plan.rollout_seeds)}
    wanted |= provenance.deciding(cell.config)
    if other := [name for name in wanted if found[name] != wanted[name]]:
        made = f"{folder} was made with {other[0].replace('_', '-')}={found[other[0]]!r}, not {wanted[other[0]]!r}"
        raise ValueError(f"{made}: give another folder, or move this one away")


def _ends(seeds: Sequence[int]) -> list[int]:
    return [seeds[0], seeds[-1]]


def _timed(function: Callable[..., Any], *arguments: Any, **options: Any) -> tuple[Any, float]:
    """Return what a function returns, and the seconds that it took."""
    began = time.perf_counter()
    return function(*arguments, **options), time.perf_counter() - began


def measure_cell(cell: Cell, seeds: Sequence[int], out: Path) -> float:
    """Train and evaluate a cell, write its run folder atomically, and return the success rate."""
    config, began = replace(cell.config, videos=False), time.perf_counter()  # nothing shows the videos
    stamp = provenance.first_stamp(cell.config, cell.kind)
    result = MEASURES[cell.kind](config, seeds)
    steps = sum(count["in_all"] for count in result.steps.values())
    costs = {"method": cell.method, "kind": cell.kind, "partition": cell.partition, "steps": result.steps,
             "gradient_steps": steps, "samples": steps * config.batch_size, "bytes": result.bytes,
             "train_s": result.train_s, "in_a_row_s": result.in_a_row_s, "rollout_seeds": _ends(seeds)}  # fmt: skip
    ended = {"status": "completed", "wall_s": time.perf_counter() - began, "code": methods.trained_by()}
    with files.new_folder(out / cell.name) as draft:
        files.write_json(draft / "config.json", asdict(cell.config))
        _log(RunFolder(draft), result, 0 if cell.kind == "base" else config.num_server_rounds, steps)
        files.write_json(draft / "stamp.json", stamp | ended | costs)
    return success_rate(result.rows)


def _log(run: RunFolder, result: Measured, round_number: int, steps: int) -> None:
    for event in result.rounds:
        run.log(event["round"], event["who"], event["kind"], event["values"])
    for episode in result.episodes:
        run.log(round_number, GLOBAL, "held-out", episode)
    for row in result.rows:
        values = {key: row[key] for key in ("task", "lab", "seed", "success", "steps", "client", "place") if key in row}
        run.log(round_number, row.get("who", GLOBAL), "rollout", values)
    run.log(round_number, GLOBAL, "evaluate", {**result.held_out, "gradient_steps": steps})


def _base(config: Config, seeds: Sequence[int]) -> Measured:
    return _measure(methods.base(config), config, seeds)


def _centralized(config: Config, seeds: Sequence[int]) -> Measured:
    bundle, seconds = _timed(methods.centralized, config, progress=False)
    steps = {GLOBAL: methods.counted(config)}
    return replace(_measure(bundle, config, seeds), steps=steps, train_s=seconds, in_a_row_s=seconds)


def _federated(config: Config, seeds: Sequence[int]) -> Measured:
    """Measure the last global model; keep what the run measured of earlier ones, without paths of videos."""
    folder = methods.federated(config, progress=False)
    events = [event for event in run_folder.read_events(folder) if event["who"] == GLOBAL]
    earlier = [event for event in events if event["round"] < config.num_server_rounds]
    for event in earlier:
        event["values"].pop("video", None)
    return replace(
        _measure(methods.federated_policy(config), config, seeds),
        rounds=[event for event in earlier if event["kind"] in ("evaluate", "rollout")],
        **_costs(folder),
    )


def _costs(run: Path) -> dict[str, Any]:
    """Return what training a federation cost, as fields of `Measured`; steps of the shared parts only."""
    replies, train = (run_folder.read_metrics(run, kind) for kind in ("replies", "train"))
    return {
        "steps": {GLOBAL: run_folder.counted_steps(run)},
        "bytes": int(replies[replies["to"] != "evaluate"][["sent_bytes", "received_bytes"]].to_numpy().sum()),
        "train_s": run_folder.read_stamp(run)["wall_s"],
        "in_a_row_s": float(train.groupby("round").seconds.max().sum()),  # each round waits for its slowest client
    }


def _local_only(config: Config, seeds: Sequence[int]) -> Measured:
    """Measure each client's own model on all held-out episodes; the rollouts are divided among the clients."""
    results, steps, seconds = [], {}, []
    for client in range(config.num_clients):
        bundle, took_s = _timed(methods.local_only, config, client, progress=False)
        seconds.append(took_s)
        steps[client_name(client)] = methods.counted(config, client)
        chosen = seeds if config.one_task_per_lab else seeds[client :: config.num_clients]
        result = _measure(bundle, config, chosen, client)
        results.append(replace(result, rows=[{**row, "client": client} for row in result.rows]))
    episodes = pd.DataFrame([episode for result in results for episode in result.episodes])
    return Measured(
        rows=[row for result in results for row in result.rows],
        held_out=pd.DataFrame([result.held_out for result in results]).mean().to_dict(),
        episodes=episodes.groupby("episode_id", as_index=False).mean().to_dict("records") if len(episodes) else [],
        steps=steps,
        train_s=sum(seconds),
        in_a_row_s=max(seconds),
    )


def _measure(bundle: Bundle, config: Config, seeds: Sequence[int], trained_in: int | None = None) -> Measured:
    """Measure one model on all held-out episodes and all tasks, or in the places of labs with one task each.

    Such labs have few demonstrations and hold none out: the model is measured on fresh ones of theirs.
    """
    if config.one_task_per_lab:
        count = FRESH_PER_LAB * config.num_labs // len(task_names(config))
        store = recordings.open_frames(replace(config, seed=config.seed + FRESH_SEED, episodes_per_task=count))
        table = store.episodes if trained_in is None else store.episodes.query("lab == @trained_in")
        result = measure.measure(bundle, store, config, episode_ids=table.episode_id.tolist())
        result = replace(result, rollouts=roll_out_in_places(bundle, config, seeds, trained_in))
    else:
        result = measure.measure(bundle, recordings.open_frames(config), config, seeds=seeds)
    averages = {"num_examples": result.num_examples, **result.averages} if result.episodes else {}
    return Measured(result.rollouts, averages, result.episodes)


def _clients(config: Config, seeds: Sequence[int]) -> Measured:
    """Measure each client's final model, personal parts included, on the client's tasks and held-out episodes."""
    run = methods.federated(replace(config, fraction_evaluate=1.0, client_rollouts=len(seeds)), progress=False)
    rollouts, evaluated = (run_folder.read_metrics(run, kind) for kind in ("rollout", "evaluate"))
    is_last = (evaluated.who != GLOBAL) & (evaluated["round"] == config.num_server_rounds)
    last = evaluated[is_last & (evaluated.num_examples > 0)]
    return Measured(
        rows=rollouts[rollouts.who != GLOBAL].to_dict("records"),
        held_out={"num_examples": int(last.num_examples.sum()),
                  "loss": float(np.average(last.loss, weights=last.num_examples))},
        **_costs(run),
    )  # fmt: skip


MEASURES = dict(zip(KINDS, (_base, _federated, _centralized, _local_only, _clients), strict=True))
