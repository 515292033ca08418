"""What the nano base is worth: success at tasks it never saw, after a minute or so of training on one core.

python benchmarks/fine_tuning.py
"""

import torch

from fedvla_lib.config import Config, task_names
from fedvla_lib.data import normalisation
from fedvla_lib.data.batches import Batches
from fedvla_lib.data.frame_store import FrameStore
from fedvla_lib.evaluation.rollouts import evaluate, rollout_seeds
from fedvla_lib.evaluation.statistics import wilson
from fedvla_lib.policy import model, prefix_cache
from fedvla_lib.policy.actor import PolicyActor
from fedvla_lib.policy.training import local_train
from report import laptop, options, recording, report, start


def main() -> None:
    """Measure and report."""
    parser = options(__doc__.splitlines()[0])
    parser.add_argument("--tasks", default="lift,place,push", help="tasks, each learned alone, from the base")
    parser.add_argument("--demonstrations", type=int, default=50, help="episodes of each task")
    parser.add_argument("--steps", type=int, default=1200, help="optimiser steps")
    parser.add_argument("--rollouts", type=int, default=100, help="attempts at each task")
    chosen = parser.parse_args()
    config = laptop(chosen.profile, tasks=chosen.tasks, episodes_per_task=chosen.demonstrations)
    torch.set_num_threads(1)
    store = recording(config)
    rows = [learn(task, store, config, chosen.steps, chosen.rollouts) for task in task_names(config)]
    report("fine_tuning", rows, chosen.out)


def learn(task: str, store: FrameStore, config: Config, steps: int, rollouts: int) -> dict[str, object]:
    """Train the base on the demonstrations of one task and let it act."""
    episodes = sorted(store.episodes.episode_id[store.episodes.task == task])
    bundle = model.load_policy(config, normalisation.episode_stats(store, episodes))
    batches = Batches(store, episodes, config.chunk_size, config.batch_size, seed=config.seed)
    result = local_train(
        bundle, prefix_cache.with_cached_prefixes(bundle, batches), config, steps=steps, progress=False
    )
    actor = PolicyActor(bundle, config.seed)
    attempts = evaluate(actor, [task], rollout_seeds(rollouts), image_size=config.image_size, progress=False)
    successes = sum(attempt["success"] for attempt in attempts)
    low, high = wilson(successes, rollouts)
    return {
        "task": task,
        "demonstrations": len(episodes),
        "steps": steps,
        "training [s]": result.seconds,
        "rollouts": rollouts,
        "successes": successes,
        "low [%]": 100 * low,
        "high [%]": 100 * high,
    }


if __name__ == "__main__":
    start(main)
