"""Shapes of the full-size SmolVLA without its weights, to compute what a client would send without a download.

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
from lerobot.policies.smolvla import SmolVLAConfig, SmolVLAPolicy

from fedvla_lib.policy.nano import write_nano
from fedvla_lib.policy.parameters import Shapes, shapes_of, trainable
from fedvla_lib.robot.spec import ACTION_KEY, CAMERAS, NUM_JOINTS, STATE_KEY, image_key

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


def _backbone(folder: Path) -> Path:
    """Write the nano backbone with the sizes of the large one; the tokenizer does not affect shapes."""
    write_nano(folder, 64)
    config = json.loads((folder / "config.json").read_text())
    config["text_config"] |= TEXT
    config["vision_config"] |= VISION
    config["scale_factor"] = 4
    (folder / "config.json").write_text(json.dumps(config))
    return folder
