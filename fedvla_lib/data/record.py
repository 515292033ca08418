"""Expert demonstrations -> a LeRobotDataset v3.0 folder that survives every kind of interruption.

LeRobot writes an episode into a staging folder inside the data set, where its files are closed. Then they are put in
place one by one, ``meta/info.json``, which counts the episodes, last. Each of these steps is atomic, so from the first
episode on the folder is at any moment a data set that LeRobot opens and that holds complete episodes only; a killed
process (SIGKILL too) loses the episode it was working on and no more. Episode i has its own files, number i, and its
own seeds: what it holds does not depend on when or in how many sittings the recording was made. This module knows
nothing about training.
"""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock
from tqdm.auto import tqdm

from fedvla_lib.data.episode_writer import INFO_FILE, LOCK, SETTINGS_FILE, STAGING, EpisodeWriter
from fedvla_lib.files import write_json
from fedvla_lib.robot.expert import Expert
from fedvla_lib.robot.labs import labs
from fedvla_lib.robot.rollout import Episode, run_episode
from fedvla_lib.robot.sim import So100Env
from fedvla_lib.robot.spec import CAMERAS, FPS
from fedvla_lib.robot.tasks import check_tasks

OLDER = {"num_labs": 1, "jitter": 0.0}  # recordings made before there were laboratories do not say so
MAX_ATTEMPTS = 20  # seeds tried until the expert succeeds at an episode


def record(
    tasks: list[str],
    episodes_per_task: int,
    root: str | Path,
    *,
    image_size: int,
    seed: int = 0,
    num_labs: int = 1,
    jitter: float = 0.0,
    progress: bool = True,
) -> Path:
    """Record successful expert episodes of `tasks` into the LeRobotDataset v3.0 folder `root`, and return it.

    Episode i shows ``tasks[i % len(tasks)]``, in laboratory ``(i // len(tasks)) % num_labs`` (`lab.labs`). What the
    folder already holds is kept: the same call continues an interrupted recording and does nothing on a complete one; a
    larger `episodes_per_task` extends it.

    Args:
        tasks: names from `tasks.ALL_TASKS`, in the order in which they alternate.
        episodes_per_task: demonstrations of each task.
        root: folder to write; a second process that records into it waits for the first.
        image_size: side of the square camera images in pixels, even.
        seed: fixes every episode.
        num_labs: laboratories to record in, in turn; with more than one, a column ``lab_index`` says which.
        jitter: above 0, each episode has cameras, light and colours of its own, drawn with this spread.
        progress: show a progress bar.

    Raises:
        ValueError: unknown task, unusable size, a folder that is not ours or was recorded with other settings.
        RuntimeError: the expert failed with `MAX_ATTEMPTS` seeds in a row.
    """
    root = Path(root)
    settings = _settings(tasks, episodes_per_task, image_size, seed, num_labs, jitter)
    _check_folder(root, settings)
    total = episodes_per_task * len(settings["tasks"])
    if _num_recorded(root) == total:
        return root
    root.mkdir(parents=True, exist_ok=True)
    with FileLock(root / LOCK):
        _check_folder(root, settings)  # the process that held the lock may have been a different recording
        _record_missing(root, settings, total, progress)
    return root


def demonstration_seed(seed: int, index: int, attempt: int) -> int:
    """Return the seed of the scene in which episode `index` of a recording is tried for the `attempt`-th time."""
    return int(np.random.SeedSequence([seed, index, attempt]).generate_state(1)[0])


def demonstrate(env: So100Env, index: int, seed: int) -> Episode:
    """Return a successful expert episode of `env`'s task; a pure function of the task, `index` and `seed`.

    Raises:
        RuntimeError: the expert failed with `MAX_ATTEMPTS` seeds in a row.
    """
    for attempt in range(MAX_ATTEMPTS):
        episode = run_episode(env, Expert(), demonstration_seed(seed, index, attempt))
        if episode.success:
            return episode
    raise RuntimeError(f"the expert failed at task {env.task!r}, episode {index}, with {MAX_ATTEMPTS} seeds in a row")


def _settings(
    tasks: list[str], episodes_per_task: int, image_size: int, seed: int, num_labs: int, jitter: float
) -> dict[str, Any]:
    """Everything that decides what an episode holds."""
    if episodes_per_task < 1 or not tasks:
        raise ValueError(f"cannot record {episodes_per_task} episodes of {tasks}: give 1 or more and at least one task")
    if image_size % 2:
        raise ValueError(f"image_size={image_size} is odd: H.264 video needs an even number of pixels")
    return {
        "tasks": check_tasks(tasks),
        "image_size": image_size,
        "seed": seed,
        "num_labs": num_labs,
        "jitter": jitter,
        "fps": FPS,
        "cameras": list(CAMERAS),
        "episodes_per_task": episodes_per_task,
    }


def _check_folder(root: Path, settings: dict[str, Any]) -> None:
    """Raise ValueError unless `root` is empty or a recording with these settings and at most as many episodes."""
    if not (root / SETTINGS_FILE).exists():
        foreign = (
            sorted(path.name for path in root.iterdir() if path.name not in (STAGING, LOCK)) if root.is_dir() else []
        )
        if foreign or root.is_file():
            raise ValueError(
                f"{root} is not a recording made by this command ({', '.join(foreign)}): give another folder"
            )
        return
    found = OLDER | json.loads((root / SETTINGS_FILE).read_text())
    for name, value in settings.items():
        if name != "episodes_per_task" and found.get(name) != value:
            raise ValueError(f"{root} was recorded with {name}={found.get(name)!r}, not {value!r}: give another folder")
    if _num_recorded(root) > settings["episodes_per_task"] * len(settings["tasks"]):
        raise ValueError(
            f"{root} already holds {_num_recorded(root)} episodes, more than episodes_per_task="
            f"{settings['episodes_per_task']} asks for: give another folder"
        )


def _num_recorded(root: Path) -> int:
    path = root / INFO_FILE
    return json.loads(path.read_text())["total_episodes"] if path.exists() else 0


def _record_missing(root: Path, settings: dict[str, Any], total: int, progress: bool) -> None:
    """Record the episodes that `root` lacks; whatever ends this leaves complete episodes only."""
    write_json(root / SETTINGS_FILE, settings)
    done = _num_recorded(root)
    size, jitter = settings["image_size"], settings["jitter"]
    envs = {task: So100Env(task, size, jitter=jitter) for task in dict.fromkeys(settings["tasks"])}
    places = labs(settings["num_labs"])
    bar = tqdm(initial=done, total=total, desc=f"recording {root.name}", unit="episode", disable=not progress)
    recorder = EpisodeWriter(root, settings, done)
    try:
        for index in range(done, total):
            turn, which = divmod(index, len(settings["tasks"]))
            env, lab = envs[settings["tasks"][which]], turn % len(places)
            env.lab = places[lab]
            recorder.add(demonstrate(env, index, settings["seed"]), lab)
            bar.update()
    except KeyboardInterrupt:
        print(f"interrupted: {_num_recorded(root)} of {total} episodes are in {root}, "
              "the same command goes on from there", file=sys.stderr)  # fmt: skip
        raise
    finally:
        bar.close()
        recorder.close()
        for env in envs.values():
            env.close()
