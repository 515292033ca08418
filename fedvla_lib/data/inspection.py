"""The data doctor: what is wrong with a data set, how to mend it, and what training will do with it.

Reads what `lerobot_reader` would refuse as well, as far as that is possible, and hands arrays to the checks of
`episode_checks` and `camera_checks`.
"""

import json
import shlex
from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from tqdm.auto import tqdm

from fedvla_lib.config import Config
from fedvla_lib.data import camera_checks, episode_checks, resampling
from fedvla_lib.data.camera_checks import SIDE, small
from fedvla_lib.data.conversion import find
from fedvla_lib.data.episode_checks import ERROR, NOTE, WARNING, Finding, Remove, Take
from fedvla_lib.data.lerobot_reader import (
    FPS_TOLERANCE,
    Cameras,
    DataError,
    Outline,
    check_rows,
    episode_rows,
    image_features,
    read_images,
    read_outline,
)
from fedvla_lib.data.recordings import camera_names
from fedvla_lib.data.splits import split
from fedvla_lib.robot.spec import CAMERAS, IMAGE_PREFIX
from fedvla_lib.robot.tasks import ALL_TASKS, task_of

SEVERITIES = (ERROR, WARNING, NOTE)  # the worst first


@dataclass(frozen=True, eq=False)
class Recorded:
    """A data set as far as it can be read."""

    outline: Outline
    takes: list[Take]
    images: dict[str, list[np.ndarray]]  # our camera -> small images of each take, see `camera_checks`
    damaged: list[Finding]  # what cannot be read


@dataclass(frozen=True)
class Report:
    """Result of an inspection."""

    findings: list[Finding]  # the worst first
    episodes_per_task: dict[str, int]  # of an instruction that is no task of the simulator, the instruction itself
    training: dict[str, Any]  # what training will do with the data

    @property
    def has_errors(self) -> bool:
        """Whether a finding is an error."""
        return any(finding.severity == ERROR for finding in self.findings)


def inspect(source: str | Path, config: Config, reference: str | Path | None = None) -> Report:
    """Inspect a data set.

    Args:
        source: a folder in LeRobotDataset format, or a hub id.
        config: settings of the training that is planned.
        reference: a data set of an arm with the right calibration, recorded from the same start pose.

    Raises:
        DataError: the data set, or the reference, cannot be found, or has no readable description.
    """
    root, cameras = find(source), camera_names(config)
    recorded = read_recorded(root, cameras)
    beside = _read_reference(find(reference), cameras) if reference else None
    found = check(recorded, beside, partial(remove_command, root), edit_command(root)) if recorded.takes else []
    findings = recorded.damaged + found
    counts = Counter(task_of(take.instruction) for take in recorded.takes)
    facts, notes = _training(recorded, config, counts)
    findings = sorted(findings + notes, key=lambda finding: SEVERITIES.index(finding.severity))
    return Report(findings, dict(counts.most_common()), facts)


def _read_reference(root: Path, cameras: Cameras | None) -> Recorded:
    """Read a reference by the names of its own cameras; if they say nothing, they may be named as in the data set."""
    try:
        return read_recorded(root)
    except DataError:
        return read_recorded(root, cameras)


def read_recorded(root: Path, cameras: Cameras | None = None) -> Recorded:
    """Read a data set, with a finding for each episode or camera that cannot be read; raise DataError if none can."""
    outline = read_outline(root, cameras)
    instructions = dict(zip(outline.files["episode_index"], outline.files["tasks"], strict=True))
    lengths = outline.files.set_index("episode_index")["length"]
    takes, damaged = {}, []
    for _, episode_id, rows in episode_rows(outline):
        try:
            states, actions = check_rows("", rows, lengths[episode_id])
        except DataError as error:
            mend = remove_command(root, [episode_id])
            damaged.append(Finding(ERROR, f"episode {episode_id}", str(error).removeprefix(": "), mend))
            continue
        times_s = rows["timestamp"].to_numpy(float)
        takes[episode_id] = Take(int(episode_id), str(instructions[episode_id][0]), times_s, states, actions)
    rows = {
        episode: (start, start + lengths[episode]) for episode, start in zip(lengths.index, outline.starts, strict=True)
    }
    images = {}
    for camera, key in outline.cameras.items():
        try:
            whole = _thumbnails(outline, key)
            images[camera] = [whole[slice(*rows[episode])] for episode in sorted(takes)]
        except DataError as error:
            name = key.removeprefix(IMAGE_PREFIX)
            damaged.append(Finding(ERROR, f"camera {name}", str(error), "remove that episode, or record it again"))
    return Recorded(outline, [takes[episode] for episode in sorted(takes)], images, damaged)


def _thumbnails(outline: Outline, key: str) -> np.ndarray:
    frames = np.zeros((int(outline.files["length"].sum()), SIDE, SIDE, 3), np.uint8)
    for row, image in tqdm(read_images(outline, key), f"reading {key}", len(frames), leave=False, unit="frame"):
        frames[row] = small(image)
    return frames


def check(recorded: Recorded, beside: Recorded | None, remove: Remove, edit: str) -> list[Finding]:
    """Run all checks; those that need degrees only if the joints are in degrees.

    Args:
        beside: a reference data set.
        remove: returns the command that removes episodes.
        edit: LeRobot's command that edits the data set, without an operation.
    """
    takes, fps, images = recorded.takes, recorded.outline.info["fps"], recorded.images
    found = [
        *episode_checks.timing(takes, fps, remove), *episode_checks.lengths(takes, remove),
        *episode_checks.duplicates(takes, remove), *episode_checks.instructions(takes, edit),
        *camera_checks.dark(takes, images, remove), *camera_checks.frozen(takes, images, fps, remove),
        *camera_checks.swapped(takes, images, beside and beside.images, recorded.outline.cameras, remove),
    ]  # fmt: skip
    if other := episode_checks.units(takes):
        return found + other
    found += episode_checks.stuck(takes, fps, remove) + episode_checks.jumps(takes, fps, remove)
    found += episode_checks.ranges(takes) + episode_checks.following(takes)
    return found + (episode_checks.shift(takes, beside.takes) if beside and beside.takes else [])


def _training(recorded: Recorded, config: Config, counts: Mapping[str, int]) -> tuple[dict[str, Any], list[Finding]]:
    """Return what training will do with the data, and notes on what a reader may not expect."""
    info, cameras, fps = recorded.outline.info, recorded.outline.cameras, recorded.outline.info["fps"]
    names = {camera: key.removeprefix(IMAGE_PREFIX) for camera, key in cameras.items()}
    table = pd.DataFrame({"episode_id": [take.episode_id for take in recorded.takes],
                          "task": [task_of(take.instruction) for take in recorded.takes]})  # fmt: skip
    held_out = split(table, config.val_fraction, config.seed)[1] if len(table) else []
    frames = sum(len(take.states) for take in recorded.takes)
    facts = {
        "episodes": len(table), "held_out_episodes": len(held_out), "frames": frames, "fps": fps,
        "policy_fps": config.fps, "cameras": names, "chunk_size": config.chunk_size,
        "chunk_s": config.chunk_size / config.fps, "unknown_tasks": [task for task in counts if task not in ALL_TASKS],
    }  # fmt: skip
    notes = []
    if fps < config.fps * (1 - FPS_TOLERANCE):
        what = f"{fps:g} frames a second, but the policy acts {config.fps} times"
        notes.append(Finding(ERROR, "fps", what, f"train with --fps {fps:g}"))
    elif what := resampling.note(fps, config.fps):
        notes.append(Finding(NOTE, "fps", what, f"--fps {fps:g} for a policy that acts as often"))
    if lacking := [camera for camera in CAMERAS if camera not in names]:
        notes.append(Finding(WARNING, "cameras", f"none for {', '.join(lacking)}: the policy sees the others only"))
    if unused := [key.removeprefix(IMAGE_PREFIX) for key in image_features(info) if key not in cameras.values()]:
        notes.append(Finding(NOTE, "cameras", f"{', '.join(unused)}: not read"))
    if facts["unknown_tasks"]:
        what = f"{len(facts['unknown_tasks'])} instructions are no task of the simulator: no rollouts of them"
        notes.append(Finding(NOTE, "tasks", what))
    return facts, notes


def edit_command(root: Path) -> str:
    """Return LeRobot's command that edits a data set in place, without the operation."""
    return f"lerobot-edit-dataset --repo_id local/data --root {shlex.quote(str(root))}"


def remove_command(root: Path, ids: Collection[int]) -> str:
    """Return LeRobot's command that copies a data set without some episodes."""
    new_root, indices = shlex.quote(f"{root}-mended"), shlex.quote(json.dumps(sorted(int(i) for i in ids)))
    operation = f"--operation.type delete_episodes --operation.episode_indices {indices}"
    return f"{edit_command(root)} --new_root {new_root} {operation}"


def table(report: Report) -> str:
    """Return a report as text: findings with their mends, episodes of each task, and what training will do."""
    lines = []
    for finding in report.findings:
        lines.append(f"{finding.severity:<8} {finding.where}: {finding.what}")
        lines += [f"{'':9}-> {finding.mend}"] if finding.mend else []
    lines += [f"{count:>8} episodes of {task!r}" for task, count in report.episodes_per_task.items()]
    facts = report.training
    cameras = ", ".join(f"camera {name} as {camera}" for camera, name in facts["cameras"].items())
    lines.append(
        f"Training reads {facts['frames']} frames of {facts['episodes']} episodes, {facts['held_out_episodes']} held "
        f"out, recorded at {facts['fps']} and used at {facts['policy_fps']} a second; {cameras}; "
        f"a chunk of {facts['chunk_size']} actions lasts {facts['chunk_s']:.2f} s."
    )
    counts = Counter(finding.severity for finding in report.findings)
    lines.append(", ".join(f"{counts[severity]} {severity}{'s' * (counts[severity] != 1)}" for severity in SEVERITIES))
    return "\n".join(lines)
