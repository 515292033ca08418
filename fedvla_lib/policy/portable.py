"""Where a saved nano policy says that its backbone is, so that the folder can be copied, renamed and uploaded.

A ``pretrained_model`` folder holds the backbone's config and tokenizer in ``vlm``, and two of its files name it.
LeRobot 0.6.1 passes that name to transformers as it stands, without the folder that it was read from, and transformers
looks for a relative name in the working directory, then on the hub (`cached_files` in ``transformers/utils/hub.py``).
So a saved policy names ``vlm``: this library finds it wherever the folder is, LeRobot's commands from inside it.
`export` writes the copy that they load from any working directory, which has to name the place where it will be.
"""

import shutil
from dataclasses import replace
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any, TypedDict

from fedvla_lib.config import Config
from fedvla_lib.files import new_folder, read_json, write_json
from fedvla_lib.policy.nano import VLM_FOLDER
from fedvla_lib.robot.spec import CAMERAS, image_key

CONFIG_FILE, PREPROCESSOR_FILE = "config.json", "policy_preprocessor.json"


class SavedPolicy(TypedDict):
    """What is read from `CONFIG_FILE`."""

    input_features: dict[str, dict[str, Any]]
    chunk_size: int
    n_action_steps: int


def saved_settings(folder: Path) -> Config:
    """Return settings that load the policy saved in `folder` as it was trained.

    Raises:
        ValueError: not a pretrained_model folder, or a policy without our cameras.
    """
    saved = read_json(_config_file(folder), SavedPolicy)
    shape = saved["input_features"].get(image_key(CAMERAS[0]), {}).get("shape")
    if not shape:
        raise ValueError(f"{folder} has no camera {CAMERAS[0]!r}: the simulator shows {', '.join(CAMERAS)}")
    chunk = {name: saved[name] for name in ("chunk_size", "n_action_steps")}
    return replace(Config(), base=str(folder), image_size=shape[-1], **chunk)


def _config_file(folder: Path) -> Path:
    if not (file := folder / CONFIG_FILE).is_file():
        raise ValueError(f"{folder} is not a pretrained_model folder: it has no {CONFIG_FILE}")
    return file


def name_backbone(folder: Path, name: str) -> None:
    """Write `name` as the backbone's into the files of a saved policy that mention it."""
    config, preprocessor = (read_json(folder / file) for file in (CONFIG_FILE, PREPROCESSOR_FILE))
    config["vlm_model_name"] = name
    for step in preprocessor["steps"]:
        if "tokenizer_name" in step["config"]:
            step["config"]["tokenizer_name"] = name
    write_json(folder / CONFIG_FILE, config)
    write_json(folder / PREPROCESSOR_FILE, preprocessor)


def export(policy: Path, place: str, out: Path | None = None) -> Path:
    """Copy a saved policy so that LeRobot loads it from `place`, whatever the working directory; return the folder.

    Args:
        place: where the copy will be when it is loaded; an absolute path if that is on another machine.
        out: the folder to write, to be moved to `place`; None writes `place` itself.

    Raises:
        ValueError: not a saved policy with its backbone, or no absolute path for a folder that will be moved.
        FileExistsError: the folder exists; nothing is overwritten.
    """
    saved = read_json(_config_file(policy))
    if not (policy / VLM_FOLDER).is_dir():
        name = saved.get("vlm_model_name")
        raise ValueError(f"{policy} has no folder {VLM_FOLDER}: its backbone {name!r} was not saved with it")
    if out and not any(kind(place).is_absolute() for kind in (PurePosixPath, PureWindowsPath)):
        raise ValueError(f"--for {place} is not an absolute path: give the one where the copy will be")
    folder = Path(out or place).absolute()
    if folder.exists():
        raise FileExistsError(f"{folder} exists already: a saved policy is never overwritten")
    with new_folder(folder) as draft:
        shutil.copytree(policy, draft, dirs_exist_ok=True)
        name_backbone(draft, f"{(place if out else str(folder)).rstrip('/')}/{VLM_FOLDER}")
    return folder
