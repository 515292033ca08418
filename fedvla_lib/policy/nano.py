"""The nano vision-language backbone: a folder that LeRobot's unmodified `SmolVLAPolicy` accepts as `vlm_model_name`.

It has the parts of SmolVLM2 (SigLIP-style vision tower, pixel-shuffle connector, Llama-style text model, BPE tokenizer
with SmolVLM's special tokens) at width 128. Also finds the pretrained nano base of this package.
"""

import hashlib
import json
import shutil
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from urllib.parse import urlsplit
from urllib.request import url2pathname

from fedvla_lib.files import cache_dir, new_folder, write_json

PACKAGE = "fedvla-lib"
NANO, NANO_RANDOM = "nano", "nano-random"  # values of Config.base
WEIGHTS_FILE = "model.safetensors"
VLM_FOLDER = "vlm"  # a saved nano policy includes its backbone's config and tokenizer, so the folder can be moved
PATCHES_PER_SIDE = 8  # the patch size scales with the image size, so compute is constant


def ensure_nano(image_size: int) -> Path:
    """Return the cached folder of the nano backbone for `image_size` pixels, written if missing; see `write_nano`."""
    folder = cache_dir() / f"nano-vlm-{image_size}"
    if not (folder / "config.json").exists():
        with new_folder(folder) as draft:
            write_nano(draft, image_size)
    return folder


def write_nano(folder: Path, image_size: int) -> None:
    """Write config, tokenizer and processors of the nano base's backbone, adapted to the size of the images.

    Raises:
        ValueError: patches do not fill `image_size`.
    """
    if image_size % PATCHES_PER_SIDE:
        raise ValueError(f"image_size={image_size} is not usable: give a multiple of {PATCHES_PER_SIDE} pixels")
    shutil.copytree(nano_base() / VLM_FOLDER, folder, dirs_exist_ok=True)
    config, processors = (json.loads((folder / f"{name}config.json").read_text()) for name in ("", "processor_"))
    config["vision_config"] |= {"image_size": image_size, "patch_size": image_size // PATCHES_PER_SIDE}
    for kind in ("image_processor", "video_processor"):
        processors[kind] |= dict.fromkeys(("size", "max_image_size"), {"longest_edge": image_size})
    write_json(folder / "config.json", config)
    write_json(folder / "processor_config.json", processors)


def nano_base() -> Path:
    """Return the folder of the pretrained nano model; raise ValueError if it is in neither of two places.

    Flower's app bundle contains no weights; code running from a bundle finds them in the installed package.
    """
    for package in (Path(__file__).parents[1], *_installed()):
        if (package / "nano_base" / WEIGHTS_FILE).is_file():
            return package / "nano_base"
    raise ValueError(
        f"the files of the nano base were not found and the package {PACKAGE} is not installed: install it on every "
        "machine of the federation, or give another base"
    )


def _installed() -> list[Path]:
    """Possible folders of the installed package: in site-packages, or the checkout of an editable installation."""
    try:
        package = distribution(PACKAGE)
    except PackageNotFoundError:
        return []
    source = json.loads(package.read_text("direct_url.json") or "{}").get("url", "")
    folders = [Path(str(package.locate_file("fedvla_lib")))]
    return folders + ([Path(url2pathname(urlsplit(source).path)) / "fedvla_lib"] if source.startswith("file:") else [])


def base_digest(base: str) -> str:
    """Return a short hash of a base's weights, or its name if they are not in a local folder."""
    file = (nano_base() if base == NANO else Path(base)) / WEIGHTS_FILE
    return hashlib.sha256(file.read_bytes()).hexdigest()[:12] if file.is_file() else base
