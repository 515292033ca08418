"""The full-size model: the published tensors, a walk through the profile `gpu`, and what saves memory on a card."""

import json
import math
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from fedvla_book import full_size
from fedvla_lib.config import PROFILES, from_profile
from fedvla_lib.data.normalisation import episode_stats
from fedvla_lib.federation.client import open_client
from fedvla_lib.policy import model
from fedvla_lib.policy.parameters import digest, shapes_of, trainable
from fedvla_lib.policy.training import flow_loss

PUBLISHED_BYTES = 906_712_520  # of smolvla_base's model.safetensors
WALK = Path(__file__).with_name("full_size_walk.py")


@pytest.mark.unit
def test_lerobots_policy_has_the_tensors_of_the_published_one():
    """A name or a shape that LeRobot changes is found here, and not on somebody's GPU."""
    listed = {name: shape for name, (_, shape) in full_size.published().items()}
    assert shapes_of(full_size.meta_policy().state_dict()) == listed and len(listed) == 500


@pytest.mark.unit
def test_a_file_of_these_tensors_is_as_long_as_the_published_one():
    """Names, types and shapes decide the length of a safetensors file, to the byte."""
    tensors, begin, header = full_size.published(), 0, {}
    sizes = {"F32": 4, "BF16": 2}
    for name in sorted(tensors, key=lambda name: (-sizes[tensors[name][0]], name)):
        kind, shape = tensors[name]
        end = begin + sizes[kind] * math.prod(shape)
        header[name] = {"dtype": kind, "shape": shape, "data_offsets": [begin, end]}
        begin = end
    length = len(json.dumps(header, separators=(",", ":")))
    assert 8 + length + -length % 8 + begin == PUBLISHED_BYTES


def walk(device, tmp_path):
    """Print what the walk prints; the hub's client reads where its cache is when it is imported."""
    full_size.write_hub(tmp_path / "home" / "hub")
    (weights,) = (tmp_path / "home" / "hub").glob("models--lerobot*/snapshots/*/model.safetensors")
    assert weights.stat().st_size == PUBLISHED_BYTES
    environment = {**os.environ, "HF_HOME": str(tmp_path / "home"), "HF_HUB_OFFLINE": "1", "OMP_NUM_THREADS": "2"}
    environment.pop("HF_HUB_CACHE", None)
    command = [sys.executable, WALK, device, tmp_path]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=3600)
    print(done.stdout)
    assert done.returncode == 0 and "walked" in done.stdout, done.stderr[-3000:]


@pytest.mark.slow
@pytest.mark.full_size
def test_the_gpu_profile_is_walked_on_the_cpu(tmp_path):
    walk("cpu", tmp_path)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_the_gpu_profile_is_walked_on_a_card(tmp_path):
    walk("cuda", tmp_path)


def trained(config, store):
    """Return the losses of two steps, and the policy after them."""
    bundle = model.load_policy(config, episode_stats(store, [0, 1]))
    return open_client(config, 0).train(bundle, 1).losses, bundle


def kept(config, bundle):
    """Return how many numbers, beside the weights, the policy keeps for the backward pass of a batch."""
    weights, sizes = {p.untyped_storage().data_ptr() for p in bundle.policy.parameters()}, {}

    def pack(tensor):
        sizes[tensor.untyped_storage().data_ptr()] = tensor.untyped_storage().nbytes() // tensor.element_size()
        return tensor

    bundle.policy.train()
    with torch.autograd.graph.saved_tensors_hooks(pack, lambda tensor: tensor):
        loss = flow_loss(bundle, open_client(config, 0).batches().at(0))
    assert loss.requires_grad
    return sum(size for pointer, size in sizes.items() if pointer not in weights)


@pytest.fixture
def tiny(recording):
    """Two steps through LeRobot's own pass: augmented images leave no prefix to cache."""
    return from_profile("tiny", base="nano", data=str(recording), augment=True, train_state_proj=True)


@pytest.mark.integration
@pytest.mark.parametrize("kind", [{}, {"lora_rank": 4}, {"train_expert_only": False, "freeze_vision_encoder": False}])
def test_gradient_checkpointing_trains_the_same_and_keeps_less(kind, tiny, store):
    config = replace(tiny, **kind)
    losses, bundle = trained(config, store)
    again, lighter = trained(saving := replace(config, gradient_checkpointing=True), store)
    assert again == losses and digest(lighter.shared_arrays()) == digest(bundle.shared_arrays())
    assert kept(saving, lighter) < 0.6 * kept(config, bundle)


@pytest.mark.integration
@pytest.mark.parametrize("augment", [True, False])
def test_mixed_precision_trains_nearly_the_same_and_exchanges_float32(augment, tiny, store):
    """Without augmentation and state projection, prefixes are cached and the expert trains on them."""
    config = replace(tiny, augment=augment, train_state_proj=augment)
    losses, bundle = trained(config, store)
    near, mixed = trained(replace(config, mixed_precision=True), store)
    assert near != losses and near == pytest.approx(losses, rel=0.02)
    assert {p.dtype for p in trainable(mixed.policy).values()} == {torch.float32}
    assert digest(mixed.shared_arrays()) != digest(bundle.shared_arrays())


@pytest.mark.unit
def test_the_gpu_profile_uses_the_card_and_mixed_precision():
    assert PROFILES["gpu"]["mixed_precision"] and PROFILES["gpu"]["device"] == "cuda"


@pytest.mark.integration
def test_lerobot_is_told_to_load_the_weights_of_a_backbone_on_the_hub(tmp_path):
    """Without them it would make parts of the policy in bfloat16 and others in float32, which cannot be computed."""
    bundle = model.load_policy(from_profile("tiny"))
    for backbone in (bundle.policy.config.vlm_model_name, full_size.BACKBONE):
        bundle.policy.config.vlm_model_name = backbone
        model.save_policy(bundle, tmp_path / backbone.replace("/", "-"))
    own, hub = (json.loads(file.read_text()) for file in sorted(tmp_path.glob("*/config.json")))
    saved = {one["vlm_model_name"]: one["load_vlm_weights"] for one in (own, hub)}
    assert saved.pop(full_size.BACKBONE) and list(saved.values()) == [False]
