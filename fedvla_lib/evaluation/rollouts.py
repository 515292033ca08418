"""Closed-loop evaluation: one row per rollout, optionally with video and trajectory on disk."""

from collections.abc import Iterator, Sequence
from contextlib import closing
from copy import copy
from pathlib import Path
from typing import Any

import numpy as np
from tqdm.auto import tqdm

from fedvla_lib.config import Config, task_names
from fedvla_lib.evaluation.video import save_rollout
from fedvla_lib.policy.actor import PolicyActor
from fedvla_lib.policy.model import Bundle
from fedvla_lib.robot.labs import REFERENCE, Lab, labs
from fedvla_lib.robot.rollout import Episode, act_in_turn, run_episodes
from fedvla_lib.robot.sim import So100Env
from fedvla_lib.robot.spec import CAMERAS, Actor

AT_ONCE = 16  # rollouts that share one batch of policy inference
FIRST_SEED = 1_000_000  # far from the seeds of recorded demonstrations


def rollout_seeds(count: int, first: int = FIRST_SEED) -> list[int]:
    """Return the seeds of `count` rollouts, the same for every model, so that results are paired."""
    return list(range(first, first + count))


def evaluate(
    actor: Actor,
    tasks: Sequence[str],
    seeds: Sequence[int],
    *,
    image_size: int,
    labs: Sequence[Lab] = (REFERENCE,),
    videos_dir: Path | None = None,
    num_videos: int | None = None,
    progress: bool = True,
) -> list[dict[str, Any]]:
    """Run one rollout per task and seed, seed s in lab s mod len(labs), and return a row for each.

    Without a video, only the images that the actor observes are rendered, which is faster and gives the same result.

    Args:
        videos_dir: folder for ``rollout_<timestamp>_<task>_<seed>.mp4`` and the trajectory (npz) of each rollout.
        num_videos: record only the first so many rollouts of each task on video; None records all.

    Returns:
        Rows: task, instruction, seed, lab (its name), success (bool), steps, completion_time_s (NaN for failures),
        action_smoothness (see `smoothness`) and video (path or None).
    """
    with_video = set(seeds[:num_videos] if videos_dir else ())
    rows = []
    bar = tqdm(total=len(tasks) * len(seeds), desc="rollouts", disable=not progress)
    with bar, closing(So100Env(image_size=image_size)) as drawing:
        for task in tasks:
            first = So100Env(task, image_size, renderer_of=drawing)
            for episode in _episodes(actor, first, seeds, labs, with_video, bar):
                video = save_rollout(episode, Path(videos_dir)) if episode.images else None
                lab = _lab(labs, episode.seed).name
                rows.append(row(episode) | {"lab": lab, "video": str(video) if video else None})
    return rows


def _episodes(
    actor: Actor, first: So100Env, seeds: Sequence[int], labs: Sequence[Lab], with_video: set[int], bar: tqdm
) -> Iterator[Episode]:
    """Yield an episode for each seed; an actor with `act_together` drives up to `AT_ONCE` environments in one batch."""
    together = getattr(actor, "act_together", act_in_turn)
    size = min(len(seeds), 1 if together is act_in_turn else AT_ONCE)
    envs = [first, *(So100Env(first.task, first.image_size, renderer_of=first) for _ in range(1, size))]
    for start in range(0, len(seeds), max(1, size)):
        group = seeds[start : start + size]
        for env, seed in zip(envs, group, strict=False):
            env.lab = _lab(labs, seed)
            env.cameras = CAMERAS if seed in with_video else ()  # none: render only what the actor observes
        actors = [actor] if size == 1 else [copy(actor) for _ in group]
        yield from run_episodes(envs[: len(group)], actors, group, together)
        bar.update(len(group))


def _lab(labs: Sequence[Lab], seed: int) -> Lab:
    return labs[seed % len(labs)]  # by seed, so that a seed is the same scene whatever other seeds are run


def row(episode: Episode) -> dict[str, Any]:
    """Return the row of one rollout, see `evaluate`."""
    return {
        "task": episode.task, "instruction": episode.instruction, "seed": episode.seed,
        "success": bool(episode.success), "steps": episode.num_frames,
        "completion_time_s": episode.duration_s if episode.success else float("nan"),
        "action_smoothness": smoothness(episode.actions),
    }  # fmt: skip


def smoothness(actions: np.ndarray) -> float:
    """Mean absolute second difference of joint targets (T, 6), degrees per step²; lower is smoother; 0 for T < 3."""
    if len(actions) < 3:
        return 0.0
    return float(np.abs(np.diff(actions.astype(np.float64), n=2, axis=0)).mean())


def success_rate(rows: Sequence[dict[str, Any]]) -> float:
    """Share of rollouts that succeeded."""
    if not rows:
        raise ValueError("no rollouts: a success rate needs at least one")
    return sum(r["success"] for r in rows) / len(rows)


def roll_out(
    bundle: Bundle, config: Config, seeds: Sequence[int], videos_dir: Path | None = None, progress: bool = False
) -> list[dict[str, Any]]:
    """Evaluate one model in closed loop on all tasks of the run, in its labs; the rows are those of `evaluate`."""
    return evaluate(
        PolicyActor(bundle, config.seed), task_names(config), seeds, image_size=config.image_size,
        labs=labs(config.num_labs), videos_dir=videos_dir, progress=progress,
    )  # fmt: skip
