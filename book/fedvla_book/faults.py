"""Faults between a good policy and an arm, each planted where it happens, and the table of which test finds which.

None of them shows in the loss of the training. An `Arm` is a policy as it is deployed, with what its recordings do not
know: who told it what, which cable is in which socket, where zero degrees is, and what stands on the table.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from fedvla_book.sentences import rate
from fedvla_lib.config import Config
from fedvla_lib.data.episode_checks import Take, shift
from fedvla_lib.data.frame_store import FrameStore
from fedvla_lib.evaluation import diagnosis
from fedvla_lib.evaluation.statistics import wilson
from fedvla_lib.files import read_json
from fedvla_lib.policy.actor import PolicyActor
from fedvla_lib.policy.model import Bundle
from fedvla_lib.robot.expert import Expert
from fedvla_lib.robot.labs import REFERENCE, Lab
from fedvla_lib.robot.layout import Region
from fedvla_lib.robot.rollout import Episode, run_episodes
from fedvla_lib.robot.sim import So100Env
from fedvla_lib.robot.spec import CAMERAS, FPS
from fedvla_lib.robot.tasks import Task

OWN = {  # fault -> the test that belongs to it, in the order of the tree
    "none": "", "statistics missing": "statistics", "cameras exchanged": "cameras", "cameras upside down": "cameras",
    "half a chunk skipped": "chunk", "zero off by 10 degrees": "zero", "cube where none was": "table",
    "another instruction": "instruction",
}  # fmt: skip
TESTS = ("statistics", "cameras", "chunk", "zero", "table", "instruction")  # in the order of the tree
BEYOND = 0.01  # statistics: share of joint values
OTHERWISE = 0.9  # cameras: a loss below this share of the one as given
LATE_STEPS = 2  # chunk: steps early or late
WORSE = 0.5  # table: difference of success on recorded and on fresh layouts
UNHEARD = 1.5  # instruction: how many times the loss with the recorded instruction
TODAY = 2_000_000  # first seed of today's demonstrations
HANDS = 4  # demonstrations made today


@dataclass(frozen=True)
class Arm:
    """A deployed policy."""

    bundle: Bundle
    task: Task  # what is on the table, and what counts as success
    lab: Lab = REFERENCE  # the calibration is in it
    told: str = ""  # the instruction, if it is not the task's

    @property
    def running(self) -> Bundle:
        """The policy with the instruction that it gets."""
        if not self.told:
            return self.bundle
        return replace(self.bundle, preprocess=Changed(self.bundle.preprocess, before=self._tell))

    def _tell(self, batch: dict[str, Any]) -> dict[str, Any]:
        return batch | {"task": [self.told] * len(batch["task"])}


@dataclass(frozen=True)
class Changed:
    """A processor with a change before or after it."""

    processor: Any
    before: Callable[[Any], Any] = lambda batch: batch
    after: Callable[[Any], Any] = lambda batch: batch

    def __call__(self, batch: Any) -> Any:
        return self.after(self.processor(self.before(batch)))

    @property
    def steps(self) -> Any:
        """The steps of the processor itself."""
        return self.processor.steps


def seen(bundle: Bundle, arrangement: str) -> Bundle:
    """Return the policy with its cameras in one of `diagnosis.arrangements`."""

    def wrong(batch: dict[str, Any]) -> dict[str, Any]:
        return batch | diagnosis.arrangements(batch)[arrangement]

    return replace(bundle, preprocess=Changed(bundle.preprocess, before=wrong))


def skipping(bundle: Bundle, steps: int) -> Bundle:
    """Return the policy with the first steps of every chunk dropped, as if they were over when it arrives."""

    def later(chunk: Any) -> Any:
        last = chunk.shape[1] - 1
        return chunk[:, [min(step + steps, last) for step in range(last + 1)]]

    return replace(bundle, postprocess=Changed(bundle.postprocess, after=later))


def zero_moved(arm: Arm, joint: int, degrees: float) -> Arm:
    """Return the arm with a joint whose calibration is off: it reports so many degrees more than there are."""
    offsets = np.array(arm.lab.joint_offset_deg) + degrees * (np.arange(len(arm.lab.joint_offset_deg)) == joint)
    return replace(arm, lab=replace(arm.lab, joint_offset_deg=tuple(offsets.tolist())))


def elsewhere(task: Task, bearing_deg: tuple[float, float]) -> Task:
    """Return the task with its first cube in another sector of the table."""
    return replace(task, cube=Region(task.cube.radius_m, bearing_deg))


def _environments(arm: Arm, config: Config, count: int, cameras: Sequence[str]) -> list[So100Env]:
    """Return environments of an arm that share the renderer of the first."""
    look = {"lab": arm.lab, "cameras": tuple(cameras)}
    first = So100Env(arm.task, config.image_size, **look)
    return [first, *(So100Env(arm.task, config.image_size, renderer_of=first, **look) for _ in range(1, count))]


def roll_out(arm: Arm, config: Config, seeds: Sequence[int]) -> list[bool]:
    """Return which rollouts of the deployed policy succeed, one for each seed, in one batch."""
    envs = _environments(arm, config, len(seeds), ())
    try:
        actors = [PolicyActor(arm.running, config.seed) for _ in seeds]
        episodes = run_episodes(envs, actors, seeds, PolicyActor.act_together)
    finally:
        envs[0].close()
    return [episode.success for episode in episodes]


def by_hand(arm: Arm, config: Config, seeds: Sequence[int]) -> FrameStore:
    """Return demonstrations of the expert on this arm, as a data set of the policy would hold them."""
    envs = _environments(arm, config, len(seeds), CAMERAS)
    try:
        episodes = run_episodes(envs, [Expert() for _ in seeds], seeds)
    finally:
        envs[0].close()
    return _as_store(episodes)


def _as_store(episodes: Sequence[Episode]) -> FrameStore:
    lengths = np.array([episode.num_frames for episode in episodes])
    ends = np.cumsum(lengths)
    table = pd.DataFrame({
        "episode_id": range(len(episodes)), "start": ends - lengths, "end": ends, "num_frames": lengths,
        "instruction": [episode.instruction for episode in episodes], "task": [episode.task for episode in episodes],
        "lab": 0,
    })  # fmt: skip
    joined = {name: np.concatenate([getattr(each, name) for each in episodes]) for name in ("states", "actions")}
    images = {camera: np.concatenate([each.images[camera] for each in episodes]) for camera in CAMERAS}
    return FrameStore(Path("today"), FPS, **joined, images=images, episodes=table)


def takes(store: FrameStore) -> list[Take]:
    """Return the episodes of a store for the doctor's checks."""
    return [
        Take(one.episode_id, one.instruction, np.arange(one.num_frames) / store.fps, store.states[one.start : one.end],
             store.actions[one.start : one.end])
        for one in store.episodes.itertuples()
    ]  # fmt: skip


def planted(good: Arm, config: Config, *, missing: Bundle, instruction: str) -> dict[str, Arm]:
    """Return an arm for each fault of `OWN`, "none" first.

    Args:
        missing: the policy with processors that lack the statistics.
        instruction: the one that the policy is told by mistake.
    """
    changed = (
        missing, seen(good.bundle, "exchanged"), seen(good.bundle, "upside down"),
        skipping(good.bundle, config.n_action_steps),
    )  # fmt: skip
    arms = [
        good, *(replace(good, bundle=bundle) for bundle in changed), zero_moved(good, 0, 10.0),
        replace(good, task=elsewhere(good.task, (50.0, 65.0))), replace(good, told=instruction),
    ]  # fmt: skip
    return dict(zip(OWN, arms, strict=True))


@dataclass(frozen=True)
class Known:
    """What the arm is compared with."""

    store: FrameStore  # the recordings that the policy learnt from
    seeds: Sequence[int]  # of their scenes
    task: Task  # that they show


def examine_all(arms: Mapping[str, Arm], known: Known, config: Config, seeds: Sequence[int]) -> pd.DataFrame:
    """Return a row for each arm: fault, test (its own), `examine`."""
    return pd.DataFrame(
        {"fault": name, "test": OWN[name]} | examine(arm, known, config, seeds) for name, arm in arms.items()
    )


def examine(arm: Arm, known: Known, config: Config, seeds: Sequence[int]) -> dict[str, Any]:
    """Return the success of an arm on fresh layouts with its interval, and whether each of `TESTS` fires, and why."""
    fresh, again = roll_out(arm, config, seeds), roll_out(replace(arm, task=known.task), config, known.seeds)
    low, high = wilson(sum(fresh), len(fresh))
    values = by_demonstrations(arm, known, config) | {"table": float(np.mean(again) - np.mean(fresh))}
    fires = {
        "statistics": values["statistics"] > BEYOND, "cameras": values["cameras"] < OTHERWISE,
        "chunk": abs(values["chunk"]) >= LATE_STEPS, "zero": values["zero"] > 0, "table": values["table"] >= WORSE,
        "instruction": values["instruction"] > UNHEARD,
    }  # fmt: skip
    share = {"rollouts": len(fresh), "success_rate": float(np.mean(fresh)), "low": low, "high": high}
    return share | fires | {f"{test} value": values[test] for test in TESTS}


def by_demonstrations(arm: Arm, known: Known, config: Config) -> dict[str, float]:
    """Return the numbers that the recordings and today's demonstrations give, by test."""
    today = by_hand(arm, config, range(TODAY, TODAY + HANDS))
    frames, running = diagnosis.frames_of(today, config), arm.running
    losses = diagnosis.loss_by_arrangement(running, frames)
    return {
        "statistics": diagnosis.beyond_statistics(running, known.store),
        "cameras": min(losses.values()) / losses["as given"], "chunk": diagnosis.lag_steps(running, frames),
        "zero": len(shift(takes(today), takes(known.store))),
        "instruction": losses["as given"] / diagnosis.loss(arm.bundle, frames),
    }  # fmt: skip


def read(file: Path) -> pd.DataFrame:
    """Return the stored table of `book/tools/fault_study.py`."""
    return pd.DataFrame(read_json(file)["rows"])


def sentence(found: pd.DataFrame) -> str:
    """Return in words what tests found in a table of `examine_all`."""
    rates = found.set_index("fault")
    own = [row.fault for row in found.itertuples() if row.test and getattr(row, row.test)]
    besides = [
        f"*{test}* ({row['fault']})" for _, row in found.iterrows() for test in TESTS if row[test] and test != row.test
    ]
    parts = [f"{name} {rate(row)}" for name, row in rates.iterrows()]
    return (
        f"Success: {'; '.join(parts)}. The test of its own finds {len(own)} of {len(found) - 1} faults; others that "
        f"fire: {', '.join(besides) or 'none'}."
    )
