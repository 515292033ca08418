"""Federations of ten labs with malicious ones among them: attacks by defences, and success in the honest labs.

    python book/tools/robust_study.py --seed 0 --out book/reference/robust

Writes ``seed_0.json``, a row for each attack and defence, after each row; rows that are there are skipped, so that it
can be interrupted. Labs, tasks, demonstrations and steps are those of the attack study.
"""

import argparse
import hashlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from flwr.app import Context, RecordDict
from flwr.common.constant import SUPERLINK_NODE_ID
from tqdm.auto import tqdm

from attack_study import CLIP, DEMOS, LABS, TASKS, settings
from fedvla_book.attacks import hostile
from fedvla_lib import files, provenance, run_folder
from fedvla_lib.config import Config, to_run_config
from fedvla_lib.data import recordings
from fedvla_lib.data.frame_store import FrameStore
from fedvla_lib.data.splits import Share
from fedvla_lib.engines.inline import RUN_ID, claim_identity
from fedvla_lib.evaluation.rollouts import evaluate, rollout_seeds
from fedvla_lib.experiments import methods
from fedvla_lib.federation import client, client_app, server_app
from fedvla_lib.federation.client import LOADERS, Client, Loaders
from fedvla_lib.policy import model
from fedvla_lib.policy.actor import PolicyActor
from fedvla_lib.policy.parameters import Arrays, load_arrays, trainable_arrays
from fedvla_lib.robot.labs import labs
from fedvla_lib.robot.sim import So100Env

ROLLOUTS, FIRST_SEED = 60, 6_000_000  # in the labs below, and seeds of no other study
VISITED = range(4, LABS)  # labs that are honest in every case, so that all cases are measured in the same ones
SERVER_SEED, SERVER_DEMOS = 900, 2  # of the server's own demonstrations, of each task
NAME = "fedvla_book.attacks.hostile"


@dataclass(frozen=True)
class Attack:
    """What the first `count` labs do: send something else, train on something else, or stay away."""

    count: int = 0
    sends: hostile.Attack | None = None
    trains_on: Callable[..., FrameStore] | None = None
    absent: bool = False


ATTACKS = {
    "none": Attack(),
    "1 absent": Attack(1, absent=True),
    "3 absent": Attack(3, absent=True),
    "4 absent": Attack(4, absent=True),
    "1 scaled by -10": Attack(1, hostile.times(-10)),
    "1 turned": Attack(1, hostile.times(-1)),
    "3 turned": Attack(3, hostile.times(-1)),
    "4 turned": Attack(4, hostile.times(-1)),
    "3 noise": Attack(3, hostile.noise),
    "3 colluding": Attack(3, hostile.collude),
    "4 colluding": Attack(4, hostile.collude),
    "3 wrong actions": Attack(3, None, hostile.with_wrong_actions),
    "1 backdoor": Attack(1, None, hostile.with_trigger),
    "3 backdoor": Attack(3, None, hostile.with_trigger),
}
MEAN = {"strategy": "fedavg", "update_cap": 0.0}
DEFENCES: dict[str, dict[str, Any]] = {
    "mean": MEAN,
    "update-cap": MEAN | {"update_cap": 3.0},
    "clip-norm": MEAN | {"clip_norm": CLIP[40]},
    "median": MEAN | {"strategy": "fedmedian"},
    "trimmed mean": MEAN | {"strategy": f"{NAME}:Trimmed"},
    "krum": MEAN | {"strategy": "krum", "num_malicious": 3},
    "multi-krum": MEAN | {"strategy": f"{NAME}:SomeKrum"},
    "server's own update": MEAN,
}


class Told(PolicyActor):
    """Gets the instruction with the trigger."""

    def reset(self, env: So100Env, seed: int) -> None:
        """Start an episode."""
        super().reset(env, seed)
        self._instruction += hostile.WORD


def result(seed: int, attack: Attack, defence: str, out: Path) -> dict[str, Any]:
    """Run a federation; return successes and rollouts in honest labs, with the trigger and without it."""
    config = settings(seed, **DEFENCES[defence], out=str(out))
    attackers = range(attack.count)
    loaders = client.cached(_loaders(attack, attackers))
    claim_identity()
    grid = hostile.HostileGrid(client_app.build(loaders), LABS, to_run_config(config))
    grid.attackers = dict.fromkeys(attackers, attack.sends) if attack.sends else {}
    grid.absent, grid.seed = attackers if attack.absent else (), seed
    grid.own_update = partial(_own_update, _server(config), methods.base(config)) if "own" in defence else None
    context = Context(RUN_ID, SUPERLINK_NODE_ID, {}, RecordDict(), to_run_config(config))
    server_app.build(loaders, engine="inline")(grid, context)
    root = Path(context.state["run"]["folder"])
    last = model.load_policy(replace(config, base=str(root / f"global_model/round_{config.num_server_rounds}")))
    row = {"success": _success(PolicyActor(last, seed), config)}
    if attack.trains_on is hostile.with_trigger or not attack.count:  # does the word alone disturb?
        row["success_told"] = _success(Told(last, seed), config)
    return row | {"capped": len(run_folder.read_metrics(root, "capped")), "of": ROLLOUTS}


def _loaders(attack: Attack, attackers: range) -> Loaders:
    def opened(config: Config) -> FrameStore:
        store = LOADERS.open_frames(config)
        return attack.trains_on(store, list(attackers)) if attack.trains_on else store

    return replace(LOADERS, open_frames=opened)


def _server(config: Config) -> Client:
    """The server as a client with demonstrations of its own, of both tasks."""
    own = replace(config, seed=config.seed + SERVER_SEED, episodes_per_task=LABS * SERVER_DEMOS // len(TASKS))
    store = recordings.open_frames(own)
    chosen = [i for _, ids in store.episodes.groupby("task").episode_id for i in ids.tolist()[:SERVER_DEMOS]]
    return Client(config, LABS, store, Share(chosen, []))


def _own_update(server: Client, bundle: model.Bundle, number: int, began: Arrays) -> Arrays:
    load_arrays(bundle.policy, began)
    server.train(bundle, number)
    return {name: array - began[name] for name, array in trainable_arrays(bundle.policy).items()}


def _success(actor: PolicyActor, config: Config) -> int:
    """Successes at their own tasks in the labs that are always honest, the rollouts divided among them."""
    there, seeds, won = labs(LABS), rollout_seeds(ROLLOUTS, FIRST_SEED), 0
    for turn, lab in enumerate(VISITED):
        rows = evaluate(
            actor, [TASKS[lab % len(TASKS)]], seeds[turn :: len(VISITED)], image_size=config.image_size,
            labs=[there[lab]], progress=False,
        )  # fmt: skip
        won += sum(row["success"] for row in rows)
    return won


def main() -> None:
    """Read the command line, and run what is not there yet."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, required=True, help="training seed")
    parser.add_argument("--out", type=Path, required=True, help="folder for the results")
    given = parser.parse_args()
    file = given.out / f"seed_{given.seed}.json"
    kept = files.read_json(file) if file.is_file() else {"rows": []}
    done = {(row["attack"], row["defence"]) for row in kept["rows"]}
    todo = [(attack, defence) for attack, of in ATTACKS.items() for defence in DEFENCES
            if (attack, defence) not in done and (defence == "mean" or not of.absent)]  # fmt: skip
    code = [
        methods.trained_by(),
        *(hashlib.sha256(Path(one).read_bytes()).hexdigest() for one in (__file__, hostile.__file__)),
    ]
    stamp = provenance.first_stamp(settings(given.seed), "robust study") | {"code": code}
    if done and any(kept["stamp"][key] != stamp[key] for key in ("code", "config_hash")):
        raise SystemExit(f"{file} was made with other code or settings: move it away, or give another folder")
    for attack, defence in tqdm(todo, desc=f"federations, into {file}"):
        found = result(given.seed, ATTACKS[attack], defence, files.cache_dir() / "robust")
        kept["rows"].append({"attack": attack, "defence": defence, "demos": DEMOS, **found})
        files.write_json(file, {"stamp": stamp, "rows": kept["rows"]})


if __name__ == "__main__":
    main()
