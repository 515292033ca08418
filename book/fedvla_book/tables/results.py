"""Read the run folders of an experiment into tables: a row per rollout, and a summary of each method."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from fedvla_book.tables.intervals import success_interval
from fedvla_lib import run_folder
from fedvla_lib.config import Config, task_names
from fedvla_lib.run_folder import GLOBAL

OF_CELL = ("method", "kind", "partition", "gradient_steps", "samples", "bytes")
# Settings that determine the demonstrations and which of them are held out.
RECORDING = ("data", "tasks", "episodes_per_task", "image_size", "num_labs", "one_task_per_lab", "val_fraction")
OWN = "own"  # place of a rollout at a lab's own task in that lab
PARALLEL = ("federated", "clients")  # kinds whose clients train in parallel
LOCAL_ONLY, FEDERATED = "local-only", "federated"  # kinds of methods
HELD_OUT = ("loss", "action_error")


def read_results(folder: Path) -> pd.DataFrame:
    """Return a row for each rollout of the last model of each cell in `folder`, with columns that describe the cell.

    train_s and in_a_row_s are NaN if the stamp lacks them. demonstrations: how many the settings ask of each lab. place
    is where a rollout was run: own, unseen or others (`evaluation.rollouts.roll_out_in_places`); own where no lab has
    a task of its own. steps_in_all and steps_in_a_row are gradient steps of the model that was rolled out. `counted`
    tells whether they were counted while training; for older cells they are derived from the settings, and a local-only
    client gets its share of the total.

    Raises:
        ValueError: there is no result.
    """
    return pd.concat([_rollouts(cell) for cell in cell_folders(folder)], ignore_index=True)


def cell_folders(folder: Path) -> Iterator[Path]:
    """Yield the run folders of an experiment's cells, or raise ValueError if there is none."""
    found = sorted(stamp.parent for stamp in Path(folder).glob("[!.]*/stamp.json"))
    cells = [run for run in found if "method" in run_folder.read_stamp(run)]  # other runs may be there too
    if not cells:
        raise ValueError(f"no results in {folder}: make some with fedvla experiment")
    yield from cells


def cell_columns(cell: Path) -> dict[str, Any]:
    """Return what a cell's stamp says about it, by column name."""
    stamp = run_folder.read_stamp(cell)
    seconds = {key: float("nan") if stamp.get(key) is None else stamp[key] for key in ("train_s", "in_a_row_s")}
    return {key: stamp[key] for key in OF_CELL} | {"run": stamp["seed"], **seconds}


def _rollouts(cell: Path) -> pd.DataFrame:
    rows = run_folder.read_metrics(cell, "rollout")
    last = run_folder.read_metrics(cell, "evaluate").iloc[-1]
    measured = {name: float(last.get(name, "nan")) for name in HELD_OUT}
    config = run_folder.read_config(cell)
    recording = ", ".join(str(getattr(config, name)) for name in RECORDING)
    rows = rows[rows["round"] == last["round"]]
    demonstrations = config.episodes_per_task * len(task_names(config)) / config.num_labs
    place = rows["place"] if "place" in rows else OWN
    steps = _steps(run_folder.read_stamp(cell), config, rows)
    of_cell = cell_columns(cell) | measured | {"recording": recording, "demonstrations": demonstrations}
    return rows.assign(place=place, **of_cell, **steps)


def _steps(stamp: dict[str, Any], config: Config, rows: pd.DataFrame) -> dict[str, Any]:
    """Columns counted, steps_in_all and steps_in_a_row of the model that made each rollout."""
    counted, total = stamp.get("steps"), stamp["gradient_steps"]
    if stamp["kind"] == LOCAL_ONLY:
        total //= config.num_clients
    in_a_row = config.num_server_rounds * config.local_steps if stamp["kind"] in PARALLEL else total
    by_model = counted or {GLOBAL: {"in_all": total, "in_a_row": in_a_row}}
    clients = rows.client.map("client_{:.0f}".format) if "client" in rows else pd.Series(GLOBAL, rows.index)
    models = [name if name in by_model else GLOBAL for name in clients]
    steps = {f"steps_{how}": [by_model[name][how] for name in models] for how in ("in_all", "in_a_row")}
    return {"counted": counted is not None, **steps}


def summary(rows: pd.DataFrame, by: Sequence[str] = ("partition", "method")) -> pd.DataFrame:
    """Return a row for each group: seeds, rollouts, success with its interval, and the mean cost of training.

    steps_in_all and steps_in_a_row are per model; gradient_steps, samples, MB and train_s sum over the models of a
    cell, of which local-only has one per client.

    Args:
        rows: of `read_results`.
        by: grouping columns; at least partition and method.
    """
    lines = []
    for group, part in rows.groupby(list(by), sort=False):
        cells = part.groupby("run").first()
        low, high = success_interval(part)
        lines.append({
            **dict(zip(by, group, strict=True)), "seeds": len(cells), "rollouts": len(part),
            "success_rate": part.success.mean(), "low": low, "high": high, "loss": cells.loss.mean(),
            "action_error": cells.action_error.mean(),
            "steps_in_all": part.steps_in_all.mean(), "steps_in_a_row": part.steps_in_a_row.mean(),
            "counted": bool(part.counted.all()), "gradient_steps": cells.gradient_steps.mean(),
            "samples": cells.samples.mean(), "MB": cells.bytes.mean() / 1e6, "train_s": cells.train_s.mean(),
            "in_a_row_s": cells.in_a_row_s.mean(),
        })  # fmt: skip
    return pd.DataFrame(lines)
