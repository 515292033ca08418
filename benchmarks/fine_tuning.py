"""Fine-tuning the nano base: success at tasks it never saw, after about a minute of training on one core.

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
    parser.add_argument("--tasks", default="lift,place,push", help="tasks, each trained separately from the base")
    parser.add_argument("--demonstrations", type=int, default=50, help="episodes per task")
    parser.add_argument("--steps", type=int, default=1200, help="gradient steps")
    parser.add_argument("--rollouts", type=int, default=100, help="rollouts per task")
    chosen = parser.parse_args()
    config = laptop(chosen.profile, tasks=chosen.tasks, episodes_per_task=chosen.demonstrations)
    torch.set_num_threads(1)
    store = recording(config)
    rows = [learn(task, store, config, chosen.steps, chosen.rollouts) for task in task_names(config)]
    report("fine_tuning", rows, chosen.out)


def learn(task: str, store: FrameStore, config: Config, steps: int, rollouts: int) -> dict[str, object]:
    """Fine-tune the base on one task's demonstrations and return its success rate."""
    episodes = sorted(store.episodes.episode_id[store.episodes.task == task])
    bundle = model.load_policy(config, normalisation.episode_stats(store, episodes))
    batches = Batches(store, episodes, config.chunk_size, config.batch_size, seed=config.seed)
    result = local_train(
        bundle, prefix_cache.with_cached_prefixes(bundle, batches), config, steps=steps, progress=False
    )
    actor = PolicyActor(bundle, config.seed)
    rows = evaluate(actor, [task], rollout_seeds(rollouts), image_size=config.image_size, progress=False)
    successes = sum(row["success"] for row in rows)
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
