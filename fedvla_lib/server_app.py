"""The Flower ServerApp: pool the clients' statistics, average their training round by round, judge and keep each model.

The run folder's place is left in ``context.state["run"]["folder"]`` for whoever started the app.
"""

import time
from dataclasses import dataclass
from typing import Any

from flwr.app import ArrayRecord, ConfigRecord, Context, MetricRecord
from flwr.serverapp import Grid, ServerApp

from fedvla_lib import clients, data, model, roster, run_folder, strategies, wire
from fedvla_lib.config import Config, from_run_config, task_names
from fedvla_lib.evaluate import rollout_seeds, success_rate
from fedvla_lib.params import load_arrays, shapes_of
from fedvla_lib.run_folder import GLOBAL, RunFolder
from fedvla_lib.tasks import check_tasks
from fedvla_lib.wire import Rollouts

ROUND_TIMEOUT_S = 4 * 3600.0  # a client that has not answered by then is left out of the round
CONNECT_TIMEOUT_S = 60.0  # how long to wait for clients to connect


def build(tools: clients.Tools = clients.TOOLS, *, engine: str = "flower", progress: bool = False) -> ServerApp:
    """Return the ServerApp; `engine` is written into the stamp, `progress` shows bars for rollouts."""
    app = ServerApp()

    @app.main()
    def main(grid: Grid, context: Context) -> None:
        config = from_run_config(context.run_config)
        with run_folder.start(config, engine=engine) as run:
            context.state["run"] = ConfigRecord({"folder": str(run.root)})
            federate(grid, config, run, tools, progress)

    return app


def federate(grid: Grid, config: Config, run: RunFolder, tools: clients.Tools, progress: bool) -> None:
    """Carry out a federated run on `grid` and write it to `run`.

    Raises:
        TooFewReplies: too few clients connected, or a round had fewer good replies than `config.min_replies`.
        ValueError: settings or data that cannot be used.
    """
    check_tasks(task_names(config))
    store = tools.open_frames(config)  # before any client: many of them must not record the same data at once
    members, weights, stats = _introduce(grid, config, run)
    bundle = model.load_policy(config, stats)
    arrays = bundle.shared_arrays()
    strategy = strategies.build(
        config,
        weights,
        roster=members,
        shapes=shapes_of(arrays),
        report=run.log,
        keep_rollouts=lambda round_number, who, rollouts: _keep_rollouts(run, round_number, who, rollouts),
        train_share=config.fraction_train,
        evaluate_share=config.fraction_evaluate,
        min_replies=config.min_replies,
        seed=config.seed,
        exchange=config.exchange,
    )
    strategy.start(
        grid,
        wire.pack_arrays(arrays),
        num_rounds=config.num_server_rounds,
        timeout=ROUND_TIMEOUT_S,
        train_config=ConfigRecord({wire.STATS: wire.pack_stats(stats)}),
        evaluate_config=ConfigRecord({wire.STATS: wire.pack_stats(stats)}),
        evaluate_fn=Judge(config, store, bundle, run, progress),
    )


@dataclass(frozen=True)
class Judge:
    """Keeps and measures the global model after each round: held-out loss, action error, closed-loop success.

    Where parts of the model are personal, the global model has them as they were before training.
    """

    config: Config
    store: data.FrameStore
    bundle: model.Bundle
    run: RunFolder
    progress: bool

    def __call__(self, round_number: int, arrays: ArrayRecord) -> MetricRecord:
        """Save ``global_model/round_N``, measure it, and log what was found; round 0 is the model before training."""
        if not clients.is_validated(self.config, round_number):
            return MetricRecord({})
        started = time.perf_counter()
        load_arrays(self.bundle.policy, wire.unpack_arrays(arrays) | self.bundle.own)
        model.save_policy(self.bundle, self.run.model_dir(round_number))
        held_out = clients.held_out_episodes(self.store, self.config)
        frames, values = clients.validate(self.bundle, self.store, held_out, self.config)
        values |= self._roll_out(round_number)
        seconds = time.perf_counter() - started
        self.run.log(round_number, GLOBAL, "evaluate", {"num_examples": frames, **values, "seconds": seconds})
        return MetricRecord(values)

    def _roll_out(self, round_number: int) -> dict[str, float]:
        """Return the success rate over all tasks and of each, when rollouts are due."""
        config = self.config
        if not config.eval_rollouts or not clients.rolls_out(config, round_number):
            return {}
        videos_dir = self.run.videos_dir(round_number, GLOBAL)
        seeds = rollout_seeds(config.eval_rollouts)
        rows = clients.roll_out(self.bundle, config, seeds, videos_dir, self.progress)
        _log_rollouts(self.run, round_number, GLOBAL, rows)
        by_task = {task: [row for row in rows if row["task"] == task] for task in task_names(config)}
        return {"success_rate": success_rate(rows)} | {
            f"success_rate.{task}": success_rate(of_task) for task, of_task in by_task.items()
        }


def _introduce(grid: Grid, config: Config, run: RunFolder) -> tuple[roster.Roster, dict[int, float], model.Stats]:
    """Learn who holds which partition and how many frames, and pool the clients' statistics.

    Nothing else about the data leaves a client. Returns the roster, each node's share of all frames, the statistics.
    """
    nodes = roster.wait_for_nodes(grid, config.num_clients, CONNECT_TIMEOUT_S)
    members, introductions = roster.call(grid, nodes, run.log, ROUND_TIMEOUT_S)
    if len(introductions) < config.min_replies:
        raise roster.TooFewReplies(
            f"{len(introductions)} of {len(nodes)} clients could be used, min-replies={config.min_replies} are "
            "required; the rejected ones are in metrics.jsonl"
        )
    for one in introductions:
        run.log(0, roster.client_name(one.partition_id), "data", {"num_examples": one.num_examples})
    whole = sum(one.num_examples for one in introductions)
    weights = {node: one.num_examples / whole for node, one in zip(members.partition_of, introductions, strict=True)}
    return members, weights, data.pool_stats([one.stats for one in introductions])


def _keep_rollouts(run: RunFolder, round_number: int, who: str, rollouts: Rollouts) -> None:
    """Write what a client filmed and log its rows."""
    folder = run.videos_dir(round_number, who)
    for name, content in rollouts.files.items():
        folder.mkdir(parents=True, exist_ok=True)
        run_folder.write_atomically(folder / name, content)
    _log_rollouts(run, round_number, who, [{**row, "video": str(folder / row["video"])} for row in rollouts.rows])


def _log_rollouts(run: RunFolder, round_number: int, who: str, rows: list[dict[str, Any]]) -> None:
    for row in rows:
        video = run.relative(row["video"])
        run.log(round_number, who, "rollout", {**row, "video": video})


app = build()
