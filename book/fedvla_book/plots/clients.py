"""Figures of clients: their data, weights, updates and drift."""

from collections.abc import Sequence

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from fedvla_book.plots.style import client_color, joint_axes, legend_above
from fedvla_lib.evaluation.figures import PALETTE, WIDTH, new_axes, round_ticks
from fedvla_lib.robot.spec import JOINT_NAMES, JOINT_UNITS


def client_counts(counts: pd.DataFrame, *, ax: Axes | None = None) -> Axes:
    """Draw episodes per client as stacked bars: rows are clients, columns are tasks."""
    ax = ax or new_axes()
    bottom = np.zeros(len(counts))
    for i, task in enumerate(counts.columns):
        ax.bar(counts.index.astype(str), counts[task], bottom=bottom, label=task, color=PALETTE[i % len(PALETTE)])
        bottom += counts[task].to_numpy()
    ax.set_ylim(0, max(1.08 * bottom.max(), ax.get_ylim()[1]))  # panels may share their scale
    ax.set_xlabel("client")
    ax.set_ylabel("episodes")
    ax.legend(frameon=False, title="task")
    return ax


def client_counts_grid(counts: dict[str, pd.DataFrame], *, axes: Sequence[Axes] | None = None) -> Sequence[Axes]:
    """Draw `client_counts` of several partitions side by side on one scale; keys are titles."""
    if axes is None:
        _, axes = plt.subplots(1, len(counts), figsize=(WIDTH, 3.2), sharey=True, layout="constrained")
    for ax, (name, table) in zip(axes, counts.items(), strict=True):
        client_counts(table, ax=ax)
        ax.set_title(name, fontsize=10)
        ax.get_legend().remove()
        ax.yaxis.set_major_locator(plt.MaxNLocator(integer=True))
    for ax in axes[1:]:
        ax.set_ylabel("")
    legend_above(axes)
    return axes


def heterogeneity(table: pd.DataFrame, *, bounds: dict[str, float] | None = None, ax: Axes | None = None) -> Axes:
    """Draw columns `total_variation` against `alpha`, a dot per draw, with mean and range; `bounds`: named levels."""
    ax = ax or new_axes()
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
        axes = joint_axes()
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
    legend_above(axes)
    return axes


def client_weights(weights: pd.DataFrame, *, ax: Axes | None = None) -> Axes:
    """Draw each client's weight in the average, in percent: rows are clients, columns are weighting schemes."""
    ax = ax or new_axes()
    width = 0.8 / len(weights.columns)
    for i, name in enumerate(weights.columns):
        places = np.arange(len(weights)) + (i - (len(weights.columns) - 1) / 2) * width
        ax.bar(places, 100 * weights[name], width * 0.9, label=name)
    ax.set_xticks(range(len(weights)), weights.index.astype(str))
    ax.set_xlabel("client")
    ax.set_ylabel("weight in the average [%]")
    ax.legend(frameon=False, ncols=len(weights.columns), loc="upper center", bbox_to_anchor=(0.5, 1.14))
    return ax


def clients_by_round(table: pd.DataFrame, value: str, *, ylabel: str, ax: Axes | None = None) -> Axes:
    """Draw a metric of each client by round and the mean weighted by frames; columns round, who, num_examples."""
    ax = ax or new_axes()
    for who, part in table.groupby("who", sort=False):
        color = client_color(int(who.removeprefix("client_")))
        ax.plot(part["round"], part[value], ".-", color=color, linewidth=1, label=who.replace("_", " "))
    weighted = (table[value] * table.num_examples).groupby(table["round"]).sum()
    mean = weighted / table.groupby("round").num_examples.sum()
    ax.plot(mean.index, mean, "--", color="black", linewidth=2, label="mean weighted by frames")
    round_ticks(ax, table["round"])
    ax.set_xlabel("round")
    ax.set_ylabel(ylabel)
    ax.legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return ax


def cosine_map(cosines: np.ndarray, *, title: str = "", ax: Axes | None = None) -> Axes:
    """Draw cosines between the updates of clients, (clients, clients) in [-1, 1], as a heat map with numbers."""
    ax = ax or new_axes()
    image = ax.imshow(cosines, cmap="RdBu", vmin=-1, vmax=1)
    for (i, j), cosine in np.ndenumerate(cosines):
        shade = "white" if abs(cosine) > 0.6 else "black"
        ax.text(j, i, f"{cosine:.2f}", ha="center", va="center", fontsize=8, color=shade)
    ax.set_xticks(range(len(cosines)))
    ax.set_yticks(range(len(cosines)))
    ax.grid(False)
    ax.set_xlabel("client")
    ax.set_ylabel("client")
    ax.set_title(title, fontsize=10)
    ax.figure.colorbar(image, ax=ax, label="cosine", shrink=0.8)
    return ax


def federation(
    clients: Sequence[str], *, down: str, up: str, server: str = "server", refused: str = "", ax: Axes | None = None
) -> Axes:
    """Draw a federation: a server above its clients, each in its colour, with what is sent down and up.

    Args:
        clients: text of each client's box.
        down, up: what is sent in each direction.
        refused: text of another box, whose connection the server refuses; empty for none.
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


def _arrow(ax: Axes, start: tuple[float, float], end: tuple[float, float], **style: str) -> None:
    ax.annotate("", end, start, arrowprops={"arrowstyle": "-|>", "shrinkA": 0, "shrinkB": 0, **style})


def client_drift(
    server: np.ndarray, local: Sequence[np.ndarray], wanted: np.ndarray, optimum: np.ndarray, *, ax: Axes | None = None
) -> Axes:
    """Draw federated averaging of two weights: the clients' paths in their local phases, and the averages.

    Args:
        server: the start and the average after each round, (rounds + 1, 2).
        local: for each client the points of its local phases, (rounds, steps + 1, 2).
        wanted: minimum of each client's loss, (clients, 2).
        optimum: the minimum of the mean loss, (2,).
    """
    ax = ax or new_axes()
    for k, phases in enumerate(local):
        ax.plot(*wanted[k], "X", color=client_color(k), markersize=10)
        for number, phase in enumerate(phases):
            label = "" if number else f"client {k}; cross: its minimum"
            ax.plot(*phase.T, "-", color=client_color(k), linewidth=1, label=label)
    ax.plot(*server.T, "o--", color="black", markersize=4, label="server: average")
    ax.plot(*optimum, "k*", markersize=14, label="minimum of the mean loss")
    ax.set_xlabel("first weight")
    ax.set_ylabel("second weight")
    ax.legend(frameon=False, fontsize=8, ncols=2, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    return ax
