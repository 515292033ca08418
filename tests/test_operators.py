"""Operators: habits within their ranges that show in the demonstrations, which succeed all the same."""

from dataclasses import fields, replace

import numpy as np
import pytest

from fedvla_lib.robot.expert import CLOSED, Expert
from fedvla_lib.robot.labs import REFERENCE, labs
from fedvla_lib.robot.operators import HABITS, Operator, draw_operator
from fedvla_lib.robot.rollout import run_episode
from fedvla_lib.robot.sim import So100Env
from fedvla_lib.robot.tasks import LAB_TASKS

pytestmark = pytest.mark.integration


def demonstrated(task, operator, seed=0):
    env = So100Env(task, cameras=(), render_mode=None, lab=replace(REFERENCE, operator=operator))
    return run_episode(env, Expert(), seed)


def path_of(operator, seed=0, task="square"):
    """Return the planned waypoints of the first part, up to the closed jaws, (steps, 3) in metres, and the cube's."""
    env, expert = So100Env(task, cameras=(), render_mode=None, lab=replace(REFERENCE, operator=operator)), Expert()
    env.reset(seed=seed)
    expert.reset(env, seed)
    closed = next(i for i, point in enumerate(expert._path) if point.gripper == CLOSED)
    return np.array([point.position_m for point in expert._path[: closed + 1]]), np.array(env.layout.cubes[0].xy_m)


def test_every_habit_has_a_range_around_the_reference_operator_s():
    assert set(HABITS) == {field.name for field in fields(Operator)}
    for habit, (low, high) in HABITS.items():
        assert low <= getattr(Operator(), habit) <= high and low < high


def test_drawn_operators_stay_within_the_ranges_and_fill_them():
    rng = np.random.default_rng(0)
    drawn = [draw_operator(rng) for _ in range(300)]
    for habit, (low, high) in HABITS.items():
        values = np.array([getattr(operator, habit) for operator in drawn])
        assert low <= values.min() < low + (high - low) / 20 and high - (high - low) / 20 < values.max() <= high


def test_each_lab_has_an_operator_of_its_own_that_stays():
    operators = [lab.operator for lab in labs(11)]
    assert len(set(operators)) == 11 and operators[0] == Operator()
    assert operators[:4] == [lab.operator for lab in labs(4)]


@pytest.mark.parametrize("task", sorted(LAB_TASKS))
def test_all_operators_succeed(task):
    there = labs(11)
    episodes = [demonstrated(task, there[1 + seed % 10].operator, seed) for seed in range(10)]
    assert np.mean([episode.success for episode in episodes]) >= 0.9


def test_a_slow_operator_takes_longer():
    slow, fast = (demonstrated("square", Operator(speed=speed)).num_frames for speed in (0.8, 1.25))
    assert slow > 1.2 * fast


def test_approach_and_grasp_are_the_operator_s():
    (usual, cube_m), (changed, _) = path_of(Operator()), path_of(Operator(hover_m=0.02, side_m=0.025, grasp_m=0.004))
    assert np.linalg.norm(usual[-1, :2] - cube_m) < 1e-6
    assert np.linalg.norm(changed[-1, :2] - cube_m) == pytest.approx(0.004, abs=1e-6)
    approach = [path[np.abs(path[:, 2] - height_m).argmin()] for path, height_m in ((usual, 0.075), (changed, 0.095))]
    assert np.linalg.norm(approach[1][:2] - approach[0][:2]) > 0.02


def test_hesitation_is_a_pause_and_a_correction_a_second_descent():
    usual, _ = path_of(Operator())
    pausing, _ = path_of(Operator(hesitation=1.0))
    still = (np.abs(np.diff(pausing, axis=0)).max(axis=1) < 1e-9).sum()
    assert 2 <= still <= 6 and len(pausing) == len(usual) + still
    correcting, _ = path_of(Operator(correction=1.0))
    turns = [(np.diff(np.sign(np.diff(path[:, 2]))) != 0).sum() for path in (usual, correcting)]
    assert turns[1] >= turns[0] + 2  # down, up, down again


def test_an_imperfect_demonstration_grasps_and_releases_worse_and_succeeds():
    careless = Operator(grasp_m=0.004, imperfect=1.0)
    path, cube_m = path_of(careless)
    assert np.linalg.norm(path[-1, :2] - cube_m) == pytest.approx(0.008, abs=1e-6)
    assert all(demonstrated(task, careless, seed).success for task in ("square", "tower") for seed in range(3))


def test_what_an_operator_does_follows_from_the_seed():
    there = labs(3)[1].operator
    one, again, other = (demonstrated("square", there, seed).actions for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, again)
    assert len(one) != len(other) or (one != other).any()


def test_the_scene_tells_the_ten_labs_task_and_colours_vary():
    square, tower = (So100Env(task, cameras=(), render_mode=None) for task in ("square", "tower"))
    asked = set()
    for seed in range(40):
        square.reset(seed=seed)
        tower.reset(seed=seed)
        asked |= {square.instruction, tower.instruction}
        (cube,), (zone,) = square.layout.cubes, square.layout.zones_xy_m
        one, other = tower.layout.cubes
        assert not tower.layout.zones_xy_m
        for left, right in ((cube.xy_m, zone), (one.xy_m, other.xy_m)):
            assert np.linalg.norm(np.subtract(left, right)) >= 0.058
    assert len(asked) == 3 + 6  # colours of one cube, and of two
