"""The simulated arm: Gymnasium's API, determinism, units, success predicates and rendering."""

import gc
import multiprocessing
import os
import subprocess
import sys
import weakref

import gymnasium
import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from fedvla_lib.robot.labs import REFERENCE, draw_lab
from fedvla_lib.robot.layout import COLORS, CUBE_HALF_M, CUBES_APART_M
from fedvla_lib.robot.meshes import decimated_meshes
from fedvla_lib.robot.sim import ENV_ID, HOME, So100Env, from_radians, to_radians
from fedvla_lib.robot.spec import CAMERAS, NUM_JOINTS
from fedvla_lib.robot.tasks import (
    ALL_TASKS,
    AWAY_M,
    LIFT_CLEARANCE_M,
    PLACE_HALF_M,
    PUSH_RADIUS_M,
    TASKS,
    TaskState,
    check_tasks,
    draw_layout,
    task_of,
)

pytestmark = pytest.mark.unit
SIZE = 32


@pytest.fixture(params=sorted(TASKS))
def task(request):
    return request.param


def blind(task: str) -> So100Env:
    return So100Env(task, cameras=(), render_mode=None)


def cube_m(env: So100Env) -> np.ndarray:
    """Return the centre of the first cube in the world frame, (3,)."""
    return env.data.body("cube").xpos.copy()


def task_text(layout, task: str) -> str:
    """Return the first wording of a task with this layout's colours."""
    colors = [cube.color for cube in layout.cubes]
    return TASKS[task].wordings[0].format(color=colors[0], other=colors[-1])


def wander(env: So100Env, seed: int, steps: int = 12) -> list[np.ndarray]:
    """Return everything observed under random targets near the start pose."""
    rng = np.random.default_rng(1)
    observation, _ = env.reset(seed=seed)
    seen = [observation]
    for _ in range(steps):
        seen.append(env.step(observation["agent_pos"] + rng.uniform(-15, 15, NUM_JOINTS))[0])
    return [np.stack([frame["agent_pos"] for frame in seen])] + [
        np.stack([frame["pixels"][camera] for frame in seen]) for camera in CAMERAS
    ]


def wait(env: So100Env, steps: int = 60) -> bool:
    """Hold the arm still; return whether the task succeeded meanwhile."""
    target = env.joints
    for _ in range(steps):
        *_, terminated, truncated, _ = env.step(target)
        if terminated or truncated:
            return terminated
    return False


def set_cube(env: So100Env, xyz_m, velocity_mps=(0.0, 0.0, 0.0)) -> None:
    env.data.joint("cube").qpos[:3] = xyz_m
    env.data.joint("cube").qvel[:3] = velocity_mps


# --- Gymnasium's API


def test_gymnasium_accepts_the_environment(task):
    check_env(So100Env(task, image_size=SIZE), skip_render_check=False)


def test_registered_with_gymnasium():
    env = gymnasium.make(ENV_ID, task="push", image_size=SIZE)
    observation, _ = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    assert env.unwrapped.task == "push"
    env.close()


def test_truncates_at_the_horizon_and_then_asks_for_a_reset(task):
    env = blind(task)
    env.reset(seed=0)
    flags = [env.step(HOME)[2:4] for _ in range(TASKS[task].horizon_steps)]
    assert not any(terminated for terminated, _ in flags)
    assert [truncated for _, truncated in flags] == [False] * (len(flags) - 1) + [True]
    with pytest.raises(RuntimeError, match="reset"):
        env.step(HOME)


def test_without_cameras_there_are_no_pixels_and_the_same_motion():
    seeing, unseeing = So100Env("lift", image_size=SIZE), blind("lift")
    assert "pixels" not in unseeing.reset(seed=3)[0]
    seeing.reset(seed=3)
    for _ in range(5):
        np.testing.assert_array_equal(seeing.step(HOME)[0]["agent_pos"], unseeing.step(HOME)[0]["agent_pos"])
    assert unseeing.render() is None


# --- determinism and randomness


def test_same_seed_same_trajectory_and_pixels(task):
    env = So100Env(task, image_size=SIZE)
    first = wander(env, seed=5)
    wander(env, seed=6)  # earlier episodes must not matter
    for again in (wander(env, seed=5), wander(So100Env(task, image_size=SIZE), seed=5)):
        for one, other in zip(first, again, strict=True):
            np.testing.assert_array_equal(one, other)


def test_different_seeds_differ(task):
    env = So100Env(task, image_size=SIZE)
    for one, other in zip(wander(env, seed=5), wander(env, seed=6), strict=True):
        assert not np.array_equal(one, other)


def test_color_changes_the_instruction_and_the_image_but_not_the_layout(task):
    env = So100Env(task, image_size=SIZE)
    layouts, images = [], []
    for color in COLORS:
        observation, _ = env.reset(seed=2, options={"color": color})
        assert env.instruction == env.task_description == task_text(env.layout, task)
        colors = [cube.color for cube in env.layout.cubes]
        assert colors[0] == color and len(set(colors)) == len(colors)
        layouts.append(tuple((cube.xy_m, cube.yaw_rad) for cube in env.layout.cubes) + env.layout.zones_xy_m)
        images.append(observation["pixels"]["front"])
    assert len(set(layouts)) == 1
    assert not np.array_equal(images[0], images[1])


def test_layouts_stay_in_their_regions_and_use_every_color(task):
    rng = np.random.default_rng(0)
    layouts = [draw_layout(TASKS[task], rng) for _ in range(200)]
    radii = np.array([np.hypot(*layout.cubes[0].xy_m) for layout in layouts])
    low, high = TASKS[task].cube.radius_m
    assert low <= radii.min() < radii.max() <= high
    assert {layout.cubes[0].color for layout in layouts} == set(COLORS)
    assert all(len(layout.zones_xy_m) == len(TASKS[task].zones) for layout in layouts)


@pytest.mark.parametrize("camera", CAMERAS)
def test_each_camera_shows_where_the_cube_is(camera):
    """The centroid of the cube's pixels moves with the cube, in both directions of the table."""
    env = So100Env("lift", image_size=96)
    env.reset(seed=0, options={"color": "blue"})
    centres = []
    for xy in ((0.18, -0.1), (0.18, 0.1), (0.23, -0.1)):
        set_cube(env, (*xy, 0.014))
        pixels = env.step(HOME)[0]["pixels"][camera].astype(int)
        blue = np.argwhere((pixels[..., 2] > 100) & (pixels[..., 2] - pixels[..., 0] > 60))
        assert len(blue) >= 15
        centres.append(blue.mean(axis=0))
    assert abs(centres[1][1] - centres[0][1]) > 20  # left or right
    assert abs(centres[2][0] - centres[0][0]) > 3  # near or far


def test_zone_is_drawn_where_the_task_has_one():
    for name, wanted in (("place", (True, True, False)), ("push", (True, True, True))):
        env = So100Env(name, image_size=96)
        pixels = env.reset(seed=0, options={"color": "blue"})[0]["pixels"]
        for camera in CAMERAS:
            bright = (pixels[camera][48:] > 200) == np.array(wanted)
            assert bright.all(axis=-1).sum() > 40, (name, camera)


# --- units and memory


def test_units_round_trip():
    env = blind("lift")
    limits = env.model.jnt_range[:NUM_JOINTS]
    for _ in range(20):
        joints = env.action_space.sample()
        np.testing.assert_allclose(from_radians(to_radians(joints, limits), limits), joints, atol=1e-4)
    np.testing.assert_allclose(from_radians(limits[:, 0], limits)[-1], 0)
    np.testing.assert_allclose(from_radians(limits[:, 1], limits)[-1], 100)


def test_positive_degrees_turn_as_documented():
    env = blind("lift")
    env.reset(seed=0)

    def grasp_m(**degrees: float) -> np.ndarray:
        joints = np.zeros(NUM_JOINTS)
        joints[["shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex"].index(*degrees)] = [*degrees.values()][0]
        env.step(joints)
        for _ in range(15):
            env.step(joints)
        return env.data.site("grasp").xpos.copy()

    zero = grasp_m(shoulder_pan=0)
    assert zero[0] > 0.3 and abs(zero[1]) < 0.02  # straight ahead, stretched
    assert grasp_m(shoulder_pan=20)[1] > zero[1] + 0.1
    assert grasp_m(shoulder_lift=10)[0] > zero[0]
    assert grasp_m(elbow_flex=10)[2] < zero[2] - 0.03
    assert grasp_m(wrist_flex=10)[2] < zero[2] - 0.01


def test_arm_reaches_its_targets_and_clips_those_out_of_range():
    env = blind("lift")
    env.reset(seed=0)
    target = HOME + np.array([10, 5, -5, 5, 20, 10])
    for _ in range(15):
        env.step(target)
    np.testing.assert_allclose(env.joints, target, atol=0.6)
    for _ in range(15):
        env.step(np.where(np.arange(NUM_JOINTS) == 5, 1e4, target))
    assert env.joints[5] == pytest.approx(100, abs=2)


def test_observations_share_no_memory_with_the_simulation():
    env = So100Env("lift", image_size=SIZE)
    observation, _ = env.reset(seed=0)
    kept = {"agent_pos": observation["agent_pos"].copy(), **{c: i.copy() for c, i in observation["pixels"].items()}}
    later, *_ = env.step(HOME + 20)
    np.testing.assert_array_equal(observation["agent_pos"], kept["agent_pos"])
    for camera in CAMERAS:
        np.testing.assert_array_equal(observation["pixels"][camera], kept[camera])
        assert not np.shares_memory(observation["pixels"][camera], later["pixels"][camera])
    before = env.joints
    later["agent_pos"][:] = 0
    np.testing.assert_array_equal(env.joints, before)


# --- success predicates


def scene(**changes) -> TaskState:
    """The state of a cube at rest on the zone's centre, with the arm away from it."""
    calm = dict(clearance_m=0.0, peak_clearance_m=0.0, speed_mps=0.0, zone_offset_m=(0.0, 0.0), held=False,
                touched=False, carried=False, flung=False, hand_distance_m=0.1)  # fmt: skip
    return TaskState(**{**calm, **changes})


LIFTED = dict(clearance_m=LIFT_CLEARANCE_M + 0.01, held=True, touched=True)
PLACED = dict(carried=True, peak_clearance_m=0.06)


@pytest.mark.parametrize(
    ("name", "good", "spoilers"),
    [
        ("lift", LIFTED, [dict(held=False), dict(clearance_m=LIFT_CLEARANCE_M - 0.01)]),
        (
            "place",
            PLACED,
            [
                dict(carried=False),
                dict(touched=True),
                dict(hand_distance_m=AWAY_M - 0.01),
                dict(speed_mps=0.1),
                dict(clearance_m=0.02),
                dict(zone_offset_m=(PLACE_HALF_M, 0.0)),
                dict(zone_offset_m=(0.0, -PLACE_HALF_M)),
            ],
        ),
        (
            "push",
            dict(touched=True),
            [
                dict(carried=True),
                dict(flung=True),
                dict(peak_clearance_m=0.03),
                dict(speed_mps=0.1),
                dict(clearance_m=0.02),
                dict(zone_offset_m=(PUSH_RADIUS_M, 0.0)),
            ],
        ),
    ],
)
def test_every_condition_of_a_predicate_matters(name, good, spoilers):
    success = TASKS[name].success
    assert success(scene(**good))
    for spoiler in spoilers:
        assert not success(scene(**{**good, **spoiler})), spoiler


UPPER = dict(carried=True, peak_clearance_m=0.06, clearance_m=2 * CUBE_HALF_M, cube_m=(0.2, 0.0, 3 * CUBE_HALF_M))


@pytest.mark.parametrize(
    ("upper", "lower"),
    [
        (dict(carried=False), {}),
        (dict(touched=True), {}),
        (dict(hand_distance_m=AWAY_M - 0.01), {}),
        (dict(speed_mps=0.1), {}),
        (dict(cube_m=(0.2, CUBE_HALF_M + 0.001, 3 * CUBE_HALF_M)), {}),
        (dict(cube_m=(0.2, 0.0, 3 * CUBE_HALF_M + 0.01)), {}),
        ({}, dict(clearance_m=0.02)),
        ({}, dict(speed_mps=0.1)),
        ({}, dict(touched=True)),
    ],
)
def test_every_condition_of_stack_matters(upper, lower):
    def stacked(upper, lower):
        below = scene(cube_m=(0.2, 0.0, CUBE_HALF_M), **lower)
        return TASKS["stack"].success(scene(others=(below,), **{**UPPER, **upper}))

    assert stacked({}, {})
    assert not stacked(upper, lower)


def test_sort_needs_both_cubes_in_their_places():
    sort = TASKS["sort"].success
    assert sort(scene(**PLACED, others=(scene(**PLACED),)))
    assert not sort(scene(**PLACED, others=(scene(**{**PLACED, "zone_offset_m": (PLACE_HALF_M, 0.0)}),)))
    assert not sort(scene(**{**PLACED, "touched": True}, others=(scene(**PLACED),)))


def test_two_cubes_never_start_closer_than_the_jaws_need():
    rng = np.random.default_rng(0)
    for _ in range(200):
        one, other = draw_layout(TASKS["sort"], rng).cubes
        assert np.linalg.norm(np.subtract(one.xy_m, other.xy_m)) >= CUBES_APART_M and one.color != other.color


def test_a_cube_that_an_episode_lacks_is_not_seen():
    """Some pretraining episodes have one cube, some two, in the same scene."""
    env = So100Env("grip", image_size=96)
    counts = set()
    for seed in range(12):
        pixels = env.reset(seed=seed)[0]["pixels"]["overhead"].astype(int)
        seen = sum(bool((pixels @ axis > 160).sum() > 5) for axis in ((2, -1, -1), (-1, 2, -1), (-1, -1, 2)))
        counts.add(len(env.layout.cubes))
        orange = 1  # the orange arm counts as a red cube
        assert seen - orange <= len(env.layout.cubes)
    assert counts == {1, 2}


# --- labs


def test_a_lab_changes_the_images_but_not_the_motion():
    lab = draw_lab("elsewhere", np.random.default_rng(0))
    here, there = So100Env("lift", image_size=SIZE), So100Env("lift", image_size=SIZE, lab=lab)
    (one, _), (other, _) = here.reset(seed=1), there.reset(seed=1)
    for camera in CAMERAS:
        assert not np.array_equal(one["pixels"][camera], other["pixels"][camera])
    assert here.layout == there.layout
    np.testing.assert_allclose(other["agent_pos"] - one["agent_pos"], there.joint_offset, atol=1e-4)
    target = HOME + 3
    for _ in range(10):
        here.step(target)
        there.step(target + there.joint_offset)  # the same pose, in the angles that the other arm reports
    np.testing.assert_allclose(here.data.qpos, there.data.qpos, atol=1e-6)


def test_no_spread_is_the_reference_lab():
    lab = draw_lab(REFERENCE.name, np.random.default_rng(0), spread=0.0)
    assert lab == REFERENCE


def test_jitter_furnishes_every_episode_anew_and_the_seed_decides():
    env = So100Env("lift", image_size=SIZE, jitter=1.0)
    labs = [env.reset(seed=seed) and env.lab for seed in (0, 1, 0)]
    assert labs[0] == labs[2] != labs[1]
    assert not any(any(lab.joint_offset_deg) for lab in labs)


def test_environments_can_share_a_renderer():
    first = So100Env("place", image_size=SIZE)
    second = So100Env("place", image_size=SIZE, renderer_of=first)
    first.reset(seed=1)
    shared = second.reset(seed=2)[0]["pixels"]
    own = So100Env("place", image_size=SIZE).reset(seed=2)[0]["pixels"]
    for camera in CAMERAS:
        np.testing.assert_array_equal(shared[camera], own[camera])


def test_a_tossed_cube_is_not_lifted():
    env = blind("lift")
    env.reset(seed=0)
    for speed_mps in (1.0, 2.0, 3.0):
        set_cube(env, cube_m(env), (0.0, 0.0, speed_mps))
        assert not wait(env, steps=20)
        assert env._states[0].peak_clearance_m > LIFT_CLEARANCE_M


def test_a_cube_knocked_into_the_circle_is_not_pushed():
    env = blind("push")
    env.reset(seed=3)
    way_m = np.subtract(env.layout.zones_xy_m[0], cube_m(env)[:2])
    set_cube(env, cube_m(env), (*(1.5 * way_m / np.linalg.norm(way_m)), 0.0))
    assert not wait(env)
    assert np.linalg.norm(cube_m(env)[:2] - env.layout.zones_xy_m[0]) < PUSH_RADIUS_M - 0.02  # although it is inside


def test_a_cube_that_was_never_carried_is_not_placed():
    env = blind("place")
    env.reset(seed=0)
    set_cube(env, (*env.layout.zones_xy_m[0], 0.014))
    assert not wait(env)


def test_an_idle_arm_fulfils_nothing(task):
    env = blind(task)
    for seed in range(3):
        env.reset(seed=seed)
        assert not wait(env, steps=TASKS[task].horizon_steps)


# --- bad input


@pytest.mark.parametrize(
    ("arguments", "names"),
    [
        (dict(task="juggle"), "lift, place, push"),
        (dict(image_size=8), "16 to 1024"),
        (dict(image_size=96.5), "whole number"),
        (dict(cameras=("wrist",)), "overhead, front"),
        (dict(render_mode="human"), "rgb_array"),
    ],
)
def test_bad_arguments_are_named_with_the_valid_ones(arguments, names):
    with pytest.raises(ValueError, match=names):
        So100Env(**arguments)


@pytest.mark.parametrize(
    ("action", "named"),
    [(np.zeros(7), r"\(7,\)"), (np.zeros((1, 6)), r"\(1, 6\)"), (np.append(np.zeros(5), np.nan), "gripper is nan")],
)
def test_bad_actions_are_named(action, named):
    env = blind("lift")
    env.reset(seed=0)
    with pytest.raises(ValueError, match=named):
        env.step(action)


def test_bad_colors_and_tasks_are_named():
    with pytest.raises(ValueError, match="red, green, blue"):
        blind("lift").reset(seed=0, options={"color": "mauve"})
    with pytest.raises(ValueError, match="lift, place, push, stack, sort"):
        check_tasks(["lift", "juggle"])


# --- instructions


def test_instructions_lead_back_to_their_task():
    rng = np.random.default_rng(0)
    for name, task in ALL_TASKS.items():
        for color in COLORS:
            assert task_of(draw_layout(task, rng, color).instruction) == name
    wordings = [text for task in ALL_TASKS.values() for text in task.wordings]
    assert len(set(wordings)) == len(wordings)
    assert task_of("Fold the towel.") == "Fold the towel."


# --- rendering


def test_frames_survive_the_end_of_another_environment():
    """Under EGL, freeing one of MuJoCo's renderers can delete another one's buffers."""
    env = So100Env("lift", image_size=SIZE)
    env.reset(seed=0)
    before = env.render()
    others = [So100Env("place", image_size=SIZE) for _ in range(2)]
    for other in others:
        other.reset(seed=1)
    others.pop().close()
    np.testing.assert_array_equal(env.render(), before)
    del other
    others.clear()
    gc.collect()
    np.testing.assert_array_equal(env.render(), before)
    env.close()
    np.testing.assert_array_equal(env.render(), before)  # rendering reopens a closed renderer


def test_an_image_drawn_in_two_layers_is_the_one_drawn_at_once():
    """Environments of several tasks share a renderer; each is in a lab of its own, which changes, too."""
    rng, first = np.random.default_rng(0), So100Env("lift", image_size=96)
    envs = [So100Env(name, image_size=96, renderer_of=first) for name in ("lift", "sort", "point_circle")]
    envs.append(So100Env("sort", image_size=96, renderer_of=envs[1]))
    at_once = [mujoco.Renderer(env.model, 96, 96) for env in envs]
    for seed in range(24):
        env, renderer = envs[seed % len(envs)], at_once[seed % len(envs)]
        if seed % 3:
            env.lab = draw_lab("drawn", rng)
        env.model.mat_rgba[:, :3] = rng.uniform(size=3)  # the base's colour, which is the same in all labs
        env.reset(seed=seed)
        for _ in range(4):
            images = env.step(HOME + rng.uniform(-40, 40, NUM_JOINTS))[0]["pixels"]
            for camera in CAMERAS:
                renderer.update_scene(env.data, camera)
                np.testing.assert_array_equal(images[camera], renderer.render())


def test_an_environment_that_nobody_holds_is_gone_at_once():
    env = So100Env("lift", image_size=SIZE)
    env.reset(seed=0)
    seen = weakref.ref(env)
    gc.disable()  # a collection would come later, in any thread
    try:
        del env
        assert seen() is None
    finally:
        gc.enable()


def test_the_end_of_another_environment_in_the_middle_of_drawing_is_put_off(monkeypatch):
    """Python may collect an environment between making an OpenGL context current and using it."""
    env, other = (So100Env("lift", image_size=SIZE) for _ in range(2))
    env.reset(seed=0), other.reset(seed=1)
    before, context = env.render(), env._renderer._gl_context
    choose = context.make_current

    def choose_and_allocate():
        choose()
        assert len([[] for _ in range(10_000)]) == 10_000  # enough to trigger a collection

    other.myself, gone = other, weakref.ref(other)
    del other
    monkeypatch.setattr(context, "make_current", choose_and_allocate)
    np.testing.assert_array_equal(env.render(), before)
    gc.collect()
    assert gone() is None
    np.testing.assert_array_equal(env.render(), before)


def test_images_are_not_blank():
    env = So100Env("lift", image_size=SIZE)
    env.reset(seed=0)
    for half in np.hsplit(env.render(), 2):
        assert half.std() > 20


@pytest.mark.skipif(sys.platform != "linux" or "DISPLAY" in os.environ, reason="needs Linux without a display")
def test_a_fresh_process_draws_without_being_told_how_and_exits_quietly():
    code = "from fedvla_lib.robot.sim import So100Env; print(*So100Env(image_size=16).reset(seed=0)[0]['pixels'])"
    unset = {name: value for name, value in os.environ.items() if name != "MUJOCO_GL"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, env=unset)
    assert (done.returncode, done.stdout.split()) == (0, list(CAMERAS)), done.stderr
    assert "Exception ignored" not in done.stderr


@pytest.mark.skipif(sys.platform != "linux" or "DISPLAY" in os.environ, reason="needs Linux without a display")
@pytest.mark.parametrize(("driver", "first"), [("off", "numpy"), ("", "mujoco")])
def test_drawing_that_cannot_work_says_what_to_set(driver, first):
    code = f"import {first}; from fedvla_lib.robot.sim import So100Env; So100Env(image_size=16).reset(seed=0)"
    environment = {**os.environ, "MUJOCO_GL": driver}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, env=environment)
    message = done.stderr.strip().splitlines()[-1]
    assert message.startswith(f"RuntimeError: cannot render off screen with MUJOCO_GL={driver!r}"), done.stderr
    assert "set MUJOCO_GL to egl, osmesa or glfw before mujoco is first imported" in message


def test_settings_and_specification_do_not_load_the_simulator():
    modules = "fedvla_lib.config, fedvla_lib.robot.spec, fedvla_lib.robot.tasks"
    code = f"import sys, {modules}; sys.exit('mujoco' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], timeout=60, check=True)


def test_two_processes_may_make_the_mesh_cache_at_once(tmp_path, monkeypatch):
    monkeypatch.setenv("FEDVLA_CACHE", str(tmp_path))
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        folders = pool.starmap(decimated_meshes, [()] * 2, chunksize=1)
    assert folders[0] == folders[1]
    assert [path.name for path in tmp_path.iterdir()] == [folders[0].name]  # no drafts left behind
    assert len(list(folders[0].glob("*.stl"))) >= 18


def test_an_episode_can_start_in_another_pose():
    env = So100Env("lift", cameras=(), render_mode=None)
    pose = HOME + [20, 10, -10, 5, 0, 40]
    env.reset(seed=0, options={"joints": pose})
    np.testing.assert_allclose(env.joints, pose, atol=0.01)
    with pytest.raises(ValueError, match=r"joints has shape \(5,\)"):
        env.reset(seed=0, options={"joints": pose[:5]})
