"""Recordings at another rate than the policy's: frames are picked by time, so that a chunk lasts as long as it should.

LeRobot does the same with ``delta_timestamps`` of ``[0, 1 / fps, ...]``, at rates that divide the recording's.
"""

from dataclasses import replace

import numpy as np

from fedvla_lib.data.lerobot_reader import FPS_TOLERANCE, DataError, ReadDataset


def resampled(dataset: ReadDataset, fps: float) -> tuple[ReadDataset, np.ndarray]:
    """Return a data set with `fps` frames a second, and the row of each of its frames before, int64 (N,).

    The frame for time t of an episode is the one recorded nearest to t. The outline stays that of the recording.

    Raises:
        DataError: it was recorded at a lower rate, so that frames would be invented.
    """
    recorded = dataset.outline.info["fps"]
    if abs(recorded - fps) <= FPS_TOLERANCE * fps:
        return dataset, np.arange(len(dataset.states))
    if recorded < fps:
        raise DataError(
            f"{dataset.outline.root} has {recorded:g} frames a second, but the policy acts {fps:g} times: give "
            f"fps={int(recorded)}"
        )
    rows = [
        start
        + np.round(np.arange(np.ceil(frames * fps / recorded - 1e-6)) * recorded / fps).clip(max=frames - 1).astype(int)
        for start, frames in zip(dataset.episodes["start"], dataset.episodes["num_frames"], strict=True)
    ]
    lengths = np.array([len(each) for each in rows])
    ends, kept = np.cumsum(lengths), np.concatenate(rows)
    episodes = dataset.episodes.assign(start=ends - lengths, end=ends, num_frames=lengths)
    return replace(dataset, episodes=episodes, states=dataset.states[kept], actions=dataset.actions[kept]), kept


def note(recorded: float, fps: float) -> str:
    """Return what is done to a recording at another rate, or ""."""
    if abs(recorded - fps) <= FPS_TOLERANCE * fps:
        return ""
    return f"{recorded:g} frames a second are resampled to fps={fps:g}, the policy's rate"
