"""The stored attacks (``book/tools/attack_study.py``) as tables, and one sentence."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from statsmodels.stats.proportion import proportion_confint

from fedvla_book.attacks import separation
from fedvla_book.sentences import interval

LOWEST = 1e-3  # where the axis shows the noise 0
CHANCE = {"task": 0.5, "place": 0.1, "member": 0.5}


def read(folder: Path) -> pd.DataFrame:
    """Return the rows of all training seeds; raise ValueError if there are none."""
    files = sorted(folder.glob("seed_*.json"))
    if not files:
        raise ValueError(f"{folder} has no attacks: run book/tools/attack_study.py")
    return pd.DataFrame([row for file in files for row in json.loads(file.read_text())["rows"]])


def by_noise(found: pd.DataFrame, steps: int = 40, demos: int = 2) -> pd.DataFrame:
    """Return the success of three attacks on one update, by noise multiplier."""
    one = found[found.saw == "one update"]
    columns = {}
    for trait in ("task", "place"):
        table = one[(one.attack == trait) & (one.steps == steps)].groupby("noise")[["right", "of"]].sum()
        columns[f"{trait} guessed"] = table.right / table.of
    members = one[(one.attack == "member") & (one.demos == demos)]
    columns["member (area)"] = members.groupby("noise").apply(
        lambda rows: separation.auc(*_scores(rows)), include_groups=False
    )
    table = pd.DataFrame(columns)
    return table.set_axis(table.index.where(table.index > 0, LOWEST), axis=0)


def noise_axis(ax: Any) -> None:
    """Scale the axis of `by_noise`, and draw what chance reaches."""
    ax.set_xscale("log")
    ax.set_xticks([LOWEST, 1e-2, 1e-1, 1], ["none", "0.01", "0.1", "1"])
    ax.set_ylim(0, 1.05)
    for chance in sorted(set(CHANCE.values())):
        ax.axhline(chance, linestyle=":", color="gray")
        ax.annotate("chance", (1, chance), xycoords=("axes fraction", "data"), ha="right", va="bottom", fontsize=8)


def states(found: pd.DataFrame) -> pd.DataFrame:
    """Return the median error of the joint state, in degrees, for each kind of message and of training."""
    rows = found[found.attack == "state"]
    table = rows.pivot_table(
        index="case", columns="saw", values="error_deg", aggfunc="median", sort=False, dropna=False
    )
    table["blind"] = rows.groupby("case").blind_deg.median()
    return table.rename_axis(index="median error [degrees]", columns=None).round(2).fillna("not possible")


def images(found: pd.DataFrame) -> str:
    """Return a sentence on the search for images."""
    rows = found[found.attack == "image"]
    parts = [
        f"With {trained} trained, the gradient of the image found agrees to {group.cosine.median():.3f} (cosine), and "
        f"the image is {group.psnr_db.median():.1f} dB from the true one; the mean image of the attacker's own "
        f"recording is {group.blind_db.median():.1f} dB."
        for trained, group in rows.groupby("trained", sort=False)
    ]
    better = (rows.psnr_db > rows.blind_db).mean()
    return " ".join([*parts, f"The search beat the mean image in {better:.0%} of {len(rows)} images."])


def members(found: pd.DataFrame) -> pd.DataFrame:
    """Return the separation of trained demonstrations, by what was seen; noise is what the server added."""
    rows = found[(found.attack == "member") & ((found.noise == 0) | (found.saw == "the global model"))]
    table = [_separated(key, group) for key, group in rows.groupby(["saw", "demos", "round", "noise"], sort=False)]
    return pd.DataFrame(table).rename(columns={"demos": "demonstrations a lab"}).set_index("seen")


def protections(
    found: pd.DataFrame, epsilon: Callable[[float], float], steps: int = 40, demos: int = 2
) -> pd.DataFrame:
    """Return the attacks under each protection: what the server finds out about a lab, with intervals.

    Where it sees sums only, it can look for members in the global model, as every lab can.

    Args:
        epsilon: of one round, for a noise multiplier.
        steps: local steps of the labs whose task and place are guessed.
        demos: demonstrations of the labs that are asked for members.
    """
    levels = sorted(noise for noise in found[found.saw == "one update"].noise.unique() if noise)
    cases = {"none": ("one update", 0.0)}
    cases |= {f"noise {noise:g} of each lab": ("one update", noise) for noise in levels}
    cases["sums only"] = ("the mean of ten", 0.0)
    table = {name: _attacked(found, saw, noise, steps, demos) for name, (saw, noise) in cases.items()}
    for name, (_, noise) in cases.items():
        table[name]["epsilon of a round"] = f"{epsilon(noise):,.1f}" if noise else "none"
    chance = {"task": "50%", "place": "10%", "member (area)": "0.50", "epsilon of a round": "0.0"}
    return pd.DataFrame({**table, "chance": chance}).T


def _attacked(found: pd.DataFrame, saw: str, noise: float, steps: int, demos: int) -> dict[str, str]:
    rows, cells = found[(found.saw == saw) & (found.noise == noise)], {}
    for trait in ("task", "place"):
        right, count = rows[(rows.attack == trait) & (rows.steps == steps)][["right", "of"]].sum()
        low, high = proportion_confint(right, count, method="wilson")
        cells[trait] = f"{right / count:.0%} {interval(low, high)}"
    seen = "the global model" if saw == "the mean of ten" else saw
    member = found[(found.attack == "member") & (found.saw == seen) & (found.noise == noise)]
    cells["member (area)"] = _area(member[(member["round"] == 1) & (member.demos == demos)])
    return cells


def _area(rows: pd.DataFrame) -> str:
    scores = _scores(rows)
    low, high = separation.auc_interval(*scores)
    return f"{separation.auc(*scores):.2f} [{low:.2f}, {high:.2f}]"


def _separated(key: tuple[str, int, int, float], rows: pd.DataFrame) -> dict[str, object]:
    inside, outside = _scores(rows)
    found = separation.true_positives(inside, outside)
    return {"seen": key[0], "demos": int(key[1]), "round": int(key[2]), "noise": key[3],
            "area [95 %]": _area(rows),
            "found at 1 in 100": f"{found:.0%}", "asked": len(inside) + len(outside)}  # fmt: skip


def _scores(rows: pd.DataFrame) -> tuple[np.ndarray, np.ndarray]:
    return np.concatenate([*rows.members]), np.concatenate([*rows.strangers])
