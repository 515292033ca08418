"""A data set's frames, decoded once into memory-mapped arrays.

Decoding a random video frame takes milliseconds, reading a row of an array microseconds, and training visits every
frame many times. `open_store` therefore reads and checks a data set once, writes one ``.npy`` per camera into the cache
and later only maps the files. This module knows neither the data set's file format nor batches.
"""

import json
import logging
import shutil
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import pandas as pd
from filelock import FileLock
from tqdm.auto import tqdm

from fedvla_lib.data import conversion, resampling
from fedvla_lib.data.lerobot_reader import Cameras, Outline, ReadDataset, read_dataset, read_images, read_info
from fedvla_lib.data.resampling import resampled
from fedvla_lib.files import cache_dir, new_folder
from fedvla_lib.robot.spec import IMAGE_PREFIX

logger = logging.getLogger(__name__)
STORE_VERSION = 3  # part of every store's key; increase it when the file format of a store changes


@dataclass(frozen=True, eq=False)
class FrameStore:
    """All frames of a data set, episode after episode; row i of every array is the same frame."""

    root: Path  # the data set's folder
    fps: float  # frames per second
    states: np.ndarray  # float32 (N, 6): joint positions, LeRobot units
    actions: np.ndarray  # float32 (N, 6): joint targets, LeRobot units
    images: dict[str, np.ndarray]  # camera -> uint8 (N, size, size, 3), memory-mapped, read-only
    episodes: pd.DataFrame  # episode_id, start, end (rows, end excluded), num_frames, instruction, task, lab
    key: str = ""  # hash of the data set's files and of how they were decoded; "" for frames that were never files

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
    source: str | Path, *, image_size: int, cameras: Cameras | None = None, fps: int | None = None,
    progress: bool = True,
) -> FrameStore:  # fmt: skip
    """Open a data set, decoding its frames into the cache the first time.

    Args:
        source: a folder in LeRobotDataset format v3.0 or v2.1, or a hub id such as ``lerobot/svla_so100_pickplace``.
        image_size: side of the square images in pixels; others are resized by `fit_square`.
        cameras: our camera -> the data set's, e.g. ``{"front": "wrist"}``; None uses `CAMERA_ALIASES`.
        fps: frames per second that the policy needs; None keeps those of the recording. See `resampling`.
        progress: show a progress bar while decoding.

    Raises:
        DataError: the data set cannot be found or is broken.
    """
    root = conversion.find(source)
    fps = fps or read_info(root)["fps"]
    key = conversion.fingerprint(root, STORE_VERSION, image_size, cameras or {}, fps)
    folder = cache_dir() / "frames" / key
    if not folder.is_dir():
        folder.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(folder.with_suffix(".lock")):  # so that concurrent processes decode a data set once
            if not folder.is_dir():
                for left in folder.parent.glob(f".{key}.*"):  # by a process that was killed while it decoded
                    shutil.rmtree(left)
                dataset = read_dataset(root, cameras)
                with new_folder(folder) as draft:
                    _build(dataset, image_size, fps, draft, progress)
    return _load(root, folder)


def _build(dataset: ReadDataset, image_size: int, fps: float, folder: Path, progress: bool) -> None:
    outline, (dataset, kept) = dataset.outline, resampled(dataset, fps)
    place = dict(zip(kept.tolist(), range(len(kept)), strict=True))
    np.save(folder / "states.npy", dataset.states)
    np.save(folder / "actions.npy", dataset.actions)
    dataset.episodes.to_json(folder / "episodes.json", orient="records", indent=1)
    content = {"fps": fps, "cameras": list(outline.cameras), "notes": _notes(outline, fps)}
    (folder / "store.json").write_text(json.dumps(content))
    total = len(dataset.states) * len(outline.cameras)
    with tqdm(total=total, desc="decoding frames", unit="frame", disable=not progress, leave=False) as bar:
        for camera, key in outline.cameras.items():
            shape = (len(dataset.states), image_size, image_size, 3)
            out = np.lib.format.open_memmap(folder / f"{camera}.npy", mode="w+", dtype=np.uint8, shape=shape)
            for row, image in read_images(outline, key):
                if row in place:
                    out[place[row]] = fit_square(image, image_size)
                    bar.update()
            out.flush()


def _notes(outline: Outline, fps: float) -> list[str]:
    """Return what is done to the data set that a reader may not expect; shown each time that it is opened."""
    names = {camera: key.removeprefix(IMAGE_PREFIX) for camera, key in outline.cameras.items()}
    others = [f"camera {name} is used as {camera}" for camera, name in names.items() if name != camera]
    return [note for note in (resampling.note(outline.info["fps"], fps), ", ".join(others)) if note]


def _load(root: Path, folder: Path) -> FrameStore:
    content = json.loads((folder / "store.json").read_text())
    for note in content["notes"]:
        logger.warning("%s: %s", root.name, note)
    return FrameStore(
        root=root, fps=content["fps"], states=np.load(folder / "states.npy"), actions=np.load(folder / "actions.npy"),
        images={camera: np.load(folder / f"{camera}.npy", mmap_mode="r") for camera in content["cameras"]},
        episodes=pd.DataFrame(json.loads((folder / "episodes.json").read_text())), key=folder.name,
    )  # fmt: skip


def fit_square(image: np.ndarray, size: int) -> np.ndarray:
    """Return uint8 (H, W, 3) as uint8 (size, size, 3): resized and padded as SmolVLA does, left and above, with black.

    So a policy that was trained on these images sees the same ones where it is given a camera's own.
    """
    if image.shape[:2] == (size, size):
        return image
    import torch
    from lerobot.policies.common.vla_utils import resize_with_pad  # here, since recordings of this size do without

    pixels = torch.from_numpy(image).permute(2, 0, 1)[None].float()
    return resize_with_pad(pixels, size, size, pad_value=0)[0].permute(1, 2, 0).round().byte().numpy()
