"""Adapters: no effect at first, the only trainable parameters, merged when saved."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from safetensors.numpy import load_file

from fedvla_book import full_size, tables
from fedvla_lib.config import from_profile
from fedvla_lib.data import recordings, splits
from fedvla_lib.data.batches import Batches
from fedvla_lib.evaluation import held_out
from fedvla_lib.policy import actor, lora, model, training
from fedvla_lib.policy.parameters import trainable_arrays

pytestmark = pytest.mark.integration
RANK = 4


@pytest.fixture(scope="module")
def setup(recording):
    """Settings, held-out batch and training batches on the shared recording."""
    config = from_profile("tiny", data=str(recording), lora_rank=RANK, num_threads=1)
    store = recordings.open_frames(config)
    train_ids, val_ids = splits.split(store, config.val_fraction, config.seed)
    batch = held_out.held_out_batches(store, val_ids, config)[0]
    return config, batch, Batches(store, train_ids, config.chunk_size, config.batch_size, seed=0)


def chunk(bundle, batch):
    noise = actor.starting_noise(bundle, len(batch["task"]), torch.Generator().manual_seed(0))
    return bundle.postprocess(bundle.policy.predict_action_chunk(bundle.preprocess(dict(batch)), noise=noise))


def test_at_first_adapters_change_nothing_and_they_alone_train(setup):
    config, batch, _ = setup
    plain, adapted = model.load_policy(replace(config, lora_rank=0)), model.load_policy(config)
    torch.testing.assert_close(chunk(adapted, batch), chunk(plain, batch))
    arrays = trainable_arrays(adapted.policy)
    assert all(name.endswith((lora.A, lora.B)) for name in arrays)
    assert {array.shape[0] if name.endswith(lora.A) else array.shape[1] for name, array in arrays.items()} == {RANK}
    assert sum(a.size for a in arrays.values()) < 0.15 * sum(a.size for a in trainable_arrays(plain.policy).values())
    assert not any("state_proj" in name for name in arrays)  # a frame's prefix stays constant


def test_every_client_starts_with_the_same_adapters(setup):
    config, _, _ = setup
    one, other = (tables.adapters(model.load_policy(config).policy) for _ in range(2))
    assert all(np.array_equal(one[name], other[name]) for name in one)
    seeded = tables.adapters(model.load_policy(replace(config, seed=1)).policy)
    assert any(not np.array_equal(one[name], seeded[name]) for name in one)


@pytest.mark.parametrize("freeze_a", [False, True])
def test_training_moves_what_it_may_and_a_saved_policy_acts_the_same_without_adapters(setup, tmp_path, freeze_a):
    config, batch, batches = setup
    config = replace(config, lora_freeze_a=freeze_a)
    bundle = model.load_policy(config)
    before = {name: p.detach().clone() for name, p in bundle.policy.named_parameters()}
    training.local_train(bundle, batches, config, steps=3, progress=False)
    moved = {name for name, p in bundle.policy.named_parameters() if not torch.equal(p, before[name])}
    assert moved == set(trainable_arrays(bundle.policy))
    assert any(name.endswith(lora.A) for name in moved) != freeze_a
    model.save_policy(bundle, tmp_path / "saved")
    names = set(load_file(tmp_path / "saved" / "model.safetensors"))
    assert not any("lora" in name or "base_layer" in name for name in names)
    again = model.load_policy(replace(config, lora_rank=0, base=str(tmp_path / "saved")))
    torch.testing.assert_close(chunk(again, batch), chunk(bundle, batch), rtol=1e-4, atol=1e-3)
    assert any(name.endswith(lora.B) for name in trainable_arrays(bundle.policy))  # saving left the adapters in place


def test_averaging_a_and_b_apart_is_wrong_unless_a_is_shared():
    rng = np.random.default_rng(0)

    def client(a):
        return {"m" + lora.A: a.astype(np.float32), "m" + lora.B: rng.normal(size=(5, 2)).astype(np.float32)}

    alike = rng.normal(size=(2, 3))
    shared = [client(alike) for _ in range(3)]
    assert tables.averaging_error(shared, [0.5, 0.3, 0.2])["m"] < 1e-6
    one, other = client(rng.normal(size=(2, 3))), client(rng.normal(size=(2, 3)))
    products = [u["m" + lora.B] @ u["m" + lora.A] for u in (one, other)]
    right = (products[0] + products[1]) / 2
    apart = (one["m" + lora.B] + other["m" + lora.B]) / 2 @ (one["m" + lora.A] + other["m" + lora.A]) / 2
    expected = np.linalg.norm(right - apart) / np.linalg.norm(right)
    assert tables.averaging_error([one, other], [0.5, 0.5])["m"] == pytest.approx(expected, rel=1e-5)
    assert expected > 0.1


def test_the_full_model_has_the_published_number_of_trainable_parameters():
    policy = full_size.meta_policy()
    assert sum(p.numel() for p in policy.parameters()) == 450_046_176
    assert sum(int(np.prod(shape)) for shape in full_size.exchanged_shapes(policy).values()) == 99_880_992
    lora.add_adapters(policy, 16, adapt_state=True)
    assert sum(int(np.prod(shape)) for shape in full_size.exchanged_shapes(policy).values()) == 742_656
