"""The Flower ServerApp: pool the clients' statistics, run the rounds, save and evaluate each global model.

It leaves the path of the run folder in ``context.state["run"]["folder"]``.
"""

import time
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Protocol, runtime_checkable

from flwr.app import ArrayRecord, ConfigRecord, Context, MetricRecord
from flwr.serverapp import Grid, ServerApp

from fedvla_lib import files, run_folder
from fedvla_lib.config import Config, from_run_config, task_names
from fedvla_lib.data import frame_store, normalisation
from fedvla_lib.evaluation import measure
from fedvla_lib.evaluation.rollouts import rollout_seeds, tasks_to_roll_out
from fedvla_lib.federation import checkpoint, messages, node_keys, privacy
from fedvla_lib.federation.accountant import open_ledger
from fedvla_lib.federation.checkpoint import Checkpoint
from fedvla_lib.federation.client import LOADERS, Loaders
from fedvla_lib.federation.node_keys import Proof
from fedvla_lib.federation.nodes import Roster, TooFewReplies, introduce_nodes, wait_for_nodes
from fedvla_lib.federation.rollout_replies import Rollouts
from fedvla_lib.federation.secure_round import SecureGrid
from fedvla_lib.federation.strategies.build import build_strategy
from fedvla_lib.federation.strategies.checked import Checked
from fedvla_lib.federation.throttled_grid import for_runtime
from fedvla_lib.policy import model
from fedvla_lib.policy.parameters import Arrays, load_arrays, shapes_of
from fedvla_lib.robot.tasks import check_tasks
from fedvla_lib.run_folder import GLOBAL, RunFolder

CONNECT_TIMEOUT_S = 60.0  # for all clients to connect
BEFORE_ALL = -1  # the round before round 0


@runtime_checkable
class ClientStates(Protocol):
    """A grid that can read and restore the states of its clients; else only runs that keep none can be resumed."""

    def client_states(self) -> dict[str, Arrays]:
        """Return the clients' arrays by client and kind, then by name."""

    def restore_clients(self, states: dict[str, Arrays]) -> None:
        """Restore what `client_states` returned."""


def build(loaders: Loaders = LOADERS, *, engine: str = "flower", progress: bool = False, jobs: int = 1) -> ServerApp:
    """Return the ServerApp.

    Args:
        engine: name for the stamp.
        progress: show progress bars for rollouts.
        jobs: processes that roll the global model out at a time.
    """
    app = ServerApp()

    @app.main()
    def main(grid: Grid, context: Context) -> None:
        config = from_run_config(context.run_config)
        proof = node_keys.proof(Path(config.node_keys), context.run_id) if config.node_keys else None
        config = replace(config, node_keys="")  # a run may be resumed with other keys
        with run_folder.start(config, engine=engine) as run:
            context.state["run"] = ConfigRecord({"folder": str(run.root)})
            federate(for_runtime(grid), config, run, loaders, progress, jobs, proof)

    return app


def federate(
    grid: Grid, config: Config, run: RunFolder, loaders: Loaders, progress: bool, jobs: int, proof: Proof | None
) -> None:
    """Run or resume a federation on `grid` and write it to `run`.

    Raises:
        TooFewReplies: too few clients connected, or a round had fewer valid replies than `config.min_replies`.
        ValueError: unusable settings or data.
    """
    check_tasks(task_names(config))
    states = grid if isinstance(grid, ClientStates) else None
    saved = _resume_from(config, run, states)
    # Before any client does: they would all record the same data. A server whose clients have the data may have none.
    store = loaders.open_frames(config) if config.data or not config.client_data else None
    roster = _introduce(grid, config, run, saved is not None, proof)
    pooled = normalisation.pool_stats(roster.plausible_stats(run.log)) if normalisation.asks_clients(config) else {}
    stats = normalisation.common_statistics(config, pooled)
    bundle = model.load_policy(config, normalisation.evaluation_statistics(config, stats, store))
    arrays, done = bundle.shared_arrays(), 0
    if saved:  # in the model's order, not the file's
        arrays, done = {name: saved.arrays[name] for name in arrays}, saved.round
    strategy = build_strategy(
        config, roster=roster, shapes=shapes_of(arrays), report=run.log,
        keep_rollouts=partial(_keep_rollouts, run), rounds_done=done,
    )  # fmt: skip
    if privacy.is_private(config):
        strategy.ledger = open_ledger(config, run.root, strategy.size, len(roster.nodes))
    if config.secure_aggregation:
        grid = SecureGrid(grid, config, shapes_of(arrays), strategy.records, run.log)
    if saved:
        strategy.load_state(checkpoint.nested(saved.strategy))
    measured = _measured(config, store, roster, None if saved else run)
    sent = {messages.STATS: normalisation.pack_stats(stats)}
    strategy.start(
        grid, messages.pack_arrays(arrays), config.num_server_rounds - done, config.round_timeout_s,
        train_config=ConfigRecord(sent), evaluate_config=ConfigRecord(sent),
        evaluate_fn=RoundEnd(measured, store, bundle, run, strategy, states, saved is not None, progress, jobs),
    )  # fmt: skip


@dataclass(frozen=True)
class RoundEnd:
    """Saves and measures the global model of a round, and writes a checkpoint. Flower calls it first for round 0.

    Personal parts of the global model are as they were before training.
    """

    config: Config  # its tasks are those that are rolled out
    store: frame_store.FrameStore | None
    bundle: model.Bundle
    run: RunFolder
    strategy: Checked
    states: ClientStates | None
    resumed: bool
    progress: bool
    jobs: int

    def __call__(self, flower_round: int, record: ArrayRecord) -> MetricRecord | None:
        """End a round, unless an earlier process already did."""
        if self.resumed and flower_round == 0:
            return None
        number, arrays = self.strategy.rounds_done + flower_round, messages.unpack_arrays(record)
        measured = self._evaluate(number, arrays) if measure.is_validated(self.config, number) else {}
        strategy = checkpoint.flat(self.strategy.state())
        clients = checkpoint.flat(self.states.client_states() if self.states else {})
        checkpoint.save(self.run.root, Checkpoint(number, arrays, strategy, clients))
        self.run.remove_models(self.config.keep_last, self.config.keep_every)  # now that the round counts
        return MetricRecord(measured)

    def _evaluate(self, round_number: int, arrays: Arrays) -> dict[str, float]:
        """Save ``global_model/round_N``, measure and log held-out loss, action error and success in closed loop.

        Round 0 is the model before training.
        """
        started = time.perf_counter()
        load_arrays(self.bundle.policy, arrays | self.bundle.own)
        model.save_policy(self.bundle, self.run.model_dir(round_number))
        due = measure.rolls_out(self.config, round_number)
        found = measure.measure(
            self.bundle, self.store, self.config, seeds=rollout_seeds(self.config.eval_rollouts if due else 0),
            videos_dir=self.run.videos_dir(round_number, GLOBAL) if self.config.videos else None,
            progress=self.progress, jobs=self.jobs,
        )  # fmt: skip
        measure.log_measurement(self.run, round_number, GLOBAL, found)
        values = found.averages | found.success() | found.success_by_task(task_names(self.config))
        counted = {"num_examples": found.num_examples, **values, "seconds": time.perf_counter() - started}
        self.run.log(round_number, GLOBAL, "evaluate", counted)
        return values


def _measured(config: Config, store: frame_store.FrameStore | None, roster: Roster, run: RunFolder | None) -> Config:
    """Return the settings with the tasks that can be rolled out only; log to a new run why others cannot."""
    shown = set(store.episodes.task if store else ()).union(*roster.tasks_of.values())
    tasks, why = tasks_to_roll_out(config, shown)
    if why and run:
        run.log(0, GLOBAL, "note", {"detail": why})
    return replace(config, tasks=",".join(tasks))


def _resume_from(config: Config, run: RunFolder, states: ClientStates | None) -> Checkpoint | None:
    """Return the checkpoint to resume from, if there is one, and remove what was written of later rounds."""
    if not config.resume:
        return None
    if not checkpoint.rounds(run.root):  # it ended before the end of round 0, and begins again
        return run_folder.forget_after(run.root, BEFORE_ALL)
    keeps_state = {
        f"strategy={config.strategy}": config.strategy == "scaffold", "keep-optimizer": config.keep_optimizer,
        f"exchange={config.exchange}": config.exchange != "float32", "personal": config.personal,
        f"noise-by={config.noise_by}": config.noise > 0 and config.noise_by != "server",
    }  # fmt: skip
    settings = [setting for setting, kept in keeps_state.items() if kept]
    if settings and not states:
        raise ValueError(
            f"{settings[0]} makes clients keep state between rounds, which is lost when a run ends on this "
            "engine: resume on engine inline, or start a new run"
        )
    found = checkpoint.load(run.root)
    run_folder.forget_after(run.root, found.round)
    if states:
        states.restore_clients(checkpoint.nested(found.clients))
    return found


def _introduce(grid: Grid, config: Config, run: RunFolder, again: bool, proof: Proof | None) -> Roster:
    """Ask clients for partition, frame count and statistics; none of their other data leaves them.

    Args:
        again: they introduced themselves to an earlier process of this run, which logged it.
        proof: that a client holds the key of its number.
    """
    nodes = wait_for_nodes(grid, config.num_clients, CONNECT_TIMEOUT_S)
    asked = {"needs_stats": normalisation.asks_clients(config), "num_clients": config.num_clients}
    asked |= {"frames_cap": config.frames_cap, "proof": proof}
    if privacy.weighs_alike(config):
        asked["most_frames"] = 1
    roster = introduce_nodes(grid, nodes, run.log, config.round_timeout_s, **asked)
    if len(roster.nodes) < config.min_replies:
        raise TooFewReplies(
            f"{len(roster.nodes)} of {len(nodes)} clients could be used, min-replies={config.min_replies} are "
            "required; the rejected ones are in metrics.jsonl"
        )
    for node in roster.nodes if not again else []:
        counted = {"num_examples": roster.examples_of[node], "counted": roster.weight(node)}
        run.log(0, roster.name(node), "data", counted)
    return roster


def _keep_rollouts(run: RunFolder, round_number: int, who: str, rollouts: Rollouts) -> None:
    """Write a client's videos and log its rollouts."""
    folder = run.videos_dir(round_number, who)
    rows, contents = rollouts
    for name, content in contents.items():
        folder.mkdir(parents=True, exist_ok=True)
        files.write_atomically(folder / name, content)
    rows = [{**row, "video": str(folder / row["video"])} for row in rows]
    measure.log_rollouts(run, round_number, who, rows)


app = build()
