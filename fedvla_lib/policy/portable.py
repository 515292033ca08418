"""Where a saved nano policy says that its backbone is, so that the folder can be copied, renamed and uploaded.

A ``pretrained_model`` folder holds the backbone's config and tokenizer in ``vlm``, and two of its files name it.
LeRobot 0.6.1 passes that name to transformers as it stands, without the folder that it was read from, and transformers
looks for a relative name in the working directory, then on the hub (`cached_files` in ``transformers/utils/hub.py``).
So a saved policy names ``vlm``: this library finds it wherever the folder is, LeRobot's commands from inside it.
`export` writes the copy that they load from any working directory, which has to name the place where it will be.
"""

import json
import shutil
from pathlib import Path, PurePosixPath, PureWindowsPath

from fedvla_lib.files import new_folder, write_json
from fedvla_lib.policy.nano import VLM_FOLDER

CONFIG_FILE, PREPROCESSOR_FILE = "config.json", "policy_preprocessor.json"


def name_backbone(folder: Path, name: str) -> None:
    """Write `name` as the backbone's into the files of a saved policy that mention it."""
    config, preprocessor = (json.loads((folder / file).read_text()) for file in (CONFIG_FILE, PREPROCESSOR_FILE))
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
    if not (policy / CONFIG_FILE).is_file():
        raise ValueError(f"{policy} is not a pretrained_model folder: it has no {CONFIG_FILE}")
    if not (policy / VLM_FOLDER).is_dir():
        name = json.loads((policy / CONFIG_FILE).read_text()).get("vlm_model_name")
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
