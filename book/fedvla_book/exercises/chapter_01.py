"""Checks of the exercises in the chapter on data."""

from collections.abc import Callable
from typing import Any

import numpy as np

from fedvla_book.exercises import close, expect


def tracking_error(measure: Callable[[np.ndarray, np.ndarray, int], float]) -> None:
    """``measure(states, actions, delay_frames)`` is the mean distance from an action to the state some frames later."""
    states, actions = np.random.default_rng(1).uniform(-90, 90, (2, 12, 6))
    reached, sent = states[:, :5], actions[:, :5]
    given = measure(states, actions, 2)
    expect(np.shape(given) == (), f"Expected one number, over frames and joints, not the shape {np.shape(given)}.")
    expect(not close(given, _apart(actions, states, 2)), "The gripper is not in degrees: leave its column out.")
    expect(not close(given, _apart(reached, sent, 2)), "You go back in time: the state follows the action.")
    around = np.abs(sent - np.roll(reached, -2, axis=0)).mean()
    expect(
        not close(given, around),
        "The last actions are paired with the first states: leave out actions without a later state.",
    )
    pairing = "Pair an action with the state `delay_frames` later, and average the distances without their sign."
    expect(close(given, _apart(sent, reached, 2)), pairing)
    expect(close(measure(states, actions, 0), _apart(sent, reached, 0)), "With a delay of 0 every frame has a pair.")


def _apart(first: np.ndarray, later: np.ndarray, frames: int) -> float:
    return np.abs(first[: len(first) - frames] - later[frames:]).mean()


def video_time(find: Callable[..., tuple[int, float]]) -> None:
    """``find(index, lengths, from_s, fps)`` is the episode of a frame and the time of its image in the file [s]."""
    lengths, from_s = np.array([50, 30, 40]), np.array([0.0, 5.0, 0.0])  # the third begins a file of its own
    (middle, late), (middle_s, late_s) = zip(*(_pair(find(i, lengths, from_s, 10)) for i in (60, 90)), strict=True)
    expect(close((middle, late), (1, 2)), "Episodes differ in length: add their lengths up until the frame is reached.")
    expect(not close(middle_s, 15.0), "Frames are not seconds: divide by the frame rate.")
    expect(not close(middle_s, 1.0), "An episode need not start where its file does: add the time at which it starts.")
    expect(not close(late_s, 9.0), "Count from the first frame of the episode, not of the data set.")
    first = _pair(find(50, lengths, from_s, 10))
    expect(close(first[0], 1), "The row after an episode's last one is the first of the next.")
    expect(
        close((middle_s, late_s), (6.0, 1.0)),
        "Start of the episode in its file, plus the frames since then divided by fps.",
    )
    given = _pair(find(15, np.array([12, 9]), np.array([1.5, 0.0]), 30))
    expect(close(given, (1, 0.1)), "The frame rate is not always the same: use the one that is given.")


def chunk_at(cut: Callable[..., tuple[np.ndarray, np.ndarray]]) -> None:
    """``cut(actions, row, end, size)`` is the chunk that starts at a row, and its mask of padding."""
    actions = 1.0 + np.arange(60).reshape(10, 6)  # all values differ, so that each identifies its row
    for row, end, size in ((5, 7, 4), (1, 7, 3), (8, 10, 4)):
        chunk, mask = map(np.asarray, _pair(cut(actions, row, end, size)))
        expect(chunk.shape == (size, 6), f"A chunk has `size` rows at every frame: {(size, 6)}, not {chunk.shape}.")
        beyond = chunk.max() > actions[end - 1].max()
        expect(not beyond, "Your chunk goes on with the next episode: `end` is where to stop.")
        expect(chunk.any(axis=1).all(), "Repeat the last action: zeros would send every joint to its zero position.")
        rows = [min(row + step, end - 1) for step in range(size)]
        expect(close(chunk, actions[rows]), "Each entry is one row further, up to the last row of the episode.")
        padded = [row + step >= end for step in range(size)]
        expect(mask.shape == (size,), f"The mask has one value for each row of the chunk, not the shape {mask.shape}.")
        expect(list(mask == 0) != padded, "Your mask marks real actions; it has to mark padding.")
        expect(list(mask != 0) == padded, "Padding starts at row `end`, which is outside the episode.")


def _pair(given: Any) -> tuple[Any, Any]:
    expect(isinstance(given, tuple | list) and len(given) == 2, "Return two things, in the order asked for.")
    return given[0], given[1]


def normalised(turn: Callable[..., np.ndarray]) -> None:
    """``turn(actions, episode_index, train_ids)`` is all frames, normalised by the training frames' statistics."""
    episode_index = np.repeat([0, 1, 2, 3], [8, 5, 12, 9])
    actions = np.random.default_rng(3).normal(20.0 * episode_index[:, None], 1.0 + np.arange(6), (34, 6))
    for train_ids in ([0, 2], [3, 1, 0]):
        given, seen = np.asarray(turn(actions, episode_index, train_ids)), np.isin(episode_index, train_ids)
        expect(given.shape == actions.shape, "All frames are wanted, held-out ones too, in their original order.")
        expect(
            not close(given, _scaled(actions, actions)), "Your statistics include held-out frames: this is the leak."
        )
        moments = given[seen].mean(axis=0), given[seen].std(axis=0)
        expect(
            close(moments, (np.zeros(6), np.ones(6))),
            "Over all training frames together, each joint has to come out with mean 0 and standard deviation 1.",
        )
        expect(
            close(given, _scaled(actions, actions[seen])),
            "Normalise held-out frames with the statistics of training frames.",
        )


def _scaled(actions: np.ndarray, known: np.ndarray) -> np.ndarray:
    return (actions - known.mean(axis=0)) / known.std(axis=0)


def rollouts_needed(count: Callable[[float, float], int]) -> None:
    """``count(rate, width)`` is the smallest number of rollouts whose Wilson interval is narrower than `width`."""
    certain, even = count(1.0, 0.1), count(0.5, 0.2)
    expect(certain != 1, "At a rate of 1 your interval has no width; the square root in Wilson's formula is never 0.")
    expect(even != _fewest(0.5, 0.4), "The width is from low to high: twice the term after ±.")
    bare = int(1.96**2 / 0.1) + 1  # the same interval without its factor
    expect(certain != bare, "The factor in front of the bracket is missing; it narrows the interval.")
    for rate, width in ((1.0, 0.1), (0.5, 0.2), (0.9, 0.1)):
        given = count(rate, width)
        expect(
            close(given, _fewest(rate, width)),
            f"At rate {rate} and width {width} it is not {given}: try each n in turn, with the whole formula.",
        )


def _fewest(rate: float, width: float, z: float = 1.96) -> int:
    """Where the squared width, a quadratic in the number of rollouts, falls below the one that is asked for."""
    ahead, behind = 4 * z**2 * rate * (1 - rate) / width**2, z**4 / width**2
    half = (ahead - 2 * z**2) / 2
    return int(half + np.sqrt(half**2 + behind - z**4)) + 1
