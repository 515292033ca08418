"""Closed-loop evaluation: actor x tasks x seeds -> one row a rollout, with its video and trajectory on disk."""

import io
import os
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import closing
from copy import copy
from datetime import datetime
from pathlib import Path
from typing import Any

import av
import numpy as np
from tqdm.auto import tqdm

from fedvla_lib.lab import REFERENCE, Lab
from fedvla_lib.rollout import Episode, in_turn, run_episodes
from fedvla_lib.sim import So100Env
from fedvla_lib.spec import CAMERAS, FPS, Actor

AT_ONCE = 16  # rollouts that a policy drives at the same time
VIDEO_SCALE = 2  # whole pixels are doubled: 96 px cameras are small on a page
FIRST_SEED = 1_000_000  # rollout seeds start here, far from the seeds of recorded demonstrations


def rollout_seeds(count: int, first: int = FIRST_SEED) -> list[int]:
    """Return the seeds of `count` evaluation rollouts, the same for every model, so that results are paired."""
    return list(range(first, first + count))


def evaluate(
    actor: Actor,
    tasks: Sequence[str],
    seeds: Sequence[int],
    *,
    image_size: int,
    labs: Sequence[Lab] = (REFERENCE,),
    videos_dir: Path | None = None,
    films: int | None = None,
    progress: bool = True,
) -> list[dict[str, Any]]:
    """Run one rollout per task and seed, seed s in laboratory s mod len(labs), and return a row for each.

    Row: task, instruction, seed, lab (its name), success (bool), steps, completion_time_s (of a success, else NaN),
    action_smoothness (mean absolute second difference of the joint targets, degrees per step squared; lower is
    smoother) and video (path or None). With `videos_dir`, a rollout leaves ``rollout_<timestamp>_<task>_<seed>.mp4``
    and a trajectory beside it; with `films`, only the first so many of each task do. Of a rollout that is not filmed
    nothing is drawn but what the actor looks at, which is faster and has the same result.
    """
    filmed = set(seeds[:films] if videos_dir else ())
    rows = []
    with tqdm(total=len(tasks) * len(seeds), desc="rollouts", disable=not progress) as bar:
        for task in tasks:
            for episode in _episodes(actor, task, seeds, image_size, labs, filmed, bar):
                video = save_rollout(episode, Path(videos_dir)) if episode.images else None
                where = {"lab": _lab(labs, episode.seed).name, "video": str(video) if video else None}
                rows.append(row(episode) | where)
    return rows


def _episodes(
    actor: Actor, task: str, seeds: Sequence[int], image_size: int, labs: Sequence[Lab], filmed: set[int], bar: tqdm
) -> Iterator[Episode]:
    """Yield an episode for each seed; an actor that can choose for many at once does."""
    together = getattr(actor, "act_together", in_turn)
    size = min(len(seeds), 1 if together is in_turn else AT_ONCE)
    screen = So100Env(task, image_size)
    envs = [screen, *(So100Env(task, image_size, screen=screen) for _ in range(1, size))]
    with closing(screen):
        for start in range(0, len(seeds), max(1, size)):
            group = seeds[start : start + size]
            for env, seed in zip(envs, group, strict=False):
                env.lab = _lab(labs, seed)
                env.cameras = CAMERAS if seed in filmed else ()  # without, it draws only where the actor looks
            actors = [actor] if size == 1 else [copy(actor) for _ in group]
            yield from run_episodes(envs[: len(group)], actors, group, together)
            bar.update(len(group))


def _lab(labs: Sequence[Lab], seed: int) -> Lab:
    return labs[seed % len(labs)]  # by the seed, so that a seed means the same scene in whatever company it is run


def row(episode: Episode) -> dict[str, Any]:
    """Summarise one rollout."""
    return {
        "task": episode.task,
        "instruction": episode.instruction,
        "seed": episode.seed,
        "success": bool(episode.success),
        "steps": episode.num_frames,
        "completion_time_s": episode.num_frames / FPS if episode.success else float("nan"),
        "action_smoothness": smoothness(episode.actions),
    }


def smoothness(actions: np.ndarray) -> float:
    """Mean absolute second difference of joint targets (T, 6): degrees per step squared; 0 for T < 3."""
    if len(actions) < 3:
        return 0.0
    return float(np.abs(np.diff(actions.astype(np.float64), n=2, axis=0)).mean())


def success_rate(rows: Sequence[dict[str, Any]]) -> float:
    """Share of rollouts that succeeded."""
    if not rows:
        raise ValueError("no rollouts: a success rate needs at least one")
    return sum(r["success"] for r in rows) / len(rows)


def save_rollout(episode: Episode, folder: Path) -> Path:
    """Write video and trajectory of a rollout and return the video's path; existing files are never overwritten."""
    stamp = datetime.now().strftime("%Y%m%d_%H%M%S_%f")
    path = folder / f"rollout_{stamp}_{episode.task}_{episode.seed}.mp4"
    _write(path, encode_video(side_by_side(episode)))
    trajectory = io.BytesIO()
    np.savez(trajectory, states=episode.states, actions=episode.actions, success=episode.success, seed=episode.seed)
    _write(path.with_suffix(".npz"), trajectory.getvalue())
    return path


def side_by_side(episode: Episode) -> np.ndarray:
    """Put the cameras next to each other, enlarged: uint8 (T, H, W, 3)."""
    frames = np.concatenate([episode.images[camera] for camera in CAMERAS], axis=2)
    return frames.repeat(VIDEO_SCALE, axis=1).repeat(VIDEO_SCALE, axis=2)


def encode_video(frames: np.ndarray, fps: int = FPS) -> bytes:
    """Encode uint8 frames (T, H, W, 3) as an mp4 that browsers play: H.264, yuv420p, index first.

    Raises:
        ValueError: frames of another shape or type, none at all, or odd sides (yuv420p halves them).
    """
    if frames.ndim != 4 or frames.shape[-1] != 3 or frames.dtype != np.uint8 or not len(frames):
        raise ValueError(f"frames are {frames.dtype} {frames.shape}: give uint8 (T, H, W, 3) with T > 0")
    height, width = frames.shape[1:3]
    if height % 2 or width % 2:
        raise ValueError(f"frames are {width} x {height} pixels: give even sides")
    with tempfile.TemporaryDirectory() as scratch:  # moving the index to the front needs a real file
        path = Path(scratch) / "video.mp4"
        with av.open(str(path), "w", options={"movflags": "faststart"}) as container:
            quality = {"crf": "20", "preset": "veryfast", "threads": "1", "x264-params": "log=-1"}
            stream = container.add_stream("libx264", rate=fps, options=quality)
            stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
            for pixels in frames:
                container.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")))
            container.mux(stream.encode(None))
        return path.read_bytes()


def read_video(path: Path) -> np.ndarray:
    """Decode an mp4 whole: uint8 (T, H, W, 3).

    Raises:
        ValueError: the file is no readable video; the message names it.
    """
    av.logging.set_level(None)  # LeRobot's encoder leaves libav printing to stderr; the exception says what is wrong
    try:
        with av.open(str(path)) as container:
            return np.stack([frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)])
    except (av.FFmpegError, ValueError, OSError, IndexError) as error:  # IndexError: no stream of pictures
        raise ValueError(f"{path} is not a readable video: {error}") from error


def _write(path: Path, content: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    scratch = path.with_name(f".{path.name}.part")
    scratch.write_bytes(content)
    os.replace(scratch, path)
