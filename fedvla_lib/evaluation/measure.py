"""Evaluate one model: error on held-out episodes, then success in closed loop.

Shared by federated rounds, centralized training and experiment cells.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fedvla_lib.config import Config, task_names
from fedvla_lib.data.frame_store import FrameStore
from fedvla_lib.data.splits import held_out_episodes
from fedvla_lib.evaluation.held_out import average, by_episode, held_out_batches, measure_frames
from fedvla_lib.evaluation.rollouts import roll_out, success_rate
from fedvla_lib.policy.model import Bundle
from fedvla_lib.run_folder import RunFolder


@dataclass(frozen=True)
class Measurement:
    """Evaluation results of one model."""

    episodes: list[dict[str, float]]  # for each held-out episode: episode_id, num_examples (frames) and averages
    averages: dict[str, float]  # over all held-out frames, see `held_out.measure_frames`; empty without episodes
    rollouts: list[dict[str, Any]]  # rows of `rollouts.evaluate`

    @property
    def num_examples(self) -> int:
        """Held-out frames measured."""
        return sum(episode["num_examples"] for episode in self.episodes)

    def success(self) -> dict[str, float]:
        """Return the success rate; empty without rollouts."""
        return {"success_rate": success_rate(self.rollouts)} if self.rollouts else {}

    def success_by_task(self, tasks: Sequence[str]) -> dict[str, float]:
        """Return the success rate of each task that has rollouts."""
        by_task = {task: [row for row in self.rollouts if row["task"] == task] for task in tasks}
        return {f"success_rate.{task}": success_rate(rows) for task, rows in by_task.items() if rows}


def measure(
    bundle: Bundle, store: FrameStore | None, config: Config, *, episode_ids: Sequence[int] | None = None,
    seeds: Sequence[int] = (), videos_dir: Path | None = None, progress: bool = False, jobs: int = 1,
) -> Measurement:  # fmt: skip
    """Evaluate a model on held-out episodes and, with `seeds`, in one rollout for each task and seed.

    Args:
        store: None without held-out episodes.
        episode_ids: None takes all held-out episodes.
        videos_dir: folder for videos of the rollouts; None records none.
        jobs: processes that roll out at a time.
    """
    ids = held_out_episodes(store, config) if store and episode_ids is None else episode_ids or []
    episodes, averages = [], {}
    if ids and (batches := held_out_batches(store, ids, config, bundle)):
        frames = measure_frames(bundle, batches, tolerance=config.action_tolerance_deg, seed=config.seed)
        episodes, averages = by_episode(frames, store, ids), average(frames)
    rows = roll_out(bundle, config, seeds, videos_dir, progress, jobs) if len(seeds) and task_names(config) else []
    return Measurement(episodes, averages, rows)


def log_measurement(run: RunFolder, round_number: int, who: str, found: Measurement) -> None:
    """Log an event for each held-out episode and each rollout."""
    for episode in found.episodes:
        run.log(round_number, who, "held-out", episode)
    log_rollouts(run, round_number, who, found.rollouts)


def log_rollouts(run: RunFolder, round_number: int, who: str, rows: Sequence[dict[str, Any]]) -> None:
    """Log an event for each rollout; paths of videos become relative to the run folder, so that it can be moved."""
    for row in rows:
        video = row["video"] and Path(row["video"]).relative_to(run.root).as_posix()
        run.log(round_number, who, "rollout", {**row, "video": video})


def is_validated(config: Config, round_number: int) -> bool:
    """Whether a round's global model is saved and evaluated: every `validate_every` rounds, and before rollouts."""
    return round_number % config.validate_every == 0 or rolls_out(config, round_number)


def rolls_out(config: Config, round_number: int) -> bool:
    """Whether a round ends with closed-loop rollouts: every `eval_every` rounds, and the last."""
    return (config.eval_every > 0 and round_number % config.eval_every == 0) or round_number == config.num_server_rounds
