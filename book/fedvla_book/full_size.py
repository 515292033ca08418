"""The full-size SmolVLA without a download: its shapes without memory, and its files with random weights.

Sizes are those of SmolVLM2-500M-Video-Instruct, whose first 16 text layers SmolVLA uses (Shukor et al. 2025,
https://arxiv.org/abs/2506.01844, and the public configurations of both models).
"""

import contextlib
import io
import json
import tempfile
from pathlib import Path

import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies import make_pre_post_processors
from lerobot.policies.smolvla import SmolVLAConfig, SmolVLAPolicy
from safetensors.torch import save_file

from fedvla_lib.policy.nano import VLM_FOLDER, WEIGHTS_FILE, write_nano
from fedvla_lib.policy.parameters import Shapes, shapes_of, trainable
from fedvla_lib.robot.spec import ACTION_KEY, CAMERAS, NUM_JOINTS, STATE_KEY, image_key

BASE, BACKBONE = "lerobot/smolvla_base", "HuggingFaceTB/SmolVLM2-500M-Video-Instruct"
TENSORS = Path(__file__).with_name("smolvla_base_tensors.txt")
TYPES = {"F32": torch.float32, "BF16": torch.bfloat16}
REVISION = "0" * 40  # of a repository that was never published
BASE_IMAGES = {f"observation.{name}": (3, 256, 256) for name in ("image", "image2", "image3")}
IMAGE_SIZE = 512
TEXT = {
    "hidden_size": 960, "intermediate_size": 2560, "num_hidden_layers": 32, "num_attention_heads": 15,
    "num_key_value_heads": 5, "head_dim": 64, "vocab_size": 49280, "max_position_embeddings": 8192,
}  # fmt: skip
VISION = {
    "hidden_size": 768, "intermediate_size": 3072, "num_hidden_layers": 12, "num_attention_heads": 12,
    "image_size": IMAGE_SIZE, "patch_size": 16,
}  # fmt: skip


def meta_policy() -> SmolVLAPolicy:
    """Return LeRobot's full-size policy on PyTorch's meta device, which allocates no memory."""
    settings = SmolVLAConfig(load_vlm_weights=False, device="cpu")
    image = PolicyFeature(FeatureType.VISUAL, (3, IMAGE_SIZE, IMAGE_SIZE))
    settings.input_features = {image_key(camera): image for camera in CAMERAS}
    settings.input_features[STATE_KEY] = PolicyFeature(FeatureType.STATE, (NUM_JOINTS,))
    settings.output_features = {ACTION_KEY: PolicyFeature(FeatureType.ACTION, (NUM_JOINTS,))}
    with tempfile.TemporaryDirectory() as scratch, torch.device("meta"):
        settings.vlm_model_name = str(_backbone(Path(scratch) / "vlm"))
        with contextlib.redirect_stdout(io.StringIO()):  # LeRobot prints how many layers it drops
            return SmolVLAPolicy(settings)


def exchanged_shapes(policy: SmolVLAPolicy) -> Shapes:
    """Return the shapes of the trainable parameters by name."""
    return shapes_of(trainable(policy))


def published() -> dict[str, tuple[str, tuple[int, ...]]]:
    """Return type and shape of each tensor of smolvla_base, by name."""
    lines = [line.split() for line in TENSORS.read_text().splitlines() if not line.startswith("#")]
    return {name: (kind, tuple(map(int, shape.split("x")))) for name, kind, shape in lines}


def write_hub(cache: Path, seed: int = 0) -> None:
    """Write smolvla_base with random weights, and its backbone, where the hub's client looks for what it downloaded.

    The files have the names, the structure and, for the weights, the size of the published ones; the tokenizer is that
    of the nano model.

    Args:
        cache: ``$HF_HOME/hub``.
    """
    backbone, base = (_snapshot(cache, name) for name in (BACKBONE, BASE))
    write_backbone(backbone)
    write_base(base, backbone, seed)
    for file in ("config.json", "policy_preprocessor.json"):
        (base / file).write_text((base / file).read_text().replace(str(backbone), BACKBONE))


def write_folder(folder: Path, seed: int = 0) -> Path:
    """Write the same as one local folder, a value of `Config.base`."""
    write_backbone(folder / VLM_FOLDER)
    write_base(folder, folder / VLM_FOLDER, seed)
    return folder


def write_base(folder: Path, backbone: Path, seed: int) -> None:
    """Write weights, settings and processors of smolvla_base; norms are 1, other weights normal with deviation 0.02."""
    settings = SmolVLAConfig(vlm_model_name=str(backbone), device="cpu", train_state_proj=True)
    images = {key: PolicyFeature(FeatureType.VISUAL, shape) for key, shape in BASE_IMAGES.items()}
    settings.input_features = {STATE_KEY: PolicyFeature(FeatureType.STATE, (NUM_JOINTS,)), **images}
    settings.output_features = {ACTION_KEY: PolicyFeature(FeatureType.ACTION, (NUM_JOINTS,))}
    settings.save_pretrained(folder)
    unit = {"mean": torch.zeros(NUM_JOINTS), "std": torch.ones(NUM_JOINTS)}
    for part in make_pre_post_processors(settings, dataset_stats={STATE_KEY: unit, ACTION_KEY: unit}):
        part.save_pretrained(folder)
    rng = torch.Generator().manual_seed(seed)
    tensors = {name: _random(name, kind, shape, rng) for name, (kind, shape) in published().items()}
    save_file(tensors, folder / WEIGHTS_FILE)


def _random(name: str, kind: str, shape: tuple[int, ...], rng: torch.Generator) -> torch.Tensor:
    if "norm" in name and name.endswith("weight"):
        return torch.ones(shape, dtype=TYPES[kind])
    return torch.empty(shape, dtype=TYPES[kind]).normal_(std=0.02, generator=rng)


def _snapshot(cache: Path, repository: str) -> Path:
    """Make the folder of a downloaded repository's only revision."""
    root = cache / f"models--{repository.replace('/', '--')}"
    (root / "refs").mkdir(parents=True)
    (root / "refs" / "main").write_text(REVISION)
    folder = root / "snapshots" / REVISION
    folder.mkdir(parents=True)
    return folder


def write_backbone(folder: Path) -> None:
    """Write settings, tokenizer and processors of SmolVLM2-500M as the files of its repository, without its weights.

    Transformers 5 itself would write fewer files; those of the repository are older, and it has to read them.
    """
    _backbone(folder, type_="bfloat16")
    tokenizer, told, processors = (
        json.loads((folder / f"{name}.json").read_text())
        for name in ("tokenizer", "tokenizer_config", "processor_config")
    )
    marks = {key: told[key] for key in ("bos_token", "eos_token", "pad_token")}
    sizes = {"size": {"longest_edge": 2048}, "max_image_size": {"longest_edge": IMAGE_SIZE}}
    kind = {"processor_class": "SmolVLMProcessor"}
    files = {
        "preprocessor_config": processors["image_processor"] | sizes | kind,
        "processor_config": {"image_seq_len": 64, **kind},
        "tokenizer_config": {**told, "tokenizer_class": "GPT2Tokenizer", "model_max_length": 8192},
        "special_tokens_map": marks,
        "added_tokens": {token["content"]: token["id"] for token in tokenizer["added_tokens"]},
        "vocab": tokenizer["model"]["vocab"],
    }
    for name, content in files.items():
        (folder / f"{name}.json").write_text(json.dumps(content))
    merges = (" ".join(pair) if isinstance(pair, list) else pair for pair in tokenizer["model"]["merges"])
    (folder / "merges.txt").write_text("\n".join(["#version: 0.2", *merges]) + "\n")


def _backbone(folder: Path, type_: str = "float32") -> Path:
    """Write the nano backbone with the sizes of the large one; the tokenizer does not affect shapes."""
    write_nano(folder, 64)
    config = json.loads((folder / "config.json").read_text())
    config["text_config"] |= TEXT | {"torch_dtype": type_}
    config["vision_config"] |= VISION | {"torch_dtype": type_}
    config |= {"scale_factor": 4, "torch_dtype": type_}
    (folder / "config.json").write_text(json.dumps(config))
    return folder
