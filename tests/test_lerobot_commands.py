"""LeRobot's own commands, unchanged, on the simulated arm: each is its `main` with a command line, in this process.

Their clock is simulated, so that an episode has as many frames on a busy machine as on an idle one.
"""

import importlib.metadata
import json
import logging
import os
import re
import shlex
import socket
import sys
import threading
import time
import zipfile
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from lerobot.cameras.opencv import OpenCVCameraConfig
from lerobot.datasets import LeRobotDataset
from lerobot.robots.so_follower import SO101Follower, SO101FollowerConfig
from lerobot.robots.so_follower import so_follower as so_follower_module
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError
from lerobot.utils.import_utils import register_third_party_plugins

from fedvla_book import lerobot_commands
from fedvla_lib.config import from_profile
from fedvla_lib.policy import model
from fedvla_lib.policy.portable import export
from fedvla_lib.robot.config_lerobot_robot import So100SimRobotConfig
from fedvla_lib.robot.config_lerobot_teleoperator import So100ScriptConfig
from fedvla_lib.robot.expert import Expert
from fedvla_lib.robot.lerobot_robot import So100SimRobot
from fedvla_lib.robot.lerobot_teleoperator import So100Script
from fedvla_lib.robot.spec import ACTION_KEY, JOINT_NAMES, STATE_KEY
from make_zip import build_plugins

pytestmark = pytest.mark.integration
ROOT = Path(__file__).parents[1]
PLUGINS = {"lerobot_env_so100_sim", "lerobot_robot_so100_sim", "lerobot_teleoperator_so100_script"}
FPS, EPISODE_S, RESET_S = 30, 3, 1
TASK = "Lift the red cube."
CAMERAS = {
    name: OpenCVCameraConfig(index_or_path=index, fps=FPS, width=160, height=120)
    for index, name in enumerate(("overhead", "front"))
}
CAMERA_FLAG = "{overhead: {type: opencv, index_or_path: 0, width: 160, height: 120, fps: 30}, "
CAMERA_FLAG += "front: {type: opencv, index_or_path: 1, width: 160, height: 120, fps: 30}}"


@pytest.fixture(scope="module", autouse=True)
def plugins(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """The three distributions, built as for the zip and put on the path of this process alone."""
    folder = tmp_path_factory.mktemp("plugins")
    for wheel in build_plugins(ROOT, folder):
        zipfile.ZipFile(wheel).extractall(folder / "site")
    level = logging.getLogger().level
    sys.path.insert(0, str(folder / "site"))
    yield
    sys.path.remove(str(folder / "site"))
    logging.getLogger().setLevel(level)


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The working directory of the commands; what they write besides stays in it."""
    folder, before = tmp_path_factory.mktemp("place"), Path.cwd()
    os.chdir(folder)
    yield folder
    os.chdir(before)


def lerobot(module: str, *arguments: object) -> None:
    """Run a command of LeRobot on a simulated clock."""
    lerobot_commands.run(module.removeprefix("scripts.").replace("_", "-"), list(map(str, arguments)))


ROBOT = (
    "--robot.type=so100_sim",
    "--robot.id=arm",
    "--robot.color=red",
    f"--robot.cameras={CAMERA_FLAG}",
    "--robot.calibration_dir=calibration",
)
SCRIPT = (
    "--teleop.type=so100_script", "--teleop.robot_id=arm", "--teleop.calibration_dir=calibration",
    f"--teleop.episode_time_s={EPISODE_S}", f"--teleop.reset_time_s={RESET_S}",
)  # fmt: skip


@pytest.fixture
def said() -> Iterator[list[str]]:
    """What the simulated arm logs; LeRobot's commands remove the handlers of others from the root."""
    lines, handler = [], logging.Handler()
    handler.emit = lambda record: lines.append(record.getMessage())
    loggers = [logging.getLogger(f"fedvla_lib.robot.lerobot_{name}") for name in ("robot", "teleoperator")]
    for logger in loggers:
        logger.setLevel(logging.INFO)
        logger.addHandler(handler)
    yield lines
    for logger in loggers:
        logger.removeHandler(handler)


@pytest.fixture(scope="module")
def recorded(place: Path) -> LeRobotDataset:
    """Two episodes of the script, recorded with lerobot-record."""
    lerobot(
        "scripts.lerobot_record", *ROBOT, *SCRIPT, "--dataset.repo_id=me/lift", f"--dataset.root={place / 'lift'}",
        "--dataset.num_episodes=2", f"--dataset.episode_time_s={EPISODE_S}", f"--dataset.reset_time_s={RESET_S}",
        f"--dataset.single_task={TASK}", "--dataset.push_to_hub=false", "--play_sounds=false", f"--dataset.fps={FPS}",
        "--dataset.rgb_encoder.vcodec=h264",
    )  # fmt: skip
    return LeRobotDataset("me/lift", root=place / "lift")


@pytest.fixture(scope="module")
def policy(place: Path) -> Path:
    """A nano policy with random weights, exported for LeRobot's commands."""
    stats = {
        key: {"mean": np.array([0, -30, 20, 70, 0, 30.0]), "std": np.full(6, 5.0)} for key in (STATE_KEY, ACTION_KEY)
    }
    model.save_policy(
        model.load_policy(from_profile("tiny", base="nano-random", num_threads=1), stats), place / "saved"
    )
    return export(place / "saved", str(place / "my_policy"))


def test_the_distributions_are_found_by_name(place):
    names = {
        name for dist in importlib.metadata.distributions() if (name := dist.metadata["Name"]).startswith("lerobot_")
    }
    assert names >= PLUGINS
    register_third_party_plugins()
    assert set(sys.modules) >= PLUGINS


def test_flags_become_a_command_line_and_two_of_them_a_table_that_marks_what_differs():
    views = lerobot_commands.cameras(["top", "wrist"], fps=30)
    one = {"robot.type": "so100_sim", "robot.cameras": views, "play_sounds": False}
    assert lerobot_commands.arguments(one)[::2] == ["--robot.type=so100_sim", "--play_sounds=false"]
    assert "wrist: {type: opencv, index_or_path: 1, width: 640, height: 480, fps: 30}}" in views
    table = lerobot_commands.side_by_side(simulated=one, real=one | {"robot.type": "so101_follower", "robot.port": "p"})
    assert table.index[table.differs != ""].tolist() == ["--robot.port", "--robot.type"]
    assert table.simulated["--robot.port"] == "" and table.real["--robot.type"] == "so101_follower"


def test_record_holds_what_the_arm_did_with_frames_of_its_rate(recorded):
    assert recorded.num_episodes == 2 and recorded.fps == FPS and recorded.meta.robot_type == "so100_sim"
    start = recorded.meta.episodes["dataset_from_index"][1]
    assert start in range(FPS * EPISODE_S, FPS * EPISODE_S + 2) and recorded.num_frames == 2 * start
    for key in (STATE_KEY, ACTION_KEY):
        assert recorded.features[key]["names"] == list(JOINT_NAMES)
    assert recorded.features["observation.images.front"]["shape"] == (120, 160, 3)
    frames = recorded.hf_dataset.with_format("numpy")
    states, actions = np.stack(frames[STATE_KEY]), np.stack(frames[ACTION_KEY])
    with make(Path("calibration"), seed=1) as robot:  # the second scene: its start, and a plan of its own
        np.testing.assert_allclose(states[start], robot.env.joints, atol=0.1)
        expert = Expert(FPS)
        expert.reset(robot.env, 1)
        np.testing.assert_allclose(actions[start], expert.act({}), atol=0.1)


def test_replay_of_an_episode_solves_its_scene_again(recorded, said):
    for episode in (0, 1):
        lerobot(
            "scripts.lerobot_replay", *ROBOT, f"--robot.seed={episode}", "--dataset.repo_id=me/lift",
            f"--dataset.root={recorded.root}", f"--dataset.episode={episode}", "--play_sounds=false",
        )  # fmt: skip
        assert any(f"seed {episode}" in line and line.endswith("', solved") for line in said), said


def test_teleoperate_solves_scene_after_scene(place, said):
    lerobot(
        "scripts.lerobot_teleoperate", *ROBOT, *SCRIPT, f"--fps={FPS}", f"--teleop_time_s={2 * EPISODE_S + RESET_S}"
    )
    assert [line.rsplit(", ")[-1] for line in said if "seed" in line] == ["solved", "solved"]


def test_a_script_that_is_cut_short_says_so_and_one_without_its_arm_is_refused(place, said):
    short = [*SCRIPT, "--teleop.episode_time_s=1"]
    lerobot("scripts.lerobot_teleoperate", *ROBOT, *short, f"--fps={FPS}", "--teleop_time_s=2")
    assert any("steps before the expert was done" in line for line in said)
    with pytest.raises(RuntimeError, match="teleop.robot_id='other'.*there are: 'arm'.*--robot.id"):
        lerobot("scripts.lerobot_teleoperate", *ROBOT, *SCRIPT, "--teleop.robot_id=other", "--teleop_time_s=1")


def test_rollout_moves_the_arm_with_a_policy(policy, said):
    lerobot(
        "scripts.lerobot_rollout", *ROBOT, f"--policy.path={policy}", f"--task={TASK}", "--duration=1", f"--fps={FPS}",
        "--device=cpu", "--play_sounds=false",
    )  # fmt: skip
    assert any(f"scene of seed 0, '{TASK}'" in line for line in said)


def test_the_dry_run_of_the_safety_page_runs_as_it_stands(recorded, policy, said):
    blocks = re.findall(
        r"```bash\n(lerobot-\S+ --robot.type=so100_sim.*?)```",
        (ROOT / "book/real_arm_safety.md").read_text(),
        re.DOTALL,
    )
    assert [block.split()[0] for block in blocks] == ["lerobot-replay", "lerobot-rollout"]
    for block in blocks:
        command, *flags = shlex.split(block.replace("\\\n", " "))
        short = ["--duration=1"] if command == "lerobot-rollout" else []
        lerobot(f"scripts.{command.replace('-', '_')}", *flags, "--robot.calibration_dir=calibration", *short)
    assert len([line for line in said if "scene of seed 0" in line]) == 2


def test_train_continues_on_what_was_recorded(recorded, policy, place):
    lerobot(
        "scripts.lerobot_train", f"--policy.path={policy}", "--policy.device=cpu", "--policy.push_to_hub=false",
        "--dataset.repo_id=me/lift", f"--dataset.root={recorded.root}", "--steps=2", "--batch_size=2",
        "--num_workers=0", f"--output_dir={place / 'trained'}", "--save_freq=2",
    )  # fmt: skip
    assert (place / "trained/checkpoints/000002/pretrained_model/model.safetensors").stat().st_size > 1e6


def test_eval_finds_the_environment_by_its_type(policy, place):
    lerobot(
        "scripts.lerobot_eval", f"--policy.path={policy}", "--policy.device=cpu", "--env.type=so100_sim",
        "--env.task=lift", "--env.image_size=96", "--eval.n_episodes=1", "--eval.batch_size=1",
        f"--output_dir={place / 'eval'}",
    )  # fmt: skip
    results = json.loads((place / "eval" / "eval_info.json").read_text())
    assert results["overall"]["n_episodes"] == 1
    assert all(Path(video).stat().st_size > 1000 for video in results["overall"]["video_paths"])


def test_edit_dataset_splits_merges_and_deletes(recorded, place):
    edit = ("scripts.lerobot_edit_dataset", "--repo_id=me/lift", f"--root={recorded.root}")
    lerobot(*edit, f"--new_root={place / 'parts'}", "--operation.type=split", '--operation.splits={"a": [0], "b": [1]}')
    parts = [place / "parts" / name for name in "ab"]
    lerobot(
        "scripts.lerobot_edit_dataset", "--new_repo_id=me/both", f"--new_root={place / 'both'}",
        "--operation.type=merge", "--operation.repo_ids=['me/b', 'me/a']",
        f"--operation.roots=['{parts[1]}', '{parts[0]}']",
    )  # fmt: skip
    both = LeRobotDataset("me/both", root=place / "both")
    assert both.num_episodes == 2 and both.num_frames == recorded.num_frames
    lerobot(
        *edit, "--new_repo_id=me/one", f"--new_root={place / 'one'}", "--operation.type=delete_episodes",
        "--operation.episode_indices=[0]",
    )  # fmt: skip
    assert LeRobotDataset("me/one", root=place / "one").num_episodes == 1


def test_dataset_viz_saves_an_episode_without_a_display(recorded, place):
    pytest.importorskip(
        "rerun", reason="lerobot-dataset-viz needs rerun-sdk, which LeRobot installs with its extra viz"
    )
    lerobot(
        "scripts.lerobot_dataset_viz", "--repo-id=me/lift", f"--root={recorded.root}", "--episode-index=1", "--save=1",
        f"--output-dir={place / 'viz'}", "--num-workers=0",
    )  # fmt: skip
    assert next((place / "viz").glob("*.rrd")).stat().st_size > 10_000


def test_policy_server_moves_the_arm_of_a_robot_client(policy, monkeypatch):
    from lerobot.async_inference import policy_server, robot_client

    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    servers, start = [], policy_server.grpc.server
    monkeypatch.setattr(
        policy_server.grpc, "server", lambda *of, **how: servers.append(start(*of, **how)) or servers[0]
    )
    monkeypatch.setattr(sys, "argv", ["policy_server", "--host=127.0.0.1", f"--port={port}"])
    serving = threading.Thread(target=policy_server.serve, daemon=True)
    serving.start()
    while serving.is_alive() and not servers:
        time.sleep(0.05)

    def stop_after_some_actions() -> None:
        deadline = time.monotonic() + 60
        while time.monotonic() < deadline and not (clients and clients[0].robot.bus.actions >= 5):
            time.sleep(0.05)
        clients[0].shutdown_event.set()  # what Ctrl-C comes to

    monkeypatch.setattr(
        sys, "argv",
        ["robot_client", *ROBOT, f"--server_address=127.0.0.1:{port}", "--policy_type=smolvla",
         f"--pretrained_name_or_path={policy}", "--actions_per_chunk=8", f"--task={TASK}", f"--fps={FPS}"],
    )  # fmt: skip
    clients, made = [], robot_client.RobotClient
    monkeypatch.setattr(robot_client, "RobotClient", lambda cfg: clients.append(made(cfg)) or clients[0])
    threading.Thread(target=stop_after_some_actions, daemon=True).start()
    robot_client.async_client()
    servers[0].stop(0).wait()
    assert clients[0].robot.bus.actions >= 5 and not clients[0].robot.is_connected


# --- the robot speaks as the real one does


def make(tmp_path: Path, **settings: object) -> So100SimRobot:
    return So100SimRobot(So100SimRobotConfig(id="one", calibration_dir=tmp_path, **settings))


def act(robot: So100SimRobot, **joints: float) -> dict[str, float]:
    return robot.send_action(robot.get_observation() | {f"{name}.pos": value for name, value in joints.items()})


def test_flags_and_features_are_those_of_the_real_arm(tmp_path, monkeypatch):
    # The real class, with the serial bus left out: what it asks the bus for are the motors that it was given.
    monkeypatch.setattr(so_follower_module, "FeetechMotorsBus", lambda motors, **_: SimpleNamespace(motors=motors))
    ours, theirs = So100SimRobotConfig.__dataclass_fields__, SO101FollowerConfig.__dataclass_fields__
    assert set(theirs) <= set(ours)
    assert {name for name in set(theirs) - {"port"} if ours[name].default != theirs[name].default} == set()
    for cameras in ({}, CAMERAS):
        real = SO101Follower(SO101FollowerConfig(port="/dev/ttyACM0", calibration_dir=tmp_path, cameras=cameras))
        robot = make(tmp_path, cameras=cameras)
        assert robot.observation_features == real.observation_features
        assert robot.action_features == real.action_features
        assert list(robot.observation_features) == list(real.observation_features)
        assert [vars(motor) for motor in robot.bus.motors.values()] == [vars(m) for m in real.bus.motors.values()]


def test_connecting_and_its_errors_are_the_real_ones(tmp_path):
    robot = make(tmp_path, cameras={"top": CAMERAS["overhead"]})
    for call in (robot.get_observation, lambda: robot.send_action({}), robot.disconnect):
        with pytest.raises(DeviceNotConnectedError):
            call()
    robot.connect()
    with pytest.raises(DeviceAlreadyConnectedError):
        robot.connect()
    assert robot.get_observation()["top"].shape == (120, 160, 3)
    robot.disconnect()
    assert not robot.is_connected and not robot.cameras["top"].is_connected


def test_a_step_is_limited_and_a_joint_stops_at_its_limit(tmp_path):
    with make(tmp_path, max_relative_target=5.0, fps=10) as robot:
        before = robot.get_observation()["shoulder_pan.pos"]
        assert act(robot, shoulder_pan=60.0)["shoulder_pan.pos"] == pytest.approx(before + 5.0)
        assert abs(robot.get_observation()["shoulder_pan.pos"] - before) < 6.0
    with make(tmp_path, fps=10) as robot:
        for _ in range(30):
            act(robot, shoulder_pan=500.0, gripper=500.0)
        limit = (robot.calibration["shoulder_pan"].range_max - 4095 / 2) * 360 / 4095
        seen = robot.get_observation()
        assert seen["shoulder_pan.pos"] == pytest.approx(limit, abs=0.5) and seen["gripper.pos"] <= 100


def test_units_follow_the_flag_and_the_calibration_file(tmp_path):
    with make(tmp_path, seed=3) as robot:
        joints = robot.env.joints
        assert [value for value in robot.get_observation().values()] == pytest.approx(joints.tolist(), abs=0.1)
        pan = robot.calibration["shoulder_pan"]
    with make(tmp_path, seed=3, use_degrees=False) as robot:
        share = (joints[0] * 4095 / 360 + 4095 / 2 - pan.range_min) / (pan.range_max - pan.range_min)
        assert robot.get_observation()["shoulder_pan.pos"] == pytest.approx(200 * share - 100, abs=0.1)
        act(robot, shoulder_pan=0.0)
    file = tmp_path / "one.json"
    written = json.loads(file.read_text())
    written["shoulder_pan"]["homing_offset"] += 100  # an arm that was calibrated 100 ticks away
    file.write_text(json.dumps(written))
    with make(tmp_path, seed=3) as robot:
        assert robot.get_observation()["shoulder_pan.pos"] == pytest.approx(joints[0] - 100 * 360 / 4095, abs=0.1)
        script = So100Script(So100ScriptConfig(robot_id="one", calibration_dir=tmp_path))
        script.connect()
        for _ in range(150):  # the expert speaks the dialect of the arm's calibration
            robot.send_action(script.get_action())
        assert robot.solved
    file.write_text(json.dumps({"shoulder_pan": written["shoulder_pan"]}))
    with pytest.raises(ValueError, match="one.json is not a calibration of this arm: give shoulder_pan, shoulder_lift"):
        make(tmp_path)


def test_a_scene_can_begin_in_a_recorded_pose_and_seeds_fix_the_rest(tmp_path):
    pose = [10.0, -40.0, 25.0, 70.0, 5.0, 20.0]
    pictures = []
    for _ in range(2):
        with make(tmp_path, start_pose=pose, seed=5, cameras=CAMERAS) as robot:
            assert [robot.get_observation()[name] for name in JOINT_NAMES] == pytest.approx(pose, abs=0.1)
            act(robot, shoulder_pan=0.0)
            pictures.append(robot.get_observation()["front"])
    np.testing.assert_array_equal(*pictures)


def camera(**changed: object) -> OpenCVCameraConfig:
    return OpenCVCameraConfig(**{"index_or_path": 0, "fps": 30, "width": 64, "height": 64, **changed})


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"task": "juggle"}, "unknown task 'juggle'"),
        ({"color": "pink"}, "robot.color='pink' is not usable: choose one of red, green, blue"),
        ({"fps": 0}, "robot.fps=0 is not usable: give a number from 1 to 200"),
        ({"lab": -1}, "robot.lab=-1"),
        ({"start_pose": [1.0]}, r"start_pose=\[1.0\] is not usable: give 6 numbers"),
        ({"cameras": {"top": camera(index_or_path=2)}}, r"choose from 0 \(over"),
        ({"cameras": {"top": camera(rotation=90)}}, "rotation=90"),
        ({"cameras": {"top": camera(fps=None)}}, "'fps' is required"),
    ],
)  # fmt: skip
def test_settings_that_cannot_be_simulated_are_named(tmp_path, settings, message):
    with pytest.raises(ValueError, match=message):
        make(tmp_path, **settings)
