"""Reads any LeRobotDataset v3.0 of an SO-100, from a folder or the hub, and checks what can be wrong with it.

Whatever does not fit is a `DataError` that names file and episode. This module keeps nothing: `store` writes what it
yields into arrays.
"""

import io
import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import av
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from huggingface_hub import snapshot_download
from huggingface_hub.errors import HfHubHTTPError, LocalEntryNotFoundError, OfflineModeIsEnabled
from lerobot.utils.constants import HF_LEROBOT_HOME, HF_LEROBOT_HUB_CACHE
from PIL import Image

from fedvla_lib.robot.spec import ACTION_KEY, CAMERAS, IMAGE_PREFIX, JOINT_NAMES, LAB_KEY, NUM_JOINTS, STATE_KEY
from fedvla_lib.robot.tasks import task_of

FORMAT = "v3.0"  # of LeRobotDataset
CAMERA_ALIASES = {  # our camera -> names it has in other people's data sets, best first
    "overhead": ("overhead", "top", "up", "above", "phone"),
    "front": ("front", "side", "wrist", "gripper", "laptop"),
}
TIMESTAMP_TOLERANCE_S = 1e-3
FPS_TOLERANCE = 0.01  # relative; containers round frame rates such as 29.97


class DataError(ValueError):
    """A data set cannot be used; the message names the file, the episode and what is wrong."""


def locate(source: str | Path) -> Path:
    """Return the folder of a data set: `source` itself, or a hub id's local copy, downloaded if need be.

    Raises:
        DataError: neither a folder nor a hub id, or the hub cannot be reached or does not have it.
    """
    folder = Path(source).expanduser()
    if folder.is_dir():
        return folder
    if folder.exists() or not re.fullmatch(r"[\w.-]+/[\w.-]+", str(source)):
        raise DataError(f"no data set at {source}: give a folder, or a hub id like lerobot/svla_so100_pickplace")
    if (HF_LEROBOT_HOME / source / "meta/info.json").exists():
        return HF_LEROBOT_HOME / source
    try:
        return Path(
            snapshot_download(str(source), repo_type="dataset", revision=FORMAT, cache_dir=HF_LEROBOT_HUB_CACHE)
        )
    except (LocalEntryNotFoundError, OfflineModeIsEnabled, HfHubHTTPError, OSError) as error:
        reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise DataError(
            f"cannot get data set {str(source)!r} from the Hugging Face hub ({type(error).__name__}: {reason}); where "
            f"there is a network run `hf download {source} --repo-type dataset --revision {FORMAT} --local-dir DIR` "
            "and give the folder DIR instead of the id"
        ) from error


@dataclass(frozen=True, eq=False)
class Source:
    """A data set whose metadata and rows have been read and checked; its pictures have not."""

    root: Path
    info: dict[str, Any]  # meta/info.json
    cameras: dict[str, str]  # our name -> feature key
    files: pd.DataFrame  # meta/episodes: in which files each episode is, and where
    episodes: pd.DataFrame  # as in FrameStore
    states: np.ndarray
    actions: np.ndarray


def read_source(root: Path, cameras: Mapping[str, str] | None) -> Source:
    info = _read_info(root)
    _check_features(root, info)
    files = _read_episodes(root, info)
    states, actions, labs = _read_rows(root, info, files)
    lengths = files["length"].to_numpy()
    ends = np.cumsum(lengths)
    instructions = [tasks[0] for tasks in files["tasks"]]
    episodes = pd.DataFrame(
        {
            "episode_id": files["episode_index"].astype(int),
            "start": ends - lengths,
            "end": ends,
            "num_frames": lengths,
            "instruction": instructions,
            "task": [task_of(text) for text in instructions],
            "lab": labs,
        }
    )
    return Source(root, info, _map_cameras(root, info, cameras), files, episodes, states, actions)


def _read_info(root: Path) -> dict[str, Any]:
    path = root / "meta/info.json"
    try:
        info = json.loads(path.read_text())
    except FileNotFoundError:
        raise DataError(f"{path} is missing: {root} is not a LeRobotDataset, or its recording never began") from None
    except json.JSONDecodeError as error:
        raise DataError(f"{path} is not JSON: {error}") from error
    if info.get("codebase_version") != FORMAT:
        raise DataError(
            f"{path} says format {info.get('codebase_version')}, this needs {FORMAT}: convert the data set with "
            "`python -m lerobot.scripts.convert_dataset_v21_to_v30`"
        )
    return info


def _check_features(root: Path, info: dict[str, Any]) -> None:
    """State and action must be six numbers with the names of the SO-100's joints, in their order."""
    for key in (STATE_KEY, ACTION_KEY):
        feature = info["features"].get(key)
        if feature is None:
            raise DataError(f"{root / 'meta/info.json'} has no feature {key}: every episode lacks it")
        if tuple(feature["shape"]) != (NUM_JOINTS,):
            raise DataError(
                f"{root / 'meta/info.json'}, every episode: {key} has shape {tuple(feature['shape'])}, "
                f"an SO-100 has ({NUM_JOINTS},)"
            )
        names = _flat_names(feature.get("names"))
        if [_plain(name) for name in names] != [_plain(name) for name in JOINT_NAMES]:
            raise DataError(
                f"{root / 'meta/info.json'}, every episode: {key} has the columns {', '.join(names) or 'nothing'}, "
                f"needed are {', '.join(JOINT_NAMES)} in this order"
            )


def _flat_names(names: Any) -> list[str]:
    """Names come as a list or as ``{"motors": [...]}``."""
    if isinstance(names, Mapping):
        names = [name for part in names.values() for name in part]
    return [str(name) for name in names or []]


def _plain(name: str) -> str:
    """``main_shoulder_pan`` and ``shoulder_pan.pos`` are the same joint."""
    return name.removeprefix("main_").removesuffix(".pos")


def _map_cameras(root: Path, info: dict[str, Any], cameras: Mapping[str, str] | None) -> dict[str, str]:
    """Our camera -> feature key, by the given mapping or by the names people commonly use."""
    found = [key for key, feature in info["features"].items() if feature["dtype"] in ("video", "image")]
    keys = {key.removeprefix(IMAGE_PREFIX): key for key in found}
    wanted = {ours: (name.removeprefix(IMAGE_PREFIX),) for ours, name in cameras.items()} if cameras else CAMERA_ALIASES
    mapping = {ours: keys[name] for ours, names in wanted.items() for name in reversed(names) if name in keys}
    missing = [ours for ours in wanted if ours not in mapping]
    if missing and (cameras or len(found) >= len(CAMERAS) or not mapping):
        raise DataError(
            f"{root / 'meta/info.json'}: no camera for {', '.join(missing)} among {', '.join(keys) or 'none'}: say "
            f"which to use, for instance cameras={{{missing[0]!r}: {next(iter(keys), 'NAME')!r}}}"
        )
    return mapping


def _read_episodes(root: Path, info: dict[str, Any]) -> pd.DataFrame:
    """Episode table of the data set, by episode number; rows that info.json does not count are left out."""
    tables = []
    for path in sorted((root / "meta/episodes").glob("*/*.parquet")):
        file = _parquet(path, "all")
        columns = [name for name in file.schema_arrow.names if not name.startswith("stats/")]
        tables.append(file.read(columns=columns).to_pandas())
    total = info["total_episodes"]
    if not total:
        raise DataError(f"{root} holds no complete episode: record some first")
    table = pd.concat(tables) if tables else pd.DataFrame({"episode_index": []})
    table = table.sort_values("episode_index").set_index("episode_index", drop=False)
    lacking = sorted(set(range(total)) - set(table.index))
    if lacking:
        raise DataError(
            f"{root / 'meta/episodes'}: episode {lacking[0]} is not listed, info.json counts {total} episodes"
        )
    return table.loc[range(total)].reset_index(drop=True)


def _parquet(path: Path, episodes: Any) -> pq.ParquetFile:
    try:
        return pq.ParquetFile(path)
    except FileNotFoundError:
        raise DataError(f"{path} is missing (episode {episodes})") from None
    except (pa.ArrowInvalid, OSError) as error:
        raise DataError(f"{path} cannot be read (episode {episodes}): {error}") from error


def _read_rows(root: Path, info: dict[str, Any], files: pd.DataFrame) -> tuple[np.ndarray, np.ndarray, list[int]]:
    """States and actions of all episodes, float32 (N, 6) each, checked, and the laboratory of each episode."""
    columns = ["episode_index", "timestamp", STATE_KEY, ACTION_KEY]
    has_labs = LAB_KEY in info["features"]
    columns += [LAB_KEY] if has_labs else []
    parts: dict[int, tuple[np.ndarray, np.ndarray, int]] = {}
    for (chunk, file), group in files.groupby(["data/chunk_index", "data/file_index"]):
        path = root / info["data_path"].format(chunk_index=chunk, file_index=file)
        source = _parquet(path, group["episode_index"].iloc[0])
        lacking = [name for name in columns if name not in source.schema_arrow.names]
        if lacking:
            raise DataError(f"{path} (episode {group['episode_index'].iloc[0]}) has no column {', '.join(lacking)}")
        table = source.read(columns=columns).to_pandas()
        for episode_id, length in zip(group["episode_index"], group["length"], strict=True):
            rows = table[table["episode_index"] == episode_id]
            lab = int(rows[LAB_KEY].iloc[0]) if has_labs and len(rows) else 0
            parts[episode_id] = (*_check_rows(path, episode_id, rows, length, info["fps"]), lab)
    states, actions, labs = zip(*(parts[episode_id] for episode_id in files["episode_index"]), strict=True)
    return np.concatenate(states), np.concatenate(actions), list(labs)


def _check_rows(
    path: Path, episode_id: int, rows: pd.DataFrame, length: int, fps: float
) -> tuple[np.ndarray, np.ndarray]:
    """States and actions of one episode, float32 (T, 6)."""
    where = f"{path}, episode {episode_id}"
    if len(rows) != length:
        raise DataError(f"{where}: has {len(rows)} frames, its metadata says {length}")
    drift = np.abs(rows["timestamp"].to_numpy() - np.arange(length) / fps)
    if drift.max() > max(TIMESTAMP_TOLERANCE_S, 1e-6 * length):
        frame = int(np.argmax(drift > TIMESTAMP_TOLERANCE_S))
        raise DataError(
            f"{where}: frame {frame} is at {rows['timestamp'].iloc[frame]:.4f} s, but at fps={fps} "
            f"it belongs at {frame / fps:.4f} s"
        )
    return _vectors(where, STATE_KEY, rows[STATE_KEY]), _vectors(where, ACTION_KEY, rows[ACTION_KEY])


def _vectors(where: str, key: str, column: pd.Series) -> np.ndarray:
    """A column of six-vectors as float32 (T, 6), all finite."""
    shapes = sorted({np.shape(value) for value in column})
    if shapes != [(NUM_JOINTS,)]:
        raise DataError(
            f"{where}: {key} has shape {shapes[0] if len(shapes) == 1 else shapes}, needed is ({NUM_JOINTS},)"
        )
    values = np.stack(column.to_list()).astype(np.float32)
    if not np.isfinite(values).all():
        frame, joint = np.argwhere(~np.isfinite(values))[0]
        raise DataError(f"{where}: {key} of frame {frame} is {values[frame, joint]} at {JOINT_NAMES[joint]}")
    return values


def read_images(source: Source, key: str) -> Iterator[tuple[int, np.ndarray]]:
    """Every frame of one camera as (store row, uint8 (H, W, 3)); all rows come exactly once."""
    is_video = source.info["features"][key]["dtype"] == "video"
    kind, pattern, read = (
        ("videos/" + key, "video_path", _video_images) if is_video else ("data", "data_path", _still_images)
    )
    starts = source.episodes["start"].to_numpy()
    for (chunk, file), group in source.files.groupby([f"{kind}/chunk_index", f"{kind}/file_index"]):
        path = source.root / source.info[pattern].format(video_key=key, chunk_index=chunk, file_index=file)
        yield from read(path, key, group, starts[group.index], source.info["fps"])


def _video_images(
    path: Path, key: str, group: pd.DataFrame, starts: np.ndarray, fps: float
) -> Iterator[tuple[int, np.ndarray]]:
    """Frames of the episodes in `group`, which share the video `path`; the frame at t s is number t * fps."""
    first = np.round(group[f"videos/{key}/from_timestamp"].to_numpy() * fps).astype(int)
    lengths = group["length"].to_numpy()
    rows = {
        frame + step: start + step
        for frame, start, length in zip(first, starts, lengths, strict=True)
        for step in range(length)
    }
    for number, picture in _decode(path, fps, group["episode_index"].iloc[0]):
        if number in rows:
            yield rows.pop(number), picture
    if rows:
        row = min(rows.values())
        place = int(np.searchsorted(starts, row, side="right")) - 1
        raise DataError(
            f"{path}, episode {group['episode_index'].iloc[place]}: the video lacks frame {row - starts[place]} of "
            f"{lengths[place]}; it is cut off or damaged"
        )


def _decode(path: Path, fps: float, episode_id: int) -> Iterator[tuple[int, np.ndarray]]:
    """All frames of a video as (number, uint8 (H, W, 3)); stops where the file cannot be decoded any further."""
    if not path.exists():
        raise DataError(f"{path} is missing (episode {episode_id})")
    try:
        container = av.open(str(path))
    except (av.FFmpegError, OSError) as error:
        raise DataError(f"{path} cannot be opened as a video (episode {episode_id}): {error.strerror}") from error
    with container:
        if not container.streams.video:
            raise DataError(f"{path} holds no video (episode {episode_id})")
        stream = container.streams.video[0]
        rate = float(stream.average_rate or 0)
        if abs(rate - fps) > FPS_TOLERANCE * fps:
            raise DataError(
                f"{path}, episode {episode_id}: runs at {rate:g} frames per second, meta/info.json says {fps}"
            )
        yield from _decode_stream(container, stream, fps)


def _decode_stream(container: Any, stream: Any, fps: float) -> Iterator[tuple[int, np.ndarray]]:
    frames = container.decode(stream)
    while True:
        try:
            frame = next(frames)
        except (StopIteration, av.FFmpegError):
            return  # the caller knows which frames it still needs and says so
        yield round(float(frame.pts * stream.time_base) * fps), frame.to_ndarray(format="rgb24")


def _still_images(
    path: Path, key: str, group: pd.DataFrame, starts: np.ndarray, fps: float
) -> Iterator[tuple[int, np.ndarray]]:
    """Frames stored as compressed pictures in the rows of a parquet file."""
    table = _parquet(path, group["episode_index"].iloc[0]).read(columns=["episode_index", key]).to_pandas()
    for episode_id, start in zip(group["episode_index"], starts, strict=True):
        for step, cell in enumerate(table.loc[table["episode_index"] == episode_id, key]):
            try:
                yield start + step, np.asarray(Image.open(io.BytesIO(cell["bytes"])).convert("RGB"))
            except (OSError, TypeError) as error:
                raise DataError(
                    f"{path}, episode {episode_id}: picture {step} of {key} cannot be read: {error}"
                ) from error
