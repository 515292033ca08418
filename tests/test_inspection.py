"""The data doctor: each kind of damage is found by name with its mend, and healthy recordings raise no alarm."""

import json
import re
import shlex
import shutil
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from fedvla_lib.cli.main import main
from fedvla_lib.config import from_profile
from fedvla_lib.data import camera_checks, episode_checks, inspection
from fedvla_lib.data.episode_checks import ERROR, NOTE, Take
from fedvla_lib.data.record import record
from fedvla_lib.robot import scene
from fedvla_lib.robot.sim import So100Env, from_radians
from fedvla_lib.robot.spec import FPS, STATE_KEY, image_key
from test_store import edit_info, edit_table, shorten_video

CONFIG = from_profile("tiny")
KEYS = {camera: image_key(camera) for camera in ("overhead", "front")}


def remove(ids):
    return f"remove {sorted(ids)}"


@pytest.fixture(scope="module")
def labs(tmp_path_factory):
    """The two tasks of the ten labs, in four of them."""
    root = tmp_path_factory.mktemp("labs") / "data"
    return record(["square", "tower"], 4, root, image_size=64, num_labs=4, progress=False)


@pytest.fixture(scope="module")
def healthy(recording):
    return inspection.read_recorded(recording)


def alarms(findings):
    return [finding for finding in findings if finding.severity != NOTE]


@pytest.mark.integration
def test_healthy_recordings_of_all_tasks_and_of_several_labs_raise_no_alarm(recording, labs):
    for root, reference in ((recording, None), (labs, None), (labs, recording), (recording, labs)):
        report = inspection.inspect(root, CONFIG, reference)
        assert not alarms(report.findings), inspection.table(report)
    assert report.episodes_per_task == {"lift": 4, "place": 4, "push": 4}
    assert report.training["chunk_s"] == 1.6 and report.training["held_out_episodes"] == 3


@pytest.mark.integration
def test_a_map_of_cameras_is_that_of_the_data_and_not_of_the_reference(recording):
    """What the doctor prints as a mend for swapped cameras: the same call with it must come out otherwise."""
    wrong = replace(CONFIG, camera_map="overhead=front,front=overhead")
    found = alarms(inspection.inspect(recording, wrong, recording).findings)
    assert [finding.mend for finding in found] == ["--camera-map front=front,overhead=overhead"]


# --- one kind of damage each, in arrays -----------------------------------------------------------------------------


def with_joint(takes, joint, change, *, of=("states", "actions"), only=None):
    """Takes in which `change` was applied to a column, of one episode or of all."""

    def changed(take):
        arrays = {name: getattr(take, name).astype(float) for name in of}
        for array in arrays.values():
            array[:, joint] = change(array[:, joint])
        return replace(take, **arrays)

    return [changed(take) if only in (None, take.episode_id) else take for take in takes]


def everywhere(takes, change):
    return [replace(take, states=change(take.states), actions=change(take.actions)) for take in takes]


def frozen_from(first):
    return lambda column: np.where(np.arange(len(column)) < first, column, column[first])


def late(takes):
    return [replace(take, times_s=take.times_s + 0.04 * (np.arange(len(take.times_s)) % 7 == 3)) for take in takes]


def other_rate(takes):
    return [replace(take, times_s=take.times_s * 10 / 15) for take in takes]


def with_text(takes, episode, text):
    return [replace(take, instruction=text) if take.episode_id == episode else take for take in takes]


def cut(takes, episode, frames):
    kept = [{name: getattr(take, name)[:frames] for name in ("times_s", "states", "actions")} for take in takes]
    return [replace(take, **k) if take.episode_id == episode else take for take, k in zip(takes, kept, strict=True)]


RADIANS = np.deg2rad(1.0)
TO_OLD = (np.array([1, -1, 1, 1, 1, 1.0]), np.array([0, 90, 90, 0, 0, 0.0]))
DAMAGE = {
    "jitter": (late, "all|episodes 0, 1", "frames come up to 40 ms too early or late", "remove"),
    "another rate": (other_rate, "all episodes", "15 frames a second, meta/info.json says 10", "fps in meta/info.json"),
    "stuck joint": (
        lambda takes: with_joint(takes, 2, frozen_from(3), of=("states",), only=4), "elbow_flex, episode 4$",
        "stands still while its target moves by", r"remove \[4\]"),
    "stuck gripper": (
        lambda takes: with_joint(takes, 5, frozen_from(0), of=("states",), only=0), "gripper, episode 0$",
        "stands still", r"remove \[0\]"),
    "jumping joint": (
        lambda takes: with_joint(takes, 0, lambda column: column + 70 * (np.arange(len(column)) == 9), only=7),
        "shoulder_pan, episode 7$", "jumps by 7", r"remove \[7\]"),
    "wrapping joint": (
        lambda takes: with_joint(takes, 4, lambda column: (column + 360) % 360), "wrist_roll",
        r"it wraps around", "calibrate the arm"),
    "radians": (
        lambda takes: everywhere(takes, lambda joints: joints * [*[RADIANS] * 5, 1]), "all joints", "radians",
        "by 180 / pi"),
    "-100..100": (
        lambda takes: everywhere(takes, lambda joints: np.clip(joints * [1, 1.95, 1, 1.2, 1, 1], -100, 100)),
        "all joints", r"-100\.\.100", "use_degrees=true"),
    "old degrees": (
        lambda takes: everywhere(takes, lambda joints: joints * TO_OLD[0] + TO_OLD[1]), "shoulder_lift, elbow_flex",
        "old calibration", "90 - shoulder_lift"),
    "gripper 0..1": (
        lambda takes: with_joint(takes, 5, lambda column: column / 100), "gripper", r"0\.\.1", "by 100"),
    "gripper in degrees": (
        lambda takes: with_joint(takes, 5, lambda column: 2 * column - 60), "gripper", "goes from -5", "calibrate"),
    "sign of the lift": (
        lambda takes: with_joint(takes, 1, np.negative), "^shoulder_lift or wrist_flex", "its sign is turned", "by -1"),
    "sign of the wrist": (
        lambda takes: with_joint(takes, 3, np.negative), "^wrist_flex or shoulder_lift", "its sign is turned", "by -1"),
    "sign of the states": (
        lambda takes: with_joint(takes, 0, np.negative, of=("states",)), "shoulder_pan", "opposite signs",
        "drive_mode"),
    "leader and follower": (
        lambda takes: with_joint(takes, 4, lambda column: column + 20, of=("actions",)), "wrist_roll",
        r"usually \+20 degrees from the state", "subtract 20"),
    "out of range": (
        lambda takes: with_joint(takes, 0, lambda column: column + 150), "shoulder_pan", "goes from 1",
        "lerobot-calibrate"),
    "duplicate": (
        lambda takes: [*takes[:-1], replace(takes[2], episode_id=11)], "episode 11", "the same as episode 2",
        r"remove \[11\]"),
    "cut off": (lambda takes: cut(takes, 5, 4), "episode 5", "less than 25%", r"remove \[5\]"),
    "no instruction": (
        lambda takes: with_text(takes, 3, " "), "episode 3", "no instruction", 'episode_tasks .*"3"'),
    "instruction in other letters": (
        lambda takes: with_text(takes, 3, f" {takes[0].instruction.upper()[:-1]}  "), "instructions",
        "in other letters", "task_replacements"),
}  # fmt: skip


@pytest.mark.integration
@pytest.mark.parametrize("kind", DAMAGE)
def test_damaged_arrays_are_found_with_their_mend(healthy, kind):
    change, where, what, mend = DAMAGE[kind]
    assert not alarms(checked(healthy, healthy.takes))
    takes = [replace(take, states=take.states.astype(float)) for take in healthy.takes]
    found = alarms(checked(healthy, change(with_text(takes, 3, takes[0].instruction) if "letters" in kind else takes)))
    assert len({finding.where.split(",")[0] for finding in found}) == 1, (
        found
    )  # a turn of 360 degrees is out of range too
    assert re.search(where, found[0].where) and re.search(what, found[0].what) and re.search(mend, found[0].mend)


def checked(healthy, takes, reference=None):
    """What is found in these episodes; their images are left out."""
    beside = reference and replace(healthy, takes=reference, images={})
    return inspection.check(replace(healthy, takes=takes, images={}), beside, remove, "edit")


@pytest.mark.integration
@pytest.mark.parametrize(
    ("joint", "change", "what", "mend"),
    [
        (2, lambda column: column + 5, r"starts \+[45]\.\d degrees from the reference", "subtract [45]"),
        (2, np.negative, "its sign is turned", "by -1"),
    ],
)
def test_a_shifted_or_turned_joint_is_found_beside_a_reference(healthy, joint, change, what, mend):
    takes = with_joint(healthy.takes, joint, change)
    assert not alarms(checked(healthy, takes)), "nothing tells without a reference"
    (found,) = alarms(checked(healthy, takes, healthy.takes))
    assert found.severity == ERROR and found.where == "elbow_flex"
    assert re.search(what, found.what) and re.search(mend, found.mend)


@pytest.mark.unit
def test_one_sentence_for_all_is_a_note():
    take = Take(0, "Lift it.", np.arange(3) / FPS, np.zeros((3, 6)), np.zeros((3, 6)))
    (found,) = episode_checks.instructions([take, replace(take, episode_id=1)], "edit")
    assert found.severity == NOTE and "all 2 episodes" in found.what


@pytest.mark.unit
def test_the_arm_of_the_checks_is_the_simulated_one():
    env = So100Env("lift", 16, cameras=())
    limits = np.stack([env.action_space.low, env.action_space.high], axis=1)
    np.testing.assert_allclose(episode_checks.LIMITS_DEG, limits[:5], atol=0.1)
    rng = np.random.default_rng(0)
    angles_rad = rng.uniform(*env._limits_rad.T, (200, 6))
    for angles in angles_rad:
        env.data.qpos[:6] = angles
        mujoco.mj_kinematics(env.model, env.data)
        height = env.data.site(scene.GRASP_SITE).xpos[2]
        found = episode_checks.lowest_hand_m(from_radians(angles, env._limits_rad)[None])
        assert abs(found - height) < 0.02


# --- cameras --------------------------------------------------------------------------------------------------------


def with_frames(images, camera, episode, change):
    return images | {camera: [change(f) if i == episode else f for i, f in enumerate(images[camera])]}


def seen(healthy, images, reference=None):
    return [
        *camera_checks.dark(healthy.takes, images, remove), *camera_checks.frozen(healthy.takes, images, FPS, remove),
        *camera_checks.swapped(healthy.takes, images, reference, KEYS, remove),
    ]  # fmt: skip


@pytest.mark.integration
@pytest.mark.parametrize(
    ("change", "what"),
    [
        (np.zeros_like, "dark"),
        (lambda frames: np.full_like(frames, 255), "one colour"),
        (lambda frames: np.concatenate([frames[:5], np.repeat(frames[5:6], len(frames) - 5, 0)]), "the same image"),
    ],
)
def test_a_dark_or_frozen_camera_is_found(healthy, change, what):
    assert not seen(healthy, healthy.images)
    (found,) = seen(healthy, with_frames(healthy.images, "front", 6, change))
    assert found.where == "front, episode 6" and what in found.what and "remove [6]" in found.mend


@pytest.mark.integration
def test_swapped_cameras_are_found_in_some_episodes_and_beside_a_reference_in_all(healthy):
    front, overhead = (healthy.images[camera] for camera in ("front", "overhead"))
    some = {
        camera: [mine[i] if i != 8 else other[i] for i in range(len(mine))]
        for camera, mine, other in (("overhead", overhead, front), ("front", front, overhead))
    }
    (found,) = seen(healthy, some)
    assert found.where == "overhead and front, episode 8" and "remove [8]" in found.mend
    everywhere_swapped = {"overhead": front, "front": overhead}
    assert not seen(healthy, everywhere_swapped)
    (found,) = seen(healthy, everywhere_swapped, healthy.images)
    assert found.mend == "--camera-map overhead=front,front=overhead"


# --- the command ----------------------------------------------------------------------------------------------------


@pytest.mark.integration
def test_the_command_prints_and_writes_what_it_finds(recording, tmp_path, capsys):
    root = shutil.copytree(recording, tmp_path / "my data")
    edit_table(root / "data/chunk-000/file-005.parquet", lambda rows: rows.iloc[:-2])
    assert main(["inspect", str(root), "--profile", "tiny", "--json", str(tmp_path / "out.json")]) == 1
    printed, saved = capsys.readouterr().out, json.loads((tmp_path / "out.json").read_text())
    (found,) = [finding for finding in saved["findings"] if finding["severity"] == ERROR]
    assert found["where"] == "episode 5" and re.fullmatch(r"has \d+ frames, its metadata says \d+", found["what"])
    assert f"{found['where']}: {found['what']}" in printed and f"-> {found['mend']}" in printed
    assert saved["training"]["episodes"] == 11 and saved["episodes_per_task"]["lift"] == 4
    assert found["mend"] == inspection.remove_command(root, [5])


@pytest.mark.integration
def test_the_command_that_is_given_to_remove_episodes_removes_them(recording, tmp_path, monkeypatch):
    from lerobot.scripts.lerobot_edit_dataset import main as edit

    root = shutil.copytree(recording, tmp_path / "my data")
    monkeypatch.setattr("sys.argv", shlex.split(inspection.remove_command(root, [3, 7])))
    edit()
    mended = inspection.inspect(f"{root}-mended", CONFIG)
    assert not alarms(mended.findings) and mended.training["episodes"] == 10


@pytest.mark.integration
def test_a_damaged_video_is_a_finding(recording, tmp_path, capsys):
    root = shutil.copytree(recording, tmp_path / "data")
    shorten_video(root / "videos/observation.images.front/chunk-000/file-005.mp4", keep=20)
    assert main(["inspect", str(root), "--profile", "tiny"]) == 1
    assert "the video lacks frame 20" in capsys.readouterr().out


@pytest.mark.unit
def test_bad_input_is_one_line_and_status_2(recording, tmp_path, capsys):
    assert main(["inspect", str(tmp_path / "none")]) == 2
    assert "no data set at" in capsys.readouterr().err
    root = shutil.copytree(recording, tmp_path / "data")
    edit_info(root, lambda info: info["features"][STATE_KEY].update(names=list("abcdef")))
    assert main(["inspect", str(root)]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "has the columns a, b, c" in said
