"""Figures of success rates with their intervals."""

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from fedvla_book.plots.style import method_color, to_ends
from fedvla_lib.evaluation.figures import PALETTE, WIDTH, new_axes


def success_bars(table: pd.DataFrame, *, ax: Axes | None = None) -> Axes:
    """Draw success rates with intervals by task and method; columns method, task, success_rate, low, high."""
    ax = ax or new_axes()
    methods, tasks = list(dict.fromkeys(table.method)), list(dict.fromkeys(table.task))
    width = 0.8 / len(methods)
    for i, method in enumerate(methods):
        part = table[table.method == method].set_index("task").loc[tasks]
        place = np.arange(len(tasks)) + (i - (len(methods) - 1) / 2) * width
        style = {"yerr": to_ends(part), "capsize": 3, "label": method, "color": method_color(method, i)}
        ax.bar(place, part.success_rate, width * 0.9, **style)
    ax.set_xticks(range(len(tasks)), tasks)
    ax.set_ylim(0, 1.02)
    ax.set_xlabel("task")
    ax.set_ylabel("success rate (95 % interval)")
    ax.legend(frameon=False, ncols=len(methods), loc="upper center", bbox_to_anchor=(0.5, 1.14))
    return ax


def rollout_grid(rows: pd.DataFrame, *, ax: Axes | None = None) -> Axes:
    """Draw successes as a grid of clients by rounds; columns who, round, task, success."""
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
    ax.set_ylabel("client")
    return ax


def interval_width(table: pd.DataFrame, *, ax: Axes | None = None) -> Axes:
    """Draw interval width against the number of rollouts, a line per success rate; columns n, width, success_rate."""
    ax = ax or new_axes()
    for rate, part in table.groupby("success_rate"):
        ax.plot(part.n, 100 * part.width, "o-", label=f"success rate {rate:.0%}")
    ax.set_xscale("log")
    ax.set_ylim(bottom=0)
    ax.set_xlabel("number of rollouts (log scale)")
    ax.set_ylabel("width of the 95 % interval [points]")
    ax.legend(frameon=False)
    return ax


def power(table: pd.DataFrame, *, ax: Axes | None = None) -> Axes:
    """Draw the power to detect a difference against rollouts per model; columns n, power, difference."""
    ax = ax or new_axes()
    for difference, part in table.groupby("difference"):
        ax.plot(part.n, part.power, "o-", label=f"true difference {100 * difference:.0f} points")
    ax.axhline(0.8, color="#555555", linestyle=":", linewidth=1)
    ax.set_xscale("log")
    ax.set_ylim(0, 1.02)
    ax.set_xlabel("rollouts per model (log scale)")
    ax.set_ylabel("power: share of experiments that detect the difference")
    ax.legend(frameon=False)
    return ax


def success_intervals(table: pd.DataFrame, *, ylabel: str = "strategy", ax: Axes | None = None) -> Axes:
    """Draw success rates with intervals, a row per method; columns method, partition, success_rate, low, high.

    Each partition has its colour and its place within the method's row.
    """
    methods, partitions = list(dict.fromkeys(table.method)), list(dict.fromkeys(table.partition))
    if ax is None:
        _, ax = plt.subplots(figsize=(WIDTH, 1.2 + 0.3 * len(methods) + 0.1 * len(table)), layout="constrained")
    for i, partition in enumerate(partitions):
        part = table[table.partition == partition]
        rows = np.array([methods.index(method) for method in part.method]) + 0.6 * ((i + 0.5) / len(partitions) - 0.5)
        errors = 100 * to_ends(part)
        if len(partitions) == 1:  # colours then tell methods apart
            for row, rate, error, method in zip(rows, 100 * part.success_rate, errors.T, part.method, strict=True):
                color = method_color(method, int(row))
                ax.errorbar(rate, row, xerr=error[:, None], fmt="o", capsize=3, color=color)
            continue
        color = PALETTE[i % len(PALETTE)]
        ax.errorbar(100 * part.success_rate, rows, xerr=errors, fmt="o", capsize=3, color=color, label=partition)
    ax.set_yticks(range(len(methods)), methods)
    ax.set_ylim(len(methods) - 0.5, -0.5)
    ax.set_xlim(max(-2, 100 * table.low.min() - 4), min(102, 100 * table.high.max() + 4))
    ax.set_xlabel("success rate [%], 95 % interval")
    ax.set_ylabel(ylabel)
    if len(partitions) > 1:
        at = {"loc": "lower center", "bbox_to_anchor": (0.5, 1.0)}
        ax.legend(frameon=False, ncols=len(partitions), title="partition", **at)
    return ax


def success_by_demonstrations(table: pd.DataFrame, *, ax: Axes | None = None) -> Axes:
    """Draw success rate against demonstrations per lab, a line per method.

    Args:
        table: columns method, demonstrations, success_rate, low, high.
    """
    ax = ax or new_axes()
    for i, (method, part) in enumerate(table.groupby("method", sort=False)):
        part, color = part.sort_values("demonstrations"), method_color(method, i)
        places = part.demonstrations * 1.03 ** (i - 1)  # so that no interval hides another
        ax.errorbar(places, 100 * part.success_rate, yerr=100 * to_ends(part), fmt="o-", capsize=3, color=color,
                    label=method)  # fmt: skip
    counts = sorted(table.demonstrations.unique())
    ax.set_xscale("log", base=2)
    ax.set_xticks(counts, [f"{count:g}" for count in counts])
    ax.set_ylim(-2, 102)
    ax.set_xlabel("demonstrations in each lab (log scale)")
    ax.set_ylabel("success rate [%], 95 % interval")
    ax.legend(frameon=False)
    return ax


def success_by_bytes(table: pd.DataFrame, *, ax: Axes | None = None) -> Axes:
    """Draw success rate against exchanged MB, a point per row; columns method, MB, success_rate, low, high.

    Points of equal MB are shifted apart so that none hides another.
    """
    if ax is None:
        _, ax = plt.subplots(figsize=(WIDTH, 4.6), layout="constrained")
    alike = table.groupby(table.MB.round()).cumcount()
    middle = (table.groupby(table.MB.round()).MB.transform("size") - 1) / 2
    places = table.MB * 1.08 ** (alike - middle)
    errors = 100 * to_ends(table).T[:, :, None]
    for i, (place, row, error) in enumerate(zip(places, table.itertuples(), errors, strict=True)):
        color, marker = method_color(row.method, i), "osD^vP*X"[(i + i // 8) % 8]
        ax.errorbar(place, 100 * row.success_rate, yerr=error, fmt=marker, capsize=3, color=color, label=row.method)
    ax.set_xscale("log")
    ax.set_ylim(-2, 102)
    ax.set_xlabel("exchanged in total [MB, log scale], equal values shifted apart")
    ax.set_ylabel("success rate [%], 95 % interval")
    ax.legend(frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8)
    return ax


def success_per_megabyte(table: pd.DataFrame, *, ax: Axes | None = None) -> Axes:
    """Draw success rate per exchanged MB, a bar per method; columns method, MB, success_rate, low, high.

    The interval is that of the success rate divided by the bytes, which are known exactly.
    """
    if ax is None:
        _, ax = plt.subplots(figsize=(WIDTH, 1.0 + 0.3 * len(table)), layout="constrained")
    points = table[["success_rate", "low", "high"]].mul(100 / table.MB, axis=0)
    places = np.arange(len(table))
    ax.barh(places, points.success_rate, xerr=to_ends(points), capsize=3, color=PALETTE[0])
    ax.set_yticks(places, table.method)
    ax.set_ylim(len(table) - 0.5, -0.5)
    ax.set_xlabel("success rate per MB exchanged [points per MB], 95 % interval")
    ax.set_ylabel("what is exchanged")
    return ax
