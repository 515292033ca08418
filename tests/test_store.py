"""Any SO-100 data set of the format opens and is decoded once; errors of a broken one name file and episode."""

import json
import os
import shutil
import threading
from collections.abc import Callable
from pathlib import Path

import av
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from lerobot.configs import RGBEncoderConfig
from lerobot.datasets import LeRobotDataset

from fedvla_lib.data.frame_store import fit_square, open_store
from fedvla_lib.data.lerobot_reader import DataError, locate
from fedvla_lib.files import new_file
from fedvla_lib.robot.spec import ACTION_KEY, CAMERAS, JOINT_NAMES, STATE_KEY, image_key

SIZE = 64  # of the recording in conftest
OLD_NAMES = ["main_" + name.removesuffix(".pos") for name in JOINT_NAMES]


# --- a recorded folder ----------------------------------------------------------------------------------------------


@pytest.mark.integration
def test_frames_are_those_that_lerobot_reads(recording, store):
    dataset = LeRobotDataset("fedvla/test", root=recording, video_backend="pyav", return_uint8=True)
    assert store.num_frames == len(dataset)
    assert store.fps == dataset.fps
    for row in (0, 27, 28, store.num_frames - 1):
        item = dataset[row]
        np.testing.assert_array_equal(store.states[row], item[STATE_KEY])
        np.testing.assert_array_equal(store.actions[row], item[ACTION_KEY])
        assert store.instructions[row] == item["task"]
        for camera in CAMERAS:
            np.testing.assert_array_equal(store.images[camera][row], item[image_key(camera)].permute(1, 2, 0))


@pytest.mark.integration
def test_the_episode_table_tiles_the_rows(store):
    table = store.episodes
    assert list(table["episode_id"]) == list(range(12))
    assert list(table["task"]) == ["lift", "place", "push"] * 4
    assert table["start"].iloc[0] == 0 and table["end"].iloc[-1] == store.num_frames
    assert (table["end"] - table["start"] == table["num_frames"]).all()
    assert (table["start"].to_numpy()[1:] == table["end"].to_numpy()[:-1]).all()


@pytest.mark.integration
def test_a_second_open_maps_the_same_files(recording, store, cache):
    before = {path: path.stat().st_mtime_ns for path in (cache / "frames").rglob("*.npy")}
    again = open_store(recording, image_size=SIZE)
    assert {path: path.stat().st_mtime_ns for path in (cache / "frames").rglob("*.npy")} == before
    assert isinstance(again.images["front"], np.memmap) and not again.images["front"].flags.writeable
    pd.testing.assert_frame_equal(again.episodes, store.episodes)


@pytest.mark.integration
def test_a_changed_data_set_is_not_mistaken_for_the_old_one(recording, store, tmp_path):
    copy = shutil.copytree(recording, tmp_path / "copy")
    edit_table(copy / "data/chunk-000/file-000.parquet", lambda table: set_value(table, ACTION_KEY, 0, 0, 12.5))
    assert open_store(copy, image_size=SIZE, progress=False).actions[0, 0] == 12.5
    assert store.actions[0, 0] != 12.5


@pytest.mark.integration
def test_other_sizes_are_resized(recording, store):
    small = open_store(recording, image_size=16, progress=False)
    assert small.images["front"].shape == (store.num_frames, 16, 16, 3)
    ours, theirs = small.images["front"][5].mean(axis=(0, 1)), store.images["front"][5].mean(axis=(0, 1))
    np.testing.assert_allclose(ours, theirs, atol=3)


@pytest.mark.integration
def test_processes_that_open_at_once_build_once(recording, tmp_path, monkeypatch):
    monkeypatch.setenv("FEDVLA_CACHE", str(tmp_path))
    stores = []
    threads = [
        threading.Thread(target=lambda: stores.append(open_store(recording, image_size=SIZE, progress=False)))
        for _ in range(3)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(stores) == 3
    assert len(list((tmp_path / "frames").glob("*/front.npy"))) == 1
    np.testing.assert_array_equal(stores[0].images["front"], stores[2].images["front"])


@pytest.mark.integration
def test_a_build_that_died_is_made_again(recording, store, tmp_path, monkeypatch):
    monkeypatch.setenv("FEDVLA_CACHE", str(tmp_path))
    broken = shutil.copytree(recording, tmp_path / "broken")
    (broken / "videos" / image_key("front") / "chunk-000/file-011.mp4").rename(tmp_path / "kept.mp4")
    with pytest.raises(DataError, match=r"file-011\.mp4 is missing \(episode 11\)"):
        open_store(broken, image_size=SIZE, progress=False)
    assert not [path for path in (tmp_path / "frames").iterdir() if path.is_dir() and not path.suffix]
    shutil.copy2(tmp_path / "kept.mp4", broken / "videos" / image_key("front") / "chunk-000/file-011.mp4")
    mended = open_store(broken, image_size=SIZE, progress=False)
    np.testing.assert_array_equal(mended.images["front"], store.images["front"])


@pytest.mark.integration
def test_what_killed_processes_left_is_neither_read_nor_kept(recording, store, tmp_path, monkeypatch):
    monkeypatch.setenv("FEDVLA_CACHE", str(tmp_path / "cache"))
    root = shutil.copytree(recording, tmp_path / "recording")
    table = root / "meta/episodes/chunk-000/file-011.parquet"
    try:
        with new_file(table) as draft:
            left = draft.name
            draft.write_bytes(table.read_bytes()[:100])
            raise KeyboardInterrupt
    except KeyboardInterrupt:
        (table.parent / left).write_bytes(b"PAR1")  # as after a kill, which runs no cleanup
    opened = open_store(root, image_size=SIZE, progress=False)
    pd.testing.assert_frame_equal(opened.episodes, store.episodes)
    (built,) = [path for path in (tmp_path / "cache/frames").iterdir() if path.is_dir()]
    left = built.with_name(f".{built.name}.killed")
    built.rename(left)
    open_store(root, image_size=SIZE, progress=False)
    assert built.is_dir() and not left.exists()


# --- other people's data sets ---------------------------------------------------------------------------------------


def write_foreign(root: Path, *, cameras: tuple[str, ...] = ("top", "wrist"), names: list[str] = OLD_NAMES) -> None:
    """Two episodes of 7 and 5 frames at 30 Hz, 48 x 64 pixels, in one file each, as LeRobot records by default.

    Image t of episode e is uniform grey, 10 * t + 100 * e.
    """
    joints = {"dtype": "float32", "shape": (len(names),), "names": names}
    video = {"dtype": "video", "shape": (48, 64, 3), "names": ["height", "width", "channels"]}
    features = {STATE_KEY: joints, ACTION_KEY: dict(joints), **{image_key(name): dict(video) for name in cameras}}
    dataset = LeRobotDataset.create(
        "someone/so100", 30, features, root=root, robot_type="so100", streaming_encoding=True,
        rgb_encoder=RGBEncoderConfig(vcodec="h264", crf=1, preset="veryfast"), encoder_threads=1, video_backend="pyav",
    )  # fmt: skip
    for episode, length in enumerate((7, 5)):
        for step in range(length):
            image = np.full((48, 64, 3), 10 * step + 100 * episode, np.uint8)
            values = np.full(len(names), step, np.float32)
            frame = {
                STATE_KEY: values,
                ACTION_KEY: values + 1,
                "task": ("Stack the blocks.", "Lift the red cube.")[episode],
            }
            dataset.add_frame({**frame, **{image_key(name): image for name in cameras}})
        dataset.save_episode()
    dataset.finalize()


@pytest.mark.integration
def test_a_foreign_data_set_opens_with_its_own_rate_names_and_sizes(tmp_path):
    write_foreign(tmp_path / "data")
    store = open_store(tmp_path / "data", image_size=32, progress=False)
    assert store.fps == 30
    assert sorted(store.images) == ["front", "overhead"]
    assert list(store.episodes["task"]) == ["Stack the blocks.", "lift"]
    assert list(store.episodes["num_frames"]) == [7, 5]
    centre = store.images["front"][:, 16, 16, 0].astype(int)
    np.testing.assert_allclose(centre, [*range(0, 70, 10), *range(100, 150, 10)], atol=3)
    assert store.images["front"][8, 0].max() == 0, "the short side is padded with black"
    np.testing.assert_array_equal(store.states[:, 0], [*range(7), *range(5)])


@pytest.mark.integration
def test_camera_names_can_be_mapped_by_hand(tmp_path):
    write_foreign(tmp_path / "data", cameras=("Camera_1", "Camera_2"))
    with pytest.raises(DataError, match="no camera for overhead, front among Camera_1, Camera_2"):
        open_store(tmp_path / "data", image_size=32)
    store = open_store(tmp_path / "data", image_size=32, cameras={"front": "Camera_2"}, progress=False)
    assert list(store.images) == ["front"]
    with pytest.raises(DataError, match="no camera for front"):
        open_store(tmp_path / "data", image_size=32, cameras={"front": "Camera_3"})


@pytest.mark.integration
def test_an_interrupted_video_of_several_episodes_names_the_episode(tmp_path):
    write_foreign(tmp_path / "data")
    path = tmp_path / "data/videos" / image_key("top") / "chunk-000/file-000.mp4"
    shorten_video(path, keep=9)  # 7 frames of episode 0 and two of episode 1
    with pytest.raises(DataError, match=r"file-000\.mp4, episode 1: the video lacks frame 2 of 5"):
        open_store(tmp_path / "data", image_size=32, progress=False)


@pytest.mark.integration
def test_images_inside_the_table_open_too(tmp_path):
    joints = {"dtype": "float32", "shape": (6,), "names": list(JOINT_NAMES)}
    image = {"dtype": "image", "shape": (16, 16, 3), "names": ["height", "width", "channels"]}
    features = {STATE_KEY: joints, ACTION_KEY: dict(joints), image_key("top"): image}
    dataset = LeRobotDataset.create("someone/images", 10, features, root=tmp_path / "data", use_videos=False)
    images = np.random.default_rng(0).integers(0, 255, (4, 16, 16, 3), dtype=np.uint8)
    for pixels in images:
        values = np.zeros(6, np.float32)
        dataset.add_frame({STATE_KEY: values, ACTION_KEY: values, image_key("top"): pixels, "task": "Wait."})
    dataset.save_episode()
    dataset.finalize()
    store = open_store(tmp_path / "data", image_size=16, progress=False)
    assert list(store.images) == ["overhead"], "one camera is enough"
    np.testing.assert_array_equal(store.images["overhead"], images)


@pytest.mark.unit
def test_a_wide_image_keeps_its_aspect():
    wide = np.full((10, 40, 3), 200, np.uint8)
    square = fit_square(wide, 20)
    assert square.shape == (20, 20, 3)
    assert (square.max(axis=(1, 2)) > 0).sum() == 5


# --- missing data sets ----------------------------------------------------------------------------------------------


@pytest.mark.unit
@pytest.mark.parametrize("name", ["pickplace", "stacking", "sorting"])
def test_offline_the_message_names_the_data_set_and_the_way_out(name):
    with pytest.raises(DataError) as caught:
        locate(f"lerobot/svla_so100_{name}")
    message = str(caught.value)
    assert f"'lerobot/svla_so100_{name}'" in message and "hf download" in message and "\n" not in message


@pytest.mark.unit
@pytest.mark.parametrize("source", ["/no/such/folder", "nowhere", "a/b/c"])
def test_neither_folder_nor_id(source):
    with pytest.raises(DataError, match=f"no data set at {source}"):
        locate(source)


@pytest.mark.unit
def test_a_folder_without_a_data_set(tmp_path):
    with pytest.raises(DataError, match=r"meta/info\.json is missing"):
        open_store(tmp_path, image_size=SIZE)


# --- broken copies of the real recording ----------------------------------------------------------------------------

ROWS = "data/chunk-000/file-005.parquet"
VIDEO = "videos/observation.images.front/chunk-000/file-005.mp4"


def edit_table(path: Path, change: Callable[[pd.DataFrame], object]) -> None:
    table = pq.read_table(path).to_pandas()
    changed = change(table)
    pq.write_table(pa.Table.from_pandas(changed if isinstance(changed, pd.DataFrame) else table), path)


def edit_info(root: Path, change: Callable[[dict], object]) -> None:
    info = json.loads((root / "meta/info.json").read_text())
    change(info)
    (root / "meta/info.json").write_text(json.dumps(info))


def shorten_video(path: Path, keep: int, fps: int | None = None) -> None:
    """Re-encode the first `keep` frames, at `fps` if given."""
    with av.open(str(path)) as container:
        rate = fps or container.streams.video[0].average_rate
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)][:keep]
    with av.open(str(path), "w") as container:
        stream = container.add_stream("h264", rate)
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt = "yuv420p"
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        container.mux(stream.encode())


def set_value(table: pd.DataFrame, key: str, frame: int, joint: int, value: float) -> None:
    vectors = [vector.copy() for vector in table[key]]
    vectors[frame][joint] = value
    table[key] = vectors


DAMAGE: dict[str, tuple[Callable[[Path], object], str]] = {
    "truncated mp4": (
        lambda root: os.truncate(root / VIDEO, (root / VIDEO).stat().st_size // 2),
        rf"{VIDEO} cannot be opened as a video \(episode 5\)",
    ),
    "mp4 with too few frames": (
        lambda root: shorten_video(root / VIDEO, keep=20),
        rf"{VIDEO}, episode 5: the video lacks frame 20 of \d+",
    ),
    "not a video": (lambda root: (root / VIDEO).write_bytes(b"hello"), rf"{VIDEO} cannot be opened .*\(episode 5\)"),
    "missing mp4": (lambda root: (root / VIDEO).unlink(), rf"{VIDEO} is missing \(episode 5\)"),
    "missing rows": (lambda root: (root / ROWS).unlink(), rf"{ROWS} is missing \(episode 5\)"),
    "truncated rows": (
        lambda root: os.truncate(root / ROWS, 2000),
        rf"{ROWS} cannot be read \(episode 5\)",
    ),
    "too few rows": (
        lambda root: edit_table(root / ROWS, lambda table: table.iloc[:-2]),
        rf"{ROWS}, episode 5: has \d+ frames, its metadata says \d+",
    ),
    "missing column": (
        lambda root: edit_table(root / ROWS, lambda table: table.drop(columns=[ACTION_KEY])),
        rf"{ROWS} \(episode 5\) has no column action",
    ),
    "missing metadata": (
        lambda root: (root / "meta/episodes/chunk-000/file-005.parquet").unlink(),
        "meta/episodes: episode 5 is not listed",
    ),
    "seven joints in the rows": (
        lambda root: edit_table(
            root / ROWS, lambda table: table.assign(**{STATE_KEY: [np.zeros(7, np.float32)] * len(table)})
        ),
        rf"{ROWS}, episode 5: observation.state has shape \(7,\), but must have \(6,\)",
    ),
    "seven joints in the description": (
        lambda root: edit_info(root, lambda info: info["features"][ACTION_KEY].update(shape=[7])),
        r"meta/info\.json, every episode: action has shape \(7,\)",
    ),
    "other joint names": (
        lambda root: edit_info(root, lambda info: info["features"][STATE_KEY].update(names=list("xyzabc"))),
        r"meta/info\.json, every episode: observation.state has the columns x, y, z, a, b, c",
    ),
    "joints in another order": (
        lambda root: edit_info(root, lambda info: info["features"][STATE_KEY]["names"].reverse()),
        r"meta/info\.json, every episode: observation.state has the columns gripper.pos",
    ),
    "fps of the description": (
        lambda root: edit_info(root, lambda info: info.update(fps=30)),
        r"file-000.parquet, episode 0: frame 1 is at 0.1000 s, but at fps=30",
    ),
    "fps of a video": (
        lambda root: shorten_video(root / VIDEO, keep=999, fps=25),
        rf"{VIDEO}, episode 5: has 25 frames per second, meta/info.json says 10",
    ),
    "NaN in a state": (
        lambda root: edit_table(root / ROWS, lambda table: set_value(table, STATE_KEY, 3, 5, np.nan)),
        rf"{ROWS}, episode 5: observation.state of frame 3 is nan at gripper.pos",
    ),
    "NaN in an action": (
        lambda root: edit_table(root / ROWS, lambda table: set_value(table, ACTION_KEY, 3, 5, np.nan)),
        rf"{ROWS}, episode 5: action of frame 3 is nan at gripper.pos",
    ),
    "older format": (
        lambda root: edit_info(root, lambda info: info.update(codebase_version="v2.0")),
        r"meta/info\.json says format v2\.0, this reads v3\.0 and v2\.1",
    ),
    "description cut off": (
        lambda root: os.truncate(root / "meta/info.json", 100),
        r"meta/info\.json is not JSON",
    ),
    "a list for a description": (
        lambda root: (root / "meta/info.json").write_text("[]"),
        r"meta/info\.json says format None",
    ),
    "no features": (
        lambda root: edit_info(root, lambda info: info.pop("features")),
        r"meta/info\.json is damaged: features: Field required",
    ),
    "text for the rate": (
        lambda root: edit_info(root, lambda info: info.update(fps="ten")),
        r"meta/info\.json is damaged: fps: Input should be a valid number",
    ),
    "no episodes": (
        lambda root: edit_info(root, lambda info: info.update(total_episodes=0)),
        "has no complete episode",
    ),
}


@pytest.mark.integration
@pytest.mark.parametrize("kind", DAMAGE)
def test_broken_data_is_refused_by_file_and_episode(recording, tmp_path, kind):
    root = shutil.copytree(recording, tmp_path / "copy")
    damage, message = DAMAGE[kind]
    damage(root)
    with pytest.raises(DataError, match=message) as caught:
        open_store(root, image_size=SIZE, progress=False)
    assert str(root) in str(caught.value)
