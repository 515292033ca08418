"""Figures of episodes: joints, frames, images, chunks of actions."""

from collections.abc import Sequence

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap

from fedvla_book.plots.style import joint_axes
from fedvla_lib.evaluation.figures import PALETTE, WIDTH, new_axes
from fedvla_lib.robot.spec import FPS, JOINT_NAMES, JOINT_UNITS


def joints(states: np.ndarray, actions: np.ndarray, *, axes: Sequence[Axes] | None = None) -> Sequence[Axes]:
    """Draw measured state and commanded action, both (T, 6) in degrees and gripper 0-100, against time, per joint."""
    if axes is None:
        axes = joint_axes()
    seconds = np.arange(len(states)) / FPS
    for i, ax in enumerate(axes):
        ax.plot(seconds, states[:, i], label="state")
        ax.plot(seconds, actions[:, i], "--", label="action")
        ax.set_title(JOINT_NAMES[i], fontsize=10)
        ax.set_ylabel(f"position [{JOINT_UNITS[i]}]")
    for ax in axes[-2:]:
        ax.set_xlabel("time [s]")
    axes[0].legend(frameon=False)
    return axes


def frame_strip(frames: np.ndarray, *, count: int = 6, title: str = "", ax: Axes | None = None) -> Axes:
    """Draw `count` frames of a video (T, H, W, 3), evenly spaced from first to last, side by side."""
    picks = np.linspace(0, len(frames) - 1, min(count, len(frames))).round().astype(int)
    if ax is None:
        height = WIDTH / len(picks) * frames.shape[1] / frames.shape[2] + 0.6
        _, ax = plt.subplots(figsize=(WIDTH, height), layout="constrained")
    gap = max(1, frames.shape[2] // 32)  # white space between frames
    spaced = np.pad(frames[picks], ((0, 0), (0, 0), (0, gap), (0, 0)), constant_values=255)
    ax.imshow(np.concatenate(list(spaced), axis=1)[:, :-gap])
    centres = np.arange(len(picks)) * spaced.shape[2] + frames.shape[2] / 2
    ax.set_xticks(centres, [f"{i / FPS:.1f} s" for i in picks])
    ax.set_yticks([])
    ax.grid(False)
    ax.set_xlabel("time in the episode")
    ax.set_title(title)
    return ax


def padding(masks: np.ndarray, *, ax: Axes | None = None) -> Axes:
    """Draw which steps of action chunks are padding: `masks` bool (samples, chunk)."""
    ax = ax or new_axes()
    colors = ListedColormap([PALETTE[0], "#DDDDDD"])
    ax.imshow(masks, cmap=colors, vmin=0, vmax=1, aspect="auto", extent=(0.5, masks.shape[1] + 0.5, len(masks), 0))
    for value, name in enumerate(("real action: counts in the loss", "padding: left out")):
        ax.plot([], [], "s", color=colors(value), label=name)
    ax.grid(False)
    ax.set_xlabel("step of the chunk")
    ax.set_ylabel("frames before the end of the episode")
    ax.set_yticks(np.arange(len(masks)) + 0.5, np.arange(len(masks), 0, -1), fontsize=8)
    ax.legend(frameon=False, ncols=2, loc="upper center", bbox_to_anchor=(0.5, 1.15))
    return ax


def trajectories(by_name: dict[str, np.ndarray], *, axes: Sequence[Axes] | None = None) -> Sequence[Axes]:
    """Draw measured joint positions (T, 6) of several actors against time, a panel per joint."""
    if axes is None:
        axes = joint_axes()
    for i, ax in enumerate(axes):
        for name, states in by_name.items():
            ax.plot(np.arange(len(states)) / FPS, states[:, i], label=name)
        ax.set_title(JOINT_NAMES[i], fontsize=10)
        ax.set_ylabel(f"position [{JOINT_UNITS[i]}]")
    for ax in axes[-2:]:
        ax.set_xlabel("time [s]")
    axes[0].legend(frameon=False, fontsize=8)
    return axes


def frame_strips(
    images: dict[str, np.ndarray], *, count: int = 6, axes: Sequence[Axes] | None = None
) -> Sequence[Axes]:
    """Draw a `frame_strip` of each camera, camera -> (T, H, W, 3), one below the other."""
    if axes is None:
        _, grid = plt.subplots(len(images), 1, figsize=(WIDTH, 1.7 * len(images)), layout="constrained", squeeze=False)
        axes = grid.ravel()
    for ax, (camera, frames) in zip(axes, images.items(), strict=True):
        frame_strip(frames, count=count, title=f"camera: {camera}", ax=ax)
    for ax in axes[:-1]:
        ax.set_xlabel("")
    return axes


def image_table(
    rows: dict[str, np.ndarray], *, titles: Sequence[str] = (), axes: np.ndarray | None = None
) -> np.ndarray:
    """Draw a table of images: each entry of `rows` is a row of them, (n, H, W, 3); `titles` name the columns."""
    count = len(next(iter(rows.values())))
    if axes is None:
        side = min(WIDTH / count, 2.2)
        size = (side * count, side * len(rows) + 0.4)
        _, axes = plt.subplots(len(rows), count, figsize=size, layout="constrained", squeeze=False)
    for line, (name, frames) in zip(axes, rows.items(), strict=True):
        line[0].set_ylabel(name)
        for ax, frame in zip(line, frames, strict=True):
            ax.imshow(frame)
            ax.set_xticks([])
            ax.set_yticks([])
    for ax, title in zip(axes[0], titles, strict=False):
        ax.set_title(title, fontsize=8)
    return axes


def chunk(
    actions: np.ndarray, frame: int, future: np.ndarray, is_pad: np.ndarray, *, joint: int = 0, ax: Axes | None = None
) -> Axes:
    """Draw one joint of an episode's actions (T, 6) and the chunk `future` (C, 6) that starts at `frame`."""
    ax = ax or new_axes()
    seconds = (frame + np.arange(len(future))) / FPS
    ax.plot(np.arange(len(actions)) / FPS, actions[:, joint], color="#999999", label="action, whole episode")
    ax.plot(seconds[~is_pad], future[~is_pad, joint], "o", color=PALETTE[0], label="chunk")
    ax.plot(seconds[is_pad], future[is_pad, joint], "x", color=PALETTE[1], label="chunk, padding")
    ax.axvline(frame / FPS, color="black", linestyle=":", label="observation")
    ax.set_xlabel("time in the episode [s]")
    ax.set_ylabel(f"{JOINT_NAMES[joint]} [{JOINT_UNITS[joint]}]")
    ax.legend(frameon=False)
    return ax


def likeness(gaps_s: np.ndarray, distances: np.ndarray, elsewhere: float, *, ax: Axes | None = None) -> Axes:
    """Draw the difference between two frames of an episode against their time gap; `elsewhere`: to another episode."""
    ax = ax or new_axes()
    ax.plot(gaps_s, distances, "o-", label="same episode")
    ax.axhline(elsewhere, color=PALETTE[1], linestyle="--", label="another episode, same task and moment")
    ax.set_ylim(bottom=0)
    ax.set_xlabel("time between the two frames [s]")
    ax.set_ylabel("mean difference [grey levels out of 255]")
    ax.legend(frameon=False)
    return ax
