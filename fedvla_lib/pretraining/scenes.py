"""Rendered still scenes of the table with the positions of all objects: the training data of grounding."""

from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.lib.format import open_memmap
from tqdm.auto import tqdm

from fedvla_lib.files import new_folder
from fedvla_lib.robot.layout import COLORS, CUBE_HALF_M, Layout, Patch
from fedvla_lib.robot.rendering import project
from fedvla_lib.robot.sim import So100Env
from fedvla_lib.robot.spec import CAMERAS
from fedvla_lib.robot.tasks import ANYWHERE, ZONES_ANYWHERE, Task

CUBES = tuple(f"{color} cube" for color in COLORS)
OBJECTS = (*CUBES, "yellow square", "white circle")  # objects that a sentence can name
ZONES = tuple(ZONES_ANYWHERE[shape] for shape in ("square", "disc"))  # in the order of the last two OBJECTS
HEIGHT_M = np.array([CUBE_HALF_M] * len(CUBES) + [0.0] * len(ZONES))  # of the objects' centres above the table
# Between these joint positions, in LeRobot units, the gripper is above the table.
POSE_FROM = np.array([-45.0, -60.0, -30.0, 30.0, -45.0, 0.0])
POSE_TO = np.array([45.0, 15.0, 45.0, 95.0, 45.0, 100.0])
AWAY_SHARE = 0.3  # share of scenes with the arm in its start pose
LOOK = Task(
    "look", wordings=("Look.",), success=lambda scene: False, hold_steps=1, horizon_steps=1,
    cube=ANYWHERE, other=ANYWHERE, other_share=0.7,
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Scenes:
    """N scenes; the positions of objects that are not in a scene are NaN."""

    images: dict[str, np.ndarray]  # camera -> uint8 (N, size, size, 3), memory-mapped, read-only
    places_m: np.ndarray  # float32 (N, objects, 2): x and y of an object's centre in the world frame
    shares: np.ndarray  # float32 (N, cameras, objects, 2): from left and from top, in image side lengths


def draw_scenes(
    folder: Path, count: int, *, image_size: int, seed: int, jitter: float, progress: bool = True
) -> Scenes:
    """Return the scenes in `folder`; if it does not exist, render `count` scenes into it.

    A scene has one or two cubes of different colours, none, one or both of the zones, and the arm in a random pose.
    Camera poses, light and colours vary on the scale `jitter`.
    """
    if not folder.is_dir():
        with new_folder(folder) as draft:
            _draw(draft, count, image_size, np.random.default_rng(seed), jitter, progress)
    images = {camera: np.load(folder / f"{camera}.npy", mmap_mode="r") for camera in CAMERAS}
    return Scenes(images, np.load(folder / "places_m.npy"), np.load(folder / "shares.npy"))


def _draw(folder: Path, count: int, size: int, rng: np.random.Generator, jitter: float, progress: bool) -> None:
    files = {camera: folder / f"{camera}.npy" for camera in CAMERAS}
    images = {camera: open_memmap(file, "w+", np.uint8, (count, size, size, 3)) for camera, file in files.items()}
    places_m = np.full((count, len(OBJECTS), 2), np.nan, np.float32)
    shares = np.full((count, len(CAMERAS), len(OBJECTS), 2), np.nan, np.float32)
    with ExitStack() as stack:
        choices = [(), ZONES[:1], ZONES[1:], ZONES]
        envs = [stack.enter_context(closing(So100Env(replace(LOOK, zones=z), size, jitter=jitter))) for z in choices]
        for row in tqdm(range(count), desc="scenes", disable=not progress):
            choice = rng.integers(len(choices))
            env, zones = envs[choice], choices[choice]
            options = {} if rng.random() < AWAY_SHARE else {"joints": rng.uniform(POSE_FROM, POSE_TO)}
            observation, _ = env.reset(seed=int(rng.integers(2**31)), options=options)
            places_m[row] = _places(env.layout, zones)
            points_m = np.column_stack([places_m[row], HEIGHT_M])
            for index, camera in enumerate(CAMERAS):
                images[camera][row] = observation["pixels"][camera]
                shares[row, index] = project(env.model, env.data, camera, points_m)
    for image in images.values():
        image.flush()
    np.save(folder / "places_m.npy", places_m)
    np.save(folder / "shares.npy", shares)


def _places(layout: Layout, zones: tuple[Patch, ...]) -> np.ndarray:
    """Positions of the objects on the table, (objects, 2), metres."""
    places_m = np.full((len(OBJECTS), 2), np.nan)
    for cube in layout.cubes:
        places_m[OBJECTS.index(f"{cube.color} cube")] = cube.xy_m
    for zone, xy_m in zip(zones, layout.zones_xy_m, strict=True):
        places_m[len(CUBES) + ZONES.index(zone)] = xy_m
    return places_m
