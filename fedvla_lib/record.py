"""Expert demonstrations -> a LeRobotDataset v3.0 folder that survives every kind of interruption.

LeRobot writes an episode into a staging folder inside the data set, where its files are closed. Then they are put in
place one by one, ``meta/info.json``, which counts the episodes, last. Each of these steps is atomic, so from the first
episode on the folder is at any moment a data set that LeRobot opens and that holds complete episodes only; a killed
process (SIGKILL too) loses the episode it was working on and no more. Episode i has its own files, number i, and its
own seeds: what it holds does not depend on when or in how many sittings the recording was made. This module knows
nothing about training.
"""

import json
import os
import shutil
import sys
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from filelock import FileLock
from lerobot.configs import RGBEncoderConfig
from lerobot.datasets import DEFAULT_EPISODES_PATH, LeRobotDataset, aggregate_stats, write_stats
from lerobot.utils.utils import SuppressProgressBars, unflatten_dict
from tqdm.auto import tqdm

from fedvla_lib.expert import Expert
from fedvla_lib.lab import labs
from fedvla_lib.rollout import Episode, run_episode
from fedvla_lib.sim import So100Env
from fedvla_lib.spec import ACTION_KEY, CAMERAS, FPS, JOINT_NAMES, LAB_KEY, NUM_JOINTS, STATE_KEY, image_key
from fedvla_lib.tasks import check_tasks

REPO_ID = "fedvla/so100_sim"  # a name LeRobot asks for; nothing is uploaded
SETTINGS_FILE = "meta/recording.json"
INFO_FILE = "meta/info.json"
STAGING, LOCK = ".staging", ".lock"
OLDER = {"num_labs": 1, "jitter": 0.0}  # recordings made before there were laboratories do not say so
MAX_ATTEMPTS = 20  # seeds tried until the expert succeeds at an episode
MAX_EPISODE_FRAMES = 1000  # frames an encoder may queue; LeRobot drops frames beyond that
ONE_EPISODE_MB = 0.001  # a file is full when it holds one episode: closed files are what an interruption cannot hurt
# Full colour resolution: with yuv420p the small, saturated cube bleeds into the table, and a policy trained on such
# pictures meets the simulator's clean ones. The mean error falls from 4 grey levels to 2 (96 pixels).
VIDEO = {"vcodec": "h264", "pix_fmt": "yuv444p", "preset": "veryfast", "crf": 18, "g": 2}
AVX2 = "AVX2,FMA3,BMI2,LZCNT"  # x264's names of what every processor with AVX-512 has


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


def features(image_size: int, num_labs: int = 1) -> dict[str, dict[str, Any]]:
    """Return LeRobot's feature table of our recordings: state, action, one square video per camera, and the lab."""
    joints = {"dtype": "float32", "shape": (NUM_JOINTS,), "names": list(JOINT_NAMES)}
    video = {"dtype": "video", "shape": (image_size, image_size, 3), "names": ["height", "width", "channels"]}
    lab = {LAB_KEY: {"dtype": "int64", "shape": (1,), "names": None}} if num_labs > 1 else {}
    videos = {image_key(camera): dict(video) for camera in CAMERAS}
    return {STATE_KEY: joints, ACTION_KEY: dict(joints), **videos, **lab}


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
    _write_json(root / SETTINGS_FILE, settings)
    done = _num_recorded(root)
    size, jitter = settings["image_size"], settings["jitter"]
    envs = {task: So100Env(task, size, jitter=jitter) for task in dict.fromkeys(settings["tasks"])}
    places = labs(settings["num_labs"])
    bar = tqdm(initial=done, total=total, desc=f"recording {root.name}", unit="episode", disable=not progress)
    recorder = _Recorder(root, settings, done)
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


class _Recorder:
    """Writes episodes through LeRobot into a staging folder and publishes each one when its files are closed."""

    def __init__(self, root: Path, settings: dict[str, Any], num_recorded: int) -> None:
        self._has_labs = settings["num_labs"] > 1
        self._root, self._staging, self._next = root, root / STAGING, num_recorded
        self._stats = [_stats_of(root, index) for index in range(num_recorded)]
        shutil.rmtree(self._staging, ignore_errors=True)
        av.logging.set_libav_level(av.logging.FATAL)  # no report of each episode; errors are raised
        writing = {
            "repo_id": REPO_ID,
            "root": self._staging,
            "streaming_encoding": True,
            "encoder_queue_maxsize": MAX_EPISODE_FRAMES,
            "encoder_threads": 1,
            "rgb_encoder": _encoder(),
            "video_backend": "pyav",
        }
        if num_recorded:
            _copy_meta(root, self._staging, num_recorded)
            self._dataset = LeRobotDataset.resume(**writing)
        else:
            self._dataset = LeRobotDataset.create(
                **writing,
                fps=FPS,
                features=features(settings["image_size"], settings["num_labs"]),
                robot_type="so100",
                data_files_size_in_mb=ONE_EPISODE_MB,
                video_files_size_in_mb=ONE_EPISODE_MB,
            )

    def add(self, episode: Episode, lab: int) -> None:
        """Write one episode and publish it."""
        where = {LAB_KEY: np.array([lab], dtype=np.int64)} if self._has_labs else {}
        with SuppressProgressBars():
            for frame in _frames(episode):
                self._dataset.add_frame(frame | where)
            self._dataset.save_episode()
        # LeRobot would close these files at the end of the recording; until then they have no footer.
        self._dataset.writer.close_writer()
        self._dataset.meta._close_writer()
        self._publish()
        self._next += 1

    def close(self) -> None:
        """Drop what is not published."""
        self._dataset.finalize()
        shutil.rmtree(self._staging, ignore_errors=True)

    def _publish(self) -> None:
        for path in _episode_files(self._staging, self._next):
            _put(path, self._root / path.relative_to(self._staging))
        # LeRobot's running aggregate depends on where a recording was interrupted; this one does not.
        self._stats.append(_stats_of(self._root, self._next))
        write_stats(aggregate_stats(self._stats), self._staging)
        for name in ("meta/tasks.parquet", "meta/stats.json", INFO_FILE):
            _put(self._staging / name, self._root / name)


def _encoder() -> RGBEncoderConfig:
    """Return the settings of x264, without its code for AVX-512.

    With that, 15 of 6,000 videos of the same episode came out with one block in other bits; with its code for AVX2,
    which gives the bits of the others, none of 6,000.
    """
    has_avx512 = pa.runtime_info().detected_simd_level == "avx512"
    return RGBEncoderConfig(**VIDEO, extra_options={"x264-params": f"asm={AVX2}"} if has_avx512 else {})


def _frames(episode: Episode) -> list[dict[str, Any]]:
    images = {image_key(camera): frames for camera, frames in episode.images.items()}
    return [
        {
            STATE_KEY: episode.states[step],
            ACTION_KEY: episode.actions[step],
            "task": episode.instruction,
            **{key: frames[step] for key, frames in images.items()},
        }
        for step in range(episode.num_frames)
    ]


def _file_name(pattern: str, index: int) -> str:
    """Episode i is in file i, in LeRobot's numbering of 1,000 files to a chunk."""
    chunk_index, file_index = divmod(index, 1000)
    return pattern.format(chunk_index=chunk_index, file_index=file_index)


def _episode_files(root: Path, index: int) -> list[Path]:
    """The closed files of one episode: videos, rows, metadata."""
    name = _file_name("chunk-{chunk_index:03d}/file-{file_index:03d}", index)
    videos = [root / "videos" / image_key(camera) / f"{name}.mp4" for camera in CAMERAS]
    return [*videos, root / "data" / f"{name}.parquet", root / "meta/episodes" / f"{name}.parquet"]


def _stats_of(root: Path, index: int) -> dict[str, dict[str, np.ndarray]]:
    """Statistics of one episode, as its metadata holds them."""
    row = pq.read_table(root / _file_name(DEFAULT_EPISODES_PATH, index)).to_pylist()[0]
    flat = {key.removeprefix("stats/"): value for key, value in row.items() if key.startswith("stats/")}
    return unflatten_dict({key: np.atleast_1d(np.array(value)) for key, value in flat.items()})


def _copy_meta(root: Path, staging: Path, num_recorded: int) -> None:
    """Copy the metadata that LeRobot needs to go on, without files of an episode that was never counted."""
    names = ["meta/info.json", "meta/tasks.parquet", "meta/stats.json"]
    for name in [*names, *(_file_name(DEFAULT_EPISODES_PATH, index) for index in range(num_recorded))]:
        _put(root / name, staging / name)


def _put(source: Path, target: Path) -> None:
    """Copy `source` to `target` so that `target` is never seen half written; LeRobot still needs `source`."""
    target.parent.mkdir(parents=True, exist_ok=True)
    partial = target.with_name(f".{target.name}.partial")
    shutil.copyfile(source, partial)
    os.replace(partial, target)


def _write_json(path: Path, content: dict[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.partial")
    partial.write_text(json.dumps(content, indent=2) + "\n")
    os.replace(partial, path)
