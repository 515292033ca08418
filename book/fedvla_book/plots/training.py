"""Figures of training: losses, learning rates, parts of the model, flow matching."""

from collections.abc import Sequence

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from fedvla_book.plots.style import STYLE, to_ends
from fedvla_lib.evaluation.figures import PALETTE, WIDTH, new_axes
from fedvla_lib.robot.spec import FPS, JOINT_NAMES, JOINT_UNITS


def loss_curve(losses: Sequence[float], *, label: str = "training", smooth: int = 20, ax: Axes | None = None) -> Axes:
    """Draw the loss of each gradient step and its moving average over `smooth` steps."""
    ax = ax or new_axes()
    values = pd.Series(list(losses))
    steps = np.arange(1, len(values) + 1)
    (line,) = ax.plot(steps, values, alpha=0.3)
    ax.plot(steps, values.rolling(smooth, min_periods=1).mean(), color=line.get_color(), label=label)
    ax.set_xlabel("optimiser step")
    ax.set_ylabel("flow-matching loss [normalised units²]")
    ax.set_ylim(bottom=0)
    ax.legend(frameon=False)
    return ax


def module_bars(table: pd.DataFrame, *, ax: Axes | None = None) -> Axes:
    """Draw trainable and frozen parameters per part of a model; columns part, parameters, trainable."""
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
    """Draw the trainable parameters of each setting, split into parts (columns as `module_bars`)."""
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
    """Draw one joint of an action chunk from noise to actions: `points` (times, chunk), a line per flow time."""
    ax = ax or new_axes()
    steps = np.arange(1, points.shape[1] + 1)
    shades = plt.get_cmap("viridis")(np.asarray(times) * 0.9)
    for time, line, shade in zip(times, points, shades, strict=True):
        ax.plot(steps, line, ".-", color=shade, linewidth=1, label=f"t = {time:.2f}")
    if goal is not None:
        ax.plot(steps, goal, "k--", label="demonstration")
    ax.set_xlabel("step of the chunk")
    ax.set_ylabel(ylabel)
    return ax


def learning_rate(rates: Sequence[float], *, ax: Axes | None = None) -> Axes:
    """Draw the learning rate of each optimiser step."""
    ax = ax or new_axes()
    ax.plot(np.arange(1, len(rates) + 1), rates, "-" if len(rates) > 20 else "o-")
    ax.set_ylim(0, 1.1 * max(rates))
    ax.set_xlabel("optimiser step")
    ax.set_ylabel("learning rate of AdamW")
    return ax


def error_by_joint(errors: pd.DataFrame, *, ax: Axes | None = None) -> Axes:
    """Draw the action error of each joint as grouped bars: rows are joints, columns are models."""
    ax = ax or new_axes()
    width = 0.8 / errors.shape[1]
    for i, name in enumerate(errors.columns):
        place = np.arange(len(errors)) + (i - (errors.shape[1] - 1) / 2) * width
        ax.bar(place, errors[name], width * 0.9, label=name)
    units = dict(zip(JOINT_NAMES, JOINT_UNITS, strict=True))
    ax.set_xticks(range(len(errors)), [f"{j.removesuffix('.pos')}\n[{units[j]}]" for j in errors.index], fontsize=8)
    ax.set_xlabel("joint")
    ax.set_ylabel("mean absolute action error [unit of the joint]")
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
    axes[1].errorbar(seen[x], seen.success_rate, yerr=to_ends(seen), fmt="o-", capsize=3, color=PALETTE[0])
    axes[1].set_ylim(-0.02, 1.02)
    axes[1].set_ylabel("success rate\n(95 % Wilson interval)")
    axes[1].set_xlabel(xlabel)
    for ax in axes:
        ax.set_xticks(sorted(set(table[x])))
    return axes


def flow_video(
    points: np.ndarray, times: Sequence[float], *, ylabel: str, goal: np.ndarray | None = None, hold: int = 3
) -> np.ndarray:
    """Draw `flow` as a video, uint8 (T, H, W, 3): each flow time lasts `hold` frames, the last a second more."""
    stills = [_flow_still(points, times, i, ylabel, goal) for i in range(len(points))]
    return np.stack(stills)[np.repeat(np.arange(len(points)), [hold] * (len(points) - 1) + [hold + FPS])]


def _flow_still(
    points: np.ndarray, times: Sequence[float], now: int, ylabel: str, goal: np.ndarray | None
) -> np.ndarray:
    """One flow time in colour and earlier ones in grey, on axes that are the same for all."""
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


PARTS = {  # centre and width, in units of a 10 x 7 figure
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
ARROWS = {  # start, end
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
OUTSIDE = {
    "images": 6.7,
    "state": 6.7,
    "noisy actions": 6.7,
    "words": 0.4,
    "velocity": -0.75,
}  # y of the labels of inputs and outputs


def architecture(table: pd.DataFrame, shapes: dict[str, Sequence[int]], *, ax: Axes | None = None) -> Axes:
    """Draw SmolVLA's parts with their parameters, and the tensor shape on each arrow.

    Args:
        table: columns part, parameters, trainable, as in `tables.module_table`.
        shapes: by arrow, as named in `ARROWS`; arrows may lack one.
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
    """Draw a box with the part's name and parameters; a partly trained part also has its trained parameters."""
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
