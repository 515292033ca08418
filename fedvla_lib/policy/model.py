"""Build or load a SmolVLA policy, select its trainable parameters, and save it.

The result is always LeRobot's own `SmolVLAPolicy` with LeRobot's processors. `Config.base` names the weights: the
pretrained nano model of this package (made by `pretraining.pretrain`), the same architecture with random weights, a
local `pretrained_model` folder, or a hub id such as ``lerobot/smolvla_base``.
"""

import contextlib
import io
import shutil
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from draccus.utils import DecodingError
from huggingface_hub.errors import HfHubHTTPError, HFValidationError, LocalEntryNotFoundError, OfflineModeIsEnabled
from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.policies import make_pre_post_processors
from lerobot.policies.smolvla import SmolVLAConfig, SmolVLAPolicy
from lerobot.processor import DeviceProcessorStep, NormalizerProcessorStep, TransitionKey, create_transition
from safetensors import SafetensorError, safe_open

from fedvla_lib.config import Config, granted_cores, split_names
from fedvla_lib.data.normalisation import Stats
from fedvla_lib.files import new_folder
from fedvla_lib.policy import lean_expert
from fedvla_lib.policy.gradient_checkpoints import recompute_activations
from fedvla_lib.policy.lora import add_adapters, merged
from fedvla_lib.policy.nano import NANO, NANO_RANDOM, VLM_FOLDER, WEIGHTS_FILE, ensure_nano, nano_base
from fedvla_lib.policy.parameters import Arrays, layer_of, trainable, trainable_arrays
from fedvla_lib.policy.portable import name_backbone
from fedvla_lib.robot.spec import ACTION_KEY, CAMERAS, NUM_JOINTS, STATE_KEY, image_key

UNREADABLE = (
    LocalEntryNotFoundError, OfflineModeIsEnabled, HfHubHTTPError, HFValidationError, OSError, DecodingError,
    SafetensorError,
)  # fmt: skip  # what LeRobot raises for a policy that is missing or damaged
POSITION_STD = 0.3  # standard deviation of the nano vision encoder's initial position embeddings
SMALL = 50_000_000  # parameters below which one thread is used; the nano policy has 2.4 million, SmolVLA 450


@dataclass(frozen=True)
class Bundle:
    """A policy with its processors, from raw batches to inputs and from outputs to joint targets."""

    policy: SmolVLAPolicy
    preprocess: Any  # raw batch (degrees, images in [0, 1], task text) -> normalised, tokenised tensors
    postprocess: Any  # normalised actions -> degrees and gripper 0-100
    own: Arrays = field(default_factory=dict)  # personal parameters, as they were when the policy was loaded

    @cached_property
    def is_lean(self) -> bool:
        """Whether the action expert can be trained by `lean_expert`."""
        return not lean_expert.refusal(self.policy)

    def normalise_actions(self, actions: torch.Tensor) -> torch.Tensor:
        """Return joint targets as the policy is trained on them: (B, chunk, 6) in degrees -> normalised."""
        transition = create_transition(action=actions)
        for step in self.preprocess.steps:
            if isinstance(step, DeviceProcessorStep | NormalizerProcessorStep):
                transition = step(transition)
        return transition[TransitionKey.ACTION]

    def shared(self) -> dict[str, torch.nn.Parameter]:
        """Return the trainable parameters that are not personal, by name (the live ones, not copies)."""
        return {name: p for name, p in trainable(self.policy).items() if name not in self.own}

    def shared_arrays(self) -> Arrays:
        """Return copies of the parameters that are exchanged, float32, by name."""
        return {name: array for name, array in trainable_arrays(self.policy).items() if name not in self.own}


def load_policy(config: Config, stats: Stats | None = None) -> Bundle:
    """Return the policy `config.base` in evaluation mode, with parameters frozen according to `config`.

    Args:
        stats: normalisation statistics of state and action. None or {}: use those saved with the base.

    Raises:
        ValueError: the base cannot be found or lacks weights, or there are no statistics.
    """
    if not stats and config.base == NANO_RANDOM:
        raise ValueError(f"base={NANO_RANDOM!r} has no statistics of its own: give those of the training episodes")
    source = str(nano_base()) if config.base == NANO else config.base
    policy = _random_nano(config) if source == NANO_RANDOM else _pretrained(config, source)
    use_threads(config, policy)
    if config.lora_rank:
        chosen = {"freeze_a": config.lora_freeze_a, "adapt_state": config.train_state_proj, "seed": config.seed}
        add_adapters(policy, config.lora_rank, **chosen)
    if config.gradient_checkpointing:
        recompute_activations(policy)
    policy.eval()
    return Bundle(policy, *_processors(policy, stats, source), _own(policy, split_names(config.personal)))


def use_threads(config: Config, policy: SmolVLAPolicy) -> None:
    """Set the number of torch threads of this process; the order of sums, and so their last bits, depends on it.

    At nano size a second thread barely speeds up a step, and makes it several times slower as soon as another process
    wants the core: there cores are for processes side by side.
    """
    small = sum(parameter.numel() for parameter in policy.parameters()) < SMALL
    torch.set_num_threads(config.num_threads or (1 if small else granted_cores()))


def uses_one_thread() -> bool:
    """Return whether torch computes on one thread in this process, as it does in worker processes."""
    return torch.get_num_threads() == 1


def _own(policy: SmolVLAPolicy, parts: list[str]) -> Arrays:
    """The arrays of the parts that stay on a client.

    Raises:
        ValueError: a part has no trainable parameter, or all parts are personal.
    """
    arrays = trainable_arrays(policy) if parts else {}
    valid = sorted({layer_of(name) for name in arrays})
    if unknown := [part for part in parts if part not in valid]:
        raise ValueError(f"personal={unknown[0]!r} is not a trainable part: choose from {', '.join(valid)}")
    if parts and set(parts) == set(valid):
        raise ValueError(f"personal={', '.join(parts)!r} leaves nothing to share: remove one of {', '.join(valid)}")
    return {name: array for name, array in arrays.items() if layer_of(name) in parts}


def save_policy(bundle: Bundle, folder: Path) -> None:
    """Write a LeRobot ``pretrained_model`` folder (config, safetensors, processors) atomically, with adapters merged.

    It names no path, so it can be moved; `portable` says how LeRobot's own commands load it.

    Raises:
        FileExistsError: `folder` exists; nothing is overwritten.
        OSError: it cannot be written; the message names it.
    """
    folder = Path(folder)
    if folder.exists():
        raise FileExistsError(f"{folder} exists already: a saved policy is never overwritten")
    with new_folder(folder) as draft:
        write_policy(bundle, draft)


def write_policy(bundle: Bundle, folder: Path) -> None:
    """Write the files of a ``pretrained_model`` folder into `folder`, an existing draft."""
    backbone = Path(bundle.policy.config.vlm_model_name)
    # Of a hub's bfloat16 backbone, LeRobot makes a policy of mixed types unless it loads that one's weights, too.
    bundle.policy.config.load_vlm_weights = not backbone.is_dir()
    for part in (merged(bundle.policy), bundle.preprocess, bundle.postprocess):
        part.save_pretrained(folder)
    if backbone.is_dir():
        shutil.copytree(backbone, folder / VLM_FOLDER)
        name_backbone(folder, VLM_FOLDER)


def _random_nano(config: Config) -> SmolVLAPolicy:
    """A nano policy with random weights that depend on the seed only."""
    settings = SmolVLAConfig(
        vlm_model_name=str(ensure_nano(config.image_size)),
        num_vlm_layers=0,  # 0 keeps all layers the backbone has
        resize_imgs_with_padding=(config.image_size, config.image_size),
        device=config.device,  # otherwise LeRobot looks for an accelerator and logs two warnings
    )
    _adapt(settings, config)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        policy = SmolVLAPolicy(settings)
        # At the default (0.02) a patch's position is drowned out by its content; with this the model learns to locate.
        embeddings = policy.model.vlm_with_expert.get_vlm_model().vision_model.embeddings
        torch.nn.init.normal_(embeddings.position_embedding.weight, std=POSITION_STD)
    return policy.to(config.device)


def _pretrained(config: Config, base: str) -> SmolVLAPolicy:
    try:
        settings = PreTrainedConfig.from_pretrained(base)
        if not isinstance(settings, SmolVLAConfig):
            raise ValueError(f"base={base!r} is a {settings.type!r} policy: give a smolvla one")
        _adapt(settings, config)
        settings.load_vlm_weights = False  # the policy's own file has them, fine-tuned
        if (Path(base) / VLM_FOLDER).is_dir():
            settings.vlm_model_name = str((Path(base) / VLM_FOLDER).resolve())
        with contextlib.redirect_stdout(io.StringIO()):  # LeRobot prints a line for each load
            policy = SmolVLAPolicy.from_pretrained(base, config=settings)
    except UNREADABLE as error:
        reason = str(error).strip().splitlines()[0][:160]
        raise ValueError(
            f"base={config.base!r} could not be loaded ({reason}): give {NANO!r}, {NANO_RANDOM!r}, a folder in "
            "LeRobot's pretrained_model format, or a hub id while the hub is reachable (unset HF_HUB_OFFLINE)"
        ) from error
    _require_all_weights(policy, base)
    return policy.float()  # the expert of smolvla_base is made in bfloat16, which rounds small updates away


def _require_all_weights(policy: SmolVLAPolicy, base: str) -> None:
    """Raise ValueError for missing tensors, which LeRobot only logs and leaves random."""
    file = Path(base) / WEIGHTS_FILE
    if not file.is_file():
        return  # from the hub cache, whose layout only LeRobot knows
    with safe_open(file, "pt") as weights:
        missing = sorted(set(policy.state_dict()) - set(weights.keys()))
    if missing:
        raise ValueError(f"{file} lacks {len(missing)} tensors of the policy, the first is {missing[0]!r}")


def _adapt(settings: SmolVLAConfig, config: Config) -> None:
    """Set cameras, sizes, chunk, device and frozen parts from the run's settings."""
    shape = (3, config.image_size, config.image_size)
    settings.input_features = {image_key(camera): PolicyFeature(FeatureType.VISUAL, shape) for camera in CAMERAS}
    settings.input_features[STATE_KEY] = PolicyFeature(FeatureType.STATE, (NUM_JOINTS,))
    settings.output_features = {ACTION_KEY: PolicyFeature(FeatureType.ACTION, (NUM_JOINTS,))}
    same = ("chunk_size", "n_action_steps", "freeze_vision_encoder", "train_expert_only", "train_state_proj", "device")
    for name in same:
        setattr(settings, name, getattr(config, name))


def _processors(policy: SmolVLAPolicy, stats: Stats | None, base: str) -> tuple[Any, Any]:
    if stats:
        return make_pre_post_processors(policy.config, dataset_stats=_as_tensors(stats))
    overrides = {
        "device_processor": {"device": str(policy.config.device)},
        "tokenizer_processor": {"tokenizer_name": policy.config.vlm_model_name},
    }
    return make_pre_post_processors(policy.config, pretrained_path=base, preprocessor_overrides=overrides)


def _as_tensors(stats: Stats) -> dict[str, dict[str, torch.Tensor]]:
    """Statistics as tensors; a missing key is an error, since LeRobot would silently skip normalisation."""
    for key in (STATE_KEY, ACTION_KEY):
        if not {"mean", "std"} <= set(stats.get(key, ())):
            raise ValueError(f"statistics lack mean and std of {key!r}: got {sorted(stats)}")
    return {
        key: {name: torch.as_tensor(np.asarray(value), dtype=torch.float32) for name, value in feature.items()}
        for key, feature in stats.items()
    }
