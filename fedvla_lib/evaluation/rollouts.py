"""Closed-loop evaluation: actor x tasks x seeds -> one row a rollout, with its video and trajectory on disk."""

from collections.abc import Iterator, Sequence
from contextlib import closing
from copy import copy
from pathlib import Path
from typing import Any

import numpy as np
from tqdm.auto import tqdm

from fedvla_lib.config import Config, task_names
from fedvla_lib.evaluation.video import save_rollout
from fedvla_lib.policy import model
from fedvla_lib.policy.actor import PolicyActor
from fedvla_lib.robot.labs import REFERENCE, Lab, labs
from fedvla_lib.robot.rollout import Episode, act_in_turn, run_episodes
from fedvla_lib.robot.sim import So100Env
from fedvla_lib.robot.spec import CAMERAS, FPS, Actor

AT_ONCE = 16  # rollouts that a policy drives at the same time
FIRST_SEED = 1_000_000  # rollout seeds start here, far from the seeds of recorded demonstrations


def rollout_seeds(count: int, first: int = FIRST_SEED) -> list[int]:
    """Return the seeds of `count` evaluation rollouts, the same for every model, so that results are paired."""
    return list(range(first, first + count))


def evaluate(
    actor: Actor,
    tasks: Sequence[str],
    seeds: Sequence[int],
    *,
    image_size: int,
    labs: Sequence[Lab] = (REFERENCE,),
    videos_dir: Path | None = None,
    films: int | None = None,
    progress: bool = True,
) -> list[dict[str, Any]]:
    """Run one rollout per task and seed, seed s in laboratory s mod len(labs), and return a row for each.

    Row: task, instruction, seed, lab (its name), success (bool), steps, completion_time_s (of a success, else NaN),
    action_smoothness (mean absolute second difference of the joint targets, degrees per step squared; lower is
    smoother) and video (path or None). With `videos_dir`, a rollout leaves ``rollout_<timestamp>_<task>_<seed>.mp4``
    and a trajectory beside it; with `films`, only the first so many of each task do. Of a rollout that is not filmed
    nothing is drawn but what the actor looks at, which is faster and has the same result.
    """
    filmed = set(seeds[:films] if videos_dir else ())
    rows = []
    with tqdm(total=len(tasks) * len(seeds), desc="rollouts", disable=not progress) as bar:
        for task in tasks:
            for episode in _episodes(actor, task, seeds, image_size, labs, filmed, bar):
                video = save_rollout(episode, Path(videos_dir)) if episode.images else None
                where = {"lab": _lab(labs, episode.seed).name, "video": str(video) if video else None}
                rows.append(row(episode) | where)
    return rows


def _episodes(
    actor: Actor, task: str, seeds: Sequence[int], image_size: int, labs: Sequence[Lab], filmed: set[int], bar: tqdm
) -> Iterator[Episode]:
    """Yield an episode for each seed; an actor that can choose for many at once does."""
    together = getattr(actor, "act_together", act_in_turn)
    size = min(len(seeds), 1 if together is act_in_turn else AT_ONCE)
    screen = So100Env(task, image_size)
    envs = [screen, *(So100Env(task, image_size, renderer_of=screen) for _ in range(1, size))]
    with closing(screen):
        for start in range(0, len(seeds), max(1, size)):
            group = seeds[start : start + size]
            for env, seed in zip(envs, group, strict=False):
                env.lab = _lab(labs, seed)
                env.cameras = CAMERAS if seed in filmed else ()  # without, it draws only where the actor looks
            actors = [actor] if size == 1 else [copy(actor) for _ in group]
            yield from run_episodes(envs[: len(group)], actors, group, together)
            bar.update(len(group))


def _lab(labs: Sequence[Lab], seed: int) -> Lab:
    return labs[seed % len(labs)]  # by the seed, so that a seed means the same scene in whatever company it is run


def row(episode: Episode) -> dict[str, Any]:
    """Summarise one rollout."""
    return {
        "task": episode.task,
        "instruction": episode.instruction,
        "seed": episode.seed,
        "success": bool(episode.success),
        "steps": episode.num_frames,
        "completion_time_s": episode.num_frames / FPS if episode.success else float("nan"),
        "action_smoothness": smoothness(episode.actions),
    }


def smoothness(actions: np.ndarray) -> float:
    """Mean absolute second difference of joint targets (T, 6): degrees per step squared; 0 for T < 3."""
    if len(actions) < 3:
        return 0.0
    return float(np.abs(np.diff(actions.astype(np.float64), n=2, axis=0)).mean())


def success_rate(rows: Sequence[dict[str, Any]]) -> float:
    """Share of rollouts that succeeded."""
    if not rows:
        raise ValueError("no rollouts: a success rate needs at least one")
    return sum(r["success"] for r in rows) / len(rows)


def roll_out(
    bundle: model.Bundle, config: Config, seeds: Sequence[int], videos_dir: Path | None = None, progress: bool = False
) -> list[dict[str, Any]]:
    """Let one model act on all tasks of the mix, in the laboratories of the run, and return a row for each rollout."""
    return evaluate(
        PolicyActor(bundle, config.seed), task_names(config), seeds, image_size=config.image_size,
        labs=labs(config.num_labs), videos_dir=videos_dir, progress=progress,
    )  # fmt: skip
