"""Figures: what the reader needs is on the axes, and the numbers drawn are the numbers given."""

import matplotlib
import numpy as np
import pandas as pd
import pytest

from fedvla_lib import plots

matplotlib.use("Agg")
pytestmark = pytest.mark.unit


@pytest.fixture(autouse=True)
def close_figures():
    yield
    plots.plt.close("all")


def labelled(ax):
    return bool(ax.get_xlabel()) and bool(ax.get_ylabel())


def test_joints_draws_state_and_action_of_every_joint_in_seconds():
    states, actions = np.random.default_rng(0).normal(size=(2, 21, 6))
    axes = plots.joints(states, actions)
    assert len(axes) == 6
    for i, ax in enumerate(axes):
        np.testing.assert_allclose(ax.lines[0].get_ydata(), states[:, i])
        np.testing.assert_allclose(ax.lines[1].get_ydata(), actions[:, i])
        assert ax.lines[0].get_xdata()[-1] == pytest.approx(2.0)
        assert "[" in ax.get_ylabel()


def test_film_strip_shows_first_and_last_frame():
    frames = np.random.default_rng(0).integers(0, 255, (30, 8, 10, 3), np.uint8)
    ax = plots.film_strip(frames, count=4)
    strip = ax.images[0].get_array()
    np.testing.assert_array_equal(strip[:, :10], frames[0])
    np.testing.assert_array_equal(strip[:, -10:], frames[-1])
    assert ax.get_xticklabels()[-1].get_text() == "2.9 s"


def test_client_counts_stack_to_the_episodes_of_each_client():
    counts = pd.DataFrame({"lift": [3, 0], "push": [1, 4]}, index=[0, 1])
    ax = plots.client_counts(counts)
    tops = [bar.get_y() + bar.get_height() for bar in ax.patches[2:]]
    assert tops == [4, 4] and labelled(ax)


def test_success_bars_have_the_heights_and_intervals_of_the_table():
    table = pd.DataFrame(
        {
            "arm": ["base", "federated"] * 2,
            "task": ["lift", "lift", "push", "push"],
            "success_rate": [0.1, 0.8, 0.0, 0.5],
            "low": [0.0, 0.6, 0.0, 0.3],
            "high": [0.3, 0.9, 0.2, 0.7],
        }
    )
    ax = plots.success_bars(table)
    assert [bar.get_height() for bar in ax.patches] == [0.1, 0.0, 0.8, 0.5]
    assert labelled(ax) and ax.get_ylim()[1] > 1


def test_curves_are_labelled_and_show_what_they_are_given():
    ax = plots.loss_curve([3.0, 1.0, 2.0], smooth=2)
    np.testing.assert_allclose(ax.lines[1].get_ydata(), [3.0, 2.0, 1.5])
    assert labelled(ax)
    table = pd.DataFrame({"round": [0, 2], "success_rate": [0.0, 0.5], "low": [0.0, 0.3], "high": [0.2, 0.7]})
    ax = plots.by_round(table, "success_rate", ylabel="success rate")
    np.testing.assert_allclose(ax.lines[0].get_ydata(), [0.0, 0.5])
    assert labelled(ax) and len(ax.collections) == 1
