"""Time of a training step compared with the floor set by this machine's arithmetic.

The floor is the floating-point operations of a step's matrix products divided by the rate at which one core multiplies
matrices that fit into its cache.

    python benchmarks/floor.py
"""

import torch
from torch.utils.flop_counter import FlopCounterMode

from fedvla_lib.data import normalisation
from fedvla_lib.data.batches import Batches
from fedvla_lib.policy import model, prefix_cache
from fedvla_lib.policy.training import flow_loss, local_train
from report import laptop, median_seconds, options, recording, report, start

STEPS = 10  # gradient steps per measurement
SIDE = 512  # of the matrices that measure the machine's rate: they fit into a core's cache


def main() -> None:
    """Measure and report."""
    chosen = options(__doc__.splitlines()[0]).parse_args()
    config = laptop(chosen.profile)
    torch.set_num_threads(1)
    store = recording(config)
    episodes = list(store.episodes.episode_id)
    batches = Batches(store, episodes, config.chunk_size, config.batch_size, seed=1)
    bundle = model.load_policy(config, normalisation.episode_stats(store, episodes))
    cached = prefix_cache.with_cached_prefixes(bundle, batches)
    rate = operations_per_second(chosen.repeats)
    rows = []
    for name, supply in {"stored prefix": cached, "whole model, frozen prefix": batches}.items():
        with FlopCounterMode(display=False) as counter:
            flow_loss(bundle, supply.at(0)).backward()
        step_s = (
            median_seconds(
                lambda supply=supply: local_train(bundle, supply, config, steps=STEPS, progress=False), chosen.repeats
            )
            / STEPS
        )
        floor_s = counter.get_total_flops() / rate
        rows.append(
            {
                "step": name,
                "operations [G]": counter.get_total_flops() / 1e9,
                "machine [G/s]": rate / 1e9,
                "floor [ms]": 1000 * floor_s,
                "measured [ms]": 1000 * step_s,
                "times the floor": step_s / floor_s,
            }
        )
    report("floor", rows, chosen.out)


def operations_per_second(repeats: int) -> float:
    """Return the rate of float32 matrix multiplication on one core, counting two operations per multiply-add."""
    left, right = torch.randn(SIDE, SIDE), torch.randn(SIDE, SIDE)
    count = 20

    def multiply() -> None:
        for _ in range(count):
            left @ right

    return count * 2 * SIDE**3 / median_seconds(multiply, repeats)


if __name__ == "__main__":
    start(main)
