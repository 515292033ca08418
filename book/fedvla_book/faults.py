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

from fedvla_book.tables.faults import OWN, TESTS
from fedvla_lib.config import Config
from fedvla_lib.data.episode_checks import Take, shift
from fedvla_lib.data.frame_store import FrameStore
from fedvla_lib.evaluation import diagnosis
from fedvla_lib.evaluation.statistics import wilson
from fedvla_lib.policy.actor import PolicyActor
from fedvla_lib.policy.model import Bundle
from fedvla_lib.robot.expert import Expert
from fedvla_lib.robot.labs import REFERENCE, Lab
from fedvla_lib.robot.layout import Region
from fedvla_lib.robot.rollout import Episode, run_episodes
from fedvla_lib.robot.sim import So100Env
from fedvla_lib.robot.spec import CAMERAS, FPS
from fedvla_lib.robot.stage import stage_of_process
from fedvla_lib.robot.tasks import PRETRAINING_TASKS, Task

PULL = replace(PRETRAINING_TASKS["pull"], horizon_steps=50)  # twice as long as a demonstration takes
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


def shifted(bundle: Bundle, steps: int) -> Bundle:
    """Return the policy whose chunks are played from so many steps after their first action, or before, if negative.

    Before its first action and after its last a chunk stands still.
    """

    def played(chunk: Any) -> Any:
        last = chunk.shape[1] - 1
        return chunk[:, [min(max(step + steps, 0), last) for step in range(last + 1)]]

    return replace(bundle, postprocess=Changed(bundle.postprocess, after=played))


def zero_moved(arm: Arm, joint: int, degrees: float) -> Arm:
    """Return the arm with a joint whose calibration is off: it reports so many degrees more than there are."""
    offsets = np.array(arm.lab.joint_offset_deg) + degrees * (np.arange(len(arm.lab.joint_offset_deg)) == joint)
    return replace(arm, lab=replace(arm.lab, joint_offset_deg=tuple(offsets.tolist())))


def elsewhere(task: Task, bearing_deg: tuple[float, float]) -> Task:
    """Return the task with its first cube in another sector of the table."""
    return replace(task, cube=Region(task.cube.radius_m, bearing_deg))


def _environments(arm: Arm, config: Config, count: int, cameras: Sequence[str]) -> list[So100Env]:
    envs = stage_of_process(config.image_size).envs(arm.task, count)
    for env in envs:
        env.lab, env.cameras = arm.lab, tuple(cameras)
    return envs


def roll_out(arm: Arm, config: Config, seeds: Sequence[int]) -> list[bool]:
    """Return which rollouts of the deployed policy succeed, one for each seed, in one batch."""
    actors = [PolicyActor(arm.running, config.seed) for _ in seeds]
    episodes = run_episodes(_environments(arm, config, len(seeds), ()), actors, seeds, PolicyActor.act_together)
    return [episode.success for episode in episodes]


def by_hand(arm: Arm, config: Config, seeds: Sequence[int]) -> FrameStore:
    """Return demonstrations of the expert on this arm, as a data set of the policy would hold them."""
    envs = _environments(arm, config, len(seeds), CAMERAS)
    return _as_store(run_episodes(envs, [Expert() for _ in seeds], seeds))


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
        shifted(good.bundle, -config.n_action_steps),
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
    today: dict[Any, FrameStore] = {}  # people demonstrate once on the same arm and table
    for arm in arms.values():
        if (place := (arm.lab, arm.task)) not in today:
            today[place] = by_hand(arm, config, range(TODAY, TODAY + HANDS))
    return pd.DataFrame(
        {"fault": name, "test": OWN[name]} | examine(arm, known, today[arm.lab, arm.task], config, seeds)
        for name, arm in arms.items()
    )


def examine(arm: Arm, known: Known, today: FrameStore, config: Config, seeds: Sequence[int]) -> dict[str, Any]:
    """Return the success of an arm on fresh layouts with its interval, and whether each of `TESTS` fires, and why."""
    fresh, again = _on_fresh_and_recorded(arm, known, config, seeds)
    low, high = wilson(sum(fresh), len(fresh))
    values = by_demonstrations(arm, known, today, config) | {"table": float(np.mean(again) - np.mean(fresh))}
    fires = {
        "statistics": values["statistics"] > BEYOND, "cameras": values["cameras"] < OTHERWISE,
        "chunk": abs(values["chunk"]) >= LATE_STEPS, "zero": values["zero"] > 0, "table": values["table"] >= WORSE,
        "instruction": values["instruction"] > UNHEARD,
    }  # fmt: skip
    share = {"rollouts": len(fresh), "success_rate": float(np.mean(fresh)), "low": low, "high": high}
    return share | fires | {f"{test} value": values[test] for test in TESTS}


def _on_fresh_and_recorded(
    arm: Arm, known: Known, config: Config, seeds: Sequence[int]
) -> tuple[list[bool], list[bool]]:
    """Return which rollouts succeed on fresh layouts and on the recorded ones; in one batch if they are of one kind."""
    if arm.task != known.task:
        return roll_out(arm, config, seeds), roll_out(replace(arm, task=known.task), config, known.seeds)
    both = roll_out(arm, config, [*seeds, *known.seeds])
    return both[: len(seeds)], both[len(seeds) :]


def by_demonstrations(arm: Arm, known: Known, today: FrameStore, config: Config) -> dict[str, float]:
    """Return the numbers that the recordings and today's demonstrations give, by test."""
    frames, running = diagnosis.frames_of(today, config), arm.running
    losses = diagnosis.loss_by_arrangement(running, frames)
    return {
        "statistics": diagnosis.beyond_statistics(running, known.store),
        "cameras": min(losses.values()) / losses["as given"], "chunk": diagnosis.lag_steps(running, frames),
        "zero": len(shift(takes(today), takes(known.store))),
        "instruction": losses["as given"] / diagnosis.loss(arm.bundle, frames),
    }  # fmt: skip
