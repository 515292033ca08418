"""Figures that compare methods: differences, learning curves, loss against success."""

from collections.abc import Sequence

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from fedvla_book.plots.style import DASHES, client_color, legend_above, method_color, to_ends
from fedvla_lib.evaluation.figures import PALETTE, WIDTH, new_axes


def grouped_bars(table: pd.DataFrame, *, xlabel: str, ylabel: str, ax: Axes | None = None) -> Axes:
    """Draw a table as bars: a group per row, a colour per column; methods keep their colours."""
    ax = ax or new_axes()
    width = 0.8 / table.shape[1]
    for i, name in enumerate(table.columns):
        place = np.arange(len(table)) + (i - (table.shape[1] - 1) / 2) * width
        ax.bar(place, table[name], width * 0.9, label=name, color=method_color(name, i))
    ax.set_xticks(range(len(table)), table.index.astype(str))
    ax.set_xlabel(xlabel)
    ax.set_ylabel(ylabel)
    if table.shape[1] > 1:
        ax.legend(frameon=False, ncols=min(4, table.shape[1]), loc="upper center", bbox_to_anchor=(0.5, 1.16))
    return ax


def loss_against_success(table: pd.DataFrame, *, ax: Axes | None = None) -> Axes:
    """Draw success rate against held-out loss, a point per method; columns method, loss, success_rate, low, high."""
    ax = ax or new_axes()
    for i, (point, error) in enumerate(zip(table.itertuples(), to_ends(table).T[:, :, None], strict=True)):
        color = method_color(point.method, i)
        ax.errorbar(point.loss, point.success_rate, yerr=error, fmt="o", capsize=3, color=color, label=point.method)
    ax.set_xscale("log")  # the base's loss may be many times that of trained models
    ax.set_xlim(table.loss.min() / 1.4, 1.4 * table.loss.max())
    ax.xaxis.set_major_locator(plt.LogLocator(subs=(1, 1.5, 2, 3, 5, 7)))
    ax.xaxis.set_major_formatter(lambda loss, _: f"{loss:g}")
    ax.xaxis.set_minor_locator(plt.NullLocator())
    ax.set_ylim(-0.02, 1.02)
    ax.set_xlabel("held-out loss [normalised units², log scale]")
    ax.set_ylabel("success rate (95 % Wilson interval)")
    ax.legend(frameon=False)
    return ax


def paired_differences(table: pd.DataFrame, *, ax: Axes | None = None) -> Axes:
    """Draw differences in success rate with intervals, a row each; columns method, other, difference, low, high."""
    if ax is None:
        _, ax = plt.subplots(figsize=(WIDTH, max(3.6, 1.2 + 0.4 * len(table))), layout="constrained")
    places = np.arange(len(table))
    errors = 100 * to_ends(table, "difference")
    ax.errorbar(100 * table.difference, places, xerr=errors, fmt="o", capsize=4, color=PALETTE[0])
    ax.axvline(0, color="#555555", linewidth=1)
    ax.set_xlim(min(-2, 100 * table.low.min() - 2), max(2, 100 * table.high.max() + 2))  # no difference is in view
    ax.set_yticks(places, table.method + " − " + table.other)
    ax.set_ylim(len(table) - 0.5, -0.5)
    ax.set_xlabel("difference in success rate [points], 95 % interval")
    ax.set_ylabel("pair of methods")
    return ax


def differences_by_partition(
    table: pd.DataFrame, *, ylabel: str = "partition", axes: Sequence[Axes] | None = None
) -> Sequence[Axes]:
    """Draw differences in success between a method and others, a panel for each other method, a row for each partition.

    Panels have separate scales, since differences from similar and from poor methods differ in size.

    Args:
        table: columns partition, method, other, difference, low, high; one `method` in all rows.
    """
    others, partitions = list(dict.fromkeys(table.other)), list(dict.fromkeys(table.partition))
    if axes is None:
        size = (WIDTH, 1.6 + 0.35 * len(partitions))
        _, axes = plt.subplots(1, len(others), figsize=size, sharey=True, squeeze=False, layout="constrained")
        axes = axes[0]
    for ax, other in zip(axes, others, strict=True):
        part = table[table.other == other]
        rows = [partitions.index(name) for name in part.partition]
        errors = 100 * to_ends(part, "difference")
        ax.errorbar(100 * part.difference, rows, xerr=errors, fmt="o", capsize=4, color=method_color(other))
        ax.axvline(0, color="#555555", linewidth=1)
        ax.set_title(f"{table.method.iloc[0]}\n− {other}", fontsize=10)
        ax.set_xlabel("difference [points],\n95 % interval")
    axes[0].set_yticks(range(len(partitions)), partitions)
    axes[0].set_ylim(len(partitions) - 0.5, -0.5)
    axes[0].set_ylabel(ylabel)
    return axes


def curves(table: pd.DataFrame, *, xlabel: str, ylabel: str, ax: Axes | None = None) -> Axes:
    """Draw each column of a table against its index; a column named ``optimum`` is a dotted line.

    Columns of one colour, such as two runs of a method, have different dashes.
    """
    ax = ax or new_axes()
    colors = [_column_color(str(name), i) for i, name in enumerate(table.columns)]
    for i, name in enumerate(table.columns):
        dashes = DASHES[colors[:i].count(colors[i]) % len(DASHES)]
        style = {"color": "black", "linestyle": ":"} if name == "optimum" else {"color": colors[i], "linestyle": dashes}
        ax.plot(table.index, table[name], label=name, **style)
    ax.set_xlabel(xlabel)
    ax.set_ylabel(ylabel)
    ax.legend(frameon=False, ncols=min(4, table.shape[1]), loc="lower center", bbox_to_anchor=(0.5, 1.0))
    return ax


def _column_color(name: str, place: int) -> str:
    """Clients and methods keep their colours; other columns take the palette in order."""
    kind, _, number = name.partition(" ")
    return client_color(int(number)) if kind == "client" and number.isdigit() else method_color(name, place)


def learning_curves(rounds: pd.DataFrame, *, axes: Sequence[Axes] | None = None) -> Sequence[Axes]:
    """Draw held-out loss and success against gradient steps, a colour per method: mean and range over training seeds.

    Args:
        rounds: columns method, run, steps, loss, success_rate (NaN: not measured).
    """
    if axes is None:
        _, axes = plt.subplots(1, 2, figsize=(WIDTH, 3.4), layout="constrained")
    for i, (method, part) in enumerate(rounds.groupby("method", sort=False)):
        for ax, value in zip(axes, ("loss", "success_rate"), strict=True):
            over = part.dropna(subset=[value]).groupby("steps")[value].agg(["mean", "min", "max"])
            ax.plot(over.index, over["mean"], "o-", color=method_color(method, i), label=method)
            ax.fill_between(over.index, over["min"], over["max"], color=method_color(method, i), alpha=0.15)
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
    """Draw success rate against held-out loss, a point per checkpoint, a colour per method; see `learning_curves`."""
    ax = ax or new_axes()
    for i, (method, part) in enumerate(rounds.groupby("method", sort=False)):
        ax.plot(part.loss, part.success_rate, "osv^D"[i % 5], alpha=0.7, color=method_color(method, i), label=method)
    ax.set_ylim(-0.02, 1.02)
    ax.set_xlabel("held-out loss [normalised units²]")
    ax.set_ylabel("success rate")
    ax.legend(frameon=False)
    return ax


def heat_maps(
    tables: dict[str, pd.DataFrame], *, xlabel: str, ylabel: str, label: str, signed: bool = False,
    axes: Sequence[Axes] | None = None,
) -> Sequence[Axes]:  # fmt: skip
    """Draw tables of numbers as heat maps side by side on one scale; missing values are grey, keys are titles.

    Args:
        tables: all with the same rows.
        label: of the colour scale.
        signed: the scale is -1 to 1; otherwise it starts at 0.
    """
    if axes is None:
        _, axes = plt.subplots(1, len(tables), figsize=(WIDTH, 2.6), sharey=True, squeeze=False, layout="constrained")
        axes = axes[0]
    top = 1.0 if signed else float(np.nanmax([np.nanmax(table.to_numpy()) for table in tables.values()]))
    for ax, (title, table) in zip(axes, tables.items(), strict=True):
        scale = {"cmap": "RdBu", "vmin": -top} if signed else {"cmap": "viridis", "vmin": 0}
        image = ax.imshow(table.to_numpy(float), aspect="auto", vmax=top, **scale)
        ax.set_facecolor("#BBBBBB")
        places = np.unique(np.linspace(0, table.shape[1] - 1, 4).round().astype(int))
        ax.set_xticks(places, table.columns[places])
        ax.set_yticks(range(len(table)), table.index)
        ax.grid(False)
        ax.set_title(title, fontsize=10)
        ax.set_xlabel(xlabel)
    axes[0].set_ylabel(ylabel)
    axes[0].figure.colorbar(image, ax=list(axes), label=label)
    return axes


def fault_map(found: pd.DataFrame, tests: Sequence[str], *, axes: Sequence[Axes] | None = None) -> Sequence[Axes]:
    """Draw the success under each fault with its interval, and beside it which tests fire.

    Args:
        found: a row per fault, from the top: fault, success_rate, low, high, ``test``, which is the test that belongs
            to the fault ("" for none), and a column of true and false for each of `tests`.
    """
    if axes is None:
        shape = {"figsize": (WIDTH, 0.36 * len(found) + 1.1), "width_ratios": (2, 3)}
        _, axes = plt.subplots(1, 2, sharey=True, layout="constrained", **shape)
    bars, grid = axes
    rows = np.arange(len(found))
    bars.barh(rows, found.success_rate, color=PALETTE[0], height=0.6)
    bars.errorbar(found.success_rate, rows, xerr=to_ends(found), fmt="none", color="black", capsize=3)
    bars.set(xlim=(0, 1), xlabel="success rate", ylabel="fault", yticks=rows, yticklabels=found.fault)
    fires = found[list(tests)].to_numpy(bool)
    own = np.array([[test == of for test in tests] for of in found.test])
    for which, color, label in (
        (fires & own, PALETTE[2], "its own test fires"), (fires & ~own, PALETTE[4], "another fires"),
        (~fires & own, PALETTE[1], "its own does not"),
    ):  # fmt: skip
        y, x = np.nonzero(which)
        grid.scatter(x, y, marker="s", s=130, color=color, label=label)
    grid.set(xlim=(-0.6, len(tests) - 0.4), ylim=(len(found) - 0.5, -0.5), xlabel="test")
    grid.set_xticks(range(len(tests)), tests, rotation=30, ha="right")
    legend_above([grid])
    return axes
