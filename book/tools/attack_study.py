"""Attack the ten labs of one training seed, without protection and with it, and write what was found.

    python book/tools/attack_study.py --seed 0 --out book/reference/attacks

Writes ``seed_0_PART.json`` for each part, a stamp and one row for each measurement; parts that are there are skipped,
so that it can be interrupted. Labs with one task each, 8 demonstrations, as in
ten_labs.toml; the attacker's own clients are in the same kinds of lab, with other demonstrations.
"""

import argparse
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm.auto import tqdm

from fedvla_book.attacks import membership, reconstruction, traits
from fedvla_lib import files, provenance
from fedvla_lib.config import Config, from_profile
from fedvla_lib.data import recordings
from fedvla_lib.data.batches import batch_of_rows
from fedvla_lib.data.frame_store import FrameStore
from fedvla_lib.data.splits import Share
from fedvla_lib.experiments import methods
from fedvla_lib.federation import privacy
from fedvla_lib.federation.client import Client
from fedvla_lib.federation.quantisation import decode, encode
from fedvla_lib.federation.strategies.scaffold import ControlVariates
from fedvla_lib.policy import model
from fedvla_lib.policy.model import Bundle
from fedvla_lib.policy.parameters import Arrays, load_arrays, trainable_arrays
from fedvla_lib.robot.spec import CAMERAS, image_key

LABS, TASKS, DEMOS = 10, ("square", "tower"), 8
SHADOW_SEED = 500  # added to a seed for the attacker's recording
STEPS = (1, 5, 40)
CLIP = {1: 0.13, 5: 1.3, 40: 12.0}  # by steps: about the length of an update, so that noise is in units of it
NOISE = (0.0, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0)  # multiplier of what each client adds
SERVER_NOISE = (0.0, 0.003, 0.03)  # the same for noise added once, by the server
ROUNDS = (1, 3, 10)
SEARCHED = 3  # labs whose images are searched for: a search takes a minute
EVERYTHING = {"freeze_vision_encoder": False, "train_expert_only": False, "train_state_proj": True}
Row = dict[str, Any]


def settings(seed: int, **changes: Any) -> Config:
    """Return the settings of the federation that is attacked: `federated` of ten_labs.toml."""
    common = {
        "tasks": ",".join(TASKS), "num_labs": LABS, "one_task_per_lab": True, "val_fraction": 0.0, "num_clients": LABS,
        "partition": "lab", "fraction_train": 1.0, "episodes_per_task": DEMOS * LABS // len(TASKS), "local_steps": 40,
        "batch_size": 16, "num_server_rounds": 10, "lr": 4e-3, "strategy": "fedavgm", "server_momentum": 0.0,
        "server_lr": 1.5, "num_threads": 1, "eval_rollouts": 0, "fraction_evaluate": 0.0, "normalisation": "base",
        "videos": False, "seed": seed,
    }  # fmt: skip
    return from_profile("laptop", **common | changes)


def clients(config: Config, store: FrameStore, count: int) -> dict[tuple[str, int], Client]:
    """Return a client for each task and lab of a recording, with its first `count` demonstrations."""
    groups = store.episodes.groupby(["task", "lab"]).episode_id
    return {
        (task, int(lab)): Client(config, int(lab), store, Share(ids.tolist()[:count], []))
        for (task, lab), ids in groups
    }


def update_of(client: Client, bundle: Bundle, start: Arrays, steps: int, **changes: Any) -> tuple[Arrays, Any]:
    """Return a client's change of the weights after local training from `start`, and its control variates."""
    load_arrays(bundle.policy, start)
    client = replace(client, config=replace(client.config, local_steps=steps, **changes))
    control = ControlVariates({name: np.zeros_like(a) for name, a in start.items()}, {})
    client.train(bundle, 1, control)
    return {name: array - start[name] for name, array in trainable_arrays(bundle.policy).items()}, control.updated()


def protected(update: Arrays, steps: int, noise: float, rng: np.random.Generator) -> Arrays:
    """Return an update as a client sends it that trusts nobody: clipped, with noise; without noise as it is."""
    if not noise:
        return update
    return privacy.noisy(privacy.clipped({"arrays": update}, CLIP[steps]), noise * CLIP[steps], rng)["arrays"]


def what_a_lab_does(seed: int) -> Iterator[Row]:
    """Task and place of each lab, guessed from one update, and from the mean of all updates."""
    config, rng = settings(seed), np.random.default_rng(seed)
    both = {"one_task_per_lab": False, "episodes_per_task": DEMOS * LABS}
    own = replace(config, seed=seed + SHADOW_SEED, **both)
    bundle = methods.base(config)
    start = trainable_arrays(bundle.policy)
    labs = clients(config, recordings.open_frames(config), DEMOS)
    made = clients(own, recordings.open_frames(own), DEMOS)
    for steps in STEPS:
        shadows = {kind: traits.flat(update_of(one, bundle, start, steps)[0]) for kind, one in made.items()}
        updates = {kind: update_of(one, bundle, start, steps)[0] for kind, one in labs.items()}
        for noise in NOISE:
            seen = {kind: traits.flat(protected(update, steps, noise, rng)) for kind, update in updates.items()}
            mean = np.mean(list(seen.values()), axis=0)
            for saw, of in (("one update", seen), ("the mean of ten", dict.fromkeys(seen, mean))):
                for trait, name, position in (("task", TASKS, 0), ("place", range(LABS), 1)):
                    by_label = {str(one): [v for kind, v in shadows.items() if kind[position] == one] for one in name}
                    right = [traits.guess(vector, by_label) == str(kind[position]) for kind, vector in of.items()]
                    yield {"attack": trait, "saw": saw, "steps": steps, "noise": noise, "right": sum(right),
                           "of": len(right)}  # fmt: skip


def who_was_in_it(seed: int, demos: int, noises: tuple[float, ...]) -> Iterator[Row]:
    """Scores of trained and of other demonstrations, for global models with noise added by the server."""
    more = DEMOS * 2 * LABS // len(TASKS)
    for noise in noises:
        private = {"noise": noise, "clip_norm": CLIP[40]} if noise else {}
        config = settings(seed, episodes_per_task=more, **private)
        store = recordings.open_frames(config)
        episodes = store.episodes.groupby("lab").episode_id
        members = [i for _, ids in episodes for i in ids.tolist()[:demos]]
        strangers = [i for _, ids in episodes for i in ids.tolist()[DEMOS : DEMOS + demos]]
        few = settings(seed, episodes_per_task=demos * LABS // len(TASKS), **private)
        other = settings(seed + SHADOW_SEED, episodes_per_task=demos * LABS // len(TASKS))
        reference = membership.losses(methods.federated_policy(other), store, members + strangers, 16, seed)
        run = methods.federated(few, progress=False)
        for number in ROUNDS:
            bundle = model.load_policy(replace(few, base=str(run / f"global_model/round_{number}")))
            scores = reference - membership.losses(bundle, store, members + strangers, 16, seed)
            found = {"members": scores[: len(members)].tolist(), "strangers": scores[len(members) :].tolist()}
            saw = {"attack": "member", "saw": "the global model", "round": number}
            yield saw | {"demos": demos, "noise": noise} | found


def who_was_in_an_update(seed: int, demos: int) -> Iterator[Row]:
    """The same for what a lab sends in the first round."""
    rng = np.random.default_rng([seed, demos])
    config = settings(seed, episodes_per_task=DEMOS * 2 * LABS // len(TASKS))
    store = recordings.open_frames(config)
    bundle, found = methods.base(config), {}
    start = trainable_arrays(bundle.policy)
    for one in clients(config, store, demos).values():
        ids = store.episodes.query("lab == @one.partition_id").episode_id.tolist()
        asked = ids[:demos] + ids[DEMOS : DEMOS + demos]
        update = update_of(one, bundle, start, 40)[0]
        load_arrays(bundle.policy, start)
        reference = membership.losses(bundle, store, asked, 16, seed)
        for noise in NOISE:
            sent = protected(update, 40, noise, rng)
            load_arrays(bundle.policy, {name: start[name] + sent[name] for name in start})
            scores = reference - membership.losses(bundle, store, asked, 16, seed)
            found.setdefault(noise, []).append(np.split(scores, [demos]))
    for noise, pairs in found.items():
        members, strangers = (np.concatenate(scores).tolist() for scores in zip(*pairs, strict=True))
        yield {"attack": "member", "saw": "one update", "round": 1, "demos": demos, "noise": noise,
               "members": members, "strangers": strangers}  # fmt: skip


SEEN = {  # what is exchanged in each case, beside the defaults: batch size, steps, optimiser
    "gradient": (1, 1, "sgd", {}),
    "gradient of 4 frames": (4, 1, "sgd", {}),
    "gradient of 16 frames": (16, 1, "sgd", {}),
    "5 steps of SGD": (1, 5, "sgd", {}),
    "one step of AdamW": (1, 1, "adamw", {}),
    "5 steps of AdamW": (1, 5, "adamw", {}),
    "LoRA, one step of SGD": (1, 1, "sgd", {"lora_rank": 4}),
}


def what_it_saw(seed: int) -> Iterator[Row]:
    """Error of the joint state of the last frame trained on, in degrees, beside the error of a guess without attack."""
    for name, (batch, steps, optimizer, changes) in SEEN.items():
        changed = {"train_state_proj": True, "batch_size": batch, "local_optimizer": optimizer, "warmup_steps": 0}
        config = settings(seed, **changed, **changes)
        bundle = methods.base(config)
        start = trainable_arrays(bundle.policy)
        for one in clients(config, recordings.open_frames(config), DEMOS).values():
            update, control = update_of(one, bundle, start, steps)
            rows = np.concatenate([one.batches().rows_at(step) for step in range(steps)])
            true = one.store.states[rows]
            blind = reconstruction.joints_deg(bundle, np.zeros(6))
            exchanged = {"update": update, "update in 8 bits": decode(encode(update, "int8"), "int8"),
                         "control variate": control}  # fmt: skip
            for what, change in exchanged.items():
                row = {"attack": "state", "saw": what, "case": name, "blind_deg": _nearest(blind, true)}
                try:
                    found = reconstruction.joints_deg(bundle, reconstruction.normalised_state(change))
                except ValueError as error:
                    yield row | {"error_deg": None, "why": str(error)}
                else:
                    yield row | {"error_deg": _nearest(found, true)}


def which_image(seed: int) -> Iterator[Row]:
    """How near a search comes to the images behind one gradient, beside the mean image of the attacker's recording."""
    for trained, changes in (("the expert", {}), ("everything", EVERYTHING)):
        config = settings(seed, **changes)
        bundle = methods.base(config)
        own = recordings.open_frames(settings(seed + SHADOW_SEED))
        for one in list(clients(config, recordings.open_frames(config), DEMOS).values())[:SEARCHED]:
            batch = batch_of_rows(one.store, one.batches().rows_at(0)[:1], config.chunk_size)
            wanted = reconstruction.gradients(bundle, batch, seed, allow_unused=True)
            wanted = [g if g is not None else torch.zeros(1) for g in wanted]
            found, cosine = reconstruction.search_images(bundle, batch, wanted, seed=seed)
            for camera in CAMERAS:
                true, mean = batch[image_key(camera)].numpy(), own.images[camera][::50].mean(axis=0) / 255
                yield {"attack": "image", "saw": "gradient", "trained": trained, "camera": camera, "cosine": cosine,
                       "psnr_db": reconstruction.psnr_db(found[image_key(camera)], true),
                       "blind_db": reconstruction.psnr_db(mean.transpose(2, 0, 1)[None], true)}  # fmt: skip


def _nearest(found: np.ndarray, true: np.ndarray) -> float:
    """Root mean square over the joints, to the frame that it fits best."""
    return float(np.sqrt(np.square(found - true).mean(axis=1)).min())


PARTS: dict[str, Callable[[int], Iterator[Row]]] = {
    "state": what_it_saw,
    "traits": what_a_lab_does,
    "update-2": partial(who_was_in_an_update, demos=2),
    "update-8": partial(who_was_in_an_update, demos=8),
    "image": which_image,
    "model-2": partial(who_was_in_it, demos=2, noises=SERVER_NOISE),
    "model-8": partial(who_was_in_it, demos=8, noises=(0.0,)),
}


def main() -> None:
    """Read the command line, run the parts of the study that are not there yet, and write a file for each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, required=True, help="training seed")
    parser.add_argument("--out", type=Path, required=True, help="folder for the results")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    for name, part in PARTS.items():
        target = given.out / f"seed_{given.seed}_{name}.json"
        if target.exists():
            continue
        stamp = provenance.first_stamp(settings(given.seed), "attack")
        rows = [{"seed": given.seed} | row for row in tqdm(part(given.seed), desc=name)]
        files.write_json(target, stamp | {"status": "completed", "rows": rows})
        print(f"{len(rows)} measurements in {target}")


if __name__ == "__main__":
    main()
