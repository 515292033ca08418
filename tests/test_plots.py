"""Figures: what the reader needs is on the axes, and the numbers drawn are the numbers given."""

import ast
import re
from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt
import nbformat
import numpy as np
import pandas as pd
import pytest

from fedvla_book import plots
from fedvla_lib.robot import spec

matplotlib.use("Agg")
pytestmark = pytest.mark.unit


@pytest.fixture(autouse=True)
def close_figures():
    yield
    plt.close("all")


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


def test_frame_strip_shows_first_and_last_frame():
    frames = np.random.default_rng(0).integers(0, 255, (30, 8, 10, 3), np.uint8)
    ax = plots.frame_strip(frames, count=4)
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
            "method": ["base", "federated"] * 2,
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


def test_film_strips_show_every_camera():
    frames = np.random.default_rng(0).integers(0, 255, (12, 8, 8, 3), np.uint8)
    axes = plots.frame_strips({"overhead": frames, "front": frames[::-1]}, count=3)
    assert [ax.get_title() for ax in axes] == ["camera: overhead", "camera: front"]
    np.testing.assert_array_equal(axes[1].images[0].get_array()[:, :8], frames[-1])


def test_pictures_put_each_frame_in_its_place():
    frames = np.random.default_rng(0).integers(0, 255, (3, 8, 8, 3), np.uint8)
    axes = plots.image_table({"as it is": frames, "reversed": frames[::-1]}, titles=["a", "b", "c"])
    assert axes.shape == (2, 3) and axes[0, 2].get_title() == "c" and axes[1, 0].get_ylabel() == "reversed"
    np.testing.assert_array_equal(axes[1, 0].images[0].get_array(), frames[2])


def test_chunk_separates_real_actions_from_padding():
    actions = np.random.default_rng(0).normal(size=(10, 6))
    future, is_pad = actions[[8, 9, 9]], np.array([False, False, True])
    ax = plots.chunk(actions, 8, future, is_pad, joint=2)
    np.testing.assert_allclose(ax.lines[1].get_ydata(), actions[[8, 9], 2])
    np.testing.assert_allclose(ax.lines[2].get_xdata(), [1.0])
    assert labelled(ax)


def test_likeness_shows_distances_and_the_level_of_another_episode():
    ax = plots.likeness(np.array([0.1, 0.2]), np.array([1.0, 2.0]), 5.0)
    np.testing.assert_allclose(ax.lines[0].get_ydata(), [1.0, 2.0])
    assert set(ax.lines[1].get_ydata()) == {5.0} and labelled(ax)


def test_partitions_and_their_heterogeneity_show_what_they_are_given():
    counts = pd.DataFrame({"lift": [3, 0], "push": [1, 4]}, index=[0, 1])
    axes = plots.client_counts_grid({"even": counts, "odd": counts})
    assert [ax.get_title() for ax in axes] == ["even", "odd"] and len(axes[0].figure.legends) == 1
    table = pd.DataFrame({"alpha": [0.1, 0.1, 1.0, 1.0], "total_variation": [0.6, 0.4, 0.2, 0.4]})
    ax = plots.heterogeneity(table, bounds={"one task a client": 2 / 3})
    np.testing.assert_allclose(ax.lines[1].get_ydata(), [0.5, 0.3])
    assert labelled(ax) and ax.get_xscale() == "log"


def test_client_statistics_and_weights_show_every_client():
    means = np.arange(12.0).reshape(2, 6)
    axes = plots.client_statistics(means, np.ones((2, 6)), means.mean(axis=0), np.ones(6))
    assert len(axes) == 6
    drawn = [(bar.lines[0].get_ydata().item(), bar.lines[0].get_color()) for bar in axes[3].containers]
    assert drawn == [(3.0, plots.client_color(0)), (9.0, plots.client_color(1))]
    weights = pd.DataFrame({"by frames": [0.25, 0.75], "equal": [0.5, 0.5]})
    ax = plots.client_weights(weights)
    assert [bar.get_height() for bar in ax.patches] == [25, 75, 50, 50] and labelled(ax)


def test_grouped_bars_give_every_number_a_bar_and_an_method_its_colour():
    table = pd.DataFrame({"federated": [1.0, 2.0], "other": [3.0, 4.0]}, index=["lift", "push"])
    ax = plots.grouped_bars(table, xlabel="task", ylabel="loss")
    assert [bar.get_height() for bar in ax.patches] == [1, 2, 3, 4] and labelled(ax)
    assert matplotlib.colors.to_hex(ax.patches[0].get_facecolor()) == plots.METHOD_COLORS["federated"].lower()


def test_clients_by_round_weights_the_mean_by_frames():
    table = pd.DataFrame({"round": [1, 1, 2, 2], "who": ["client_0", "client_3"] * 2, "num_examples": [3, 1] * 2})
    table["loss"] = [1.0, 5.0, 2.0, 2.0]
    ax = plots.clients_by_round(table, "loss", ylabel="loss")
    np.testing.assert_allclose(ax.lines[-1].get_ydata(), [2.0, 2.0])
    assert [line.get_color() for line in ax.lines[:2]] == [plots.client_color(0), plots.client_color(3)]
    assert len(ax.lines) == 3 and labelled(ax)


def test_cosine_map_writes_every_cosine():
    ax = plots.cosine_map(np.array([[1.0, -0.25], [-0.25, 1.0]]))
    assert [text.get_text() for text in ax.texts] == ["1.00", "-0.25", "-0.25", "1.00"] and labelled(ax)


def test_methods_and_their_differences_keep_their_intervals():
    methods = pd.DataFrame({"method": ["base"], "loss": [0.5], "success_rate": [0.2], "low": [0.1], "high": [0.4]})
    ax = plots.loss_against_success(methods)
    np.testing.assert_allclose(ax.containers[0].lines[0].get_xydata(), [[0.5, 0.2]])
    assert labelled(ax)
    pairs = pd.DataFrame({"method": ["federated"], "other": ["base"], "difference": [0.3], "low": [0.1], "high": [0.5]})
    ax = plots.paired_differences(pairs)
    segment = ax.containers[0].lines[2][0].get_segments()[0]
    np.testing.assert_allclose(segment[:, 0], [10, 50])
    assert labelled(ax) and ax.get_yticklabels()[0].get_text() == "federated − base"


def test_differences_have_a_panel_for_each_other_method_and_a_row_for_each_partition():
    table = pd.DataFrame(
        {"partition": ["iid", "task", "task"], "method": "averaged", "other": ["pooled", "pooled", "alone"],
         "difference": [-0.02, -0.1, 0.5], "low": [-0.03, -0.2, 0.4], "high": [0.01, -0.05, 0.7]}
    )  # fmt: skip
    axes = plots.differences_by_partition(table)
    assert [ax.get_title() for ax in axes] == ["averaged\n− pooled", "averaged\n− alone"]
    assert [text.get_text() for text in axes[0].get_yticklabels()] == ["iid", "task"] and labelled(axes[0])
    np.testing.assert_allclose(axes[0].containers[0].lines[0].get_xydata(), [[-2, 0], [-10, 1]])
    np.testing.assert_allclose(axes[1].containers[0].lines[0].get_xydata(), [[50, 1]])  # in the row of its partition
    np.testing.assert_allclose(axes[0].containers[0].lines[2][0].get_segments()[1][:, 0], [-20, -5])
    assert all(ax.get_xlim()[0] < 0 < ax.get_xlim()[1] for ax in axes)  # zero is in sight


def test_model_bars_show_counts_and_what_trains():
    table = pd.DataFrame({"part": ["eye", "hand"], "parameters": [2_000_000, 500_000], "trainable": [0, 500_000]})
    ax = plots.module_bars(table)
    assert [bar.get_width() for bar in ax.patches] == [0, 0.5, 2.0, 0]
    assert [text.get_text() for text in ax.texts] == ["2,000,000", "500,000"] and labelled(ax)
    ax = plots.trainable_bars({"all": table.assign(trainable=table.parameters), "hand only": table})
    assert [bar.get_width() for bar in ax.patches] == [2.0, 0, 0.5, 0.5] and labelled(ax)


def test_flow_draws_a_line_per_time_and_the_goal():
    points = np.arange(12.0).reshape(3, 4)
    ax = plots.flow(points, [1, 0.5, 0], ylabel="angle [deg]", goal=np.zeros(4))
    np.testing.assert_allclose([line.get_ydata() for line in ax.lines], [*points, np.zeros(4)])
    assert labelled(ax)


def test_the_video_of_a_flow_shows_each_time_and_holds_the_last():
    points = np.arange(12.0).reshape(3, 4)
    frames = plots.flow_video(points, [1, 0.5, 0], ylabel="angle [deg]", goal=np.zeros(4), hold=2)
    assert frames.dtype == np.uint8 and len(frames) == 6 + spec.FPS and not any(side % 2 for side in frames.shape[1:3])
    assert (frames[0] == frames[1]).all() and (frames[4] == frames[-1]).all()
    assert (frames[1] != frames[2]).any() and (frames[3] != frames[4]).any()


def test_the_architecture_shows_every_count_and_shape_it_is_given():
    counts = {part: 1_000 * (i + 1) for i, part in enumerate(plots.training.PARTS)}
    table = pd.DataFrame({"part": counts.keys(), "parameters": counts.values(), "trainable": 0})
    table.loc[table.part == "action expert", "trainable"] = 7
    shapes = {name: (8, i, 99) for i, name in enumerate(plots.training.ARROWS)}
    ax = plots.architecture(table, shapes)
    words = "|".join(text.get_text() for text in ax.texts)
    assert all(f"\n{count:,}" in words for count in counts.values()) and "(7 trained)" in words
    assert all(f"{name}\n8 × {i} × 99" in words for i, name in enumerate(shapes))
    trained = [patch.get_facecolor()[:3] == matplotlib.colors.to_rgb(plots.PALETTE[0]) for patch in ax.patches]
    assert trained == [part == "action expert" for part in counts]


def test_padding_rate_and_errors_are_labelled_and_drawn_as_given():
    masks = np.array([[False, True], [True, True]])
    ax = plots.padding(masks)
    np.testing.assert_array_equal(ax.images[0].get_array(), masks)
    assert labelled(ax) and [text.get_text() for text in ax.get_yticklabels()] == ["2", "1"]
    ax = plots.learning_rate([0.1, 0.2])
    np.testing.assert_allclose(ax.lines[0].get_ydata(), [0.1, 0.2])
    assert labelled(ax)
    errors = pd.DataFrame({"a": range(6), "b": range(6)}, index=spec.JOINT_NAMES)
    ax = plots.error_by_joint(errors)
    assert [bar.get_height() for bar in ax.patches] == [*range(6), *range(6)]
    assert labelled(ax) and "[deg]" in ax.get_xticklabels()[0].get_text()


def test_loss_and_success_skips_rounds_without_rollouts():
    table = pd.DataFrame(
        {
            "round": [0, 1, 2],
            "loss": [2.0, 1.5, 1.0],
            "success_rate": [0.0, np.nan, 0.5],
            "low": [0.0, np.nan, 0.2],
            "high": [0.3, np.nan, 0.8],
        }
    )
    above, below = plots.loss_and_success(table, "round", xlabel="round")
    assert list(above.lines[0].get_ydata()) == [2.0, 1.5, 1.0]
    assert list(below.lines[0].get_xdata()) == [0, 2]
    assert below.get_xlabel() == "round" and above.get_ylabel() and below.get_ylabel()


def test_rollout_grid_has_a_square_for_each_client_and_round():
    rows = pd.DataFrame(
        {"who": ["a", "a", "b"], "round": [1, 2, 2], "task": ["lift", "lift", "push"], "success": [True, False, False]}
    )
    ax = plots.rollout_grid(rows)
    assert [text.get_text() for text in ax.texts] == ["lift\n1/1", "lift\n0/1", "push\n0/1"]
    assert len(ax.patches) == 3 and labelled(ax)


def test_how_much_rollouts_tell():
    widths = pd.DataFrame({"n": [10, 100], "width": [0.5, 0.2], "success_rate": [0.5, 0.5]})
    ax = plots.interval_width(widths)
    np.testing.assert_allclose(ax.lines[0].get_ydata(), [50, 20])
    assert labelled(ax)
    ax = plots.power(pd.DataFrame({"n": [10, 100], "power": [0.1, 0.9], "difference": [0.1, 0.1]}))
    np.testing.assert_allclose(ax.lines[0].get_ydata(), [0.1, 0.9])
    assert labelled(ax)


def test_trajectories_of_different_length_share_the_clock():
    axes = plots.trajectories({"expert": np.zeros((11, 6)), "policy": np.ones((21, 6))})
    assert len(axes) == 6
    assert [line.get_xdata()[-1] for line in axes[0].lines] == pytest.approx([1.0, 2.0])


def test_curves_draw_every_column_against_the_index():
    table = pd.DataFrame({"a": [1.0, 2.0], "b": [3.0, 1.0]}, index=[0.5, 0.7])
    ax = plots.curves(table, xlabel="w", ylabel="loss")
    assert labelled(ax) and [line.get_label() for line in ax.lines] == ["a", "b"]
    np.testing.assert_array_equal(ax.lines[1].get_xydata(), [[0.5, 3.0], [0.7, 1.0]])
    marked = plots.curves(table.rename(columns={"b": "optimum"}), xlabel="w", ylabel="loss")
    assert marked.lines[1].get_linestyle() == ":"


def test_success_intervals_show_rate_and_both_ends_in_percent():
    table = pd.DataFrame(
        {"method": ["a", "b", "a"], "partition": ["iid", "iid", "task"], "success_rate": [0.5, 0.8, 0.1],
         "low": [0.4, 0.7, 0.0], "high": [0.6, 0.9, 0.3]}
    )  # fmt: skip
    ax = plots.success_intervals(table)
    assert labelled(ax) and [text.get_text() for text in ax.get_yticklabels()] == ["a", "b"]
    points = {c.get_label(): c.lines[0].get_xydata() for c in ax.containers}
    np.testing.assert_allclose(points["iid"][:, 0], [50, 80])
    np.testing.assert_allclose(points["task"][:, 0], [10])
    (_, _, (bars,)) = ax.containers[1]
    np.testing.assert_allclose(bars.get_segments()[0][:, 0], [0, 30])
    assert round(points["task"][0, 1]) == 0  # in the row of its method
    alone = plots.success_intervals(table[:2], ylabel="statistics")
    assert alone.get_ylabel() == "statistics" and alone.get_legend() is None  # one partition needs no name


def test_success_by_bytes_names_every_point():
    table = pd.DataFrame(
        {"method": ["a", "b"], "MB": [10.0, 100.0], "success_rate": [0.2, 0.9], "low": [0.1, 0.8], "high": [0.3, 1.0]}
    )
    ax = plots.success_by_bytes(table)
    assert labelled(ax) and ax.get_xscale() == "log"
    assert [text.get_text() for text in ax.get_legend().get_texts()] == ["a", "b"]
    np.testing.assert_allclose(ax.containers[1].lines[0].get_xydata(), [[100, 90]])


def test_success_by_bytes_sets_points_of_equal_bytes_apart():
    same = pd.DataFrame(
        {"method": list("abc"), "MB": [10.0, 600.0, 600.0], "success_rate": 0.9, "low": 0.8, "high": 1.0}
    )
    ax = plots.success_by_bytes(same)
    alone, left, right = (container.lines[0].get_xdata()[0] for container in ax.containers)
    assert alone == 10 and 0.9 * 600 < left < 600 < right < 1.1 * 600
    np.testing.assert_allclose(left * right, 600**2)


def test_success_by_demonstrations_draws_a_line_per_method_over_a_log_axis():
    counts, methods = [1, 2, 4], ["local-only", "centralized"]
    rates = {"success_rate": [0.1, 0.2, 0.4, 0.5, 0.6, 0.9], "low": 0.05, "high": 0.95}
    table = pd.DataFrame({"method": np.repeat(methods, 3), "demonstrations": counts * 2, **rates})
    ax = plots.success_by_demonstrations(table.sample(frac=1.0, random_state=0).sort_values("method", kind="stable"))
    assert labelled(ax) and ax.get_xscale() == "log" and ax.get_xlim()[0] > 0
    assert [text.get_text() for text in ax.get_legend().get_texts()] == sorted(methods)
    np.testing.assert_allclose(ax.containers[1].lines[0].get_xydata()[:, 1], [10, 20, 40])  # in their order
    assert [label.get_text() for label in ax.get_xticklabels()] == ["1", "2", "4"]


def test_a_fault_map_has_a_mark_for_each_test_that_fires_and_for_an_own_one_that_does_not():
    found = pd.DataFrame({
        "fault": ["none", "zero", "cable"], "test": ["", "calibration", "cameras"], "success_rate": [0.9, 0.1, 0.0],
        "low": [0.7, 0.0, 0.0], "high": [1.0, 0.3, 0.2], "calibration": [False, True, True],
        "cameras": [False, False, False],
    })  # fmt: skip
    bars, grid = plots.fault_map(found, ["calibration", "cameras"])
    assert bars.get_xlabel() == "success rate" and [bar.get_width() for bar in bars.patches] == [0.9, 0.1, 0.0]
    own, another, silent = (marks.get_offsets().data.tolist() for marks in grid.collections)
    assert (own, another, silent) == ([[0, 1]], [[0, 2]], [[1, 2]])
    assert [label.get_text() for label in bars.get_yticklabels()] == ["none", "zero", "cable"]


def checkpoint_table():
    return pd.DataFrame(
        {"method": ["a", "a", "a", "a", "b", "b", "b"], "run": [0, 0, 1, 1, 0, 0, 0], "steps": [0, 8, 0, 8, 0, 4, 8],
         "loss": [3.0, 1.0, 5.0, 2.0, 3.0, 2.5, 2.0], "success_rate": [0.0, 0.4, 0.0, 0.8, 0.0, np.nan, 0.5]}
    )  # fmt: skip


def test_two_curves_of_one_method_can_be_told_apart():
    table = pd.DataFrame({"FedAvg, nobody attacks": [3.0, 1.0], "FedAvg": [3.0, 4.0], "Krum": [3.0, 2.0]})
    honest, attacked, krum = plots.curves(table, xlabel="round", ylabel="loss").get_lines()
    assert honest.get_color() == attacked.get_color() != krum.get_color()
    assert honest.get_linestyle() != attacked.get_linestyle() and krum.get_linestyle() == "-"


def test_learning_curves_show_mean_and_range_over_seeds():
    axes = plots.learning_curves(checkpoint_table())
    assert all(map(labelled, axes)) and axes[0].get_yscale() == "log"
    np.testing.assert_allclose(axes[0].lines[0].get_xydata(), [[0, 4], [8, 1.5]])
    np.testing.assert_allclose(axes[1].lines[0].get_xydata(), [[0, 0], [8, 0.6]])
    np.testing.assert_allclose(axes[1].lines[1].get_xydata(), [[0, 0], [8, 0.5]])  # no gap where none was measured
    band = axes[1].collections[0].get_paths()[0].vertices
    assert band[:, 1].max() == 0.8 and band[band[:, 0] == 8][:, 1].min() == 0.4
    (legend,) = axes[0].figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["a", "b"]


def test_checkpoints_are_points_of_loss_and_success():
    ax = plots.checkpoints(checkpoint_table())
    assert labelled(ax) and [text.get_text() for text in ax.get_legend().get_texts()] == ["a", "b"]
    np.testing.assert_allclose(ax.lines[0].get_xydata(), [[3, 0], [1, 0.4], [5, 0], [2, 0.8]])
    assert ax.lines[0].get_linestyle() == "None" and ax.lines[0].get_marker() != ax.lines[1].get_marker()


def test_heat_maps_share_a_scale_and_leave_gaps():
    one = pd.DataFrame([[1.0, np.nan], [0.5, 2.0]], index=["layer 0", "projections"], columns=[1, 2])
    axes = plots.heat_maps({"lift": one, "push": 2 * one}, xlabel="round", ylabel="part", label="length")
    assert [ax.get_title() for ax in axes] == ["lift", "push"] and labelled(axes[0])
    np.testing.assert_array_equal(axes[0].images[0].get_array(), np.ma.masked_invalid(one.to_numpy()))
    assert [ax.images[0].get_clim() for ax in axes] == [(0, 4)] * 2
    assert [text.get_text() for text in axes[0].get_yticklabels()] == list(one.index)
    assert axes[0].figure.axes[-1].get_ylabel() == "length"  # the scale says what the colours are
    signed = plots.heat_maps({"lift": one / 4}, xlabel="round", ylabel="part", label="cosine", signed=True)
    assert signed[0].images[0].get_clim() == (-1, 1)


def test_success_per_megabyte_is_points_over_bytes_with_the_ends_of_the_interval():
    table = pd.DataFrame(
        {"method": ["a", "b"], "MB": [50.0, 10.0], "success_rate": [0.5, 0.2], "low": [0.4, 0.1], "high": [0.7, 0.3]}
    )
    ax = plots.success_per_megabyte(table)
    assert [bar.get_width() for bar in ax.patches] == pytest.approx([1, 2])
    assert labelled(ax) and "points per MB" in ax.get_xlabel()
    bars = ax.containers[0].lines[2][0]
    np.testing.assert_allclose(bars.get_segments()[0][:, 0], [0.8, 1.4])


def test_a_federation_shows_every_client_in_its_colour_and_who_is_refused():
    ax = plots.federation(["client 0", "client 1"], down="weights", up="numbers", refused="intruder")
    faces = [matplotlib.colors.to_hex(box.get_facecolor()) for box in ax.patches]
    assert faces[1:3] == [plots.client_color(k).lower() for k in (0, 1)]
    said = " ".join(text.get_text() for text in ax.texts)
    assert all(word in said for word in ("server", "client 1", "intruder", "✗", "weights", "numbers"))
    assert "✗" not in " ".join(text.get_text() for text in plots.federation(["a"], down="", up="").texts)


def test_client_drift_draws_every_local_phase_and_the_averages():
    server = np.array([[0.0, 0.0], [1.0, 1.0], [2.0, 1.0]])
    local = [np.zeros((2, 4, 2)), np.ones((2, 4, 2))]
    ax = plots.client_drift(server, local, np.eye(2), np.array([0.5, 0.5]))
    assert sum(line.get_color() == plots.client_color(1) for line in ax.lines) == 3 and labelled(ax)
    (averages,) = [line for line in ax.lines if (line.get_label() or "").startswith("server")]
    np.testing.assert_allclose(averages.get_xydata(), server)


def test_methods_and_clients_have_one_colour_each():
    assert len({plots.method_color(method) for method in plots.METHOD_COLORS}) == len(plots.METHOD_COLORS)
    for figure in (plots.curves, plots.grouped_bars):  # wherever a method stands among others
        table = pd.DataFrame({"other": [1.0, 2.0], "centralized": [1.0, 2.0]})
        ax = figure(table, xlabel="x", ylabel="y")
        found = ax.lines[1].get_color() if ax.lines else matplotlib.colors.to_hex(ax.patches[2].get_facecolor())
        assert found.lower() == plots.METHOD_COLORS["centralized"].lower()
    assert plots.method_color("FedAvg") == plots.method_color("fedavg-200x2x2") == plots.method_color("federated")
    assert plots.method_color("fedavg-10x4x20") != plots.method_color("federated")
    assert len(set(plots.CLIENT_COLORS)) == 10 and plots.client_color(13) == plots.client_color(3)


def colours_in(tree):
    """Every colour that code gives by name or number: as a keyword, in a mapping, or at the head of a line's format."""
    of_a_task = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.keyword) and node.arg == "options"}
    for node in ast.walk(tree):
        given = [node] if isinstance(node, ast.keyword) and node.arg else []
        if isinstance(node, ast.Dict) and id(node) not in of_a_task:  # a cube's colour is none of a figure
            pairs = zip(node.keys, node.values, strict=True)
            given = [ast.keyword(key.value, value) for key, value in pairs if isinstance(key, ast.Constant)]
        for one in given:
            if isinstance(one.value, ast.Constant) and isinstance(one.value.value, str):
                if "color" in str(one.arg) or one.arg == "c":
                    yield one.value.value
        if isinstance(node, ast.Call) and getattr(node.func, "attr", "") in ("plot", "errorbar", "scatter"):
            texts = [a.value for a in node.args if isinstance(a, ast.Constant) and isinstance(a.value, str)]
            yield from (text[0] for text in texts if text[0] in "bgrcmyk" or text.startswith("C"))
        if isinstance(node, ast.Constant) and re.fullmatch(r"#[0-9A-Fa-f]{6}", str(node.value)):
            yield node.value


def is_neutral(colour):
    if colour in ("black", "white", "k", "w", "none"):
        return True
    return colour.startswith("#") and len({colour[i : i + 2].lower() for i in (1, 3, 5)}) == 1  # a grey


def sources():
    """The modules of figures, and the code of every chapter."""
    for path in sorted(Path(plots.__file__).parent.glob("*.py")):
        yield pytest.param(path.read_text(), id=f"plots.{path.stem}")
    for path in sorted((Path(__file__).parents[1] / "notebooks").glob("*.ipynb")):
        cells = [cell.source for cell in nbformat.read(path, as_version=4).cells if cell.cell_type == "code"]
        yield pytest.param("\n".join(cells), id=path.stem)


@pytest.mark.parametrize("code", list(sources()))
def test_no_figure_has_a_colour_of_its_own(code):
    known = {*plots.PALETTE, *plots.CLIENT_COLORS, *plots.style.METHOD_FAMILIES.values()}
    assert not [colour for colour in colours_in(ast.parse(code)) if colour not in known and not is_neutral(colour)]


def test_a_raw_colour_would_be_noticed():
    said = ast.parse("ax.plot(x, y, 'r--', color='tab:red', label='k'); ax.bar(x, y, edgecolor='#12AB34')")
    assert {"r", "tab:red", "#12AB34"} == {colour for colour in colours_in(said) if not is_neutral(colour)}
