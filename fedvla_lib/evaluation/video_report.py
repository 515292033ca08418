"""Check a folder of rollout videos against their trajectories and report metrics by round; list damaged files."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
import pandas as pd

from fedvla_lib import files
from fedvla_lib.evaluation import figures, rollouts, statistics
from fedvla_lib.evaluation.video import read_video
from fedvla_lib.robot.spec import FPS

METRICS = {
    "success_rate": "success rate",
    "completion_time": "completion time of successes [s]",
    "action_smoothness": "action smoothness [deg per step²]",
}


def read_videos(folder: Path) -> tuple[pd.DataFrame, list[str]]:
    """Read every ``round_N/WHO/rollout_*.mp4`` under `folder` and check it against its trajectory.

    Returns:
        A row for each intact rollout (round, who, task, seed, success, steps, completion_time, action_smoothness), and
        a line for each damaged one: which file, and what is wrong.

    Raises:
        ValueError: there is no such video.
    """
    videos = sorted({path.with_suffix(".mp4") for path in folder.glob("round_*/*/rollout_*.*")})
    if not videos:
        raise ValueError(f"{folder} holds no round_N/WHO/rollout_*.mp4: give the evaluate folder of a run")
    rows, damaged = [], []
    for video in videos:
        try:
            rows.append(_read(video))
        except ValueError as error:
            damaged.append(f"{video.relative_to(folder)}: {error}")
    return pd.DataFrame(rows), damaged


def _read(video: Path) -> dict[str, Any]:
    if not video.is_file():
        raise ValueError("the trajectory has no video")
    if not (path := video.with_suffix(".npz")).is_file():
        raise ValueError("the video has no trajectory")
    try:
        with np.load(path) as arrays:
            trajectory = {name: arrays[name] for name in ("actions", "success", "seed")}
    except (OSError, EOFError, KeyError, ValueError, BadZipFile) as error:
        raise ValueError(f"its trajectory cannot be read: {error}") from error
    frames, steps = len(read_video(video)), len(trajectory["actions"])
    if frames != steps:
        raise ValueError(f"the video has {frames} frames, its trajectory {steps} steps")
    success = bool(trajectory["success"])
    return {
        "round": int(video.parts[-3].removeprefix("round_")), "who": video.parts[-2],
        "task": video.stem.rsplit("_", 2)[1], "seed": int(trajectory["seed"]), "success": success, "steps": steps,
        "completion_time": steps / FPS if success else float("nan"),
        "action_smoothness": rollouts.smoothness(trajectory["actions"]),
    }  # fmt: skip


def trend_by_round(rows: pd.DataFrame, metric: str, *, seed: int = 0) -> pd.DataFrame:
    """Return a metric for each round: n, value, low, high (Wilson for success, else bootstrap over rollouts)."""
    lines = []
    for number, part in rows.groupby("round"):
        is_success = metric == "success_rate"
        each = part["success" if is_success else metric].dropna().to_numpy(float)
        measured = statistics.mean_with_interval(each, of_success=is_success, seed=seed)
        lines.append({"round": number, "metric": metric, **measured})
    return pd.DataFrame(lines)


def write(out: Path, rows: pd.DataFrame, table: pd.DataFrame, damaged: Sequence[str]) -> None:
    """Write rollouts and rounds as CSV, damaged files as JSON, and a figure of the trend into `out`."""
    files.write_atomically(out / "rollouts.csv", rows.to_csv(index=False).encode())
    files.write_atomically(out / "rounds.csv", table.to_csv(index=False).encode())
    files.write_json(out / "damaged.json", list(damaged))
    figures.save(figures.trends(table, METRICS), out / "trend.png")
