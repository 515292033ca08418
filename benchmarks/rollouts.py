"""Closed-loop rollouts per minute: this library against lerobot-eval, same policy, same environment, same seeds.

    python benchmarks/rollouts.py --policy outputs/DATE_TIME/global_model/round_8
"""

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from report import laptop, options, report, start, timed

from fedvla_lib import evaluate, model
from fedvla_lib.config import Config
from fedvla_lib.evaluate import FIRST_SEED


def main() -> None:
    """Measure and report."""
    parser = options(__doc__.splitlines()[0])
    parser.add_argument("--policy", type=Path, required=True, help="a saved policy")
    parser.add_argument("--task", default="lift", help="the task")
    parser.add_argument("--rollouts", type=int, default=32, help="attempts of each side")
    parser.add_argument("--batch", type=int, default=8, help="environments that lerobot-eval runs at once")
    chosen = parser.parse_args()
    config = laptop(chosen.profile, base=str(chosen.policy))
    seeds = evaluate.rollout_seeds(chosen.rollouts)
    rows: list[dict] = []
    ours_s = timed(lambda: rows.extend(ours(config, chosen.task, seeds)))
    with tempfile.TemporaryDirectory() as folder:
        theirs_s, successes = lerobot_eval(chosen, config, Path(folder))
    agree = sum(row["success"] == success for row, success in zip(rows, successes, strict=True))
    row = {
        "task": chosen.task,
        "rollouts": chosen.rollouts,
        "ours [1/min]": 60 * chosen.rollouts / ours_s,
        "lerobot-eval [1/min]": 60 * chosen.rollouts / theirs_s,
        "ratio": theirs_s / ours_s,
        "our successes": sum(row["success"] for row in rows),
        "lerobot's": sum(successes),
        "seeds that agree": agree,
    }
    report("rollouts", [row], chosen.out)


def ours(config: Config, task: str, seeds: list[int]) -> list[dict]:
    """Load the policy and roll out, as the command line does."""
    actor = model.PolicyActor(model.load_policy(config))
    return evaluate.evaluate(actor, [task], seeds, image_size=config.image_size, progress=False)


def lerobot_eval(chosen: object, config: Config, folder: Path) -> tuple[float, list[bool]]:
    """Run LeRobot's command; return the seconds it reports for its episodes, and whether each succeeded."""
    command = [
        sys.executable, "-m", "lerobot.scripts.lerobot_eval", f"--policy.path={chosen.policy}",
        "--policy.device=cpu", "--env.type=so100_sim", f"--env.task={chosen.task}",
        f"--env.image_size={config.image_size}", "--env.discover_packages_path=fedvla_lib.lerobot_env",
        f"--eval.n_episodes={chosen.rollouts}", f"--eval.batch_size={chosen.batch}", f"--seed={FIRST_SEED}",
        f"--output_dir={folder / 'out'}",
    ]  # fmt: skip
    settings = {**os.environ, "HF_HUB_OFFLINE": "1", "OMP_NUM_THREADS": "1"}
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=settings)
    found = json.loads((folder / "out" / "eval_info.json").read_text())
    one = found["per_task"][0]["metrics"]
    return found["overall"]["eval_s"], list(one["successes"])


if __name__ == "__main__":
    start(main)
