"""Closed-loop evaluation: one row per rollout, optionally with video and trajectory on disk."""

from collections.abc import Collection, Sequence
from contextlib import closing
from copy import copy
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from tqdm.auto import tqdm

from fedvla_lib.config import Config, task_names
from fedvla_lib.evaluation.video import save_rollout
from fedvla_lib.policy.actor import PolicyActor
from fedvla_lib.policy.model import Bundle, uses_one_thread
from fedvla_lib.robot.labs import REFERENCE, Lab, labs
from fedvla_lib.robot.rollout import Episode, act_in_turn, run_episodes
from fedvla_lib.robot.spec import CAMERAS, FPS, Actor
from fedvla_lib.robot.stage import stage_of_process
from fedvla_lib.robot.tasks import ALL_TASKS
from fedvla_lib.workers import side_by_side

AT_ONCE = 16  # rollouts that share one batch of policy inference
WORTH_WORKERS = 8  # groups: fewer take less time than worker processes need to start
FIRST_SEED = 1_000_000  # far from the seeds of recorded demonstrations


def rollout_seeds(count: int, first: int = FIRST_SEED) -> list[int]:
    """Return the seeds of `count` rollouts, the same for every model, so that results are paired."""
    return list(range(first, first + count))


def evaluate(
    actor: Actor, tasks: Sequence[str], seeds: Sequence[int], *, image_size: int, labs: Sequence[Lab] = (REFERENCE,),
    videos_dir: Path | None = None, progress: bool = True, jobs: int = 1,
) -> list[dict[str, Any]]:  # fmt: skip
    """Run one rollout per task and seed, seed s in lab s mod len(labs), and return a row for each.

    Without a video, only the images that the actor observes are rendered, which is faster and gives the same result.

    Args:
        videos_dir: folder for ``rollout_<timestamp>_<task>_<seed>.mp4`` and the trajectory (npz) of each rollout.
        jobs: groups of rollouts that run at a time, each in its own process; the rows do not depend on it.

    Returns:
        Rows: task, instruction, seed, lab (its name), success (bool), steps, completion_time_s (NaN for failures),
        action_smoothness (see `smoothness`) and video (path or None).
    """
    work, found = partial(_group, actor, image_size=image_size, labs=tuple(labs), videos_dir=videos_dir), {}
    groups = [(task, tuple(seeds[i : i + AT_ONCE])) for task in tasks for i in range(0, len(seeds), AT_ONCE)]
    jobs = jobs if len(groups) >= WORTH_WORKERS else 1
    bar = tqdm(total=len(tasks) * len(seeds), desc="rollouts", disable=not progress)
    with bar, closing(stage_of_process(image_size)):
        for group, rows in side_by_side(work, groups, jobs, here=uses_one_thread()):
            found[group] = rows
            bar.update(len(group[1]))
    return [row for group in groups for row in found[group]]


def _group(
    actor: Actor, group: tuple[str, tuple[int, ...]], *, image_size: int, labs: Sequence[Lab], videos_dir: Path | None
) -> list[dict[str, Any]]:
    """Run rollouts of one task; an actor with `act_together` drives them all in one batch."""
    task, seeds = group
    together = getattr(actor, "act_together", act_in_turn)
    envs = stage_of_process(image_size).envs(task, len(seeds))
    for env, seed in zip(envs, seeds, strict=True):
        env.lab = labs[seed % len(labs)]  # a seed is the same scene whatever other seeds are run
        env.cameras = CAMERAS if videos_dir else ()  # none: render only what the actor observes
    at_once = len(seeds) if together is not act_in_turn else 1
    episodes = []
    for i in range(0, len(seeds), at_once):
        actors = [actor] if at_once == 1 else [copy(actor) for _ in seeds]
        episodes += run_episodes(envs[i : i + at_once], actors, seeds[i : i + at_once], together)
    return [_row(episode, env.lab, videos_dir) for episode, env in zip(episodes, envs, strict=True)]


def _row(episode: Episode, lab: Lab, videos_dir: Path | None) -> dict[str, Any]:
    """Return the row of one rollout, see `evaluate`, and write its video."""
    return {
        "task": episode.task, "instruction": episode.instruction, "seed": episode.seed,
        "success": bool(episode.success), "steps": episode.num_frames,
        "completion_time_s": episode.duration_s if episode.success else float("nan"),
        "action_smoothness": smoothness(episode.actions), "lab": lab.name,
        "video": str(save_rollout(episode, Path(videos_dir))) if videos_dir else None,
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


def roll_out_in_places(
    bundle: Bundle, config: Config, seeds: Sequence[int], trained_in: int | None = None
) -> list[dict[str, Any]]:
    """Evaluate one model of labs with one task each; rows as in `evaluate`, with a column place.

    Lab k takes every `num_labs`-th seed from the k-th, on its own task: once in the lab (place "own"), once in
    the next lab, in which nobody recorded (place "unseen").

    Args:
        trained_in: number of the only lab that the model saw. It is measured at that lab's task, and on a quarter of
            the seeds at each of the other tasks, in the labs that have it (place "others"). None: at all labs' tasks.
    """
    tasks, there, rows = task_names(config), labs(config.num_labs + 1), []
    actor = PolicyActor(bundle, config.seed)

    def add(place: str, task: str, chosen: Sequence[int], where: Sequence[Lab]) -> None:
        found = evaluate(actor, [task], chosen, image_size=config.image_size, labs=where, progress=False)
        rows.extend({**row, "place": place} for row in found)

    for k in range(config.num_labs) if trained_in is None else [trained_in]:
        task, own = tasks[k % len(tasks)], seeds[k :: config.num_labs]
        add("own", task, own, [there[k]])
        add("unseen", task, own, [there[-1]])
        for n, other in enumerate(tasks) if trained_in is not None else ():
            if other != task:
                add("others", other, own[: len(own) // 4], there[n : -1 : len(tasks)])
    return rows


def simulates(config: Config) -> bool:
    """Return whether the simulator acts as often as the policy."""
    return config.fps == FPS


def tasks_to_roll_out(config: Config, held: Collection[str]) -> tuple[list[str], str]:
    """Return the tasks of a run that can be rolled out, and in one line why others cannot, or "".

    Args:
        held: what the episodes of the data show; empty if nobody says.
    """
    if not simulates(config):
        return [], f"no rollouts: the policy acts fps={config.fps} times a second, the simulator {FPS}"
    tasks = task_names(config)
    lacking = [task for task in tasks if held and task not in held]
    others = [task for task in ALL_TASKS if task in held and task not in tasks]
    hint = f"; they show {', '.join(others)}: give them as tasks" if others else ""
    why = f"no rollouts of {', '.join(lacking)}: the data show none of them{hint}" if lacking else ""
    return [task for task in tasks if task not in lacking], why


def roll_out(
    bundle: Bundle, config: Config, seeds: Sequence[int], videos_dir: Path | None = None, progress: bool = False,
    jobs: int = 1,
) -> list[dict[str, Any]]:  # fmt: skip
    """Evaluate one model in closed loop on all tasks of the run, in its labs; the rows are those of `evaluate`."""
    return evaluate(
        PolicyActor(bundle, config.seed), task_names(config), seeds, image_size=config.image_size,
        labs=labs(config.num_labs), videos_dir=videos_dir, progress=progress, jobs=jobs,
    )  # fmt: skip
