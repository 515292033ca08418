"""A data set's frames, decoded once into memory-mapped arrays.

Decoding a random video frame takes milliseconds, reading a row of an array microseconds, and training visits every
frame many times. `open_store` therefore reads and checks a data set once, writes one ``.npy`` per camera into the cache
and later only maps the files. This module knows neither the data set's file format nor batches.
"""

import hashlib
import json
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import pandas as pd
from filelock import FileLock
from PIL import Image, ImageOps
from tqdm.auto import tqdm

from fedvla_lib.data.lerobot_reader import ReadDataset, locate, read_dataset, read_images
from fedvla_lib.files import cache_dir, new_folder

STORE_VERSION = 2  # part of every store's key; increase it when the file format of a store changes


@dataclass(frozen=True, eq=False)
class FrameStore:
    """All frames of a data set, episode after episode; row i of every array is the same frame."""

    root: Path  # the data set's folder
    fps: int  # frames per second
    states: np.ndarray  # float32 (N, 6): joint positions, LeRobot units
    actions: np.ndarray  # float32 (N, 6): joint targets, LeRobot units
    images: dict[str, np.ndarray]  # camera -> uint8 (N, size, size, 3), memory-mapped, read-only
    episodes: pd.DataFrame  # episode_id, start, end (rows, end excluded), num_frames, instruction, task, lab

    @property
    def num_frames(self) -> int:
        """Number of rows."""
        return len(self.states)

    @cached_property
    def episode_ends(self) -> np.ndarray:
        """Row at which the episode of each row ends (excluded), int64 (N,)."""
        return np.repeat(self.episodes["end"].to_numpy(), self.episodes["num_frames"].to_numpy())

    @cached_property
    def instructions(self) -> list[str]:
        """The instruction of each row."""
        return list(np.repeat(self.episodes["instruction"].to_numpy(dtype=object), self.episodes["num_frames"]))


def open_store(
    source: str | Path, *, image_size: int, cameras: Mapping[str, str] | None = None, progress: bool = True
) -> FrameStore:
    """Open a data set, decoding its frames into the cache the first time.

    Args:
        source: a folder in LeRobotDataset v3.0 format, or a hub id such as ``lerobot/svla_so100_pickplace``.
        image_size: side of the square images in pixels; other sizes are scaled with their aspect ratio kept, and
            padded with black.
        cameras: our camera name -> the data set's, e.g. ``{"front": "wrist"}``; None uses `CAMERA_ALIASES`.
        progress: show a progress bar while decoding.

    Raises:
        DataError: the data set cannot be found or is broken.
    """
    root = locate(source)
    key = _fingerprint(root, image_size, cameras)
    folder = cache_dir() / "frames" / key
    if not folder.is_dir():
        folder.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(folder.with_suffix(".lock")):  # so that concurrent processes decode a data set once
            if not folder.is_dir():
                for left in folder.parent.glob(f".{key}.*"):  # by a process that was killed while it decoded
                    shutil.rmtree(left)
                dataset = read_dataset(root, cameras)
                with new_folder(folder) as draft:
                    _build(dataset, image_size, draft, progress)
    return _load(root, folder)


def _build(dataset: ReadDataset, image_size: int, folder: Path, progress: bool) -> None:
    outline = dataset.outline
    np.save(folder / "states.npy", dataset.states)
    np.save(folder / "actions.npy", dataset.actions)
    dataset.episodes.to_json(folder / "episodes.json", orient="records", indent=1)
    (folder / "store.json").write_text(json.dumps({"fps": outline.info["fps"], "cameras": list(outline.cameras)}))
    total = len(dataset.states) * len(outline.cameras)
    with tqdm(total=total, desc="decoding frames", unit="frame", disable=not progress, leave=False) as bar:
        for camera, key in outline.cameras.items():
            shape = (len(dataset.states), image_size, image_size, 3)
            out = np.lib.format.open_memmap(folder / f"{camera}.npy", mode="w+", dtype=np.uint8, shape=shape)
            for row, image in read_images(outline, key):
                out[row] = fit_square(image, image_size)
                bar.update()
            out.flush()


def _load(root: Path, folder: Path) -> FrameStore:
    content = json.loads((folder / "store.json").read_text())
    return FrameStore(
        root=root, fps=content["fps"], states=np.load(folder / "states.npy"), actions=np.load(folder / "actions.npy"),
        images={camera: np.load(folder / f"{camera}.npy", mmap_mode="r") for camera in content["cameras"]},
        episodes=pd.DataFrame(json.loads((folder / "episodes.json").read_text())),
    )  # fmt: skip


def _fingerprint(root: Path, image_size: int, cameras: Mapping[str, str] | None) -> str:
    """Return the name of a store: a hash of the data set's files (name, size, time), the image size and the cameras."""
    paths = sorted(path for part in ("meta", "data", "videos") for path in (root / part).rglob("*") if path.is_file())
    files = [(str(path.relative_to(root)), path.stat().st_size, path.stat().st_mtime_ns) for path in paths]
    content = json.dumps([STORE_VERSION, image_size, dict(cameras or {}), files])
    return hashlib.sha256(content.encode()).hexdigest()[:24]


def fit_square(image: np.ndarray, size: int) -> np.ndarray:
    """Return uint8 (H, W, 3) as uint8 (size, size, 3): scaled with its aspect ratio kept, centred on black."""
    if image.shape[:2] == (size, size):
        return image
    return np.asarray(ImageOps.pad(Image.fromarray(image), (size, size), Image.Resampling.BILINEAR))
