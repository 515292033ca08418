"""Objects on the table: regions to draw positions from, cubes, zones, and the drawn layout.

Lengths are metres in the world frame of `tasks`.
"""

from dataclasses import dataclass
from itertools import combinations

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
    zones_xy_m: tuple[tuple[float, float], ...]  # the first belongs to the first cube

    @property
    def color(self) -> str:
        """Colour of the first cube."""
        return self.cubes[0].color

    @property
    def cube_xy_m(self) -> tuple[float, float]:
        """Centre of the first cube."""
        return self.cubes[0].xy_m

    @property
    def cube_yaw_rad(self) -> float:
        """Yaw of the first cube."""
        return self.cubes[0].yaw_rad

    @property
    def zone_xy_m(self) -> tuple[float, float] | None:
        """Centre of the first zone; None without a zone."""
        return self.zones_xy_m[0] if self.zones_xy_m else None


MAX_CUBE_YAW_RAD = np.deg2rad(25.0)  # largest angle between a cube face and the direction from the base
CUBES_APART_M = 0.058  # minimum distance between cube centres, so that the open jaws fit between them
ZONES_APART_M = 0.10


def check_color(color: str) -> str:
    """Return `color`; raise ValueError listing the valid colours if it is unknown."""
    if color not in COLORS:
        raise ValueError(f"unknown colour {color!r}: choose one of {', '.join(COLORS)}")
    return color


Point = tuple[tuple[float, float], float]  # x and y in metres, bearing in radians


def draw_apart(regions: list[Region], apart_m: float, rng: np.random.Generator) -> list[Point]:
    """Draw one point in each region; redraw all of them until every two are at least `apart_m` apart."""
    while True:
        points = [_draw_point(region, rng) for region in regions]
        if all(np.linalg.norm(np.subtract(a[0], b[0])) >= apart_m for a, b in combinations(points, 2)):
            return points


def _draw_point(region: Region, rng: np.random.Generator) -> Point:
    radius_m = rng.uniform(*region.radius_m)
    bearing_rad = np.deg2rad(rng.uniform(*region.bearing_deg))
    return cartesian(radius_m, bearing_rad), float(bearing_rad)


def cartesian(radius_m: float, bearing_rad: float) -> tuple[float, float]:
    """Return x and y in metres of a point around the arm's first joint."""
    return float(radius_m * np.cos(bearing_rad)), float(radius_m * np.sin(bearing_rad))
