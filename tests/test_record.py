"""A recording is a valid LeRobot data set at every moment; interruptions do not change the result."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import av
import imageio.v3 as iio
import numpy as np
import pyarrow.parquet as pq
import pytest
from lerobot.datasets import LeRobotDataset

from conftest import heed_interrupts
from fedvla_lib.data import episode_writer
from fedvla_lib.data.record import _num_recorded, demonstrate, record
from fedvla_lib.robot.rollout import Episode
from fedvla_lib.robot.sim import So100Env
from fedvla_lib.robot.spec import ACTION_KEY, CAMERAS, FPS, JOINT_NAMES, STATE_KEY, image_key
from fedvla_lib.robot.tasks import task_of

SIZE = 32
NUM_PUTS = 7  # files published per episode: two videos, rows, metadata, and three shared ones


def lerobot_opens(root: Path) -> LeRobotDataset:
    return LeRobotDataset("fedvla/test", root=root, video_backend="pyav")


def made_up_episode(index: int, length: int = 5) -> Episode:
    """Return random data that depends on `index` only."""
    rng = np.random.default_rng(index)
    return Episode(
        task="lift",
        instruction=f"Lift the {('red', 'green')[index % 2]} cube.",
        seed=index,
        states=rng.normal(size=(length, 6)).astype(np.float32),
        actions=rng.normal(size=(length, 6)).astype(np.float32),
        images={camera: rng.integers(0, 255, (length, SIZE, SIZE, 3), dtype=np.uint8) for camera in CAMERAS},
        success=True,
    )


def write(root: Path, until: int) -> None:
    """Extend the made-up recording in `root` to `until` episodes."""
    done = _num_recorded(root)
    recorder = episode_writer.EpisodeWriter(root, {"image_size": SIZE, "num_labs": 1}, done)
    try:
        for index in range(done, until):
            recorder.add(made_up_episode(index), lab=0)
    finally:
        recorder.close()


def contents(root: Path) -> dict[str, object]:
    """Return all files: tables as tables, the rest as bytes."""
    paths = [path for part in ("meta", "data", "videos") for path in (root / part).rglob("*") if path.is_file()]
    assert not [path for path in paths if path.name.startswith(".")], "incomplete files are left"
    return {
        str(path.relative_to(root)): pq.read_table(path) if path.suffix == ".parquet" else path.read_bytes()
        for path in paths
    }


def assert_same(root: Path, whole: Path) -> None:
    """Compare two recordings file by file and report the columns or frames that differ."""
    found, wanted = contents(root), contents(whole)
    assert sorted(found) == sorted(wanted)
    different = [name for name in sorted(wanted) if found[name] != wanted[name]]
    assert not different, "\n".join(f"{name}: {difference(root / name, whole / name)}" for name in different)


def difference(path: Path, other: Path) -> str:
    """Describe the columns or frames in which two files differ."""
    if path.suffix == ".parquet":
        found, wanted = pq.read_table(path), pq.read_table(other)
        return f"columns {[name for name in wanted.column_names if not found[name].equals(wanted[name])]}"
    if path.suffix != ".mp4":
        return "other bytes"
    found, wanted = (np.asarray(iio.imread(file, plugin="pyav"), dtype=int) for file in (path, other))
    if found.shape != wanted.shape:
        return f"{found.shape} pixels in place of {wanted.shape}"
    apart = np.abs(found - wanted)
    return f"frames {np.flatnonzero(apart.any(axis=(1, 2, 3)))} of {len(wanted)}, up to {apart.max()} grey levels"


@pytest.mark.integration
def test_lerobot_reads_back_what_the_expert_did(recording):
    dataset = lerobot_opens(recording)
    episode = demonstrate(So100Env("place", 64), index=1, seed=0)
    rows = [dataset[i] for i in range(len(dataset)) if dataset.hf_dataset[i]["episode_index"] == 1]
    assert len(rows) == episode.num_frames
    assert dataset.fps == FPS
    assert dataset.features[STATE_KEY]["names"] == list(JOINT_NAMES) == dataset.features[ACTION_KEY]["names"]
    np.testing.assert_array_equal(np.stack([row[STATE_KEY] for row in rows]), episode.states)
    np.testing.assert_array_equal(np.stack([row[ACTION_KEY] for row in rows]), episode.actions)
    assert {row["task"] for row in rows} == {episode.instruction}
    for camera in CAMERAS:
        seen = np.stack([row[image_key(camera)].permute(1, 2, 0) for row in rows]) * 255
        assert np.abs(seen - episode.images[camera]).mean() < 3, "H.264 changes at most a few grey levels"


@pytest.mark.integration
def test_tasks_alternate_and_statistics_are_there(recording):
    dataset = lerobot_opens(recording)
    assert dataset.num_episodes == 12
    tasks = [task_of(texts[0]) for texts in dataset.meta.episodes["tasks"]]
    assert tasks == ["lift", "place", "push"] * 4
    states = np.stack([row[STATE_KEY].numpy() for row in dataset.hf_dataset])
    np.testing.assert_allclose(dataset.meta.stats[STATE_KEY]["mean"], states.mean(axis=0), rtol=1e-4, atol=1e-3)
    assert dataset.meta.stats[STATE_KEY]["count"] == len(states)


@pytest.mark.integration
def test_the_same_command_on_a_complete_folder_changes_nothing(recording):
    before = {path: path.stat().st_mtime_ns for path in recording.rglob("*")}
    assert record(["lift", "place", "push"], 4, recording, image_size=64) == recording
    assert {path: path.stat().st_mtime_ns for path in recording.rglob("*")} == before


@pytest.mark.integration
@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"tasks": ["place", "lift", "push"]}, "tasks="),
        ({"image_size": 96}, "image_size=64, not 96"),
        ({"seed": 1}, "seed=0, not 1"),
        ({"episodes_per_task": 3}, "already has 12 episodes"),
    ],
)
def test_other_settings_on_an_existing_folder_are_refused(recording, change, reason):
    settings = {"tasks": ["lift", "place", "push"], "episodes_per_task": 4, "image_size": 64, "seed": 0, **change}
    with pytest.raises(ValueError, match=reason) as caught:
        record(root=recording, **settings)
    assert str(recording) in str(caught.value)


@pytest.mark.unit
@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"tasks": ["juggle"]}, "unknown task 'juggle': choose one of lift, place, push"),
        ({"tasks": []}, "at least one task"),
        ({"episodes_per_task": 0}, "give 1 or more"),
        ({"image_size": 33}, "image_size=33 is odd"),
    ],
)
def test_unusable_requests_are_refused_before_anything_is_written(tmp_path, change, reason):
    settings = {"tasks": ["lift"], "episodes_per_task": 1, "image_size": SIZE, **change}
    with pytest.raises(ValueError, match=reason):
        record(root=tmp_path / "new", **settings)
    assert not (tmp_path / "new").exists()


@pytest.mark.unit
def test_a_folder_with_other_files_is_left_alone(tmp_path):
    (tmp_path / "thesis.txt").write_text("mine")
    with pytest.raises(ValueError, match=r"thesis\.txt"):
        record(["lift"], 1, tmp_path, image_size=SIZE)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]


@pytest.mark.integration
def test_dying_at_any_moment_of_publishing_leaves_complete_episodes_and_the_same_result(tmp_path, monkeypatch):
    """Publishing writes several files per episode; interrupt before each of them in turn, in the second episode."""
    write(tmp_path / "whole", 3)
    move = episode_writer._put
    for survived in range(NUM_PUTS):
        root, moved = tmp_path / f"died_after_{survived}", 0

        def dying(source: Path, target: Path, survived: int = survived, root: Path = root) -> None:
            nonlocal moved
            if target.is_relative_to(root) and ".staging" not in target.parts:
                if moved == NUM_PUTS + survived:
                    raise KeyboardInterrupt
                moved += 1
            move(source, target)

        with monkeypatch.context() as patch:
            patch.setattr(episode_writer, "_put", dying)
            with pytest.raises(KeyboardInterrupt):
                write(root, 3)
        dataset = lerobot_opens(root)
        assert dataset.num_episodes == 1 and len(dataset) == 5
        assert dataset[4][image_key("front")].shape == (3, SIZE, SIZE)
        write(root, 3)
        assert_same(root, tmp_path / "whole")


@pytest.mark.unit
def test_x264_is_kept_from_its_code_whose_bits_vary(tmp_path):
    """x264 logs the CPU capabilities that it uses."""
    av.logging.set_level(av.logging.INFO)
    try:
        with av.logging.Capture() as log, av.open(str(tmp_path / "video.mp4"), "w") as video:
            stream = video.add_stream("h264", FPS, options=episode_writer._encoder().get_codec_options(1, True))
            stream.width, stream.height, stream.pix_fmt = SIZE, SIZE, "yuv444p"
            video.mux(stream.encode(av.VideoFrame(SIZE, SIZE, "yuv444p")))
            video.mux(stream.encode())
    finally:
        av.logging.set_level(None)
    text = "".join(line for _, _, line in log)
    assert "using cpu capabilities" in text and "AVX512" not in text and "error" not in text.lower()


@pytest.mark.integration
@pytest.mark.parametrize("name", ["SIGKILL", "SIGINT"])
def test_a_killed_recording_holds_complete_episodes_and_continues_to_the_same_result(tmp_path, name):
    root, whole = tmp_path / "killed", tmp_path / "whole"
    command = (
        f"from fedvla_lib.data.record import record; record(['lift'], 50, {str(root)!r}, image_size={SIZE}, seed=3)"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", command], stderr=subprocess.PIPE, text=True, preexec_fn=heed_interrupts
    )
    deadline = time.monotonic() + 300
    while _num_recorded(root) < 2 and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.01)
    os.kill(process.pid, getattr(signal, name))
    _, message = process.communicate(timeout=60)
    done = _num_recorded(root)
    dataset = lerobot_opens(root)
    assert 2 <= done == dataset.num_episodes < 50
    assert len(dataset) == sum(dataset.meta.episodes["length"])
    assert dataset[len(dataset) - 1][image_key("overhead")].shape == (3, SIZE, SIZE)
    if name == "SIGINT":
        assert f"interrupted: {done} of 50 episodes are in {root}" in message
        assert not (root / ".staging").exists()
    record(["lift"], done + 1, root, image_size=SIZE, seed=3, progress=False)
    record(["lift"], done + 1, whole, image_size=SIZE, seed=3, progress=False)
    assert not (root / ".staging").exists()
    assert_same(root, whole)
    assert json.loads((root / "meta/info.json").read_text())["total_episodes"] == done + 1
