"""Checks of a data set's cameras: functions of small images that return findings; see `episode_checks`."""

from collections.abc import Mapping, Sequence
from itertools import combinations

import numpy as np

from fedvla_lib.data.episode_checks import ERROR, Finding, Remove, Take, episodes_named
from fedvla_lib.robot.spec import IMAGE_PREFIX

SIDE = 16  # of a small image, in pixels
DARK, FLAT = 12.0, 3.0  # grey levels: mean brightness of a covered lens, and spread over an image without content
SAME = 0.5  # grey levels: mean difference of two frames of a camera that delivers the same one twice
FROZEN_S, MOVED_DEG = 1.0, 15.0  # a camera that shows the same for so long while the arm moves as far is frozen
CROSSED = 1.25  # how much less alike two cameras are with themselves than with each other, if swapped; else below 0.7

Thumbnails = Mapping[str, Sequence[np.ndarray]]  # camera -> uint8 (T, SIDE, SIDE, 3) of each episode


def small(image: np.ndarray) -> np.ndarray:
    """Return every n-th pixel of uint8 (H, W, 3) as uint8 (SIDE, SIDE, 3)."""
    rows, columns = (np.linspace(0, length - 1, SIDE).round().astype(int) for length in image.shape[:2])
    return image[np.ix_(rows, columns)]


def dark(takes: Sequence[Take], images: Thumbnails, remove: Remove) -> list[Finding]:
    """Find episodes in which a camera is dark, or shows one colour."""
    found = []
    for camera, of in images.items():
        blind = [take.episode_id for take, frames in zip(takes, of, strict=True) if _is_blind(frames)]
        if blind:
            what = "the camera is dark or shows one colour: covered, unplugged, or overexposed"
            mend = f"record again with light and a free lens; without these episodes: {remove(blind)}"
            found.append(Finding(ERROR, f"{camera}, {episodes_named(blind)}", what, mend))
    return found


def _is_blind(frames: np.ndarray) -> bool:
    return frames.mean() < DARK or np.median(frames.std(axis=(1, 2))) < FLAT


def frozen(takes: Sequence[Take], images: Thumbnails, fps: float, remove: Remove) -> list[Finding]:
    """Find episodes in which a camera shows the same image while the arm moves."""
    found = []
    for camera, of in images.items():
        ids = [
            take.episode_id
            for take, frames in zip(takes, of, strict=True)
            if not _is_blind(frames) and _stands_still(take.states, frames, round(FROZEN_S * fps))
        ]
        if ids:
            what = f"the same image for {FROZEN_S:g} s and more while the arm moves"
            mend = f"give the camera a USB port of its own and record again; without these episodes: {remove(ids)}"
            found.append(Finding(ERROR, f"{camera}, {episodes_named(ids)}", what, mend))
    return found


def _stands_still(states: np.ndarray, frames: np.ndarray, least: int) -> bool:
    """Whether for `least` frames no image changes and a joint of the arm moves."""
    change = np.abs(np.diff(frames.astype(np.int16), axis=0)).mean(axis=(1, 2, 3))
    edges = np.flatnonzero(np.concatenate([[True], change > SAME, [True]]))  # a run of equal frames ends at each
    runs = zip(edges[:-1], edges[1:], strict=True)
    return any(
        stop - start > least and np.ptp(states[start:stop, :5], axis=0).max() > MOVED_DEG for start, stop in runs
    )


def swapped(
    takes: Sequence[Take], images: Thumbnails, reference: Thumbnails | None, keys: Mapping[str, str], remove: Remove
) -> list[Finding]:
    """Find pairs of cameras of which each shows what the other shows, in other episodes or in a reference data set.

    Args:
        keys: our camera -> the data set's name for it, with LeRobot's prefix.
    """
    found, names = [], list(images)
    views = {camera: np.stack([_view(frames) for frames in of]) for camera, of in images.items()}
    compared = views  # less than half of the episodes can be the odd ones out
    if reference and set(names) <= set(reference):
        compared = {camera: np.stack([_view(frames) for frames in reference[camera]]) for camera in names}
    usual = {camera: np.median(of, axis=0) for camera, of in compared.items()}
    for one, other in combinations(names, 2):
        straight, cross = (
            [_apart(mine, usual[a]) + _apart(its, usual[b]) for mine, its in zip(views[one], views[other], strict=True)]
            for a, b in ((one, other), (other, one))
        )
        crossed = [take.episode_id for take, a, b in zip(takes, straight, cross, strict=True) if a > CROSSED * b]
        if crossed:
            what = f"each shows what the other shows {'in most episodes' if compared is views else 'in the reference'}"
            mend = f"without these episodes: {remove(crossed)}"
            if len(crossed) == len(takes):
                mend = "--camera-map " + ",".join(
                    f"{keys[name].removeprefix(IMAGE_PREFIX)}={role}" for name, role in ((one, other), (other, one))
                )
            found.append(Finding(ERROR, f"{one} and {other}, {episodes_named(crossed)}", what, mend))
    return found


def _view(frames: np.ndarray) -> np.ndarray:
    """Return what a camera sees in an episode, whatever the light: its mean image, with mean 0 and spread 1."""
    mean = frames.mean(axis=(0, 3))
    return (mean - mean.mean()) / (mean.std() + 1e-9)


def _apart(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.square(one - other).mean())
