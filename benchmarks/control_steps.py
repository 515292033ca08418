"""Rendered control steps per second: decimated meshes against the package's own.

    python benchmarks/control_steps.py
"""

from fedvla_lib.robot import meshes
from fedvla_lib.robot.sim import HOME, So100Env
from report import laptop, median_seconds, options, report, start


def main() -> None:
    """Measure and report."""
    parser = options(__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=40, help="control steps of each measurement")
    chosen = parser.parse_args()
    config = laptop(chosen.profile)
    ours_s = seconds_per_step(So100Env("lift", config.image_size), chosen)
    blind_s = seconds_per_step(So100Env("lift", config.image_size, cameras=(), render_mode=None), chosen)
    meshes.VISUAL_FACES = 10**9  # no mesh has more, so all are used as they are
    whole = So100Env("lift", config.image_size)
    whole_s = seconds_per_step(whole, chosen)
    row = {
        "cameras": len(whole.cameras),
        "pixels": config.image_size,
        "decimated [steps/s]": 1 / ours_s,
        "undecimated [steps/s]": 1 / whole_s,
        "ratio": whole_s / ours_s,
        "no picture [steps/s]": 1 / blind_s,
    }
    report("control_steps", [row], chosen.out)


def seconds_per_step(env: So100Env, chosen: object) -> float:
    """Return the time of one control step with both pictures."""

    def episode() -> None:
        env.reset(seed=0)
        for _ in range(chosen.steps):
            env.step(HOME)

    return median_seconds(episode, chosen.repeats) / chosen.steps


if __name__ == "__main__":
    start(main)
