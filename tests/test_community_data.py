"""Recordings of others: 480 x 640 at 30 frames a second, other cameras, formats v3.0 and v2.1."""

import json
import logging
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from lerobot.configs import RGBEncoderConfig
from lerobot.datasets import LeRobotDataset
from PIL import Image

from fedvla_lib.cli.main import main
from fedvla_lib.config import from_profile
from fedvla_lib.data.batches import batch_of_rows
from fedvla_lib.data.frame_store import fit_square, open_store
from fedvla_lib.data.lerobot_reader import DataError
from fedvla_lib.data.recordings import camera_names, open_frames
from fedvla_lib.policy.model import load_policy
from fedvla_lib.robot.spec import ACTION_KEY, STATE_KEY, image_key
from test_store import OLD_NAMES

pytestmark = pytest.mark.integration
RATE, STEPS = 30, 12  # frames a second; control steps of the simulated arm that each episode shows
NAMES = {"top": "overhead", "wrist": "front"}


def write_as_a_lab_would(root: Path, store, names=NAMES, text="Grab the block.", rate=RATE) -> Path:
    """The first steps of two episodes of the simulated arm, as a camera of 480 x 640 pixels sees them."""
    joints = {"dtype": "float32", "shape": (6,), "names": OLD_NAMES}
    video = {"dtype": "video", "shape": (480, 640, 3), "names": ["height", "width", "channels"]}
    features = {STATE_KEY: joints, ACTION_KEY: dict(joints), **{image_key(name): dict(video) for name in names}}
    encoder = RGBEncoderConfig(vcodec="h264", crf=10, preset="ultrafast")
    dataset = LeRobotDataset.create(
        "someone/so100", rate, features, root=root, robot_type="so100", streaming_encoding=True, rgb_encoder=encoder,
        encoder_threads=1, video_backend="pyav", data_files_size_in_mb=0.001, video_files_size_in_mb=0.001,
        encoder_queue_maxsize=1000,
    )  # fmt: skip
    for start in store.episodes["start"][:2]:
        times = np.arange(STEPS * rate // 10) * 10 / rate  # in control steps
        values = {
            key: np.stack([np.interp(times, np.arange(STEPS), array[start : start + STEPS, i]) for i in range(6)], 1)
            for key, array in ((STATE_KEY, store.states), (ACTION_KEY, store.actions))
        }
        for i, step in enumerate(times.astype(int)):
            row = {key: array[i].astype(np.float32) for key, array in values.items()}
            row |= {image_key(name): wide(store.images[ours][start + step]) for name, ours in names.items()}
            dataset.add_frame({"task": text, **row})
        dataset.save_episode()
    dataset.finalize()
    return root


def wide(image: np.ndarray) -> np.ndarray:
    return np.asarray(Image.fromarray(image).resize((640, 480), Image.Resampling.NEAREST))


@pytest.fixture(scope="module")
def lab(tmp_path_factory, store) -> Path:
    return write_as_a_lab_would(tmp_path_factory.mktemp("community") / "data", store)


@pytest.fixture(scope="module")
def old(tmp_path_factory, lab) -> Path:
    """The same data set in format v2.1: a file for each episode, its metadata in lines of JSON."""
    root = tmp_path_factory.mktemp("old") / "so100"
    info, rows = json.loads((lab / "meta/info.json").read_text()), pd.read_parquet(lab / "meta/episodes")
    (root / "meta").mkdir(parents=True)
    for i, row in rows.iterrows():
        for kind, pattern in (("data", "data"), *((f"videos/{image_key(name)}",) * 2 for name in NAMES)):
            numbers = row[f"{kind}/chunk_index"], row[f"{kind}/file_index"]
            suffix = "parquet" if kind == "data" else "mp4"
            source = lab / pattern / f"chunk-{numbers[0]:03d}" / f"file-{numbers[1]:03d}.{suffix}"
            folder = root / ("data/chunk-000" if kind == "data" else f"videos/chunk-000/{kind.removeprefix('videos/')}")
            folder.mkdir(parents=True, exist_ok=True)
            shutil.copy(source, folder / f"episode_{i:06d}.{suffix}")
    tasks = pd.read_parquet(lab / "meta/tasks.parquet").reset_index()
    stats = [{key: value for key, value in row.items() if key.startswith("stats/")} for _, row in rows.iterrows()]
    write_lines(root / "meta/tasks.jsonl", [{"task_index": 0, "task": tasks.iloc[0]["task"]}])
    episodes = [{"episode_index": i, "tasks": list(row.tasks), "length": row.length} for i, row in rows.iterrows()]
    write_lines(root / "meta/episodes.jsonl", episodes)
    lines = [{"episode_index": i, "stats": nested(each)} for i, each in enumerate(stats)]
    write_lines(root / "meta/episodes_stats.jsonl", lines)
    info |= {
        "codebase_version": "v2.1", "total_chunks": 1, "total_videos": 4,
        "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
        "video_path": "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4",
    }  # fmt: skip
    (root / "meta/info.json").write_text(json.dumps(info))
    return root


def write_lines(path: Path, rows: list[dict]) -> None:
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))


def nested(stats: dict) -> dict:
    found: dict = {}
    for key, value in stats.items():
        _, feature, name = key.split("/")
        plain = [x.tolist() if hasattr(x, "tolist") else x for x in np.atleast_1d(value)]
        found.setdefault(feature, {})[name] = json.loads(json.dumps(plain, default=lambda x: x.tolist()))
    return found


def settings(root: Path, **overrides):
    return from_profile("tiny", data=str(root), **overrides)


# --- rate -----------------------------------------------------------------------------------------------------------


def test_frames_are_picked_by_time_so_that_a_chunk_lasts_as_long_as_it_should(lab, store):
    frames = open_frames(settings(lab))
    assert frames.fps == 10 and list(frames.episodes["num_frames"]) == [STEPS, STEPS]
    for episode, row in enumerate(frames.episodes["start"]):
        start = store.episodes["start"][episode]
        np.testing.assert_allclose(frames.states[row : row + STEPS], store.states[start : start + STEPS], atol=1e-5)
    deltas = {ACTION_KEY: [step / 10 for step in range(8)]}
    theirs = LeRobotDataset("fedvla/test", root=lab, delta_timestamps=deltas, video_backend="pyav")
    batch = batch_of_rows(frames, range(2 * STEPS), 8)
    for row in range(2 * STEPS):
        item = theirs[3 * row]
        assert torch.equal(batch[STATE_KEY][row], item[STATE_KEY])
        real = ~batch["action_is_pad"][row]
        assert torch.equal(real, ~item["action_is_pad"])
        assert torch.equal(batch[ACTION_KEY][row][real], item[ACTION_KEY][real])


@pytest.mark.parametrize(("fps", "rows"), [(30, range(36)), (20, [0, 2, 3, 4, 6, 8, 9]), (7, [0, 4, 9, 13, 17, 21])])
def test_other_rates_take_the_nearest_frame(lab, fps, rows):
    found, every = (open_store(lab, image_size=16, fps=rate, progress=False) for rate in (fps, 30))
    np.testing.assert_array_equal(found.states[: len(rows)], every.states[list(rows)])
    np.testing.assert_array_equal(found.images["front"][: len(rows)], every.images["front"][list(rows)])
    assert found.episodes["num_frames"].tolist() == [int(np.ceil(36 * fps / 30))] * 2


def test_another_rate_and_other_cameras_are_said_each_time_and_more_frames_than_there_are_refused(lab, caplog):
    for _ in range(2):
        caplog.clear()
        with caplog.at_level(logging.WARNING):
            open_frames(settings(lab))
        assert "30 frames a second are resampled to fps=10, the policy's rate" in caplog.text
        assert "camera top is used as overhead, camera wrist is used as front" in caplog.text
    caplog.clear()
    open_frames(settings(lab, fps=30))
    assert "resampled" not in caplog.text
    with pytest.raises(DataError, match="30 frames a second, but the policy acts 60 times: give fps=30"):
        open_frames(settings(lab, fps=60))


def test_recordings_of_this_book_are_used_as_they_are(recording, caplog):
    open_frames(settings(recording))
    assert not caplog.text


# --- images ---------------------------------------------------------------------------------------------------------


def test_a_policy_sees_the_stored_image_as_it_sees_the_cameras_own():
    config = from_profile("tiny", image_size=96)  # the side to which the base resizes
    policy = load_policy(config).policy
    image = np.random.default_rng(0).integers(0, 255, (480, 640, 3), dtype=np.uint8)
    image[100:200, 300:500] = [255, 0, 0]

    def seen(pixels):
        raw = torch.from_numpy(pixels.copy()).permute(2, 0, 1)[None].float() / 255
        return policy.prepare_images({image_key("overhead"): raw, image_key("front"): raw})[0][0]

    torch.testing.assert_close(seen(fit_square(image, config.image_size)), seen(image), atol=1.01 / 255, rtol=0)


# --- cameras --------------------------------------------------------------------------------------------------------


def test_ambiguous_cameras_are_refused_until_a_map_says_which(tmp_path, store, capsys):
    root = write_as_a_lab_would(tmp_path / "data", store, {"phone": "overhead", "laptop": "front", "wrist": "front"})
    with pytest.raises(DataError, match="wrist and laptop could each be camera front: .* camera-map=wrist=front"):
        open_frames(settings(root))
    assert main(["inspect", str(root)]) == 2
    assert "camera-map=wrist=front" in capsys.readouterr().err
    frames = open_frames(settings(root, camera_map="laptop=front"))
    assert sorted(frames.images) == ["front", "overhead"]
    with pytest.raises(DataError, match="no camera for front among phone, laptop, wrist"):
        open_frames(settings(root, camera_map="labtop=front"))
    turned = open_frames(settings(root, camera_map="phone=front,laptop=overhead"))
    np.testing.assert_array_equal(turned.images["front"], frames.images["overhead"])


@pytest.mark.unit
@pytest.mark.parametrize("text", ["top", "top=above", "top=front=wrist", "=front", "top=front,top=overhead"])
def test_a_map_that_is_none_is_refused_in_one_line(text, capsys):
    with pytest.raises(ValueError, match="is not usable: give cameras of the data, each once, as one of overhead"):
        camera_names(from_profile("tiny", camera_map=text))
    assert main(["inspect", "x/y", "--camera-map", text]) == 2
    assert capsys.readouterr().err.count("\n") == 1


# --- format v2.1 ----------------------------------------------------------------------------------------------------


def test_the_older_format_is_read_through_lerobots_converter_and_stays_as_it_was(lab, old, store):
    before = {path: path.stat().st_mtime_ns for path in old.parent.rglob("*")}
    frames, expected = open_frames(settings(old)), open_frames(settings(lab))
    assert {path: path.stat().st_mtime_ns for path in old.parent.rglob("*")} == before
    np.testing.assert_array_equal(frames.actions, expected.actions)
    np.testing.assert_array_equal(frames.images["front"], expected.images["front"])
    assert frames.instructions == expected.instructions
    again = open_frames(settings(old))
    assert again.root == frames.root, "converted once"


def test_what_cannot_be_converted_is_refused_with_the_whole_command(old, tmp_path, cache):
    broken = shutil.copytree(old, tmp_path / "broken")
    (broken / "meta/episodes_stats.jsonl").unlink()
    with pytest.raises(DataError, match="LeRobot's converter ends with FileNotFoundError") as caught:
        open_frames(settings(broken))
    said = str(caught.value)
    command = "convert_dataset_v21_to_v30 --repo-id=local/data --root=COPY --push-to-hub=false"
    assert command in said and str(broken) in said and "\n" not in said
    assert {path.name for path in broken.parent.iterdir()} == {"broken"}


# --- the doctor -----------------------------------------------------------------------------------------------------


def test_the_doctor_reads_them_and_says_what_training_will_do(lab, old, capsys, tmp_path):
    for root in (lab, old):
        assert main(["inspect", str(root), "--profile", "tiny", "--json", str(tmp_path / "out.json")]) == 0
        assert "30 frames a second are resampled to fps=10" in capsys.readouterr().out
        facts = json.loads((tmp_path / "out.json").read_text())["training"]
        assert facts["cameras"] == {"overhead": "top", "front": "wrist"} and facts["chunk_s"] == 1.6
        assert facts["unknown_tasks"] == ["Grab the block."]
    assert main(["inspect", str(lab), "--fps", "60"]) == 1
    assert "train with --fps 30" in capsys.readouterr().out
