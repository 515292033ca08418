"""Writing episodes with LeRobot: file layout, video encoding and crash-safe publishing."""

import shutil
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.configs import RGBEncoderConfig
from lerobot.datasets import DEFAULT_EPISODES_PATH, LeRobotDataset, aggregate_stats, write_stats
from lerobot.utils.utils import SuppressProgressBars, unflatten_dict

from fedvla_lib.files import new_file
from fedvla_lib.robot.rollout import Episode
from fedvla_lib.robot.spec import ACTION_KEY, CAMERAS, FPS, JOINT_NAMES, LAB_KEY, NUM_JOINTS, STATE_KEY, image_key

REPO_ID = "fedvla/so100_sim"  # required by LeRobot; nothing is uploaded
SETTINGS_FILE = "meta/recording.json"
INFO_FILE = "meta/info.json"
SHARED_FILES = ("meta/tasks.parquet", "meta/stats.json", INFO_FILE)  # the last one counts the episodes
STAGING, LOCK = ".staging", ".lock"
MAX_EPISODE_FRAMES = 1000  # size of the encoder's queue; LeRobot drops frames when it is full
ONE_EPISODE_MB = 0.001  # one episode per file, so that an interruption cannot damage files of earlier episodes
# yuv444p keeps full colour resolution: with yuv420p the small, saturated cube bleeds into the table, while in rollouts
# the policy sees clean images. The mean error falls from 4 grey levels to 2 (at 96 pixels).
VIDEO = {"vcodec": "h264", "pix_fmt": "yuv444p", "preset": "veryfast", "crf": 18, "g": 2}
AVX2 = "AVX2,FMA3,BMI2,LZCNT"  # in x264's names; every processor with AVX-512 has these


def features(image_size: int, num_labs: int = 1) -> dict[str, dict[str, Any]]:
    """Return LeRobot's features of a recording: state, action, one square video per camera, and the lab if several."""
    joints = {"dtype": "float32", "shape": (NUM_JOINTS,), "names": list(JOINT_NAMES)}
    video = {"dtype": "video", "shape": (image_size, image_size, 3), "names": ["height", "width", "channels"]}
    lab = {LAB_KEY: {"dtype": "int64", "shape": (1,), "names": None}} if num_labs > 1 else {}
    videos = {image_key(camera): dict(video) for camera in CAMERAS}
    return {STATE_KEY: joints, ACTION_KEY: dict(joints), **videos, **lab}


class EpisodeWriter:
    """Writes episodes through LeRobot into a staging folder and publishes each one when its files are closed."""

    def __init__(self, root: Path, settings: dict[str, Any], num_recorded: int) -> None:
        self._root, self._staging = root, root / STAGING
        self._stats = [_stats_of(root, index) for index in range(num_recorded)]
        shutil.rmtree(self._staging, ignore_errors=True)
        av.logging.set_libav_level(av.logging.FATAL)  # no log per episode; errors are raised
        writing = dict(
            repo_id=REPO_ID, root=self._staging, video_backend="pyav", rgb_encoder=_encoder(), encoder_threads=1,
            streaming_encoding=True, encoder_queue_maxsize=MAX_EPISODE_FRAMES,
        )  # fmt: skip
        if num_recorded:
            # What LeRobot needs to resume, without the files of an episode that is not counted yet.
            for name in [*SHARED_FILES, *(_file_name(DEFAULT_EPISODES_PATH, index) for index in range(num_recorded))]:
                _put(root / name, self._staging / name)
            self._dataset = LeRobotDataset.resume(**writing)
        else:
            self._dataset = LeRobotDataset.create(
                **writing, fps=FPS, features=features(settings["image_size"], settings["num_labs"]), robot_type="so100",
                data_files_size_in_mb=ONE_EPISODE_MB, video_files_size_in_mb=ONE_EPISODE_MB,
            )  # fmt: skip

    def add(self, episode: Episode, lab: int) -> None:
        """Write one episode and publish it."""
        columns = {STATE_KEY: episode.states, ACTION_KEY: episode.actions}
        columns |= {image_key(camera): frames for camera, frames in episode.images.items()}
        if LAB_KEY in self._dataset.features:
            columns[LAB_KEY] = np.full((episode.num_frames, 1), lab, np.int64)
        with SuppressProgressBars():
            for step in range(episode.num_frames):
                row = {key: values[step] for key, values in columns.items()}
                self._dataset.add_frame({"task": episode.instruction, **row})
            self._dataset.save_episode()
        # LeRobot closes these files only at the end of a recording, and until then they have no footer.
        self._dataset.writer.close_writer()
        self._dataset.meta._close_writer()
        self._publish(len(self._stats))

    def close(self) -> None:
        """Discard unpublished files."""
        self._dataset.finalize()
        shutil.rmtree(self._staging, ignore_errors=True)

    def _publish(self, index: int) -> None:
        for path in _episode_files(self._staging, index):
            _put(path, self._root / path.relative_to(self._staging))
        # Unlike LeRobot's running aggregate, this does not depend on where a recording was interrupted.
        self._stats.append(_stats_of(self._root, index))
        # Sorted: LeRobot aggregates in the order of a set, which differs from process to process.
        stats = {key: dict(sorted(values.items())) for key, values in sorted(aggregate_stats(self._stats).items())}
        write_stats(stats, self._staging)
        for name in SHARED_FILES:
            _put(self._staging / name, self._root / name)


def _encoder() -> RGBEncoderConfig:
    """Return the settings of x264, with its AVX-512 code disabled.

    With AVX-512, 15 of 6,000 videos of the same episode differed in one block; with AVX2, none of 6,000.
    """
    has_avx512 = pa.runtime_info().detected_simd_level == "avx512"
    return RGBEncoderConfig(**VIDEO, extra_options={"x264-params": f"asm={AVX2}"} if has_avx512 else {})


def _file_name(pattern: str, index: int) -> str:
    """Episode i is in file i; LeRobot puts 1,000 files in a chunk."""
    chunk_index, file_index = divmod(index, 1000)
    return pattern.format(chunk_index=chunk_index, file_index=file_index)


def _episode_files(root: Path, index: int) -> list[Path]:
    """Return the files of one episode: videos, rows, metadata."""
    name = _file_name("chunk-{chunk_index:03d}/file-{file_index:03d}", index)
    videos = [root / "videos" / image_key(camera) / f"{name}.mp4" for camera in CAMERAS]
    return [*videos, root / "data" / f"{name}.parquet", root / "meta/episodes" / f"{name}.parquet"]


def _stats_of(root: Path, index: int) -> dict[str, dict[str, np.ndarray]]:
    row = pq.read_table(root / _file_name(DEFAULT_EPISODES_PATH, index)).to_pylist()[0]
    flat = {key.removeprefix("stats/"): value for key, value in row.items() if key.startswith("stats/")}
    return unflatten_dict({key: np.atleast_1d(np.array(value)) for key, value in flat.items()})


def _put(source: Path, target: Path) -> None:
    """Copy `source` to `target` atomically; LeRobot still needs `source`."""
    with new_file(target) as draft:
        shutil.copyfile(source, draft)
