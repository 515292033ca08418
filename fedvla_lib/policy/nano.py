"""The nano vision-language backbone: a folder that LeRobot's unmodified `SmolVLAPolicy` accepts as `vlm_model_name`.

It has the parts of SmolVLM2 (SigLIP-style vision tower, pixel-shuffle connector, Llama-style text model, BPE tokenizer
with SmolVLM's special tokens) at width 128, with random weights. Also finds the pretrained nano base of this package.
"""

import hashlib
import json
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from urllib.parse import urlsplit
from urllib.request import url2pathname

from tokenizers import Tokenizer, decoders, models, pre_tokenizers, trainers
from transformers import PreTrainedTokenizerFast, SmolVLMConfig, SmolVLMImageProcessor, SmolVLMProcessor
from transformers.models.smolvlm.video_processing_smolvlm import SmolVLMVideoProcessor

from fedvla_lib.files import cache_dir, new_folder

PACKAGE = "fedvla-lib"
NANO, NANO_RANDOM = "nano", "nano-random"  # values of Config.base
WEIGHTS_FILE = "model.safetensors"
WIDTH, TEXT_LAYERS, VISION_LAYERS = 128, 4, 3
PATCHES_PER_SIDE = 8  # the patch size scales with the image size, so compute is constant
CONNECTOR_SCALE = 2  # pixel shuffle merges 2 x 2 patches into one token: 16 tokens per camera
VOCAB_SIZE = 384
SPECIAL_TOKENS = [
    "<|im_start|>", "<|im_end|>", "<fake_token_around_image>", "<image>", "<global-img>", "<end_of_utterance>",
]  # fmt: skip
# The tokenizer learns its merges from these sentences; other bytes can still be encoded, but take more tokens.
CORPUS = [
    f"{verb} the {color} {thing}."
    for verb in ("Lift", "Put", "Push", "Pick up", "Move", "Stack", "Sort", "Slide", "Place")
    for color in ("red", "green", "blue", "yellow", "white", "black", "orange")
    for thing in ("cube", "cube into the zone", "cube in the bin", "block on the table", "cube on the left", "right")
]


def ensure_nano(image_size: int) -> Path:
    """Return the cached folder of the nano backbone for `image_size` pixels, written if missing; see `write_nano`."""
    folder = cache_dir() / f"nano-vlm-{image_size}"
    if not (folder / "config.json").exists():
        with new_folder(folder) as draft:
            write_nano(draft, image_size)
    return folder


def write_nano(folder: Path, image_size: int) -> None:
    """Write config, tokenizer and processors of the nano backbone; ValueError unless patches fill `image_size`."""
    if image_size % PATCHES_PER_SIDE:
        raise ValueError(f"image_size={image_size} is not usable: give a multiple of {PATCHES_PER_SIDE} pixels")
    tokenizer = _tokenizer()
    _config(image_size, tokenizer).save_pretrained(folder)
    sizes = dict.fromkeys(("size", "max_image_size"), {"longest_edge": image_size})
    images, video = SmolVLMImageProcessor(**sizes), SmolVLMVideoProcessor(**sizes)
    tokens = (PATCHES_PER_SIDE // CONNECTOR_SCALE) ** 2
    SmolVLMProcessor(images, tokenizer, video_processor=video, image_seq_len=tokens).save_pretrained(folder)


def _config(image_size: int, tokenizer: PreTrainedTokenizerFast) -> SmolVLMConfig:
    widths = {"hidden_size": WIDTH, "intermediate_size": 2 * WIDTH, "num_attention_heads": 4}
    vision = widths | {
        "num_hidden_layers": VISION_LAYERS, "image_size": image_size, "patch_size": image_size // PATCHES_PER_SIDE,
    }  # fmt: skip
    text = widths | {
        "model_type": "llama", "num_hidden_layers": TEXT_LAYERS, "num_key_value_heads": 2, "head_dim": WIDTH // 4,
        "vocab_size": len(tokenizer), "max_position_embeddings": 512, "pad_token_id": tokenizer.pad_token_id,
    }  # fmt: skip
    return SmolVLMConfig(
        vision_config=vision, text_config=text, scale_factor=CONNECTOR_SCALE, pad_token_id=tokenizer.pad_token_id,
        image_token_id=tokenizer.convert_tokens_to_ids("<image>"),
    )  # fmt: skip


def _tokenizer() -> PreTrainedTokenizerFast:
    bpe = Tokenizer(models.BPE())
    bpe.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False)
    bpe.decoder = decoders.ByteLevel()
    trainer = trainers.BpeTrainer(
        vocab_size=VOCAB_SIZE, special_tokens=SPECIAL_TOKENS, show_progress=False,
        initial_alphabet=pre_tokenizers.ByteLevel.alphabet(),
    )  # fmt: skip
    bpe.train_from_iterator(CORPUS, trainer)
    return PreTrainedTokenizerFast(
        tokenizer_object=bpe, bos_token="<|im_start|>", eos_token="<|im_end|>", pad_token="<|im_end|>",
        extra_special_tokens={
            "fake_image_token": "<fake_token_around_image>", "image_token": "<image>",
            "global_image_token": "<global-img>", "end_of_utterance_token": "<end_of_utterance>",
        },
    )  # fmt: skip


def nano_base() -> Path:
    """Return the folder of the pretrained nano model; raise ValueError if it is in neither of two places.

    Flower's app bundle contains no weights; code running from a bundle finds them in the installed package.
    """
    for package in (Path(__file__).parents[1], *_installed()):
        if (package / "nano_base" / WEIGHTS_FILE).is_file():
            return package / "nano_base"
    raise ValueError(
        f"base={NANO!r} was not found and the package {PACKAGE} is not installed: install it on every machine of the "
        "federation, or give another base"
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
