"""Tables -> Axes. Every function draws one figure's content, labels its axes with units and returns the Axes.

Figures have an opaque white ground so that they stay readable on a dark page; colours are Okabe and Ito's, which remain
distinct for colour-blind readers. One arm and one joint keep one colour throughout the book.
"""

from collections.abc import Sequence

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from fedvla_lib.spec import FPS, JOINT_NAMES, JOINT_UNITS

PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#F0E442", "#000000")
ARM_COLORS = {"base": "#7F7F7F", "local-only": "#E69F00", "federated": "#0072B2", "centralized": "#009E73"}
STYLE = {
    "figure.facecolor": "white",
    "savefig.facecolor": "white",
    "axes.facecolor": "white",
    "axes.grid": True,
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


def joints(states: np.ndarray, actions: np.ndarray, *, axes: Sequence[Axes] | None = None) -> Sequence[Axes]:
    """Draw measured state and commanded action, both (T, 6), against time: one panel per joint."""
    if axes is None:
        _, grid = plt.subplots(2, 3, figsize=(10, 4.6), sharex=True, layout="constrained")
        axes = grid.ravel()
    seconds = np.arange(len(states)) / FPS
    for i, ax in enumerate(axes):
        ax.plot(seconds, states[:, i], label="state")
        ax.plot(seconds, actions[:, i], "--", label="action")
        ax.set_title(JOINT_NAMES[i], fontsize=10)
        ax.set_ylabel(f"position [{JOINT_UNITS[i]}]")
    for ax in axes[-3:]:
        ax.set_xlabel("time [s]")
    axes[0].legend(frameon=False)
    return axes


def film_strip(frames: np.ndarray, *, count: int = 6, title: str = "", ax: Axes | None = None) -> Axes:
    """Draw `count` frames of a video (T, H, W, 3), evenly spaced from first to last, side by side."""
    picks = np.linspace(0, len(frames) - 1, min(count, len(frames))).round().astype(int)
    if ax is None:
        _, ax = plt.subplots(figsize=(10, 10 / len(picks) * frames.shape[1] / frames.shape[2] + 0.5), layout="constrained")
    width = frames.shape[2]
    ax.imshow(np.concatenate(list(frames[picks]), axis=1))
    ax.set_xticks((np.arange(len(picks)) + 0.5) * width, [f"{i / FPS:.1f} s" for i in picks])
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
    ax.set_xticks(sorted(set(table["round"])))
    ax.set_xlabel("round")
    ax.set_ylabel(ylabel)
    ax.legend(frameon=False)
    return ax


def success_bars(table: pd.DataFrame, *, ax: Axes | None = None) -> Axes:
    """Draw success rates with Wilson intervals; columns arm, task, success_rate, low, high."""
    ax = ax or _new_axes()
    arms, tasks = list(dict.fromkeys(table.arm)), list(dict.fromkeys(table.task))
    width = 0.8 / len(arms)
    for i, arm in enumerate(arms):
        part = table[table.arm == arm].set_index("task").loc[tasks]
        errors = np.abs(np.stack([part.success_rate - part.low, part.high - part.success_rate]))
        place = np.arange(len(tasks)) + (i - (len(arms) - 1) / 2) * width
        color = ARM_COLORS.get(arm, PALETTE[i % len(PALETTE)])
        ax.bar(place, part.success_rate, width * 0.9, yerr=errors, capsize=3, label=arm, color=color)
    ax.set_xticks(range(len(tasks)), tasks)
    ax.set_ylim(0, 1.02)
    ax.set_xlabel("task")
    ax.set_ylabel("success rate (95 % Wilson interval)")
    ax.legend(frameon=False, ncols=len(arms), loc="upper center", bbox_to_anchor=(0.5, 1.14))
    return ax


def _new_axes() -> Axes:
    _, ax = plt.subplots(figsize=(7, 3.6), layout="constrained")
    return ax
