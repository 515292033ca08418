"""Records expert demonstrations into a LeRobotDataset v3.0 folder; safe to interrupt at any time.

LeRobot writes each episode into a staging folder inside the data set. Its closed files are then published one by one,
``meta/info.json``, which counts the episodes, last. Each step is atomic, so from the first episode on LeRobot can open
the folder at any moment and finds complete episodes only; a killed process (even by SIGKILL) loses only the current
episode. Episode i has its own files and seeds, so its content does not depend on interruptions.
"""

import sys
from contextlib import closing
from dataclasses import asdict, dataclass, fields
from functools import partial
from pathlib import Path
from typing import Any, TypedDict

import numpy as np
from filelock import FileLock
from tqdm.auto import tqdm

from fedvla_lib.data.episode_writer import INFO_FILE, LOCK, SETTINGS_FILE, STAGING, EpisodeWriter
from fedvla_lib.files import read_json, write_json
from fedvla_lib.robot.expert import Expert
from fedvla_lib.robot.labs import labs
from fedvla_lib.robot.rollout import Episode, run_episode
from fedvla_lib.robot.sim import So100Env
from fedvla_lib.robot.spec import CAMERAS, FPS
from fedvla_lib.robot.stage import stage_of_process
from fedvla_lib.robot.tasks import check_tasks
from fedvla_lib.workers import default_jobs, side_by_side

OLD_DEFAULTS = {"num_labs": 1, "one_task_per_lab": False, "jitter": 0.0}  # what older recordings do not state
WORTH_WORKERS = 30  # episodes: fewer are recorded before workers have started
MAX_ATTEMPTS = 20  # seeds tried per episode until the expert succeeds


@dataclass(frozen=True)
class Scenes:
    """Where the episodes of a recording take place."""

    num_labs: int = 1  # labs to record in, in turn; with more than one, the column ``lab_index`` holds the lab
    one_task_per_lab: bool = False  # lab k records only task k, counted modulo the number of tasks
    jitter: float = 0.0  # above 0, cameras, light and colours are drawn for every episode, with this spread

    def lab_of(self, index: int, num_tasks: int) -> int:
        """Return the lab of an episode; episode i shows task ``i % num_tasks``."""
        return (index if self.one_task_per_lab else index // num_tasks) % self.num_labs


def record(
    tasks: list[str], episodes_per_task: int, root: str | Path, *, image_size: int, seed: int = 0,
    progress: bool = True, **scenes: Any,
) -> Path:  # fmt: skip
    """Record successful expert episodes of `tasks` into the LeRobotDataset v3.0 folder `root`, and return it.

    Episode i shows ``tasks[i % len(tasks)]`` in lab ``Scenes.lab_of`` of `robot.labs.labs`. Existing
    episodes are kept: the same call continues an interrupted recording and does nothing on a complete one; a larger
    `episodes_per_task` extends it. Many are demonstrated side by side (`workers.default_jobs`), with the same bytes.

    Args:
        tasks: names from `robot.tasks.ALL_TASKS`, in the order in which they alternate.
        root: folder to write; a second process recording into it waits for the first.
        image_size: side of the square camera images in pixels, even.
        seed: fixes every episode.
        **scenes: of `Scenes`.

    Raises:
        ValueError: unknown task, unusable size, a folder that is not a recording or has other settings.
        RuntimeError: the expert failed with `MAX_ATTEMPTS` seeds in a row.
    """
    root = Path(root)
    settings = _settings(tasks, episodes_per_task, image_size, seed, Scenes(**scenes))
    _check_folder(root, settings)
    total = episodes_per_task * len(settings["tasks"])
    if _num_recorded(root) == total:
        return root
    # Before the lock: a worker that imports the caller's script would wait for it, instead of being refused.
    jobs = default_jobs() if total - _num_recorded(root) >= WORTH_WORKERS else 1
    root.mkdir(parents=True, exist_ok=True)
    with FileLock(root / LOCK):
        _check_folder(root, settings)  # the previous holder of the lock may have recorded something else
        _record_missing(root, settings, range(_num_recorded(root), total), jobs, progress)
    return root


def demonstration_seed(seed: int, index: int, attempt: int) -> int:
    """Return the environment's seed for the `attempt`-th attempt at episode `index` of a recording."""
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


def _settings(tasks: list[str], episodes_per_task: int, image_size: int, seed: int, scenes: Scenes) -> dict[str, Any]:
    """Return the checked settings that determine the content of a recording."""
    if episodes_per_task < 1 or not tasks:
        raise ValueError(f"cannot record {episodes_per_task} episodes of {tasks}: give 1 or more and at least one task")
    if image_size % 2:
        raise ValueError(f"image_size={image_size} is odd: H.264 video needs an even number of pixels")
    return dict(
        tasks=check_tasks(tasks), image_size=image_size, seed=seed, **asdict(scenes), fps=FPS,
        cameras=list(CAMERAS), episodes_per_task=episodes_per_task,
    )  # fmt: skip


def _check_folder(root: Path, settings: dict[str, Any]) -> None:
    """Raise ValueError unless `root` is empty or a recording with these settings and at most as many episodes."""
    if not (root / SETTINGS_FILE).exists():
        names = {path.name for path in root.iterdir()} if root.is_dir() else set()
        foreign = ", ".join(sorted(names - {STAGING, LOCK}))
        if foreign or root.is_file():
            raise ValueError(f"{root} is not a recording made by this command ({foreign}): give another folder")
        return
    recorded = OLD_DEFAULTS | read_json(root / SETTINGS_FILE)
    for name, value in settings.items():
        before = recorded.get(name)
        if name != "episodes_per_task" and before != value:
            raise ValueError(f"{root} was recorded with {name}={before!r}, not {value!r}: give another folder")
    if _num_recorded(root) > settings["episodes_per_task"] * len(settings["tasks"]):
        raise ValueError(
            f"{root} already has {_num_recorded(root)} episodes, more than episodes_per_task="
            f"{settings['episodes_per_task']} requests: give another folder"
        )


class Recorded(TypedDict):
    """What is read from `INFO_FILE`."""

    total_episodes: int


def _num_recorded(root: Path) -> int:
    path = root / INFO_FILE
    return read_json(path, Recorded)["total_episodes"] if path.exists() else 0


def _record_missing(root: Path, settings: dict[str, Any], missing: range, jobs: int, progress: bool) -> None:
    """Record the episodes that are missing in `root`, in their order."""
    write_json(root / SETTINGS_FILE, settings)
    done, total, waiting, work = missing.start, missing.stop, {}, partial(_demonstrated, settings)
    bar = tqdm(initial=done, total=total, desc=f"recording {root.name}", unit="episode", disable=not progress)
    stage = stage_of_process(settings["image_size"], settings["jitter"])
    with closing(stage), closing(EpisodeWriter(root, settings, done)) as recorder, bar:
        try:
            for index, demonstrated in side_by_side(work, missing, jobs, preload=("lerobot.datasets",)):
                waiting[index] = demonstrated
                while done in waiting:
                    recorder.add(*waiting.pop(done))
                    bar.update()
                    done += 1
        except BaseException:  # bindings of MuJoCo turn a Ctrl-C into a TypeError
            print(f"interrupted: {_num_recorded(root)} of {total} episodes are in {root}, "
                  "run the same command to continue", file=sys.stderr)  # fmt: skip
            raise


def _demonstrated(settings: dict[str, Any], index: int) -> tuple[Episode, int]:
    """Return an episode of a recording, and the number of the lab that it shows."""
    tasks, scenes = settings["tasks"], Scenes(**{field.name: settings[field.name] for field in fields(Scenes)})
    lab = scenes.lab_of(index, len(tasks))
    (env,) = stage_of_process(settings["image_size"], settings["jitter"]).envs(tasks[index % len(tasks)])
    env.lab = labs(settings["num_labs"])[lab]
    return demonstrate(env, index, settings["seed"]), lab
