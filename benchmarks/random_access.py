"""Random access to training frames: the decoded store against LeRobot's data set, which decodes video.

python benchmarks/random_access.py
"""

import numpy as np
from lerobot.datasets import LeRobotDataset

from fedvla_lib.data import batches
from fedvla_lib.data.episode_writer import REPO_ID
from fedvla_lib.robot.spec import ACTION_KEY, FPS
from report import laptop, median_seconds, options, recording, report, start


def main() -> None:
    """Measure and report."""
    parser = options(__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=64, help="frames read per measurement, in random order")
    chosen = parser.parse_args()
    config = laptop(chosen.profile)
    store = recording(config)
    chunk = [step / FPS for step in range(config.chunk_size)]
    dataset = LeRobotDataset(REPO_ID, root=store.root, delta_timestamps={ACTION_KEY: chunk}, video_backend="pyav")
    rows = np.random.default_rng(0).permutation(store.num_frames)[: chosen.frames]
    ours_s = median_seconds(lambda: batches.batch_of_rows(store, rows, config.chunk_size), chosen.repeats) / len(rows)
    theirs_s = median_seconds(lambda: [dataset[int(row)] for row in rows], chosen.repeats) / len(rows)
    result = {"ours [ms/frame]": 1e3 * ours_s, "lerobot [ms/frame]": 1e3 * theirs_s, "ratio": theirs_s / ours_s}
    report("random_access", [result | {"frames": len(rows), "repeats": chosen.repeats}], chosen.out)


if __name__ == "__main__":
    start(main)
