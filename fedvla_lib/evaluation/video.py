"""Write rollouts as mp4 videos with their trajectories, and read videos back."""

import io
import tempfile
from collections.abc import Iterable
from datetime import datetime
from itertools import chain
from pathlib import Path

import av
import numpy as np

from fedvla_lib.files import write_atomically
from fedvla_lib.robot.rollout import Episode
from fedvla_lib.robot.spec import CAMERAS, FPS

VIDEO_SCALE = 2  # integer upscaling: 96 px cameras are small on a page


def save_rollout(episode: Episode, folder: Path) -> Path:
    """Write video and trajectory of a rollout and return the video's path; existing files are never overwritten."""
    stamp = datetime.now().strftime("%Y%m%d_%H%M%S_%f")
    path = folder / f"rollout_{stamp}_{episode.task}_{episode.seed}.mp4"
    frames = np.concatenate([episode.images[camera] for camera in CAMERAS], axis=2)  # side by side
    write_atomically(path, encode_video(frames.repeat(VIDEO_SCALE, axis=1).repeat(VIDEO_SCALE, axis=2)))
    trajectory = io.BytesIO()
    np.savez(trajectory, states=episode.states, actions=episode.actions, success=episode.success, seed=episode.seed)
    write_atomically(path.with_suffix(".npz"), trajectory.getvalue())
    return path


def encode_video(frames: Iterable[np.ndarray], fps: int = FPS, crf: int = 20) -> bytes:
    """Encode uint8 frames (T, H, W, 3) as an mp4 that browsers play: H.264, yuv420p, index first; `crf` is its loss.

    Raises:
        ValueError: wrong shape or dtype, no frames, or odd width or height (yuv420p halves both).
    """
    frames = iter(frames)
    first = next(frames, np.empty(0))
    if first.ndim != 3 or first.shape[-1] != 3 or first.dtype != np.uint8:
        raise ValueError(f"the first frame is {first.dtype} {first.shape}: give uint8 (H, W, 3), at least one")
    height, width = first.shape[:2]
    if height % 2 or width % 2:
        raise ValueError(f"frames are {width} x {height} pixels: give even sides")
    with tempfile.TemporaryDirectory() as scratch:  # moving the index to the front needs a real file
        path = Path(scratch) / "video.mp4"
        with av.open(str(path), "w", options={"movflags": "faststart"}) as container:
            quality = {"crf": str(crf), "preset": "veryfast", "threads": "1", "x264-params": "log=-1"}
            stream = container.add_stream("libx264", rate=fps, options=quality)
            stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
            for pixels in chain([first], frames):
                container.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")))
            container.mux(stream.encode(None))
        return path.read_bytes()


def read_video(path: Path) -> np.ndarray:
    """Decode an mp4: uint8 (T, H, W, 3); raise ValueError, which names the file, if it cannot be decoded."""
    av.logging.set_level(None)  # LeRobot's encoder leaves libav printing to stderr; the exception says what is wrong
    try:
        with av.open(str(path)) as container:
            return np.stack([frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)])
    except (av.FFmpegError, ValueError, OSError, IndexError) as error:  # IndexError: no video stream
        raise ValueError(f"{path} is not a readable video: {error}") from error
