"""Checks of the exercises in the chapter on an arm of one's own."""

from collections.abc import Callable

import numpy as np

from fedvla_book.exercises import close, expect

TICKS = 4095  # of an encoder in a turn, as LeRobot counts


def fastest(speed: Callable[[float, float], float]) -> None:
    """``speed(clamp, fps)``: the largest speed that --robot.max_relative_target allows, degrees a second."""
    given = speed(5.0, 30.0)
    expect(not close(given, 5.0), "That is for one step: how many steps are there in a second?")
    expect(not close(given, 5.0 / 30.0), "More steps a second allow more degrees a second: multiply.")
    expect(close(given, 150.0), "Degrees for each step, times steps in a second.")
    expect(close(speed(2.0, 10.0), 20.0), "It has to depend on both, the clamp and the rate.")


def degrees(convert: Callable[[float, int, int], float]) -> None:
    """``convert(value, range_min, range_max)``: LeRobot's -100..100 of a calibrated joint in degrees."""
    given = convert(50.0, 1000, 3000)
    right = 0.5 * 1000 * 360 / TICKS
    expect(not close(given, 50.0), "50 of 100 is half of the way to an end, wherever that end is: not 50 degrees.")
    expect(not close(given, 2 * right), "-100 to 100 is the whole range: 100 is half a range away from its middle.")
    expect(not close(given, 500.0), "Those are ticks of the encoder: 4095 of them are 360 degrees.")
    expect(not close(given, 2500 * 360 / TICKS), "LeRobot's zero degrees is the middle of the range, not tick 0.")
    expect(close(given, right), "Half a range for 100, in ticks, times 360 / 4095.")
    expect(close(convert(-100.0, 800, 3200), -1200 * 360 / TICKS), "-100 is the end of the range below the middle.")


def rows_at(rows: Callable[[int, float, float], np.ndarray]) -> None:
    """``rows(frames, recorded, fps)``: the rows of an episode that a policy of another rate reads, by time."""
    given = np.asarray(rows(9, 30.0, 10.0))
    expect(given.ndim == 1, "Return a list of row numbers.")
    expect(not close(given, np.arange(9)), "Those are all the frames: a chunk would last a third of its time.")
    expect(not close(given, [0, 3, 6, 9]), "There is no row 9 in an episode of 9 frames.")
    expect(close(given, [0, 3, 6]), "Take the times 0, 1 / fps, 2 / fps and so on that lie in the episode.")
    uneven = np.asarray(rows(10, 25.0, 10.0))
    expect(not close(uneven, [0, 2, 4, 6, 8]), "25 / 10 is no whole number: round each time's row, not the step.")
    expect(close(uneven, [0, 2, 5, 8]) or close(uneven, [0, 3, 5, 8]), "The frame for a time is the nearest one.")
    expect(np.max(rows(8, 25.0, 10.0)) < 8, "There is no row 8 in an episode of 8 frames: the last one is the nearest.")


def zero_offset(offset: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> None:
    """``offset(today, recorded)``: by how many degrees each joint's zero has moved; both (episodes, joints)."""
    rng = np.random.default_rng(4)
    recorded = np.array([0.0, -50.0, 30.0, 75.0, 0.0]) + rng.uniform(-2, 2, (12, 5))
    moved = np.array([0.0, 0.0, -8.0, 0.0, 0.0])
    today = recorded[:6].mean(axis=0) + moved + rng.uniform(-0.5, 0.5, (6, 5))
    difference = today.mean(axis=0) - recorded.mean(axis=0)
    given = np.asarray(offset(today.copy(), recorded.copy()))
    expect(given.shape == (5,), "Return a number for each joint: average over the episodes.")
    expect(not close(given, difference), "The arm never starts in quite the same pose: less than 3 degrees is 0.")
    signed = np.where(np.abs(difference) > 3, difference, 0)
    expect(not close(given, -signed), "Today minus recorded: what today's arm reports too much.")
    expect(not close(given, np.where(difference > 3, difference, 0)), "A zero can move either way: compare its size.")
    expect(close(given, signed), "The difference of the mean start poses, and 0 where it is below 3 degrees.")


def best_lag(lag: Callable[[np.ndarray, np.ndarray, int], int]) -> None:
    """``lag(given, recorded, most)``: ``given[t]`` is most like ``recorded[t + lag]``; both (steps, joints)."""
    rng = np.random.default_rng(6)
    recorded = np.cumsum(rng.normal(size=(60, 6)), axis=0)
    for true in (3, -5, 0):
        rows = np.arange(60) + true
        inside = (rows >= 0) & (rows < 60)
        given = np.where(inside[:, None], recorded[rows.clip(0, 59)], rng.normal(size=(60, 6)) * 50)
        found = lag(given.copy(), recorded.copy(), 8)
        expect(np.shape(found) == (), "Return one number of steps.")
        expect(true == 0 or found != -true, "The sign is turned: positive if the given actions come too early.")
        expect(found == true, "Try all shifts from -most to most, on the steps that both have, and take the best mean.")
    still = np.zeros((30, 6))
    expect(lag(still, still, 4) == 0, "All lags fit an arm that stands still equally well: then it is 0.")
