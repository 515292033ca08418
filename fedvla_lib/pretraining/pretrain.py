"""How the nano base is made: it learns to see, then to act, and an account of it is written beside its weights.

SmolVLA's recipe is a vision-language model that knows the world and stays frozen while the action expert learns. The
nano model's vision-language part is made here: it learns what "the red cube" means and where on the table it is
(`ground`). Then it is frozen, and the expert learns broad skills on tasks that no client will ever be asked for: reach,
grip, drag, pull, nudge and point, with cubes of several colours, in a different light and from a slightly different
angle in every episode. ``base = "nano"`` names the result, which comes with the package.
"""

import hashlib
import json
import time
from contextlib import closing
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
from fedvla_lib.files import cache_dir, new_folder, write_json
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
TWO_CUBES = ("reach", "grip")  # tasks in which a second cube can stand on the table


def settings(recipe: Recipe) -> Config:
    """Return the settings of the expert's training, in which the vision-language part is frozen."""
    shared = ("episodes_per_task", "image_size", "batch_size", "lr", "checkpoint_every", "num_threads", "seed")
    return replace(
        Config(),
        base="nano-random",
        tasks=",".join(PRETRAINING_TASKS),
        warmup_steps=min(100, recipe.steps // 10),
        **{name: getattr(recipe, name) for name in shared},
    )


def pretrain(recipe: Recipe, out: Path, progress: bool = True) -> Path:
    """Make the base and its account in the folder `out`, and return it; an interrupted call goes on where it was.

    Raises:
        FileExistsError: `out` is there already.
        ValueError: a number of the recipe is not usable.
    """
    _check(recipe)
    out = Path(out)
    if out.exists():
        raise FileExistsError(f"{out} exists already: give a folder that does not")
    out.absolute().parent.mkdir(parents=True, exist_ok=True)
    began, config, work = time.perf_counter(), settings(recipe), _work_folder(recipe)
    stamp = first_stamp(config, "pretrain")
    recording = record.record(
        list(PRETRAINING_TASKS),
        recipe.episodes_per_task,
        work / "recording",
        image_size=recipe.image_size,
        seed=recipe.seed,
        jitter=recipe.jitter,
        progress=progress,
    )
    store = frame_store.open_store(recording, image_size=recipe.image_size)
    episodes = list(store.episodes.episode_id)
    stats = normalisation.episode_stats(store, episodes)
    seeing, grounding = ground(recipe, stats, work, progress)
    bundle = model.load_policy(config, stats)
    bundle.policy.load_state_dict(seeing.policy.state_dict())
    batches = Batches(store, episodes, config.chunk_size, recipe.batch_size, seed=recipe.seed)
    result = local_train(
        bundle, with_cached_prefixes(bundle, batches, progress), config, steps=recipe.steps,
        checkpoints=Checkpoints(work / "checkpoints", resume=True), progress=progress,
    )  # fmt: skip
    account = {
        "recipe": asdict(recipe),
        "episodes": len(episodes),
        "frames": store.num_frames,
        "parameters": sum(p.numel() for p in bundle.policy.parameters()),
        "grounding": grounding,
        "training_seconds": result.seconds,
        "last_loss": sum(result.losses[-100:]) / len(result.losses[-100:]),
        "success": measure(bundle, recipe, progress),
        "language": follows_instructions(bundle, recipe, progress),
    }
    seconds = time.perf_counter() - began
    account |= {"stamp": stamp | {"status": "completed", "wall_s": seconds}}
    with new_folder(out.absolute()) as draft:
        model.write_policy(bundle, draft)
        _name_backbone_here(draft, bundle.policy.config.vlm_model_name)
        write_json(draft / CARD_FILE, account)
    return out


def ground(
    recipe: Recipe, stats: normalisation.Stats, work: Path, progress: bool = True
) -> tuple[model.Bundle, dict[str, float]]:
    """Teach a random nano model to see; return it with an account of how well it points at what a sentence names."""
    everything = {"freeze_vision_encoder": False, "train_expert_only": False, "train_state_proj": True}
    config = replace(settings(recipe), warmup_steps=min(100, recipe.grounding_steps // 10), **everything)
    bundle = model.load_policy(config, stats)
    drawing = {"image_size": recipe.image_size, "jitter": recipe.jitter, "progress": progress}
    scenery = draw_scenes(work / "scenery", recipe.scenes, seed=recipe.seed, **drawing)
    unseen = draw_scenes(work / "scenery_unseen", recipe.unseen_scenes, seed=recipe.seed + 1, **drawing)
    with probing(bundle, recipe.seed):
        result = local_train(
            bundle, Questions(scenery, bundle, recipe.batch_size, recipe.seed), config, steps=recipe.grounding_steps,
            checkpoints=Checkpoints(work / "grounding", resume=True), objective=Objective(grounding_loss), progress=progress,
        )  # fmt: skip
        missed_m = pointing_error_m(bundle, Questions(unseen, bundle, recipe.batch_size, recipe.seed))
    return bundle, {
        "seconds": result.seconds,
        "phrase_tokens": len(missed_m),
        "median_error_m": float(np.median(missed_m)),
        "p90_error_m": float(np.quantile(missed_m, 0.9)),
    }


def _check(recipe: Recipe) -> None:
    for name, value in asdict(recipe).items():
        if value < 0 or (value == 0 and name not in ("jitter", "seed")):
            flag = name.replace("_", "-")
            raise ValueError(f"{flag}={value} is not usable: give a number above 0")


def _name_backbone_here(folder: Path, backbone: str) -> None:
    """Let the saved files name the backbone that lies beside them, not where it lay on the machine that trained."""
    for path in sorted(folder.glob("*.json")):
        path.write_text(path.read_text().replace(json.dumps(backbone), json.dumps(model.VLM_FOLDER)))


def measure(bundle: model.Bundle, recipe: Recipe, progress: bool = True) -> list[dict[str, Any]]:
    """Return success per task, with Wilson intervals: the pretraining tasks, then, never seen, those of the clients."""
    tasks = [*PRETRAINING_TASKS, *TASKS]
    actor = PolicyActor(bundle, recipe.seed)
    rows = evaluate(actor, tasks, rollout_seeds(recipe.rollouts), image_size=recipe.image_size, progress=progress)
    return success_table(pd.DataFrame(rows), ["task"]).to_dict("records")


def follows_instructions(bundle: model.Bundle, recipe: Recipe, progress: bool = True) -> list[dict[str, Any]]:
    """Measure whether the instruction decides: two cubes stand there, and the arm is told the right or the other one.

    Success is judged for the same cube in both cases, on the same seeds.
    """
    actors = {"right": PolicyActor(bundle, recipe.seed), "other": _Misled(bundle, recipe.seed)}
    rows = []
    for task in TWO_CUBES:
        seeds = _seeds_with_two_cubes(task, recipe.rollouts)
        for told, actor in actors.items():
            found = evaluate(actor, [task], seeds, image_size=recipe.image_size, progress=progress)
            rows += [row | {"told": told} for row in found]
    return success_table(pd.DataFrame(rows), ["task", "told"]).to_dict("records")


class _Misled(PolicyActor):
    """Hears the instruction with the other cube's colour in it."""

    def reset(self, env: So100Env, seed: int) -> None:
        super().reset(env, seed)
        asked, other = (cube.color for cube in env.layout.cubes)
        self._instruction = self._instruction.replace(asked, other)


def _seeds_with_two_cubes(task: str, count: int) -> list[int]:
    with closing(So100Env(task, cameras=(), render_mode=None)) as env:
        found = (seed for seed in rollout_seeds(20 * count) if _num_cubes(env, seed) == 2)
        return list(islice(found, count))


def _num_cubes(env: So100Env, seed: int) -> int:
    env.reset(seed=seed)
    return len(env.layout.cubes)


def _work_folder(recipe: Recipe) -> Path:
    """Where recording and checkpoints of this recipe, trained by this code, are kept until it is done."""
    key = json.dumps(asdict(recipe), sort_keys=True) + code_digest(pretrain)
    return cache_dir() / f"pretraining-{hashlib.sha256(key.encode()).hexdigest()[:12]}"


def read_account(base: Path | None = None) -> dict[str, Any]:
    """Return what was written about a base when it was made; default the one that comes with the package.

    Raises:
        ValueError: the folder holds no such account.
    """
    path = (base or nano.nano_base()) / CARD_FILE
    if not path.is_file():
        raise ValueError(f"{base} holds no {CARD_FILE}: it was not made by fedvla pretrain")
    return json.loads(path.read_text())
