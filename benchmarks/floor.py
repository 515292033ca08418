"""Time of a training step compared with the floor set by this machine's arithmetic.

The floor is the floating-point operations of a step's matrix products divided by the rate at which one core multiplies
matrices that fit into its cache. With --compile a row shows what a compiler makes of LeRobot's pass over the action
expert; it needs a C++ compiler, and compiles before the first step.

    python benchmarks/floor.py --compile
"""

import shutil

import torch
from torch.utils.flop_counter import FlopCounterMode

from fedvla_lib.config import Config
from fedvla_lib.data import normalisation
from fedvla_lib.data.batches import Batches
from fedvla_lib.policy import model, prefix_cache
from fedvla_lib.policy.model import Bundle
from fedvla_lib.policy.training import flow_loss, local_train
from report import laptop, median_seconds, options, recording, report, start

STEPS = 10  # gradient steps per measurement
SIDE = 512  # of the matrices that measure the machine's rate: they fit into a core's cache


class LeRobots(Bundle):
    """A policy whose action expert is computed by LeRobot's own pass."""

    is_lean = False


def main() -> None:
    """Measure and report."""
    parser = options(__doc__.splitlines()[0])
    parser.add_argument("--compile", action="store_true", help="also LeRobot's pass, compiled")
    chosen = parser.parse_args()
    if chosen.compile and not shutil.which("c++"):
        raise ValueError("--compile needs a C++ compiler: no c++ on the PATH")
    config = laptop(chosen.profile)
    torch.set_num_threads(1)
    store = recording(config)
    episodes = list(store.episodes.episode_id)
    batches = Batches(store, episodes, config.chunk_size, config.batch_size, seed=1)
    bundle = model.load_policy(config, normalisation.episode_stats(store, episodes))
    cached = prefix_cache.with_cached_prefixes(bundle, batches)
    theirs = LeRobots(bundle.policy, bundle.preprocess, bundle.postprocess)
    sides = {
        "stored prefix": (bundle, cached),
        "stored prefix, LeRobot's pass": (theirs, cached),
        "whole model, frozen prefix": (bundle, batches),
    }
    rate = operations_per_second(chosen.repeats)
    rows = [
        row(name, operations(*side), step_seconds(*side, config, chosen.repeats), rate) for name, side in sides.items()
    ]
    if chosen.compile:
        count = operations(theirs, cached)  # not counted in what is compiled
        bundle.policy.model.denoise_step = torch.compile(bundle.policy.model.denoise_step, dynamic=False)
        step_s = step_seconds(theirs, cached, config, chosen.repeats)
        rows.append(row("stored prefix, LeRobot's pass compiled", count, step_s, rate))
    report("floor", rows, chosen.out)


def operations(bundle: Bundle, supply: Batches) -> int:
    """Count the floating-point operations of a step's matrix products."""
    with FlopCounterMode(display=False) as counter:
        flow_loss(bundle, supply.at(0)).backward()
    return counter.get_total_flops()


def step_seconds(bundle: Bundle, supply: Batches, config: Config, repeats: int) -> float:
    """Measure a training step."""
    return median_seconds(lambda: local_train(bundle, supply, config, steps=STEPS, progress=False), repeats) / STEPS


def row(name: str, count: int, step_s: float, rate: float) -> dict[str, object]:
    """Return a row of the report."""
    return {
        "step": name, "operations [G]": count / 1e9, "machine [G/s]": rate / 1e9,
        "floor [ms]": 1000 * count / rate, "measured [ms]": 1000 * step_s, "times the floor": step_s * rate / count,
    }  # fmt: skip


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
