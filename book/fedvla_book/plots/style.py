"""Colours and figure style of the book.

Figures have an opaque white background to stay readable on dark pages; colours are Okabe and Ito's, which colour-blind
readers can distinguish. Methods and clients keep their colours throughout the book (`method_color`, `client_color`);
anything else takes the palette in order.
"""

from collections.abc import Sequence

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from fedvla_lib.evaluation.figures import PALETTE, WIDTH

METHOD_COLORS = {"base": "#7F7F7F", "local-only": "#E69F00", "federated": "#0072B2", "centralized": "#009E73"}
METHOD_FAMILIES = {  # first part of a stored method's name -> its colour
    **METHOD_COLORS,
    "fedavg": METHOD_COLORS["federated"],
    "fedavg-10x4x20": "#56B4E9",
    "scaffold": "#D55E00",
    "fedprox": "#CC79A7",
}
DASHES = ("-", "--", "-.")
# Okabe and Ito's colours, then two of Tol's muted scheme: the book's federations have ten clients.
CLIENT_COLORS = (*PALETTE[:6], "#117733", "#000000", "#882255", "#7F7F7F")
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


def method_color(method: str, other: int = 0) -> str:
    """Return the colour of a method throughout the book; a method without one takes number `other` of the palette."""
    name = method.lower().replace(", ", "-") + "-"
    own = [color for family, color in METHOD_FAMILIES.items() if name.startswith(f"{family}-")]
    return own[-1] if own else PALETTE[other % len(PALETTE)]


def client_color(client: int) -> str:
    """Return the colour of a client throughout the book, by its number; colours repeat after ten."""
    return CLIENT_COLORS[client % len(CLIENT_COLORS)]


def to_ends(table: pd.DataFrame, value: str = "success_rate") -> np.ndarray:
    """Return the distances, (2, rows), from a column to the columns low and high, as matplotlib draws intervals."""
    return np.abs(np.stack([table[value] - table.low, table.high - table[value]]))


def legend_above(axes: Sequence[Axes]) -> None:
    """Draw one legend above panels that share their labels."""
    handles, labels = axes[0].get_legend_handles_labels()
    axes[0].figure.legend(handles, labels, frameon=False, ncols=len(labels), loc="outside upper center")


def joint_axes() -> Sequence[Axes]:
    """Return a panel per joint in two columns: three would be too small on a page."""
    _, grid = plt.subplots(3, 2, figsize=(WIDTH, 6.2), sharex=True, layout="constrained")
    return grid.ravel()
