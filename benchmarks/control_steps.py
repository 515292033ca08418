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
    no_images_s = seconds_per_step(So100Env("lift", config.image_size, cameras=(), render_mode=None), chosen)
    meshes.VISUAL_FACES = 10**9  # above any mesh: disables decimation
    undecimated = So100Env("lift", config.image_size)
    undecimated_s = seconds_per_step(undecimated, chosen)
    row = {
        "cameras": len(undecimated.cameras),
        "pixels": config.image_size,
        "decimated [steps/s]": 1 / ours_s,
        "undecimated [steps/s]": 1 / undecimated_s,
        "ratio": undecimated_s / ours_s,
        "no images [steps/s]": 1 / no_images_s,
    }
    report("control_steps", [row], chosen.out)


def seconds_per_step(env: So100Env, chosen: object) -> float:
    """Return the seconds of one control step with the environment's cameras."""

    def episode() -> None:
        env.reset(seed=0)
        for _ in range(chosen.steps):
            env.step(HOME)

    return median_seconds(episode, chosen.repeats) / chosen.steps


if __name__ == "__main__":
    start(main)
