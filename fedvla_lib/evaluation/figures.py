"""Figures that commands write next to their tables: a metric by round, and differences between runs."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes

PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#F0E442", "#000000")
WIDTH = 7  # inches; a page scales wider figures down, text included


def by_round(table: pd.DataFrame, value: str, *, ylabel: str, label: str = "", ax: Axes | None = None) -> Axes:
    """Draw a metric against the round; columns `low` and `high`, where present, become a band."""
    ax = ax or new_axes()
    (line,) = ax.plot(table["round"], table[value], "o-", label=label or value)
    if {"low", "high"} <= set(table.columns):
        ax.fill_between(table["round"], table.low, table.high, color=line.get_color(), alpha=0.15)
    round_ticks(ax, table["round"])
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


def new_axes() -> Axes:
    _, ax = plt.subplots(figsize=(WIDTH, 3.6), layout="constrained")
    return ax


def round_ticks(ax: Axes, rounds: pd.Series) -> None:
    """Put a tick at each round, or at some of them where all labels would overlap."""
    numbers = sorted(set(rounds))
    if len(numbers) <= 8:
        ax.set_xticks(numbers)
    else:
        ax.xaxis.set_major_locator(plt.MaxNLocator(6, integer=True))


def run_differences(table: pd.DataFrame, *, note: str = "") -> Sequence[Axes]:
    """Draw each metric's differences to the first run with their intervals: a table of `compare_runs.differences`.

    Args:
        note: what makes the runs incomparable, shown as the title.
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
    """Write the figure of the axes to an image file and close it."""
    figure = (axes if isinstance(axes, Axes) else axes[0]).figure
    figure.savefig(path, bbox_inches="tight")
    plt.close(figure)
