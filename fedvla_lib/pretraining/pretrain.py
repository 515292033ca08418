"""Pretraining of the nano base: phrase grounding, then imitation; a report is saved with the weights.

SmolVLA's recipe is a pretrained vision-language model that stays frozen while the action expert trains. Here the nano
vision-language part first learns what "the red cube" means and where on the table it is (`ground`). Then it is frozen,
and the expert trains on demonstrations of tasks that no client has: reach, grip, drag, pull, nudge and point, with
cubes, light and camera poses that vary between episodes. The result comes with the package as ``base = "nano"``.
"""

import hashlib
import json
import time
from dataclasses import asdict, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from fedvla_lib.config import Config
from fedvla_lib.data import frame_store, normalisation, record
from fedvla_lib.data.batches import Batches
from fedvla_lib.evaluation.rollouts import evaluate, rollout_seeds
from fedvla_lib.evaluation.statistics import success_table
from fedvla_lib.files import cache_dir, new_folder, read_json, write_json
from fedvla_lib.policy import model, nano
from fedvla_lib.policy.actor import PolicyActor
from fedvla_lib.policy.prefix_cache import with_cached_prefixes
from fedvla_lib.policy.training import Checkpoints, Objective, local_train
from fedvla_lib.pretraining.grounding import Questions, grounding_loss, pointing_error_m, probing
from fedvla_lib.pretraining.recipe import Recipe
from fedvla_lib.pretraining.scenes import draw_scenes
from fedvla_lib.provenance import code_digest, first_stamp
from fedvla_lib.robot.sim import So100Env
from fedvla_lib.robot.tasks import PRETRAINING_TASKS, TASKS

CARD_FILE = "pretraining.json"
TWO_CUBES = ("reach", "grip")  # tasks that can have a second cube


def settings(recipe: Recipe) -> Config:
    """Return the settings of the action expert's training, with the vision-language part frozen."""
    shared = ("episodes_per_task", "image_size", "batch_size", "lr", "checkpoint_every", "num_threads", "seed")
    given = {name: getattr(recipe, name) for name in shared}
    tasks, warmup_steps = ",".join(PRETRAINING_TASKS), min(100, recipe.steps // 10)
    return replace(Config(), base="nano-random", tasks=tasks, warmup_steps=warmup_steps, **given)


def pretrain(recipe: Recipe, out: Path, progress: bool = True) -> Path:
    """Pretrain a base, save it with its report in the folder `out`, and return `out`; resumes an interrupted call.

    Raises:
        FileExistsError: `out` exists.
        ValueError: a number in the recipe is not usable.
    """
    _check(recipe)
    if out.exists():
        raise FileExistsError(f"{out} exists already: give a folder that does not")
    out.absolute().parent.mkdir(parents=True, exist_ok=True)
    began, config, work = time.perf_counter(), settings(recipe), _work_folder(recipe)
    stamp = first_stamp(config, "pretrain")
    drawn = {"image_size": recipe.image_size, "seed": recipe.seed, "jitter": recipe.jitter, "progress": progress}
    recording = record.record(list(PRETRAINING_TASKS), recipe.episodes_per_task, work / "recording", **drawn)
    store = frame_store.open_store(recording, image_size=recipe.image_size)
    episodes = list(store.episodes.episode_id)
    stats = normalisation.episode_stats(store, episodes)
    grounded, grounding = ground(recipe, stats, work, progress)
    bundle = model.load_policy(config, stats)
    bundle.policy.load_state_dict(grounded.policy.state_dict())
    batches = Batches(store, episodes, config.chunk_size, recipe.batch_size, seed=recipe.seed)
    result = local_train(
        bundle, with_cached_prefixes(bundle, batches, progress), config, steps=recipe.steps,
        checkpoints=Checkpoints(work / "checkpoints", resume=True), progress=progress,
    )  # fmt: skip
    report = {
        "recipe": asdict(recipe), "episodes": len(episodes), "frames": store.num_frames,
        "parameters": sum(p.numel() for p in bundle.policy.parameters()), "grounding": grounding,
        "training_seconds": result.seconds, "last_loss": float(np.mean(result.losses[-100:])),
        "success": measure(bundle, recipe, progress), "language": follows_instructions(bundle, recipe, progress),
    }  # fmt: skip
    report["stamp"] = stamp | {"status": "completed", "wall_s": time.perf_counter() - began}
    with new_folder(out.absolute()) as draft:
        model.write_policy(bundle, draft)
        write_json(draft / CARD_FILE, report)
    return out


def ground(
    recipe: Recipe, stats: normalisation.Stats, work: Path, progress: bool = True
) -> tuple[model.Bundle, dict[str, float]]:
    """Train a random nano model on grounding; return it and a report of its pointing error on unseen scenes."""
    unfrozen = {"freeze_vision_encoder": False, "train_expert_only": False, "train_state_proj": True}
    config = replace(settings(recipe), warmup_steps=min(100, recipe.grounding_steps // 10), **unfrozen)
    bundle = model.load_policy(config, stats)
    options = {"image_size": recipe.image_size, "jitter": recipe.jitter, "progress": progress}
    scenes = draw_scenes(work / "scenery", recipe.scenes, seed=recipe.seed, **options)
    unseen = draw_scenes(work / "scenery_unseen", recipe.unseen_scenes, seed=recipe.seed + 1, **options)
    with probing(bundle, recipe.seed):
        result = local_train(
            bundle, Questions(scenes, bundle, recipe.batch_size, recipe.seed), config, steps=recipe.grounding_steps,
            checkpoints=Checkpoints(work / "grounding", resume=True), objective=Objective(grounding_loss),
            progress=progress,
        )  # fmt: skip
        errors_m = pointing_error_m(bundle, Questions(unseen, bundle, recipe.batch_size, recipe.seed))
    return bundle, {
        "seconds": result.seconds, "phrase_tokens": len(errors_m), "median_error_m": float(np.median(errors_m)),
        "p90_error_m": float(np.quantile(errors_m, 0.9)),
    }  # fmt: skip


def _check(recipe: Recipe) -> None:
    for name, value in asdict(recipe).items():
        if value < 0 or (value == 0 and name not in ("jitter", "seed")):
            raise ValueError(f"{name.replace('_', '-')}={value} is not usable: give a number above 0")


def measure(bundle: model.Bundle, recipe: Recipe, progress: bool = True) -> list[dict[str, Any]]:
    """Return success rates with Wilson intervals, for the pretraining tasks and the clients' tasks (not trained on)."""
    tasks = [*PRETRAINING_TASKS, *TASKS]
    actor = PolicyActor(bundle, recipe.seed)
    rows = evaluate(actor, tasks, rollout_seeds(recipe.rollouts), image_size=recipe.image_size, progress=progress)
    return success_table(pd.DataFrame(rows), ["task"]).to_dict("records")


def follows_instructions(bundle: model.Bundle, recipe: Recipe, progress: bool = True) -> list[dict[str, Any]]:
    """Return success rates in scenes with two cubes when the instruction names the target or the other cube.

    In both cases success refers to the target cube, with the same seeds.
    """
    actors = {"right": PolicyActor(bundle, recipe.seed), "other": _Misled(bundle, recipe.seed)}
    rows = []
    for task in TWO_CUBES:
        seeds = _seeds_with_two_cubes(task, recipe.rollouts)
        for told, actor in actors.items():
            rollouts = evaluate(actor, [task], seeds, image_size=recipe.image_size, progress=progress)
            rows += [row | {"told": told} for row in rollouts]
    return success_table(pd.DataFrame(rows), ["task", "told"]).to_dict("records")


class _Misled(PolicyActor):
    """Gets the instruction with the colour of the other cube."""

    def reset(self, env: So100Env, seed: int) -> None:
        super().reset(env, seed)
        right, other = (cube.color for cube in env.layout.cubes)
        self._instruction = self._instruction.replace(right, other)


def _seeds_with_two_cubes(task: str, count: int) -> list[int]:
    env = So100Env(task, cameras=(), render_mode=None)
    seeds = (seed for seed in rollout_seeds(20 * count) if env.reset(seed=seed) and len(env.layout.cubes) == 2)
    return list(islice(seeds, count))


def _work_folder(recipe: Recipe) -> Path:
    """Folder for the recording and checkpoints of this recipe and this version of the code."""
    key = json.dumps(asdict(recipe), sort_keys=True) + code_digest(pretrain)
    return cache_dir() / f"pretraining-{hashlib.sha256(key.encode()).hexdigest()[:12]}"


def read_account(base: Path | None = None) -> dict[str, Any]:
    """Return the report saved with a base, by default the one in this package; raise ValueError if it has none."""
    path = (base or nano.nano_base()) / CARD_FILE
    if not path.is_file():
        raise ValueError(f"{path.parent} has no {CARD_FILE}: it was not made by fedvla pretrain")
    return read_json(path)
