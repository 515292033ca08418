"""Objects on the table: regions to draw positions from, cubes, zones, and the drawn layout.

Lengths are metres in the world frame of `tasks`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, starmap

import numpy as np

COLORS = {  # name in the instruction -> red, green, blue in [0, 1]
    "red": (0.86, 0.12, 0.10),
    "green": (0.10, 0.60, 0.20),
    "blue": (0.10, 0.25, 0.85),
}
CUBE_HALF_M = 0.014  # half the edge of the cube


@dataclass(frozen=True)
class Region:
    """Part of the table, in polar coordinates around the arm's first joint."""

    radius_m: tuple[float, float]
    bearing_deg: tuple[float, float]  # 0 is straight ahead, positive to the arm's left


@dataclass(frozen=True)
class Patch:
    """A flat coloured shape on the table."""

    region: Region  # where its centre may be
    shape: str  # "square" (yellow) or "disc" (white)
    half_m: float  # half the side of the square, or the radius of the disc


@dataclass(frozen=True)
class Cube:
    """A cube at the start of an episode."""

    color: str
    xy_m: tuple[float, float]
    yaw_rad: float


@dataclass(frozen=True)
class Layout:
    """Instruction and object poses at the start of an episode."""

    instruction: str
    cubes: tuple[Cube, ...]  # the first is the one to move
    zones_xy_m: tuple[tuple[float, float], ...]  # centres; the first zone belongs to the first cube


MAX_CUBE_YAW_RAD = np.deg2rad(25.0)  # largest angle between a cube face and the direction from the base
CUBES_APART_M = 0.058  # minimum distance between cube centres, so that the open jaws fit between them
ZONES_APART_M = 0.10


def draw_cubes(regions: Sequence[Region], colors: Sequence[str], rng: np.random.Generator) -> tuple[Cube, ...]:
    """Draw a cube in each region, in the first of these colours."""
    points = _draw_apart(regions, CUBES_APART_M, rng)
    turns_rad = [rng.uniform(-MAX_CUBE_YAW_RAD, MAX_CUBE_YAW_RAD) for _ in points]
    drawn = zip(colors, points, turns_rad, strict=False)  # there may be more colours
    return tuple(Cube(color, cartesian(*point), float(point[1] + turn_rad)) for color, point, turn_rad in drawn)


def draw_zones(zones: Sequence[Patch], rng: np.random.Generator) -> tuple[tuple[float, float], ...]:
    """Draw the centre of each zone, x and y in metres."""
    return tuple(cartesian(*point) for point in _draw_apart([zone.region for zone in zones], ZONES_APART_M, rng))


def _draw_apart(regions: Sequence[Region], apart_m: float, rng: np.random.Generator) -> list[tuple[float, float]]:
    """Draw radius and bearing in each region; redraw all of them until every two are at least `apart_m` apart."""
    while True:
        points = [(rng.uniform(*r.radius_m), np.deg2rad(rng.uniform(*r.bearing_deg))) for r in regions]
        if all(np.linalg.norm(np.subtract(a, b)) >= apart_m for a, b in combinations(starmap(cartesian, points), 2)):
            return points


def cartesian(radius_m: float, bearing_rad: float) -> tuple[float, float]:
    """Return x and y in metres of a point around the arm's first joint."""
    return float(radius_m * np.cos(bearing_rad)), float(radius_m * np.sin(bearing_rad))
