"""Tables -> Axes. Every function draws one figure's content, labels its axes with units and returns the Axes.

Figures have an opaque white ground so that they stay readable on a dark page; colours are Okabe and Ito's, which remain
distinct for colour-blind readers. One arm and one client keep one colour throughout the book: ask `arm_color` and
`client_color`; other things that are told apart in one figure only take the palette in its order.
"""

from collections.abc import Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure

from fedvla_lib.spec import FPS, JOINT_NAMES, JOINT_UNITS

PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#F0E442", "#000000")
ARM_COLORS = {"base": "#7F7F7F", "local-only": "#E69F00", "federated": "#0072B2", "centralized": "#009E73"}
ARM_FAMILIES = {  # what a stored arm's name begins with -> its colour; a cadence or an addition follows the name
    **ARM_COLORS,
    "fedavg": ARM_COLORS["federated"],
    "fedavg-10x4x20": "#56B4E9",
    "scaffold": "#D55E00",
    "fedprox": "#CC79A7",
}
DASHES = ("-", "--", "-.")
# Okabe and Ito's, then two of Tol's muted scheme: ten clients is what a federation of this book has.
CLIENT_COLORS = (*PALETTE[:6], "#117733", "#000000", "#882255", "#7F7F7F")
WIDTH = 7  # inches; on a page a wider figure shrinks, and its text with it
STYLE = {
    "figure.facecolor": "white",
    "savefig.facecolor": "white",
    "axes.facecolor": "white",
    "axes.grid": True,
    "axes.axisbelow": True,  # bars cover the grid
    "grid.color": "#DDDDDD",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "figure.dpi": 110,
    "font.size": 10,
    "axes.prop_cycle": plt.cycler(color=PALETTE),
}


def use_style() -> None:
    """Apply the book's figure style to this session."""
    plt.rcParams.update(STYLE)


def arm_color(arm: str, other: int = 0) -> str:
    """Return the colour of an arm throughout the book; one without its own takes number `other` of the palette."""
    name = arm.lower().replace(", ", "-") + "-"
    own = [color for family, color in ARM_FAMILIES.items() if name.startswith(f"{family}-")]
    return own[-1] if own else PALETTE[other % len(PALETTE)]


def client_color(client: int) -> str:
    """Return the colour of a client throughout the book, by its number; ten differ."""
    return CLIENT_COLORS[client % len(CLIENT_COLORS)]


def joints(states: np.ndarray, actions: np.ndarray, *, axes: Sequence[Axes] | None = None) -> Sequence[Axes]:
    """Draw measured state and commanded action, both (T, 6), against time: one panel per joint."""
    if axes is None:
        axes = _joint_axes()
    seconds = np.arange(len(states)) / FPS
    for i, ax in enumerate(axes):
        ax.plot(seconds, states[:, i], label="state")
        ax.plot(seconds, actions[:, i], "--", label="action")
        ax.set_title(JOINT_NAMES[i], fontsize=10)
        ax.set_ylabel(f"position [{JOINT_UNITS[i]}]")
    for ax in axes[-2:]:
        ax.set_xlabel("time [s]")
    axes[0].legend(frameon=False)
    return axes


def film_strip(frames: np.ndarray, *, count: int = 6, title: str = "", ax: Axes | None = None) -> Axes:
    """Draw `count` frames of a video (T, H, W, 3), evenly spaced from first to last, side by side."""
    picks = np.linspace(0, len(frames) - 1, min(count, len(frames))).round().astype(int)
    if ax is None:
        height = WIDTH / len(picks) * frames.shape[1] / frames.shape[2] + 0.6
        _, ax = plt.subplots(figsize=(WIDTH, height), layout="constrained")
    gap = max(1, frames.shape[2] // 32)  # white, so that one frame does not run into the next
    spaced = np.pad(frames[picks], ((0, 0), (0, 0), (0, gap), (0, 0)), constant_values=255)
    ax.imshow(np.concatenate(list(spaced), axis=1)[:, :-gap])
    centres = np.arange(len(picks)) * spaced.shape[2] + frames.shape[2] / 2
    ax.set_xticks(centres, [f"{i / FPS:.1f} s" for i in picks])
    ax.set_yticks([])
    ax.grid(False)
    ax.set_xlabel("time in the episode")
    ax.set_title(title)
    return ax


def client_counts(counts: pd.DataFrame, *, ax: Axes | None = None) -> Axes:
    """Draw episodes per client as stacked bars: rows are clients, columns are tasks."""
    ax = ax or _new_axes()
    bottom = np.zeros(len(counts))
    for i, task in enumerate(counts.columns):
        ax.bar(counts.index.astype(str), counts[task], bottom=bottom, label=task, color=PALETTE[i % len(PALETTE)])
        bottom += counts[task].to_numpy()
    ax.set_ylim(0, max(1.08 * bottom.max(), ax.get_ylim()[1]))  # the other panels of a shared scale count too
    ax.set_xlabel("client")
    ax.set_ylabel("episodes")
    ax.legend(frameon=False, title="task")
    return ax


def loss_curve(losses: Sequence[float], *, label: str = "training", smooth: int = 20, ax: Axes | None = None) -> Axes:
    """Draw the loss of each step, with a moving average over `smooth` steps on top."""
    ax = ax or _new_axes()
    values = pd.Series(list(losses))
    steps = np.arange(1, len(values) + 1)
    (line,) = ax.plot(steps, values, alpha=0.3)
    ax.plot(steps, values.rolling(smooth, min_periods=1).mean(), color=line.get_color(), label=label)
    ax.set_xlabel("optimiser step")
    ax.set_ylabel("flow-matching loss [normalised units²]")
    ax.set_ylim(bottom=0)
    ax.legend(frameon=False)
    return ax


def by_round(table: pd.DataFrame, value: str, *, ylabel: str, label: str = "", ax: Axes | None = None) -> Axes:
    """Draw a metric against the round; columns `low` and `high`, where present, become a band."""
    ax = ax or _new_axes()
    (line,) = ax.plot(table["round"], table[value], "o-", label=label or value)
    if {"low", "high"} <= set(table.columns):
        ax.fill_between(table["round"], table.low, table.high, color=line.get_color(), alpha=0.15)
    _round_ticks(ax, table["round"])
    ax.set_xlabel("round")
    ax.set_ylabel(ylabel)
    ax.legend(frameon=False)
    return ax


def trends(table: pd.DataFrame, labels: dict[str, str]) -> Sequence[Axes]:
    """Draw metrics against the round, a panel each; columns round, metric, value, low, high; labels by metric."""
    metrics = list(dict.fromkeys(table.metric))
    _, axes = plt.subplots(len(metrics), 1, figsize=(WIDTH, 2.6 * len(metrics)), squeeze=False, layout="constrained")
    for ax, metric in zip(axes[:, 0], metrics, strict=True):
        by_round(table[table.metric == metric], "value", ylabel=labels[metric], label="mean (band: 95 %)", ax=ax)
    return axes[:, 0]


def success_bars(table: pd.DataFrame, *, ax: Axes | None = None) -> Axes:
    """Draw success rates with their intervals; columns arm, task, success_rate, low, high."""
    ax = ax or _new_axes()
    arms, tasks = list(dict.fromkeys(table.arm)), list(dict.fromkeys(table.task))
    width = 0.8 / len(arms)
    for i, arm in enumerate(arms):
        part = table[table.arm == arm].set_index("task").loc[tasks]
        errors = np.abs(np.stack([part.success_rate - part.low, part.high - part.success_rate]))
        place = np.arange(len(tasks)) + (i - (len(arms) - 1) / 2) * width
        ax.bar(place, part.success_rate, width * 0.9, yerr=errors, capsize=3, label=arm, color=arm_color(arm, i))
    ax.set_xticks(range(len(tasks)), tasks)
    ax.set_ylim(0, 1.02)
    ax.set_xlabel("task")
    ax.set_ylabel("success rate (95 % interval)")
    ax.legend(frameon=False, ncols=len(arms), loc="upper center", bbox_to_anchor=(0.5, 1.14))
    return ax


def _new_axes() -> Axes:
    _, ax = plt.subplots(figsize=(WIDTH, 3.6), layout="constrained")
    return ax


def _round_ticks(ax: Axes, rounds: pd.Series) -> None:
    """A tick for each round, or for some of them where the labels of all would touch."""
    numbers = sorted(set(rounds))
    if len(numbers) <= 8:
        ax.set_xticks(numbers)
    else:
        ax.xaxis.set_major_locator(plt.MaxNLocator(6, integer=True))


def _joint_axes() -> Sequence[Axes]:
    """A panel per joint, two side by side: three would be too small on a page."""
    _, grid = plt.subplots(3, 2, figsize=(WIDTH, 6.2), sharex=True, layout="constrained")
    return grid.ravel()


def module_bars(table: pd.DataFrame, *, ax: Axes | None = None) -> Axes:
    """Draw parameters per part of a model, trainable and frozen; columns part, parameters, trainable."""
    if ax is None:
        _, ax = plt.subplots(figsize=(WIDTH, 0.38 * len(table) + 1.1), layout="constrained")
    millions, trainable = table.parameters / 1e6, table.trainable / 1e6
    ax.barh(table.part, trainable, color=PALETTE[0], label="trainable")
    ax.barh(table.part, millions - trainable, left=trainable, color="#BBBBBB", label="frozen")
    for place, count in enumerate(table.parameters):
        ax.annotate(f"{count:,}", (millions.iloc[place], place), xytext=(4, 0), textcoords="offset points", va="center")
    ax.set_xlim(0, 1.2 * millions.max())
    ax.invert_yaxis()
    ax.set_xlabel("parameters [millions]")
    ax.set_ylabel("part of the model")
    ax.legend(frameon=False, loc="lower right")
    return ax


def trainable_bars(tables: dict[str, pd.DataFrame], *, ax: Axes | None = None) -> Axes:
    """Draw how many parameters train under each setting, split into parts (columns as `module_bars`)."""
    if ax is None:
        _, ax = plt.subplots(figsize=(WIDTH, 0.5 * len(tables) + 1.9), layout="constrained")
    counts = pd.DataFrame({name: table.set_index("part").trainable for name, table in tables.items()}) / 1e6
    left = np.zeros(len(tables))
    for i, part in enumerate(counts.index[counts.sum(axis=1) > 0]):
        ax.barh(counts.columns, counts.loc[part], left=left, label=part, color=PALETTE[i % len(PALETTE)])
        left += counts.loc[part].to_numpy()
    ax.invert_yaxis()
    ax.set_xlabel("trainable parameters [millions]")
    ax.set_ylabel("setting")
    ax.legend(frameon=False, fontsize=8, ncols=2, loc="upper center", bbox_to_anchor=(0.4, -0.3))
    return ax


def flow(
    points: np.ndarray, times: Sequence[float], *, ylabel: str, goal: np.ndarray | None = None, ax: Axes | None = None
) -> Axes:
    """Draw one joint of an action chunk from noise to plan: `points` (times, chunk), a line per flow time."""
    ax = ax or _new_axes()
    steps = np.arange(1, points.shape[1] + 1)
    shades = plt.get_cmap("viridis")(np.asarray(times) * 0.9)
    for time, line, shade in zip(times, points, shades, strict=True):
        ax.plot(steps, line, ".-", color=shade, linewidth=1, label=f"t = {time:.2f}")
    if goal is not None:
        ax.plot(steps, goal, "k--", label="demonstration")
    ax.set_xlabel("step of the chunk")
    ax.set_ylabel(ylabel)
    return ax


def padding(masks: np.ndarray, *, ax: Axes | None = None) -> Axes:
    """Draw which steps of action chunks are padding: `masks` bool (samples, chunk)."""
    ax = ax or _new_axes()
    colors = ListedColormap([PALETTE[0], "#DDDDDD"])
    ax.imshow(masks, cmap=colors, vmin=0, vmax=1, aspect="auto", extent=(0.5, masks.shape[1] + 0.5, len(masks), 0))
    for value, name in enumerate(("real action: counts in the loss", "padding: left out")):
        ax.plot([], [], "s", color=colors(value), label=name)
    ax.grid(False)
    ax.set_xlabel("step of the chunk")
    ax.set_ylabel("frames before the end of the episode")
    ax.set_yticks(np.arange(len(masks)) + 0.5, np.arange(len(masks), 0, -1), fontsize=8)
    ax.legend(frameon=False, ncols=2, loc="upper center", bbox_to_anchor=(0.5, 1.15))
    return ax


def learning_rate(rates: Sequence[float], *, ax: Axes | None = None) -> Axes:
    """Draw the learning rate of each optimiser step."""
    ax = ax or _new_axes()
    ax.plot(np.arange(1, len(rates) + 1), rates, "-" if len(rates) > 20 else "o-")
    ax.set_ylim(0, 1.1 * max(rates))
    ax.set_xlabel("optimiser step")
    ax.set_ylabel("learning rate of AdamW")
    return ax


def error_by_joint(errors: pd.DataFrame, *, ax: Axes | None = None) -> Axes:
    """Draw the action error of each joint as grouped bars: rows are joints, columns are models."""
    ax = ax or _new_axes()
    width = 0.8 / errors.shape[1]
    for i, name in enumerate(errors.columns):
        place = np.arange(len(errors)) + (i - (errors.shape[1] - 1) / 2) * width
        ax.bar(place, errors[name], width * 0.9, label=name)
    units = dict(zip(JOINT_NAMES, JOINT_UNITS, strict=True))
    ax.set_xticks(range(len(errors)), [f"{j.removesuffix('.pos')}\n[{units[j]}]" for j in errors.index], fontsize=8)
    ax.set_xlabel("joint")
    ax.set_ylabel("mean absolute action error")
    ax.legend(frameon=False)
    return ax


def loss_and_success(table: pd.DataFrame, x: str, *, xlabel: str, axes: Sequence[Axes] | None = None) -> Sequence[Axes]:
    """Draw held-out loss above success rate over `x`; columns loss, success_rate, low, high (NaN: not measured)."""
    if axes is None:
        _, axes = plt.subplots(2, 1, figsize=(7, 4.8), sharex=True, layout="constrained")
    axes[0].plot(table[x], table.loss, "o-", color=PALETTE[1])
    axes[0].set_ylabel("held-out loss\n[normalised units²]")
    axes[0].set_ylim(0, 1.1 * table.loss.max())
    seen = table.dropna(subset=["success_rate"])
    errors = np.abs(np.stack([seen.success_rate - seen.low, seen.high - seen.success_rate]))
    axes[1].errorbar(seen[x], seen.success_rate, yerr=errors, fmt="o-", capsize=3, color=PALETTE[0])
    axes[1].set_ylim(-0.02, 1.02)
    axes[1].set_ylabel("success rate\n(95 % Wilson interval)")
    axes[1].set_xlabel(xlabel)
    for ax in axes:
        ax.set_xticks(sorted(set(table[x])))
    return axes


def rollout_grid(rows: pd.DataFrame, *, ax: Axes | None = None) -> Axes:
    """Draw who succeeded when: a square per client and round with its task; columns who, round, task, success."""
    who, rounds = list(dict.fromkeys(rows.who)), sorted(rows["round"].unique())
    if ax is None:
        _, ax = plt.subplots(figsize=(2.6 + 1.3 * len(rounds), 0.42 * len(who) + 1.2), layout="constrained")
    for (name, number), group in rows.groupby(["who", "round"]):
        x, y, share = rounds.index(number), who.index(name), group.success.mean()
        color = PALETTE[2] if share == 1 else PALETTE[1] if share == 0 else PALETTE[4]
        ax.add_patch(plt.Rectangle((x - 0.45, y - 0.4), 0.9, 0.8, color=color, alpha=0.35))
        text = f"{', '.join(dict.fromkeys(group.task))}\n{int(group.success.sum())}/{len(group)}"
        ax.text(x, y, text, ha="center", va="center", fontsize=8)
    ax.set_xlim(-0.6, len(rounds) - 0.4)
    ax.set_ylim(len(who) - 0.4, -0.6)
    ax.set_xticks(range(len(rounds)), rounds)
    ax.set_yticks(range(len(who)), who)
    ax.grid(False)
    ax.set_xlabel("round")
    ax.set_ylabel("where the rollouts ran")
    return ax


def interval_width(table: pd.DataFrame, *, ax: Axes | None = None) -> Axes:
    """Draw the width of an interval against the number of rollouts; columns n, width, success_rate (one line each)."""
    ax = ax or _new_axes()
    for rate, part in table.groupby("success_rate"):
        ax.plot(part.n, 100 * part.width, "o-", label=f"{rate:.0%} succeed")
    ax.set_xscale("log")
    ax.set_ylim(bottom=0)
    ax.set_xlabel("number of rollouts (logarithmic)")
    ax.set_ylabel("width of the 95 % interval [points]")
    ax.legend(frameon=False)
    return ax


def power(table: pd.DataFrame, *, ax: Axes | None = None) -> Axes:
    """Draw how often a difference is detected against the rollouts per model; columns n, power, difference."""
    ax = ax or _new_axes()
    for difference, part in table.groupby("difference"):
        ax.plot(part.n, part.power, "o-", label=f"true difference {100 * difference:.0f} points")
    ax.axhline(0.8, color="#555555", linestyle=":", linewidth=1)
    ax.set_xscale("log")
    ax.set_ylim(0, 1.02)
    ax.set_xlabel("rollouts per model (logarithmic)")
    ax.set_ylabel("share of experiments that see it")
    ax.legend(frameon=False)
    return ax


def trajectories(by_name: dict[str, np.ndarray], *, axes: Sequence[Axes] | None = None) -> Sequence[Axes]:
    """Draw measured joint positions (T, 6) of several actors against time: one panel per joint."""
    if axes is None:
        axes = _joint_axes()
    for i, ax in enumerate(axes):
        for name, states in by_name.items():
            ax.plot(np.arange(len(states)) / FPS, states[:, i], label=name)
        ax.set_title(JOINT_NAMES[i], fontsize=10)
        ax.set_ylabel(f"position [{JOINT_UNITS[i]}]")
    for ax in axes[-2:]:
        ax.set_xlabel("time [s]")
    axes[0].legend(frameon=False, fontsize=8)
    return axes


def film_strips(images: dict[str, np.ndarray], *, count: int = 6, axes: Sequence[Axes] | None = None) -> Sequence[Axes]:
    """Draw each camera's film strip, camera -> (T, H, W, 3), one under the other."""
    if axes is None:
        _, grid = plt.subplots(len(images), 1, figsize=(WIDTH, 1.7 * len(images)), layout="constrained", squeeze=False)
        axes = grid.ravel()
    for ax, (camera, frames) in zip(axes, images.items(), strict=True):
        film_strip(frames, count=count, title=f"camera: {camera}", ax=ax)
    for ax in axes[:-1]:
        ax.set_xlabel("")
    return axes


def pictures(rows: dict[str, np.ndarray], *, titles: Sequence[str] = (), axes: np.ndarray | None = None) -> np.ndarray:
    """Draw a table of pictures: each entry of `rows` is one row of them, (n, H, W, 3); `titles` name the columns."""
    count = len(next(iter(rows.values())))
    if axes is None:
        side = min(WIDTH / count, 2.2)
        size = (side * count, side * len(rows) + 0.4)
        _, axes = plt.subplots(len(rows), count, figsize=size, layout="constrained", squeeze=False)
    for line, (name, frames) in zip(axes, rows.items(), strict=True):
        line[0].set_ylabel(name)
        for ax, frame in zip(line, frames, strict=True):
            ax.imshow(frame)
            ax.set_xticks([])
            ax.set_yticks([])
    for ax, title in zip(axes[0], titles, strict=False):
        ax.set_title(title, fontsize=8)
    return axes


def chunk(
    actions: np.ndarray, frame: int, future: np.ndarray, is_pad: np.ndarray, *, joint: int = 0, ax: Axes | None = None
) -> Axes:
    """Draw one joint of an episode's actions (T, 6) and the chunk `future` (C, 6) that starts at `frame`."""
    ax = ax or _new_axes()
    seconds = (frame + np.arange(len(future))) / FPS
    ax.plot(np.arange(len(actions)) / FPS, actions[:, joint], color="#999999", label="action, whole episode")
    ax.plot(seconds[~is_pad], future[~is_pad, joint], "o", color=PALETTE[0], label="chunk")
    ax.plot(seconds[is_pad], future[is_pad, joint], "x", color=PALETTE[1], label="chunk, padding")
    ax.axvline(frame / FPS, color="black", linestyle=":", label="observation")
    ax.set_xlabel("time in the episode [s]")
    ax.set_ylabel(f"{JOINT_NAMES[joint]} [{JOINT_UNITS[joint]}]")
    ax.legend(frameon=False)
    return ax


def likeness(gaps_s: np.ndarray, distances: np.ndarray, elsewhere: float, *, ax: Axes | None = None) -> Axes:
    """Draw how far apart two frames of an episode are against the time between them; `elsewhere`: another episode's."""
    ax = ax or _new_axes()
    ax.plot(gaps_s, distances, "o-", label="same episode")
    ax.axhline(elsewhere, color=PALETTE[1], linestyle="--", label="another episode, same task and moment")
    ax.set_ylim(bottom=0)
    ax.set_xlabel("time between the two frames [s]")
    ax.set_ylabel("mean difference [grey levels of 255]")
    ax.legend(frameon=False)
    return ax


def client_counts_grid(counts: dict[str, pd.DataFrame], *, axes: Sequence[Axes] | None = None) -> Sequence[Axes]:
    """Draw `client_counts` of several partitions side by side, on one scale; the keys become titles."""
    if axes is None:
        _, axes = plt.subplots(1, len(counts), figsize=(WIDTH, 3.2), sharey=True, layout="constrained")
    for ax, (name, table) in zip(axes, counts.items(), strict=True):
        client_counts(table, ax=ax)
        ax.set_title(name, fontsize=10)
        ax.get_legend().remove()
        ax.yaxis.set_major_locator(plt.MaxNLocator(integer=True))
    for ax in axes[1:]:
        ax.set_ylabel("")
    _legend_above(axes)
    return axes


def heterogeneity(table: pd.DataFrame, *, bounds: dict[str, float] | None = None, ax: Axes | None = None) -> Axes:
    """Draw columns `total_variation` against `alpha`, one dot a draw, with mean and range; `bounds`: named levels."""
    ax = ax or _new_axes()
    groups = table.groupby("alpha").total_variation
    ax.fill_between(groups.mean().index, groups.min(), groups.max(), alpha=0.15)
    ax.plot(table.alpha, table.total_variation, "o", color=PALETTE[0], alpha=0.4, markersize=4, label="one draw")
    ax.plot(groups.mean().index, groups.mean(), color=PALETTE[0], label="mean; band: lowest to highest draw")
    for (name, level), style in zip((bounds or {}).items(), ("--", ":", "-."), strict=False):
        ax.axhline(level, color="#555555", linestyle=style, label=name)
    ax.set_xscale("log")
    ax.set_ylim(bottom=-0.02)
    ax.set_xlabel("Dirichlet concentration alpha (log scale)")
    ax.set_ylabel("total variation distance")
    ax.legend(frameon=False, fontsize=8, ncols=4, loc="upper center", bbox_to_anchor=(0.5, 1.12))
    return ax


def client_statistics(
    means: np.ndarray,
    stds: np.ndarray,
    pooled_mean: np.ndarray,
    pooled_std: np.ndarray,
    *,
    axes: Sequence[Axes] | None = None,
) -> Sequence[Axes]:
    """Draw each client's mean and standard deviation per joint, both (clients, 6), over the pooled ones, (6,)."""
    if axes is None:
        axes = _joint_axes()
    places = np.arange(len(means))
    for i, ax in enumerate(axes):
        low, high = pooled_mean[i] - pooled_std[i], pooled_mean[i] + pooled_std[i]
        ax.axhspan(low, high, color="black", alpha=0.12, label="pooled mean ± std")
        ax.axhline(pooled_mean[i], color="black")
        for k, (mean, std) in enumerate(zip(means[:, i], stds[:, i], strict=True)):
            label = "" if k else "client mean ± std"
            ax.errorbar(k, mean, std, fmt="o", capsize=2, markersize=4, color=client_color(k), label=label)
        ax.set_title(JOINT_NAMES[i], fontsize=10)
        ax.set_ylabel(f"action [{JOINT_UNITS[i]}]")
        ax.set_xticks(places)
    for ax in axes[-2:]:
        ax.set_xlabel("client")
    _legend_above(axes)
    return axes


def client_weights(weights: pd.DataFrame, *, ax: Axes | None = None) -> Axes:
    """Draw each client's share of the average, in percent: rows are clients, columns are ways to weight."""
    ax = ax or _new_axes()
    width = 0.8 / len(weights.columns)
    for i, name in enumerate(weights.columns):
        places = np.arange(len(weights)) + (i - (len(weights.columns) - 1) / 2) * width
        ax.bar(places, 100 * weights[name], width * 0.9, label=name)
    ax.set_xticks(range(len(weights)), weights.index.astype(str))
    ax.set_xlabel("client")
    ax.set_ylabel("weight in the average [%]")
    ax.legend(frameon=False, ncols=len(weights.columns), loc="upper center", bbox_to_anchor=(0.5, 1.14))
    return ax


def _legend_above(axes: Sequence[Axes]) -> None:
    """One legend for panels that share their labels, above all of them."""
    handles, labels = axes[0].get_legend_handles_labels()
    axes[0].figure.legend(handles, labels, frameon=False, ncols=len(labels), loc="outside upper center")


def grouped_bars(table: pd.DataFrame, *, xlabel: str, ylabel: str, ax: Axes | None = None) -> Axes:
    """Draw a table as bars: a group per row, a colour per column; an arm keeps its colour."""
    ax = ax or _new_axes()
    width = 0.8 / table.shape[1]
    for i, name in enumerate(table.columns):
        place = np.arange(len(table)) + (i - (table.shape[1] - 1) / 2) * width
        ax.bar(place, table[name], width * 0.9, label=name, color=arm_color(name, i))
    ax.set_xticks(range(len(table)), table.index.astype(str))
    ax.set_xlabel(xlabel)
    ax.set_ylabel(ylabel)
    if table.shape[1] > 1:
        ax.legend(frameon=False, ncols=min(4, table.shape[1]), loc="upper center", bbox_to_anchor=(0.5, 1.16))
    return ax


def clients_by_round(table: pd.DataFrame, value: str, *, ylabel: str, ax: Axes | None = None) -> Axes:
    """Draw a metric of every client by round, and their mean weighted by frames; columns round, who, num_examples."""
    ax = ax or _new_axes()
    for who, part in table.groupby("who", sort=False):
        color = client_color(int(who.removeprefix("client_")))
        ax.plot(part["round"], part[value], ".-", color=color, linewidth=1, label=who.replace("_", " "))
    weighted = (table[value] * table.num_examples).groupby(table["round"]).sum()
    mean = weighted / table.groupby("round").num_examples.sum()
    ax.plot(mean.index, mean, "--", color="black", linewidth=2, label="mean weighted by frames")
    _round_ticks(ax, table["round"])
    ax.set_xlabel("round")
    ax.set_ylabel(ylabel)
    ax.legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return ax


def cosine_map(cosines: np.ndarray, *, title: str = "", ax: Axes | None = None) -> Axes:
    """Draw cosines between the updates of clients, (clients, clients) in [-1, 1], as coloured squares with numbers."""
    ax = ax or _new_axes()
    picture = ax.imshow(cosines, cmap="RdBu", vmin=-1, vmax=1)
    for (i, j), cosine in np.ndenumerate(cosines):
        shade = "white" if abs(cosine) > 0.6 else "black"
        ax.text(j, i, f"{cosine:.2f}", ha="center", va="center", fontsize=8, color=shade)
    ax.set_xticks(range(len(cosines)))
    ax.set_yticks(range(len(cosines)))
    ax.grid(False)
    ax.set_xlabel("client")
    ax.set_ylabel("client")
    ax.set_title(title, fontsize=10)
    ax.figure.colorbar(picture, ax=ax, label="cosine", shrink=0.8)
    return ax


def loss_against_success(table: pd.DataFrame, *, ax: Axes | None = None) -> Axes:
    """Draw one point an arm: held-out loss across, success rate up; columns arm, loss, success_rate, low, high."""
    ax = ax or _new_axes()
    for i, point in enumerate(table.itertuples()):
        color = arm_color(point.arm, i)
        error = np.abs([[point.success_rate - point.low], [point.high - point.success_rate]])
        ax.errorbar(point.loss, point.success_rate, yerr=error, fmt="o", capsize=3, color=color, label=point.arm)
    ax.set_xscale("log")  # the start may lie many times above the trained arms
    ax.set_xlim(table.loss.min() / 1.4, 1.4 * table.loss.max())
    ax.xaxis.set_major_locator(plt.LogLocator(subs=(1, 1.5, 2, 3, 5, 7)))
    ax.xaxis.set_major_formatter(lambda loss, _: f"{loss:g}")
    ax.xaxis.set_minor_locator(plt.NullLocator())
    ax.set_ylim(-0.02, 1.02)
    ax.set_xlabel("held-out loss [normalised units², logarithmic]")
    ax.set_ylabel("success rate (95 % Wilson interval)")
    ax.legend(frameon=False)
    return ax


def paired_differences(table: pd.DataFrame, *, ax: Axes | None = None) -> Axes:
    """Draw differences in success rate with their intervals, a line each; columns arm, other, difference, low, high."""
    if ax is None:
        _, ax = plt.subplots(figsize=(WIDTH, max(3.6, 1.2 + 0.4 * len(table))), layout="constrained")
    places = np.arange(len(table))
    errors = np.abs(np.stack([table.difference - table.low, table.high - table.difference]))
    ax.errorbar(100 * table.difference, places, xerr=100 * errors, fmt="o", capsize=4, color=PALETTE[0])
    ax.axvline(0, color="#555555", linewidth=1)
    reach = max(20, 105 * table[["low", "high"]].abs().to_numpy().max())
    ax.set_xlim(-reach, reach)
    ax.set_yticks(places, table.arm + " − " + table.other)
    ax.set_ylim(len(table) - 0.5, -0.5)
    ax.set_xlabel("difference in success rate [points], 95 % interval")
    ax.set_ylabel("pair of arms")
    return ax


def differences_by_partition(table: pd.DataFrame, *, axes: Sequence[Axes] | None = None) -> Sequence[Axes]:
    """Draw differences in success of one arm to others, a panel for each other arm, a row for each partition.

    Each panel has its own scale: what separates an arm from its rival is small beside what separates it from a bad one.

    Args:
        table: columns partition, arm, other, difference, low, high; the same arm in all lines.
    """
    others, partitions = list(dict.fromkeys(table.other)), list(dict.fromkeys(table.partition))
    if axes is None:
        size = (WIDTH, 1.6 + 0.35 * len(partitions))
        _, axes = plt.subplots(1, len(others), figsize=size, sharey=True, squeeze=False, layout="constrained")
        axes = axes[0]
    for ax, other in zip(axes, others, strict=True):
        part = table[table.other == other]
        rows = [partitions.index(name) for name in part.partition]
        errors = 100 * np.abs(np.stack([part.difference - part.low, part.high - part.difference]))
        ax.errorbar(100 * part.difference, rows, xerr=errors, fmt="o", capsize=4, color=arm_color(other))
        ax.axvline(0, color="#555555", linewidth=1)
        ax.set_title(f"{table.arm.iloc[0]}\n− {other}", fontsize=10)
        ax.set_xlabel("difference [points],\n95 % interval")
    axes[0].set_yticks(range(len(partitions)), partitions)
    axes[0].set_ylim(len(partitions) - 0.5, -0.5)
    axes[0].set_ylabel("partition")
    return axes


def run_differences(table: pd.DataFrame, *, note: str = "") -> Sequence[Axes]:
    """Draw each metric's differences to the first run with their intervals; columns run, against, metric, difference...

    Args:
        note: what makes the runs incomparable; it becomes the title.
    """
    metrics = list(dict.fromkeys(table.metric))
    figure, axes = plt.subplots(1, len(metrics), figsize=(WIDTH, 1.2 + 0.4 * table.run.nunique()), squeeze=False)
    for ax, metric in zip(axes[0], metrics, strict=True):
        part = table[table.metric == metric]
        errors = np.abs(np.stack([part.difference - part.low, part.high - part.difference]))
        ax.errorbar(part.difference, range(len(part)), xerr=errors, fmt="o", capsize=4, color=PALETTE[0])
        ax.axvline(0, color="#555555", linewidth=1)
        ax.set_yticks(range(len(part)), part.run if ax is axes[0][0] else [])
        ax.set_ylim(len(part) - 0.5, -0.5)
        ax.set_xlabel(metric.replace("_", " "))
    axes[0][0].set_ylabel(f"run − {table.against.iloc[0]}")
    figure.suptitle(f"not comparable: {note}" if note else "", fontsize=9, wrap=True)
    figure.tight_layout()
    return axes[0]


def save(axes: Axes | Sequence[Axes], path: Path) -> None:
    """Write the figure of the axes as a picture, and close it."""
    figure = (axes if isinstance(axes, Axes) else axes[0]).figure
    figure.savefig(path, bbox_inches="tight")
    plt.close(figure)


def curves(table: pd.DataFrame, *, xlabel: str, ylabel: str, ax: Axes | None = None) -> Axes:
    """Draw each column of a table against its index; a column named ``optimum`` is a dotted line.

    Columns of one colour, such as two runs of one arm, differ by their dashes.
    """
    ax = ax or _new_axes()
    colors = [_column_color(str(name), i) for i, name in enumerate(table.columns)]
    for i, name in enumerate(table.columns):
        dashes = DASHES[colors[:i].count(colors[i]) % len(DASHES)]
        look = {"color": "black", "linestyle": ":"} if name == "optimum" else {"color": colors[i], "linestyle": dashes}
        ax.plot(table.index, table[name], label=name, **look)
    ax.set_xlabel(xlabel)
    ax.set_ylabel(ylabel)
    ax.legend(frameon=False, ncols=min(4, table.shape[1]), loc="lower center", bbox_to_anchor=(0.5, 1.0))
    return ax


def _column_color(name: str, place: int) -> str:
    """A client keeps its colour; other columns are arms, or take the palette in order."""
    kind, _, number = name.partition(" ")
    return client_color(int(number)) if kind == "client" and number.isdigit() else arm_color(name, place)


def success_intervals(table: pd.DataFrame, *, ylabel: str = "strategy", ax: Axes | None = None) -> Axes:
    """Draw a success rate with its interval for each line; columns arm, partition, success_rate, low, high.

    A partition has a colour and a place within the arm's row, so that arms can be compared in each.
    """
    arms, partitions = list(dict.fromkeys(table.arm)), list(dict.fromkeys(table.partition))
    if ax is None:
        _, ax = plt.subplots(figsize=(WIDTH, 1.2 + 0.3 * len(arms) + 0.1 * len(table)), layout="constrained")
    for i, partition in enumerate(partitions):
        part = table[table.partition == partition]
        rows = np.array([arms.index(arm) for arm in part.arm]) + 0.6 * ((i + 0.5) / len(partitions) - 0.5)
        errors = 100 * np.abs(np.stack([part.success_rate - part.low, part.high - part.success_rate]))
        if len(partitions) == 1:  # then the colours are the arms'
            for row, rate, error, arm in zip(rows, 100 * part.success_rate, errors.T, part.arm, strict=True):
                look = {"fmt": "o", "capsize": 3, "color": arm_color(arm, int(row))}
                ax.errorbar(rate, row, xerr=error[:, None], **look)
            continue
        color = PALETTE[i % len(PALETTE)]
        ax.errorbar(100 * part.success_rate, rows, xerr=errors, fmt="o", capsize=3, color=color, label=partition)
    ax.set_yticks(range(len(arms)), arms)
    ax.set_ylim(len(arms) - 0.5, -0.5)
    ax.set_xlim(-2, 102)
    ax.set_xlabel("success rate [%], 95 % interval")
    ax.set_ylabel(ylabel)
    if len(partitions) > 1:
        at = {"loc": "lower center", "bbox_to_anchor": (0.5, 1.0)}
        ax.legend(frameon=False, ncols=len(partitions), title="partition", **at)
    return ax


def success_by_bytes(table: pd.DataFrame, *, ax: Axes | None = None) -> Axes:
    """Draw success against what travelled, a labelled point a line; columns arm, MB, success_rate, low, high.

    Points of equal MB would hide each other: they stand side by side, around their place.
    """
    if ax is None:
        _, ax = plt.subplots(figsize=(WIDTH, 4.6), layout="constrained")
    alike = table.groupby(table.MB.round()).cumcount()
    middle = (table.groupby(table.MB.round()).MB.transform("size") - 1) / 2
    places = table.MB * 1.08 ** (alike - middle)
    for i, (place, row) in enumerate(zip(places, table.itertuples(), strict=True)):
        errors = 100 * np.abs([[row.success_rate - row.low], [row.high - row.success_rate]])
        color, marker = arm_color(row.arm, i), "osD^vP*X"[(i + i // 8) % 8]
        ax.errorbar(place, 100 * row.success_rate, yerr=errors, fmt=marker, capsize=3, color=color, label=row.arm)
    ax.set_xscale("log")
    ax.set_ylim(-2, 102)
    ax.set_xlabel("everything that travelled [MB], equals side by side")
    ax.set_ylabel("success rate [%], 95 % interval")
    ax.legend(frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8)
    return ax


def learning_curves(rounds: pd.DataFrame, *, axes: Sequence[Axes] | None = None) -> Sequence[Axes]:
    """Draw held-out loss and success against gradient steps, an arm a colour: mean and range over training seeds.

    Args:
        rounds: columns arm, run, steps, loss, success_rate (NaN: not measured).
    """
    if axes is None:
        _, axes = plt.subplots(1, 2, figsize=(WIDTH, 3.4), layout="constrained")
    for i, (arm, part) in enumerate(rounds.groupby("arm", sort=False)):
        for ax, value in zip(axes, ("loss", "success_rate"), strict=True):
            over = part.dropna(subset=[value]).groupby("steps")[value].agg(["mean", "min", "max"])
            ax.plot(over.index, over["mean"], "o-", color=arm_color(arm, i), label=arm)
            ax.fill_between(over.index, over["min"], over["max"], color=arm_color(arm, i), alpha=0.15)
            ax.set_xlabel("gradient steps of all clients")
    axes[0].set_ylabel("held-out loss [normalised units²]")
    axes[0].set_yscale("log")
    axes[0].yaxis.set_major_locator(plt.LogLocator(subs=(1, 2, 5)))
    axes[0].yaxis.set_major_formatter("{x:g}")
    axes[0].yaxis.set_minor_formatter(plt.NullFormatter())
    axes[1].set_ylabel("success rate")
    axes[1].set_ylim(-0.02, 1.02)
    axes[0].figure.legend(*axes[0].get_legend_handles_labels(), frameon=False, ncols=3, loc="outside upper center")
    return axes


def checkpoints(rounds: pd.DataFrame, *, ax: Axes | None = None) -> Axes:
    """Draw one point a checkpoint: held-out loss across, success rate up, an arm a colour; columns as above."""
    ax = ax or _new_axes()
    for i, (arm, part) in enumerate(rounds.groupby("arm", sort=False)):
        ax.plot(part.loss, part.success_rate, "osv^D"[i % 5], alpha=0.7, color=arm_color(arm, i), label=arm)
    ax.set_ylim(-0.02, 1.02)
    ax.set_xlabel("held-out loss [normalised units²]")
    ax.set_ylabel("success rate")
    ax.legend(frameon=False)
    return ax


def flow_film(
    points: np.ndarray, times: Sequence[float], *, ylabel: str, goal: np.ndarray | None = None, hold: int = 3
) -> np.ndarray:
    """Draw `flow` as a film, uint8 (T, H, W, 3): each time stands `hold` frames, the plan at the end a second more."""
    stills = [_flow_still(points, times, i, ylabel, goal) for i in range(len(points))]
    return np.stack(stills)[np.repeat(np.arange(len(points)), [hold] * (len(points) - 1) + [hold + FPS])]


def _flow_still(
    points: np.ndarray, times: Sequence[float], now: int, ylabel: str, goal: np.ndarray | None
) -> np.ndarray:
    """One time in colour, the times before it in grey, on axes that stay the same for all."""
    with plt.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 3.6), dpi=100, layout="constrained")
        ax = figure.subplots()
        steps = np.arange(1, points.shape[1] + 1)
        ax.plot(steps, points[:now].T, color="#CCCCCC", linewidth=1)
        if goal is not None:
            ax.plot(steps, goal, "k--", label="demonstration")
        ax.plot(steps, points[now], ".-", color=PALETTE[0], linewidth=2, label="chunk now")
        everything = points if goal is None else np.vstack([points, goal])
        pad = 0.05 * np.ptp(everything) or 1
        ax.set_ylim(everything.min() - pad, everything.max() + pad)
        ax.set_xlabel("step of the chunk")
        ax.set_ylabel(ylabel)
        ax.set_title(f"flow time t = {times[now]:.2f}", fontsize=10, loc="left")
        ax.legend(frameon=False, ncols=2, loc="lower right", bbox_to_anchor=(1, 1))
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


PARTS = {  # centre and width on a sheet of 10 x 7
    "vision encoder": (1.5, 5.0, 2.5),
    "connector (pixel shuffle + projection)": (1.5, 3.6, 2.5),
    "state projection": (4.8, 5.0, 2.3),
    "language model": (3.1, 2.0, 5.7),
    "language head (unused by the policy)": (4.8, 0.5, 2.3),
    "action input projection": (8.5, 5.0, 2.5),
    "action-time MLP": (8.5, 3.6, 2.5),
    "action expert": (8.5, 2.0, 2.5),
    "action output projection": (8.5, 0.5, 2.5),
}
ARROWS = {  # from, to, where the label stands
    "images": ((1.5, 6.3), (1.5, 5.45)),
    "patches": ((1.5, 4.55), (1.5, 4.05)),
    "image tokens": ((1.5, 3.15), (1.5, 2.45)),
    "state": ((4.8, 6.3), (4.8, 5.45)),
    "state token": ((4.8, 4.55), (4.8, 2.45)),
    "words": ((1.5, 0.8), (1.5, 1.55)),
    "keys, values": ((5.95, 2.0), (7.25, 2.0)),
    "noisy actions": ((8.5, 6.3), (8.5, 5.45)),
    "action tokens, flow time": ((8.5, 4.55), (8.5, 4.05)),
    "suffix": ((8.5, 3.15), (8.5, 2.45)),
    "expert tokens": ((8.5, 1.55), (8.5, 0.95)),
    "velocity": ((8.5, 0.05), (8.5, -0.4)),
}
OUTSIDE = {"images": 6.7, "state": 6.7, "noisy actions": 6.7, "words": 0.4, "velocity": -0.75}  # what enters or leaves


def architecture(table: pd.DataFrame, shapes: dict[str, Sequence[int]], *, ax: Axes | None = None) -> Axes:
    """Draw SmolVLA's parts with their parameters, and the shape of what flows on each arrow.

    Args:
        table: columns part, parameters, trainable, as of `model.module_table`.
        shapes: by arrow, as named in `ARROWS`; an arrow without a shape stays without one.
    """
    if ax is None:
        _, ax = plt.subplots(figsize=(WIDTH, 6), layout="constrained")
    for name, (start, end) in ARROWS.items():
        ax.annotate("", end, start, arrowprops={"arrowstyle": "-|>", "color": "black", "shrinkA": 0, "shrinkB": 0})
        _arrow_label(ax, name, " × ".join(map(str, shapes.get(name, ()))))
    for row in table.itertuples():
        _part(ax, row.part, row.parameters, row.trainable)
    for color, label in ((PALETTE[0], "trained"), ("#BBBBBB", "frozen")):
        ax.plot([], [], "s", color=color, alpha=0.5, label=label)
    ax.legend(frameon=False, ncols=2, loc="lower center", bbox_to_anchor=(0.5, -0.04))
    ax.set_xlim(0, 10)
    ax.set_ylim(-1.3, 7.1)
    ax.set_axis_off()
    return ax


def _part(ax: Axes, part: str, parameters: int, trainable: int) -> None:
    """A box with the part's name and its number of parameters; a part that trains in some of them says in how many."""
    x, y, width = PARTS[part]
    color = PALETTE[0] if trainable else "#BBBBBB"
    ax.add_patch(plt.Rectangle((x - width / 2, y - 0.45), width, 0.9, facecolor=color, alpha=0.5, edgecolor="black"))
    name = part.replace(" (", "\n(").replace("pixel shuffle + ", "shuffle + ")
    some = f" ({trainable:,} trained)" if 0 < trainable < parameters else ""
    ax.text(x, y, f"{name}\n{parameters:,}{some}", ha="center", va="center", fontsize=8)


def _arrow_label(ax: Axes, name: str, shape: str) -> None:
    (x, y), (to_x, to_y) = ARROWS[name]
    if name in OUTSIDE:
        ax.text(x, OUTSIDE[name], f"{name}\n{shape}", ha="center", va="center", fontsize=8, color="#222222")
    elif y == to_y:
        ax.text((x + to_x) / 2, y + 0.1, f"{name}\n{shape}", ha="center", va="bottom", fontsize=7, color="#222222")
    else:
        ax.text(x + 0.12, (y + to_y) / 2, f"{name}\n{shape}", va="center", fontsize=7, color="#222222")


def heat_maps(
    tables: dict[str, pd.DataFrame], *, xlabel: str, ylabel: str, label: str, signed: bool = False,
    axes: Sequence[Axes] | None = None,
) -> Sequence[Axes]:  # fmt: skip
    """Draw tables of numbers as coloured squares side by side, on one scale; what is missing is grey, keys are titles.

    Args:
        tables: rows and columns as they are to stand, the same rows in all.
        label: of the colours.
        signed: the numbers lie between -1 and 1, and 0 is the middle of the scale; else it begins at 0.
    """
    if axes is None:
        _, axes = plt.subplots(1, len(tables), figsize=(WIDTH, 2.6), sharey=True, squeeze=False, layout="constrained")
        axes = axes[0]
    top = 1.0 if signed else float(np.nanmax([np.nanmax(table.to_numpy()) for table in tables.values()]))
    for ax, (title, table) in zip(axes, tables.items(), strict=True):
        scale = {"cmap": "RdBu", "vmin": -top} if signed else {"cmap": "viridis", "vmin": 0}
        picture = ax.imshow(table.to_numpy(float), aspect="auto", vmax=top, **scale)
        ax.set_facecolor("#BBBBBB")
        places = np.unique(np.linspace(0, table.shape[1] - 1, 4).round().astype(int))
        ax.set_xticks(places, table.columns[places])
        ax.set_yticks(range(len(table)), table.index)
        ax.grid(False)
        ax.set_title(title, fontsize=10)
        ax.set_xlabel(xlabel)
    axes[0].set_ylabel(ylabel)
    axes[0].figure.colorbar(picture, ax=list(axes), label=label)
    return axes


def success_per_megabyte(table: pd.DataFrame, *, ax: Axes | None = None) -> Axes:
    """Draw points of success for each megabyte that travelled, a bar an arm; columns arm, MB, success_rate, low, high.

    The interval is that of the success rate, divided by the bytes, which are known exactly.
    """
    if ax is None:
        _, ax = plt.subplots(figsize=(WIDTH, 1.0 + 0.3 * len(table)), layout="constrained")
    points = {name: 100 * table[name] / table.MB for name in ("success_rate", "low", "high")}
    errors = np.stack([points["success_rate"] - points["low"], points["high"] - points["success_rate"]])
    places = np.arange(len(table))
    ax.barh(places, points["success_rate"], xerr=np.abs(errors), capsize=3, color=PALETTE[0])
    ax.set_yticks(places, table.arm)
    ax.set_ylim(len(table) - 0.5, -0.5)
    ax.set_xlabel("success rate for what travelled [points per MB], 95 % interval")
    ax.set_ylabel("what travels")
    return ax


def federation(
    clients: Sequence[str], *, down: str, up: str, server: str = "server", refused: str = "", ax: Axes | None = None
) -> Axes:
    """Draw a federation: a server above its clients, each in its colour, and what goes down and comes up.

    Args:
        clients: a line of text for each client's box.
        down, up: what the arrows carry.
        refused: if given, the text of one more box that the server turns away.
    """
    if ax is None:
        _, ax = plt.subplots(figsize=(WIDTH, 3.4), layout="constrained")
    places = np.arange(len(clients) + bool(refused)) * 2.0
    middle = places.mean()
    _box(ax, middle, 2.2, server, "#BBBBBB")
    for k, (x, text) in enumerate(zip(places, clients, strict=False)):
        _box(ax, x, 0.0, text, client_color(k))
        for shift, start, end in ((-0.25, 1.8, 0.4), (0.25, 0.4, 1.8)):
            foot, head = x + shift, middle + shift + 0.25 * (x - middle)
            ends = ((head, start), (foot, end)) if start > end else ((foot, start), (head, end))
            _arrow(ax, *ends, color=client_color(k))
    if refused:
        _box(ax, places[-1], 0.0, refused, "#FFFFFF")
        _arrow(ax, (places[-1], 0.4), (middle + 0.25 * (places[-1] - middle), 1.7), color="black", linestyle=":")
        ax.text((places[-1] + middle) / 2 + 0.4, 1.2, "✗", fontsize=20, ha="center", va="center")
    ax.text(places[0] - 0.9, 1.3, f"down:\n{down}", ha="left", va="center", fontsize=9)
    ax.text(places[-1] + 0.9, 1.3, f"up:\n{up}", ha="right", va="center", fontsize=9)
    ax.set_xlim(places[0] - 1.0, places[-1] + 1.0)
    ax.set_ylim(-0.6, 2.8)
    ax.set_axis_off()
    return ax


def _box(ax: Axes, x: float, y: float, text: str, color: str) -> None:
    ax.add_patch(plt.Rectangle((x - 0.85, y - 0.4), 1.7, 0.8, facecolor=color, alpha=0.35, edgecolor="black"))
    ax.text(x, y, text, ha="center", va="center", fontsize=9)


def _arrow(ax: Axes, start: tuple[float, float], end: tuple[float, float], **look: str) -> None:
    ax.annotate("", end, start, arrowprops={"arrowstyle": "-|>", "shrinkA": 0, "shrinkB": 0, **look})


def client_drift(
    server: np.ndarray, local: Sequence[np.ndarray], wanted: np.ndarray, optimum: np.ndarray, *, ax: Axes | None = None
) -> Axes:
    """Draw federated averaging of two weights: where the clients walk in their local phases, and where averages land.

    Args:
        server: the average after each round, from the start on, (rounds + 1, 2).
        local: for each client the points of its local phases, (rounds, steps + 1, 2).
        wanted: each client's own minimum, (clients, 2).
        optimum: the minimum of the mean loss, (2,).
    """
    ax = ax or _new_axes()
    for k, phases in enumerate(local):
        ax.plot(*wanted[k], "X", color=client_color(k), markersize=10)
        for number, phase in enumerate(phases):
            label = "" if number else f"client {k}; cross: what it wants"
            ax.plot(*phase.T, "-", color=client_color(k), linewidth=1, label=label)
    ax.plot(*server.T, "o--", color="black", markersize=4, label="server: average of both")
    ax.plot(*optimum, "k*", markersize=14, label="best for both together")
    ax.set_xlabel("first weight")
    ax.set_ylabel("second weight")
    ax.legend(frameon=False, fontsize=8, ncols=2, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    return ax
