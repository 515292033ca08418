"""Checks of the exercises in the chapter on evaluation."""

from collections.abc import Callable, Sequence

import numpy as np
from scipy.stats import binomtest, norm

from fedvla_book.exercises import close, expect


def incomplete(find: Callable[..., Sequence[int]]) -> None:
    """``find(frames, steps, row_steps)`` lists the indices where video, trajectory and row differ in length."""
    frames = np.array([40, 0, 55, 60, 70, 33, 45])
    steps = np.array([40, 50, 65, 60, 60, 33, 44])
    given = np.asarray(find(frames, steps, np.array([40, 50, 65, 58, 60, 33, 45])))
    expect(given.dtype != bool, "You return a mask; return its indices, such as [1, 4].")
    found = set(given.ravel().tolist())
    expect(not found & {0, 5}, "Rollouts 0 and 5 are complete: all three lengths agree.")
    expect(found != {1}, "A video that opens can still lack its end: compare its length with that of the rollout.")
    expect(4 in found, "A video can also be too long, for example one from another rollout.")
    expect(3 in found, "Check the row, too: a video and a trajectory that agree may belong to another rollout.")
    expect(found == {1, 2, 3, 4, 6}, f"1, 2, 3, 4 and 6 have a length that differs, you list {sorted(found)}.")
    expect(len(find(steps, steps, steps)) == 0, "If all lengths agree, the list has to be empty.")


def wilson_interval(interval: Callable[[int, int], tuple[float, float]]) -> None:
    """``interval(successes, rollouts)`` returns the lower and the upper end of Wilson's 95 % interval."""
    none = interval(0, 20)
    expect(np.shape(none) == (2,), "Return two numbers: the lower end, then the upper.")
    expect(not close(*none), "20 failures do not prove a rate of 0, but your interval has no width there.")
    for successes, rollouts in ((14, 20), (5, 5), (0, 20), (1, 3)):
        given, case = np.asarray(interval(successes, rollouts)), f"{successes} of {rollouts}"
        right = np.array(binomtest(successes, rollouts).proportion_ci(method="wilson"))
        expect(not close(given[::-1], right, 1e-3), "The ends are swapped: lower end first.")
        narrow = binomtest(successes, rollouts).proportion_ci(confidence_level=0.9, method="wilson")
        expect(not close(given, narrow, 1e-3), "That is a 90 % interval: z must leave out 2.5 % on each side.")
        undivided = right * (1 + norm.ppf(0.975) ** 2 / rollouts)
        expect(not close(given, undivided, 1e-3), "The last division is missing: everything is over 1 + z²/n.")
        expect(close(given.mean(), right.mean(), 1e-3), f"The middle is off for {case}: it is p + z²/(2n), divided.")
        expect(close(given, right, 1e-3), f"The middle is right for {case}, the width is not: look at the root.")


def faster_by(seconds: Callable[[np.ndarray, np.ndarray], float]) -> None:
    """``seconds(before_s, after_s)`` is the time saved where both models succeed; NaN is a failure."""
    nan = float("nan")
    before, after = np.array([4.0, 5.0, nan, 9.0, 12.0]), np.array([4.4, 5.8, 7.0, nan, nan])
    given = seconds(before, after)
    expect(np.shape(given) == (), "Expected one number, the mean over seeds.")
    expect(not close(given, nan), "NaN propagates: leave out the seeds without a time.")
    expect(not close(given, np.nanmean(before) - np.nanmean(after)), "Your two means are over different seeds.")
    expect(not close(given, np.mean(np.nan_to_num(before) - np.nan_to_num(after))), "A failure does not take 0 s.")
    expect(not close(given, 0.6), "The sign is reversed: slower on both seeds is a negative saving.")
    expect(close(given, -0.6), "Take the seeds that both models solve, and the mean of before minus after.")
    expect(close(seconds(after + 3, after), 3.0), "If every success takes 3 s less, 3 s are saved.")


def jump_ratio(ratio: Callable[[np.ndarray, int], float]) -> None:
    """``ratio(actions, n_action_steps)`` is the mean change where chunks meet over the mean change elsewhere."""
    rng = np.random.default_rng(5)
    for plan, steps in ((8, 45), (5, 31)):
        starts = np.arange(steps) // plan
        inside = np.cumsum(rng.normal(0.5, 1.0, (steps, 6)), axis=0)
        actions = inside + 4 * rng.normal(size=(starts[-1] + 1, 6))[starts]
        given, change = ratio(actions, plan), np.diff(actions, axis=0)
        meet = np.diff(starts) == 1
        right = _over(np.abs(change), meet)
        expect(np.shape(given) == (), "Expected one number, over all joints and steps.")
        expect(not close(given, 1 / right), "It is inverted: where chunks meet over elsewhere.")
        expect(
            not close(given, _over(change, meet)),
            "Changes of opposite sign cancel: take absolute values before the mean.",
        )
        all_steps = np.abs(change)[meet].mean() / np.abs(change).mean()
        expect(not close(given, all_steps), "Leave the steps where chunks meet out of the second mean.")
        late = np.arange(steps - 1) % plan == 0
        expect(not close(given, _over(np.abs(change), late)), "Off by one: a new chunk starts with its first action.")
        expect(close(given, right), "Change k is from action k to k + 1; chunks meet where k + 1 is a multiple.")


def _over(change: np.ndarray, chosen: np.ndarray) -> float:
    return change[chosen].mean() / change[~chosen].mean()


def misled(share: Callable[[np.ndarray, np.ndarray], float]) -> None:
    """``share(loss, success)``: the share of pairs that differ in success which the loss ranks the wrong way."""
    loss, success = np.array([0.5, 0.4, 0.3, 0.2]), np.array([0.0, 0.3, 0.3, 0.2])
    given = share(loss, success)
    expect(not close(given, 2 / 6), "Two models with the same success cannot be ranked: leave that pair out.")
    expect(not close(given, 3 / 5), "You count where the loss is right; a lower loss should mean more success.")
    expect(not close(given, 1 / 2), "Compare each checkpoint with all others, not with the next one only.")
    expect(not close(given, 2), "That is a count: divide by the number of pairs that differ in success.")
    expect(close(given, 2 / 5), "List the pairs: 5 differ in success, and in 2 of them the lower loss is worse.")
    rising = np.arange(6.0)
    expect(close(share(rising, rising), 1.0), "If success always rises with the loss, every pair is misleading.")
    expect(close(share(rising, -rising), 0.0), "If success always falls with the loss, no pair is misleading.")


def visible(difference: Callable[[int, float], float]) -> None:
    """``difference(rollouts, rate)`` is the difference this many rollouts per model detect in 80 % of experiments."""
    for rollouts, rate in ((50, 0.6), (400, 0.7), (30, 0.5)):
        given, right = difference(rollouts, rate), _visible(rollouts, rate, 0.8)
        half = _visible(rollouts, rate, 0.5)
        expect(
            not close(given, half, 2e-3), "Such a difference is detected in half of the experiments: add z for 80 %."
        )
        one = (norm.ppf(0.975) + norm.ppf(0.8)) * np.sqrt(rate * (1 - rate) / rollouts)
        expect(not close(given, one, 2e-3), "Both models are measured: their variances add up.")
        same = np.sqrt(2) * one
        expect(not close(given, same, 2e-3), "The better model has a variance of its own, from its own rate.")
        expect(close(given, right, 2e-3), f"For {rollouts} rollouts at rate {rate} the formula says {right:.3f}.")


def _visible(rollouts: int, rate: float, power: float) -> float:
    """Solve rollouts d² = z² (p(1 - p) + (p + d)(1 - p - d)), the sample size formula, for d."""
    square = (norm.ppf(0.975) + norm.ppf(power)) ** 2
    return max(np.roots([rollouts + square, -square * (1 - 2 * rate), -2 * square * rate * (1 - rate)]).real)
