"""Rendered control steps per second: this library's environment against the same arm as its package ships it.

There the meshes keep all their faces, and MuJoCo's own renderer draws every image whole. A third environment has those
meshes and draws like ours, which separates the two causes.

    python benchmarks/control_steps.py
"""

from collections.abc import Sequence

import mujoco
import numpy as np

from fedvla_lib.robot import meshes
from fedvla_lib.robot.sim import HOME, So100Env
from fedvla_lib.robot.spec import CAMERAS
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
    shipped = ShippedEnv("lift", config.image_size)
    shipped_s = seconds_per_step(shipped, chosen)
    undecimated_s = seconds_per_step(So100Env("lift", config.image_size), chosen)
    row = {
        "cameras": len(shipped.cameras),
        "pixels": config.image_size,
        "ours [steps/s]": 1 / ours_s,
        "as shipped [steps/s]": 1 / shipped_s,
        "ratio": shipped_s / ours_s,
        "all faces, drawn like ours [steps/s]": 1 / undecimated_s,
        "no images [steps/s]": 1 / no_images_s,
    }
    report("control_steps", [row], chosen.out)


class ShippedEnv(So100Env):
    """The environment with MuJoCo's own renderer, which draws every image whole."""

    def camera_images(self, cameras: Sequence[str] = CAMERAS) -> dict[str, np.ndarray]:
        if self._renderer is None:
            self._renderer = mujoco.Renderer(self.model, self.image_size, self.image_size)
        return {camera: self._whole(camera) for camera in cameras}

    def _whole(self, camera: str) -> np.ndarray:
        self._renderer.update_scene(self.data, camera)
        return self._renderer.render()


def seconds_per_step(env: So100Env, chosen: object) -> float:
    """Return the seconds of one control step with the environment's cameras."""

    def episode() -> None:
        env.reset(seed=0)
        for _ in range(chosen.steps):
            env.step(HOME)

    return median_seconds(episode, chosen.repeats) / chosen.steps


if __name__ == "__main__":
    start(main)
