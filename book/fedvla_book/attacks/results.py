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
    columns["member (area)"] = members.groupby("noise").apply(_mean_area, include_groups=False)
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


def guesses(found: pd.DataFrame) -> str:
    """Return a sentence on the tasks and places guessed from one update without noise, by local steps."""
    rows = found[(found.saw == "one update") & (found.noise == 0)]
    parts = []
    for trait, chance in (("task", "a half"), ("place", "a tenth")):
        counts = rows[rows.attack == trait].groupby("steps")[["right", "of"]].sum()
        after = [f"{row.right:.0f} of {row.of:.0f} after {steps:.0f} steps" for steps, row in counts.iterrows()]
        low, high = proportion_confint(*counts.iloc[-1], method="wilson")
        text = f"{trait.capitalize()} guessed: {', '.join(after)} {interval(low, high)}; chance is {chance}."
        parts.append(text.replace("after 1 steps", "after 1 step"))
    return " ".join(parts)


def shown(found: pd.DataFrame, steps: int = 40, demos: int = 2) -> str:
    """Return a sentence on which attacks on an update without noise are above chance, and which are not shown to be."""
    rows, outcome = found[(found.saw == "one update") & (found.noise == 0)], {True: [], False: []}
    for trait in ("task", "place"):
        right, count = rows[(rows.attack == trait) & (rows.steps == steps)][["right", "of"]].sum()
        low, _ = proportion_confint(right, count, method="wilson")
        outcome[bool(low > CHANCE[trait])].append(f"the guess of the {trait}")
    member = rows[(rows.attack == "member") & (rows.demos == demos)]
    outcome[_limits(member)[1] > CHANCE["member"]].append(f"membership with {demos} demonstrations")
    return (
        f"Without noise the interval is above chance for: {', '.join(outcome[True]) or 'none'}. "
        f"Not shown to work: {', '.join(outcome[False]) or 'none'}."
    )


def last_readable(found: pd.DataFrame, steps: int = 40) -> float:
    """Return the largest noise multiplier at which nine in ten tasks are guessed from one update."""
    rows = found[(found.saw == "one update") & (found.attack == "task") & (found.steps == steps)]
    counts = rows.groupby("noise")[["right", "of"]].sum()
    return float(counts.index[counts.right >= 0.9 * counts.of].max())


def images(found: pd.DataFrame) -> str:
    """Return a sentence on the search for images."""
    rows = found[found.attack == "image"]
    parts = [
        f"With {trained} trained, the gradient of the image found agrees to {group.cosine.median():.3f} (cosine), and "
        f"its peak signal-to-noise ratio (higher is closer) is {group.psnr_db.median():.1f} dB; that of the mean image "
        f"of the attacker's own recording is {group.blind_db.median():.1f} dB."
        for trained, group in rows.groupby("trained", sort=False)
    ]
    better = (rows.psnr_db > rows.blind_db).mean()
    found = f"The search beat the mean image in {better:.0%} of {len(rows)} images."
    return " ".join([*parts, found, "Images with nearly the same gradient can look quite different."])


def members(found: pd.DataFrame) -> pd.DataFrame:
    """Return the separation of trained demonstrations, by what was seen; noise is what the server added."""
    rows = found[(found.attack == "member") & ((found.noise == 0) | (found.saw == "the global model"))]
    table = [_separated(key, group) for key, group in rows.groupby(["saw", "demos", "round", "noise"], sort=False)]
    return pd.DataFrame(table).rename(columns={"demos": "demonstrations a lab"}).set_index("seen")


def protections(
    found: pd.DataFrame, epsilon: Callable[[float, int], float], delta: float, steps: int = 40, demos: int = 2
) -> pd.DataFrame:
    """Return the attacks under each protection: what the server finds out about a lab, with intervals.

    Where it sees sums only, it can test membership on the global model of the last round, as every lab can; one guess
    of the task, or of the place, is then the same for all labs.

    Args:
        epsilon: for a noise multiplier and a number of rounds, at `delta`.
        steps: local steps of the labs whose task and place are guessed.
        demos: demonstrations of the labs that are asked for members.
    """
    levels = sorted(noise for noise in found[found.saw == "one update"].noise.unique() if noise)
    cases = {"none": ("one update", 0.0)}
    cases |= {f"noise {noise:g} of each lab": ("one update", noise) for noise in levels}
    cases["sums only"] = ("the mean of ten", 0.0)
    table = {name: _attacked(found, saw, noise, steps, demos) for name, (saw, noise) in cases.items()}
    spent = {rounds: f"epsilon of {rounds} round{'s' * (rounds > 1)}, delta {delta:g}" for rounds in (1, 10)}
    for name, (_, noise) in cases.items():
        table[name] |= {text: f"{epsilon(noise, n):,.1f}" if noise else "none" for n, text in spent.items()}
    chance = {"task": "50%", "place": "10%", "member (area)": "0.50"} | dict.fromkeys(spent.values(), "0.0")
    return pd.DataFrame({**table, "chance": chance}).T


def _attacked(found: pd.DataFrame, saw: str, noise: float, steps: int, demos: int) -> dict[str, str]:
    rows, cells = found[(found.saw == saw) & (found.noise == noise)], {}
    for trait in ("task", "place"):
        right, count = rows[(rows.attack == trait) & (rows.steps == steps)][["right", "of"]].sum()
        low, high = proportion_confint(right, count, method="wilson")
        limits = interval(low, high) if saw == "one update" else "for any answer"
        cells[trait] = f"{right / count:.0%} {limits}"
    seen = "the global model" if saw == "the mean of ten" else saw
    member = found[(found.attack == "member") & (found.saw == seen) & (found.noise == noise) & (found.demos == demos)]
    cells["member (area)"] = _area(member[member["round"] == member["round"].max()])
    return cells


def _area(rows: pd.DataFrame) -> str:
    return "{:.2f} [{:.2f}, {:.2f}]".format(*_limits(rows))


def _limits(rows: pd.DataFrame) -> tuple[float, float, float]:
    """The mean area over training seeds, and its interval."""
    middle = _mean_area(rows)
    ends = np.array([separation.auc_interval(*scores) for scores in _by_seed(rows)])
    half = float(np.sqrt(np.square(np.diff(ends) / 2).sum()) / len(ends))
    return middle, max(0.0, middle - half), min(1.0, middle + half)


def _mean_area(rows: pd.DataFrame) -> float:
    """The mean over training seeds, whose scores have scales of their own."""
    return float(np.mean([separation.auc(*scores) for scores in _by_seed(rows)]))


def _separated(key: tuple[str, int, int, float], rows: pd.DataFrame) -> dict[str, object]:
    each = _by_seed(rows)
    found = np.mean([(inside > outside.max()).mean() for inside, outside in each])
    chance = np.mean([1 / (len(outside) + 1) for _, outside in each])  # of a rank above all others
    return {"seen": key[0], "demos": int(key[1]), "round": int(key[2]), "noise": key[3],
            "area [95 %]": _area(rows),
            "found without a false accusation": f"{found:.0%}", "by chance": f"{chance:.1%}",
            "asked": sum(map(len, sum(each, ())))}  # fmt: skip


def _by_seed(rows: pd.DataFrame) -> list[tuple[np.ndarray, np.ndarray]]:
    return [(np.asarray(row.members), np.asarray(row.strangers)) for row in rows.itertuples()]
