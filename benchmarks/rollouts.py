"""Closed-loop rollouts per minute: this library against lerobot-eval, same policy, same environment, same seeds.

Both sides run 16 environments at a time, record the first ten rollouts on video (fixed in lerobot-eval) and draw the
same noise: the policy's k-th chunk in a scene uses the k-th draw of one generator, whatever the scene's seed, so the
same rollouts should succeed. lerobot-eval is measured twice: on one core like this library, with all environments in
its own process, and with its defaults, one process per environment on all cores.

lerobot-eval's clock starts when its policy is loaded and its environments' processes run. So this library is timed
twice: as a call finds it, and once more, when the policy and a process to fork workers from are there.

    python benchmarks/rollouts.py --policy outputs/DATE_TIME/global_model/round_8
"""

import json
import os
import subprocess
import sys
import tempfile
from argparse import Namespace
from pathlib import Path
from typing import Any

import torch

from fedvla_lib.config import Config, granted_cores
from fedvla_lib.evaluation import rollouts
from fedvla_lib.evaluation.rollouts import FIRST_SEED
from fedvla_lib.policy import model
from fedvla_lib.policy.actor import PolicyActor
from fedvla_lib.policy.portable import export
from report import laptop, options, report, start, timed

VIDEOS = 10  # fixed in lerobot-eval
AS_LEROBOT = "as-lerobot-eval"  # first argument with which this script calls itself to run lerobot-eval


def main() -> None:
    """Measure and report."""
    parser = options(__doc__.splitlines()[0])
    parser.add_argument("--policy", type=Path, required=True, help="a saved policy")
    parser.add_argument("--task", default="lift", help="the task")
    parser.add_argument("--rollouts", type=int, default=288, help="rollouts on each side")
    parser.add_argument(
        "--batch", type=int, default=rollouts.AT_ONCE, help="environments that lerobot-eval runs at once"
    )
    parser.add_argument("--python", default=sys.executable, help="what runs a measurement in a process of its own")
    chosen = parser.parse_args()
    config = laptop(chosen.profile, base=str(chosen.policy))
    torch.set_num_threads(1)
    report("rollouts", [compared(chosen, config, jobs) for jobs in sorted({1, granted_cores()})], chosen.out)


def compared(chosen: Namespace, config: Config, jobs: int) -> dict[str, Any]:
    """Measure both sides on `jobs` cores; on several, lerobot-eval has a process for each environment."""
    rows: list[dict] = []
    own_processes, seeds = jobs > 1, rollouts.rollout_seeds(chosen.rollouts)
    all_cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, all_cores if own_processes else {min(all_cores)})
    whole_s = timed(lambda: ours(SameNoise(model.load_policy(config)), config, chosen.task, seeds, jobs))
    actor = SameNoise(model.load_policy(config))
    ours_s = timed(lambda: rows.extend(ours(actor, config, chosen.task, seeds, jobs)))
    os.sched_setaffinity(0, all_cores)
    with tempfile.TemporaryDirectory() as folder:
        theirs_s, successes = lerobot_eval(chosen, config, Path(folder), own_processes)
    return {
        "lerobot-eval's environments": "a process each" if own_processes else "in its own process",
        "cores": jobs,
        "task": chosen.task,
        "rollouts": chosen.rollouts,
        "ours [1/min]": 60 * chosen.rollouts / ours_s,
        "lerobot-eval [1/min]": 60 * chosen.rollouts / theirs_s,
        "ratio": theirs_s / ours_s,
        "with our start [1/min]": 60 * chosen.rollouts / whole_s,
        "ratio with it": theirs_s / whole_s,
        "our successes": sum(row["success"] for row in rows),
        "lerobot's": sum(successes),
        "seeds that agree": sum(row["success"] == won for row, won in zip(rows, successes, strict=True)),
    }


class SameNoise(PolicyActor):
    """A policy that draws the same noise in every rollout."""

    def reset(self, env: Any, seed: int) -> None:
        super().reset(env, FIRST_SEED)


def ours(actor: SameNoise, config: Config, task: str, seeds: list[int], jobs: int) -> list[dict]:
    """Run the rollouts, as `fedvla evaluate` does, as many on video as lerobot-eval's."""
    settings = {"image_size": config.image_size, "progress": False, "jobs": jobs}
    with tempfile.TemporaryDirectory() as videos:
        rows = rollouts.evaluate(actor, [task], seeds[:VIDEOS], videos_dir=Path(videos), **settings)
    return rows + rollouts.evaluate(actor, [task], seeds[VIDEOS:], **settings)


def lerobot_eval(chosen: Namespace, config: Config, folder: Path, own_processes: bool) -> tuple[float, list[bool]]:
    """Run LeRobot's command; return the seconds that it reports, and the success of each rollout."""
    command = [
        chosen.python, __file__, AS_LEROBOT, f"--policy.path={export(chosen.policy, str(folder / 'policy'))}",
        "--policy.device=cpu", "--env.type=so100_sim", f"--env.task={chosen.task}",
        f"--env.image_size={config.image_size}",
        f"--eval.n_episodes={chosen.rollouts}", f"--eval.batch_size={chosen.batch}", f"--seed={FIRST_SEED}",
        f"--eval.use_async_envs={str(own_processes).lower()}", f"--output_dir={folder / 'out'}",
    ]  # fmt: skip
    settings = {**os.environ, "HF_HUB_OFFLINE": "1", "OMP_NUM_THREADS": "1"}
    first = min(os.sched_getaffinity(0))
    pinned = None if own_processes else lambda: os.sched_setaffinity(0, {first})
    subprocess.run(command, check=True, capture_output=True, env=settings, preexec_fn=pinned)
    results = json.loads((folder / "out" / "eval_info.json").read_text())
    return results["overall"]["eval_s"], list(results["per_task"][0]["metrics"]["successes"])


def as_lerobot_eval() -> None:
    """Run LeRobot's command with its policy patched to draw the noise of `SameNoise`."""
    from lerobot.policies.smolvla import SmolVLAPolicy
    from lerobot.policies.smolvla.modeling_smolvla import VLAFlowMatching
    from lerobot.scripts.lerobot_eval import main as evaluate_policy

    original_reset, source = SmolVLAPolicy.reset, SameNoise(bundle=None)

    def reset(policy: SmolVLAPolicy) -> None:
        original_reset(policy)
        source.reset(Namespace(instruction=""), FIRST_SEED)

    def sample_noise(_: VLAFlowMatching, shape: tuple[int, ...], device: torch.device) -> torch.Tensor:
        return torch.randn((1, *shape[1:]), generator=source._generator).expand(shape).to(device)

    SmolVLAPolicy.reset, VLAFlowMatching.sample_noise = reset, sample_noise
    evaluate_policy()


if __name__ == "__main__":
    if sys.argv[1:2] == [AS_LEROBOT]:
        del sys.argv[1]
        as_lerobot_eval()
    else:
        start(main)
