"""Pictures of the table on which nothing happens, and where each thing in them is: what grounding learns from."""

from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from tqdm.auto import tqdm

from fedvla_lib.files import new_folder
from fedvla_lib.robot.layout import COLORS, CUBE_HALF_M
from fedvla_lib.robot.rendering import project
from fedvla_lib.robot.sim import So100Env
from fedvla_lib.robot.spec import CAMERAS
from fedvla_lib.robot.tasks import ANYWHERE, ZONES_ANYWHERE, Task

CUBES = tuple(f"{color} cube" for color in COLORS)
THINGS = (*CUBES, "yellow square", "white circle")  # what a sentence can name
ZONES = tuple(ZONES_ANYWHERE[shape] for shape in ("square", "disc"))  # in the order of the last two
HEIGHT_M = np.array([CUBE_HALF_M] * len(CUBES) + [0.0] * len(ZONES))  # of a thing's centre above the table
# Between these joints the hand is somewhere over the table, in LeRobot units.
POSE_FROM = np.array([-45.0, -60.0, -30.0, 30.0, -45.0, 0.0])
POSE_TO = np.array([45.0, 15.0, 45.0, 95.0, 45.0, 100.0])
AWAY_SHARE = 0.3  # share of scenes in which the arm is drawn back, as at the start of an episode
LOOK = Task(
    "look", wordings=("Look.",), success=lambda scene: False, hold_steps=1, horizon_steps=1,
    cube=ANYWHERE, other=ANYWHERE, other_share=0.7,
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Scenes:
    """N scenes; a thing that is not in a scene has no numbers (NaN)."""

    images: dict[str, np.ndarray]  # camera -> uint8 (N, size, size, 3), memory-mapped, read-only
    places_m: np.ndarray  # float32 (N, things, 2): x and y of a thing's centre in the world frame
    shares: np.ndarray  # float32 (N, cameras, things, 2): where it appears, from left and from top, in picture sides


def draw_scenes(
    folder: Path, count: int, *, image_size: int, seed: int, jitter: float, progress: bool = True
) -> Scenes:
    """Return `count` scenes kept in `folder`, drawn now if they are not there.

    Each has one or two cubes of different colours, none, one or both of the zones, the arm in some pose, and a camera
    pose, light and paint of its own, `jitter` wide.
    """
    if not folder.is_dir():
        with new_folder(folder) as draft:
            _draw(draft, count, image_size, np.random.default_rng(seed), jitter, progress)
    images = {camera: np.load(folder / f"{camera}.npy", mmap_mode="r") for camera in CAMERAS}
    return Scenes(images, np.load(folder / "places_m.npy"), np.load(folder / "shares.npy"))


def _draw(folder: Path, count: int, size: int, rng: np.random.Generator, jitter: float, progress: bool) -> None:
    shape = (count, size, size, 3)
    images = {
        camera: np.lib.format.open_memmap(folder / f"{camera}.npy", mode="w+", dtype=np.uint8, shape=shape)
        for camera in CAMERAS
    }
    places_m = np.full((count, len(THINGS), 2), np.nan, np.float32)
    shares = np.full((count, len(CAMERAS), len(THINGS), 2), np.nan, np.float32)
    with ExitStack() as stack:
        choices = [(), ZONES[:1], ZONES[1:], ZONES]
        envs = [stack.enter_context(closing(So100Env(replace(LOOK, zones=z), size, jitter=jitter))) for z in choices]
        for row in tqdm(range(count), desc="scenes", disable=not progress):
            env = envs[rng.integers(len(envs))]
            options = {} if rng.random() < AWAY_SHARE else {"joints": rng.uniform(POSE_FROM, POSE_TO)}
            seen, _ = env.reset(seed=int(rng.integers(2**31)), options=options)
            for camera in CAMERAS:
                images[camera][row] = seen["pixels"][camera]
            places_m[row] = _places(env)
            for index, camera in enumerate(CAMERAS):
                points_m = np.column_stack([places_m[row], HEIGHT_M])
                shares[row, index] = project(env.model, env.data, camera, points_m)
    for image in images.values():
        image.flush()
    np.save(folder / "places_m.npy", places_m)
    np.save(folder / "shares.npy", shares)


def _places(env: So100Env) -> np.ndarray:
    """Where each thing lies on the table, (things, 2)."""
    places_m = np.full((len(THINGS), 2), np.nan)
    for cube in env.layout.cubes:
        places_m[THINGS.index(f"{cube.color} cube")] = cube.xy_m
    for zone, xy_m in zip(env.zones, env.layout.zones_xy_m, strict=True):
        places_m[len(CUBES) + ZONES.index(zone)] = xy_m
    return places_m
