"""Draw an episode again for people to watch: larger and smoother than the policy saw it."""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing
from itertools import pairwise, zip_longest
from typing import Any

import numpy as np

from fedvla_lib.evaluation.video import encode_video
from fedvla_lib.robot.labs import REFERENCE, Lab
from fedvla_lib.robot.rendering import pose_between
from fedvla_lib.robot.sim import So100Env
from fedvla_lib.robot.spec import CAMERAS, FPS

SIDE = 480  # pixels
PER_STEP = 2  # images of a control step
REDRAWN_FPS = PER_STEP * FPS
CRF = 28  # loss of the video: half a minute of two cameras stays below `video_player.MAX_BYTES`


def redraw(
    task: str, seed: int, actions: np.ndarray, *, lab: Lab = REFERENCE, cameras: Sequence[str] = CAMERAS,
    side: int = SIDE,
) -> Iterator[np.ndarray]:  # fmt: skip
    """Yield the images of an episode, uint8 (side, side * cameras, 3), `REDRAWN_FPS` a second.

    The recorded joint targets, `actions` (T, 6), drive the simulator again, which takes the same poses as before, since
    seed and lab fix where it starts. Between two control steps poses are interpolated.
    """
    with closing(So100Env(task, side, cameras=(), lab=lab)) as env:
        env.reset(seed=int(seed))  # a row of a table has numbers of NumPy
        poses = [env.data.qpos.copy()]
        for action in actions:
            env.step(action)
            poses.append(env.data.qpos.copy())
        for before, after in pairwise(poses):
            for part in range(PER_STEP):
                pose_between(env.model, env.data, before, after, part / PER_STEP)
                yield np.hstack(list(env.camera_images(cameras).values()))


def redrawn_video(task: str, seed: int, actions: np.ndarray, **view: Any) -> bytes:
    """Return the images of `redraw` as an mp4."""
    return encode_video(redraw(task, seed, actions, **view), REDRAWN_FPS, CRF)


def tiled(episodes: Sequence[Iterable[np.ndarray]], columns: int) -> Iterator[np.ndarray]:
    """Yield the images of several episodes in one, row by row; an episode that ends earlier holds its last image."""
    shown: list[np.ndarray] = []
    for images in zip_longest(*episodes):
        shown = [last if image is None else image for image, last in zip(images, shown or images, strict=True)]
        yield np.vstack([np.hstack(shown[k : k + columns]) for k in range(0, len(shown), columns)])
