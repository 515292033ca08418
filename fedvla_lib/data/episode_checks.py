"""Checks of joints, times and instructions of recorded episodes: functions of arrays that return findings.

Each check looks for one kind of damage. `inspection` reads a data set and runs them all; cameras are in
`camera_checks`. Thresholds lie far from healthy recordings, of simulated arms and of real ones: an SO-100 turns a joint
by at most 300 degrees a second, and two arms of the same kind are calibrated to within a few degrees.
"""

import json
import re
import shlex
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from fedvla_lib.robot.spec import JOINT_NAMES
from fedvla_lib.robot.tasks import task_of

ERROR, WARNING, NOTE = "error", "warning", "note"  # severities
ARM = range(5)  # the joints in degrees; the gripper comes after them
NAMES = [name.removesuffix(".pos") for name in JOINT_NAMES]
# Ends of the joints' ranges (degrees) as the simulated arm has them. Calibrated ranges of real arms differ a little.
LIMITS_DEG = np.array([[-126.1, 126.1], [-90.0, 101.5], [-90.0, 90.0], [-114.6, 103.1], [-180.0, 180.0]])
LIMIT_MARGIN_DEG = 15.0
FASTEST = 500.0  # degrees (percent of the gripper) a second; no motor of the arm is as fast
STILL, STILL_S, LEFT_BEHIND = 0.3, 1.0, 5.0  # moves by less, for so long, while its target moves so far: stuck
APART_DEG = 10.0  # usual distance from action to state, beyond which two arms are calibrated differently
SHIFT_DEG = 3.0  # difference of mean start poses; labs of this book differ by less than 2
SCATTER_DEG = 8.0  # standard deviation of start poses, above which their mean tells nothing
LOWEST_M = (-0.02, 0.12)  # where the hand is at its lowest, above the table, in a recording on a table
CLOSE_M = -0.05  # so little below the table may come from zeros that are a few degrees off
SHORT = 0.25  # of the median length of the episodes of the same task
MOST_RADIANS = 3.5  # no joint turns by more than about pi

Remove = Callable[[Collection[int]], str]  # the command that removes episodes


@dataclass(frozen=True)
class Finding:
    """One problem of a data set, or one fact about it."""

    severity: str  # error: learning from it goes wrong; warning: look at it; note: for information
    where: str
    what: str
    mend: str = ""  # the command, or what to set


@dataclass(frozen=True, eq=False)
class Take:
    """One episode without its images."""

    episode_id: int
    instruction: str
    times_s: np.ndarray  # (T,)
    states: np.ndarray  # (T, 6), LeRobot units
    actions: np.ndarray  # (T, 6)


def episodes_named(ids: Collection[int]) -> str:
    """Return ``episode 3`` or ``episodes 3, 5, 8 and 12 more``."""
    ids = sorted(ids)
    more = f" and {len(ids) - 6} more" if len(ids) > 6 else ""
    return f"episode{'s' * (len(ids) > 1)} {', '.join(map(str, ids[:6]))}{more}"


def timing(takes: Sequence[Take], fps: float, remove: Remove) -> list[Finding]:
    """Find timestamps that are not evenly spaced by 1 / fps."""
    late = {}
    for take in takes:
        drift = np.abs(take.times_s - np.arange(len(take.times_s)) / fps)
        if drift.max() > 0.1 / fps:
            late[take.episode_id] = float(drift.max())
    if not late:
        return []
    if len(late) == len(takes):
        rate = np.median([1 / np.median(np.diff(take.times_s)) for take in takes if len(take.times_s) > 1])
        if abs(rate - fps) > 0.02 * fps:
            what = f"frames are {1000 / rate:.0f} ms apart: {rate:.3g} frames a second, meta/info.json says {fps:g}"
            return [Finding(ERROR, "all episodes", what, f"set fps in meta/info.json to {rate:.0f}")]
    what = f"frames come up to {1000 * max(late.values()):.0f} ms too early or late, 1 / fps is {1000 / fps:.0f} ms"
    mend = "record with fewer or smaller cameras, so that the loop keeps its rate; or " + remove(late)
    return [Finding(ERROR, episodes_named(late), what, mend)]


def lengths(takes: Sequence[Take], remove: Remove) -> list[Finding]:
    """Find episodes that are far shorter than others of the same task: recordings that were cut off."""
    by_task = defaultdict(list)
    for take in takes:
        by_task[task_of(take.instruction)].append(take)
    short = [
        take.episode_id
        for group in by_task.values()
        for take in group
        if len(take.times_s) < max(2, SHORT * np.median([len(each.times_s) for each in group]))
    ]
    what = f"less than {SHORT:.0%} of the usual length: cut off?"
    return [Finding(WARNING, episodes_named(short), what, remove(short))] if short else []


def duplicates(takes: Sequence[Take], remove: Remove) -> list[Finding]:
    """Find episodes whose states and actions are those of an earlier one."""
    seen: dict[bytes, int] = {}
    found = {}
    for take in takes:
        content = np.concatenate([take.states, take.actions]).astype(np.float32).tobytes()
        first = seen.setdefault(content, take.episode_id)
        if first != take.episode_id:
            found[take.episode_id] = first
    if not found:
        return []
    what = f"the same as {episodes_named(set(found.values()))}: training and held-out data would share them"
    return [Finding(ERROR, episodes_named(found), what, remove(found))]


def jumps(takes: Sequence[Take], fps: float, remove: Remove) -> list[Finding]:
    """Find joints that move faster than the arm can: lost readings, or an angle that wraps around."""
    return _by_joint(
        {
            (joint, take.episode_id): float(steps[:, joint].max())
            for take in takes
            if len(take.states) > 1
            for steps in [np.abs(np.diff(take.states, axis=0))]
            for joint in np.flatnonzero(steps.max(axis=0) > FASTEST / fps)
        },
        lambda size: f"jumps by {size:.0f} from one frame to the next" + " (it wraps around)" * (size > 300),
        lambda ids: f"{remove(ids)}; check the motor's cable, and calibrate the arm if it wraps around",
    )


def stuck(takes: Sequence[Take], fps: float, remove: Remove) -> list[Finding]:
    """Find joints that rest while their target moves. A gripper that holds something may: it has to rest throughout."""
    found = {}
    for take in takes:
        for joint, name in enumerate(NAMES):
            state, action = take.states[:, joint], take.actions[:, joint]
            left = float(np.ptp(action)) if np.ptp(state) < 0.02 * np.ptp(action) else 0.0
            if name != "gripper":
                left = max(left, _left_behind(state, action, round(STILL_S * fps)))
            if left > LEFT_BEHIND:
                found[joint, take.episode_id] = left
    return _by_joint(
        found,
        lambda size: f"stands still while its target moves by {size:.0f}",
        lambda ids: f"{remove(ids)}; check the motor and its cable",
    )


def _left_behind(state: np.ndarray, action: np.ndarray, frames: int) -> float:
    """Return how far the target moves at most while the state rests for so many frames."""
    if len(state) < frames:
        return 0.0
    rests, moves = (np.ptp(sliding_window_view(values, frames), axis=1) for values in (state, action))
    return float(moves[rests < STILL].max(initial=0.0))


def _by_joint(
    found: dict[tuple[int, int], float], what: Callable[[float], str], mend: Callable[[Collection[int]], str]
) -> list[Finding]:
    """Return an error for each joint, given its largest value by (joint, episode)."""
    findings = []
    for joint in sorted({joint for joint, _ in found}):
        ids = [episode for other, episode in found if other == joint]
        size = max(found[joint, episode] for episode in ids)
        findings.append(Finding(ERROR, f"{NAMES[joint]}, {episodes_named(ids)}", what(size), mend(ids)))
    return findings


def units(takes: Sequence[Take]) -> list[Finding]:
    """Find joints that are not in degrees, and a gripper that is not in percent.

    LeRobot's -100..100 cannot be told from degrees where no joint reached an end of its range.
    """
    values = np.concatenate([*(take.states for take in takes), *(take.actions for take in takes)])
    arm, gripper = values[:, ARM], values[:, -1]
    found = []
    if np.abs(arm).max() < MOST_RADIANS:
        what = f"radians: none is beyond {np.abs(arm).max():.2f}"
        mend = "multiply the first five columns of observation.state and action by 180 / pi"
        found.append(Finding(ERROR, "all joints", what, mend))
    elif np.abs(arm).max() <= 100.001 and (np.abs(arm) > 99.999).sum() > 1:
        found.append(Finding(
            ERROR, "all joints", "LeRobot's -100..100: values end at exactly 100 and none is beyond",
            "record with --robot.use_degrees=true --teleop.use_degrees=true, or multiply each of the first five "
            "columns by 0.0004395 (range_max - range_min) of its joint in the arm's calibration file",
        ))  # fmt: skip
    elif _is_old(arm):
        found.append(Finding(
            ERROR, "shoulder_lift, elbow_flex", "degrees of LeRobot's old calibration, with zero at the stretched arm",
            "replace shoulder_lift by 90 - shoulder_lift and elbow_flex by elbow_flex - 90, in observation.state and "
            "action",
        ))  # fmt: skip
    if gripper.max() <= MOST_RADIANS and np.ptp(gripper) > 0.1:
        of = "0..1" if gripper.max() <= 1.001 else "radians"
        mend = "multiply its column by 100" if of == "0..1" else "map its range to 0..100: 0 is closed, 100 open"
        found.append(Finding(ERROR, "gripper", f"{of}: it goes from {gripper.min():.2f} to {gripper.max():.2f}", mend))
    elif gripper.min() < -LIMIT_MARGIN_DEG or gripper.max() > 100 + LIMIT_MARGIN_DEG:
        what = f"goes from {gripper.min():.0f} to {gripper.max():.0f}, but 0 is closed and 100 is open"
        found.append(Finding(ERROR, "gripper", what, "calibrate it again: lerobot-calibrate, from closed to open"))
    return found


def _is_old(arm: np.ndarray) -> bool:
    """Whether the joints leave their ranges, and do not once they are converted from the old calibration."""
    converted = arm * [1, -1, 1, 1, 1] + [0, 90, -90, 0, 0]
    return len(_outside(arm[:, :3])) > 0 and len(_outside(converted[:, :3])) == 0


def _outside(arm: np.ndarray) -> list[int]:
    """Return the joints (columns) that leave their range by more than the margin in more than 1 % of frames."""
    low, high = LIMITS_DEG[: arm.shape[1]].T
    beyond = (arm < low - LIMIT_MARGIN_DEG) | (arm > high + LIMIT_MARGIN_DEG)
    return np.flatnonzero(beyond.mean(axis=0) > 0.01).tolist()


def ranges(takes: Sequence[Take]) -> list[Finding]:
    """Find joints in degrees that leave their ranges, or of which the sign puts the hand below or far above the table.

    A turned shoulder_pan or wrist_roll looks like its mirror image; `shift` finds it beside a reference.
    """
    states = np.concatenate([take.states for take in takes]).astype(float)
    calibrate = "calibrate again: lerobot-calibrate, and move every joint through its whole range"
    found = [
        Finding(ERROR, NAMES[joint], f"goes from {states[:, joint].min():.0f} to {states[:, joint].max():.0f} degrees, "
                f"the arm from {LIMITS_DEG[joint, 0]:.0f} to {LIMITS_DEG[joint, 1]:.0f}", calibrate)
        for joint in _outside(states[:, ARM])
    ]  # fmt: skip
    lowest = lowest_hand_m(states)
    if found or LOWEST_M[0] <= lowest <= LOWEST_M[1]:
        return found
    turned = {joint: lowest_hand_m(states * np.where(np.arange(6) == joint, -1, 1)) for joint in (1, 2, 3)}
    better = sorted((height, NAMES[joint]) for joint, height in turned.items() if 0 <= height <= LOWEST_M[1])
    what = f"with these angles the hand is {lowest:.2f} m above the table at its lowest"
    if not better:
        where = "shoulder_lift, elbow_flex, wrist_flex"
        return [Finding(WARNING, where, f"{what}: a sign, a unit or a zero is off", calibrate)]
    mend = "; or ".join(f"multiply the columns of {name} by -1: then it is {height:.2f} m" for height, name in better)
    where, severity = " or ".join(name for _, name in better), WARNING if CLOSE_M < lowest < 0 else ERROR
    what = f"its sign is turned, or a zero is off: {what}"
    return [Finding(severity, where, what, f"{mend} (observation.state and action); or {calibrate}")]


def lowest_hand_m(states: np.ndarray) -> float:
    """Return the height (m) of the point between the jaws above the table in the lowest 1 % of states (N, 6), degrees.

    The heights of the links' ends add up; the coefficients are fitted to the simulated arm, within 1 cm.
    """
    upper, fore, hand = np.cumsum(np.deg2rad(states[:, 1:4]), axis=1).T
    height = 0.12 + 0.11 * np.cos(upper) - 0.03 * np.sin(upper) - 0.13 * np.sin(fore) - 0.15 * np.sin(hand)
    return float(np.percentile(height, 1))


def following(takes: Sequence[Take]) -> list[Finding]:
    """Find joints of which state and action have opposite signs, or zeros far apart."""
    states, actions = (np.concatenate([getattr(take, of) for take in takes]) for of in ("states", "actions"))
    found = []
    for joint in ARM:
        state, action = states[:, joint], actions[:, joint]
        apart = float(np.median(action - state))
        moved = min(np.ptp(state), np.ptp(action)) > APART_DEG
        if moved and np.corrcoef(state, action)[0, 1] < -0.5:
            what, mend = "state and action have opposite signs", "set drive_mode alike for leader and follower"
            found.append(Finding(ERROR, NAMES[joint], what, f"{mend}, or multiply one of the two columns by -1"))
        elif abs(apart) > APART_DEG:
            what = f"the action is usually {apart:+.0f} degrees from the state: leader and follower differ"
            mend = f"calibrate both in the same pose, or subtract {apart:.1f} from its column in action"
            found.append(Finding(WARNING, NAMES[joint], what, mend))
    return found


def shift(takes: Sequence[Take], reference: Sequence[Take]) -> list[Finding]:
    """Compare start poses with those of a reference data set: a joint's zero is shifted, or its sign is turned."""
    found = []
    here, there = (np.stack([take.states[0] for take in each]).astype(float) for each in (takes, reference))
    for joint in ARM:
        mine, theirs = here[:, joint], there[:, joint]
        difference, scatter = float(mine.mean() - theirs.mean()), max(mine.std(), theirs.std())
        error = 3 * np.sqrt(mine.var() / len(mine) + theirs.var() / len(theirs))
        if scatter > SCATTER_DEG or abs(difference) <= max(SHIFT_DEG, error):
            continue
        what = f"starts {difference:+.1f} degrees from the reference: its zero is shifted"
        mend = f"calibrate again in the reference's pose, or subtract {difference:.1f} from its columns"
        if abs(mine.mean() + theirs.mean()) < SHIFT_DEG:
            what = f"starts at {mine.mean():.0f} degrees, the reference at {theirs.mean():.0f}: its sign is turned"
            mend = "multiply its columns by -1"
        found.append(Finding(ERROR, NAMES[joint], what, f"{mend} in observation.state and action"))
    return found


def instructions(takes: Sequence[Take], command: str) -> list[Finding]:
    """Find instructions that are empty, that differ in case, punctuation or spaces only, or that are all one.

    Args:
        command: LeRobot's command that edits the data set, without an operation.
    """
    texts, found = Counter(take.instruction for take in takes), []
    if empty := [take.episode_id for take in takes if not _plain(take.instruction)]:
        given = json.dumps({str(episode): "WHAT TO DO" for episode in empty})
        mend = f"{command} --operation.type modify_tasks --operation.episode_tasks {shlex.quote(given)}"
        found.append(Finding(ERROR, episodes_named(empty), "no instruction", mend))
    alike = defaultdict(list)
    for text, _ in texts.most_common():
        alike[_plain(text)].append(text)
    for usual, *others in alike.values():
        if others and _plain(usual):
            given = json.dumps(dict.fromkeys(others, usual), ensure_ascii=False)
            mend = f"{command} --operation.type modify_tasks --operation.task_replacements {shlex.quote(given)}"
            what = f"{', '.join(map(repr, others))} is {usual!r} in other letters: a model reads two tasks"
            found.append(Finding(WARNING, "instructions", what, mend))
    if len(alike) == 1 and len(takes) > 1:
        what = f"all {len(takes)} episodes have {next(iter(texts))!r}: a policy learns to ignore the instruction"
        found.append(Finding(NOTE, "instructions", what, "fine for one task; merge data sets of others for several"))
    return found


def _plain(text: str) -> str:
    return " ".join(re.findall(r"\w+", text.casefold()))
