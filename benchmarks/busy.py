"""A chapter's training cell alone, and beside other programs that keep cores busy: one thread against one per core.

python benchmarks/busy.py
"""

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from fedvla_lib.config import granted_cores
from fedvla_lib.data import normalisation
from fedvla_lib.data.batches import Batches
from fedvla_lib.policy import model, prefix_cache
from fedvla_lib.policy.training import local_train
from report import laptop, median_seconds, options, recording, report, start


def main() -> None:
    """Measure and report."""
    parser = options(__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=40, help="gradient steps of the cell")
    chosen = parser.parse_args()
    store = recording(laptop(chosen.profile))
    episodes = list(store.episodes.episode_id)
    rows = []
    for threads in sorted({1, granted_cores()}):
        config = laptop(chosen.profile, num_threads=threads)
        bundle = model.load_policy(config, normalisation.episode_stats(store, episodes))
        batches = Batches(store, episodes, config.chunk_size, config.batch_size, seed=1)
        supply = prefix_cache.with_cached_prefixes(bundle, batches)

        def cell(bundle=bundle, supply=supply, config=config) -> None:
            local_train(bundle, supply, config, steps=chosen.steps, progress=False)

        alone_s = median_seconds(cell, chosen.repeats)
        for programs in sorted({1, granted_cores()}):
            with spinning(programs):
                beside_s = median_seconds(cell, chosen.repeats)
            rows.append({
                "threads": threads, "cores": granted_cores(), "busy programs": programs,
                "alone [ms a step]": 1000 * alone_s / chosen.steps,
                "beside them [ms a step]": 1000 * beside_s / chosen.steps,
                "ratio": beside_s / alone_s,
            })  # fmt: skip
    report("busy", rows, chosen.out)


@contextmanager
def spinning(count: int) -> Iterator[None]:
    """Keep `count` processes computing meanwhile."""
    programs = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for program in programs:
            program.kill()
            program.wait()


if __name__ == "__main__":
    start(main)
