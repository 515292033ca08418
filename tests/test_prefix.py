"""Training on stored prefixes: same loss, gradients and weights; used only where prefixes are constant."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from fedvla_lib.config import from_profile
from fedvla_lib.data import normalisation
from fedvla_lib.data.batches import Batches
from fedvla_lib.data.frame_store import open_store
from fedvla_lib.evaluation import held_out
from fedvla_lib.policy import model, prefix_cache, training
from fedvla_lib.policy.actor import starting_noise
from fedvla_lib.policy.parameters import trainable
from fedvla_lib.robot.spec import ACTION_KEY, CAMERAS, STATE_KEY, image_key

CONFIG = from_profile("tiny", base="nano-random", num_threads=1)


def fresh(store, config=CONFIG):
    return model.load_policy(config, normalisation.episode_stats(store, store.episodes.episode_id))


def batches_of(store, augment=False):
    ids = list(store.episodes.episode_id)
    return Batches(store, ids, CONFIG.chunk_size, CONFIG.batch_size, seed=1, augment=augment)


@pytest.mark.unit
def test_loss_and_gradients_equal_the_policys_own(store):
    bundle = fresh(store)
    bundle.policy.train()
    batches = batches_of(store)
    stored = prefix_cache.with_cached_prefixes(bundle, batches)
    for step in range(3):
        batch = batches.at(step)
        noise = torch.randn(CONFIG.batch_size, CONFIG.chunk_size, 32)
        times = torch.rand(CONFIG.batch_size)
        expected, _ = bundle.policy.forward(bundle.preprocess(batch), noise=noise, time=times)
        trained = list(trainable(bundle.policy).values())
        wanted = torch.autograd.grad(expected, trained)
        actual = prefix_cache.prefix_loss(bundle, stored.at(step), noise, times)
        assert actual.item() == pytest.approx(expected.item(), rel=1e-6)
        for left, right in zip(wanted, torch.autograd.grad(actual, trained), strict=True):
            torch.testing.assert_close(left, right, rtol=1e-4, atol=1e-6)


@pytest.mark.unit
def test_training_on_stored_prefixes_gives_the_same_losses_and_weights(store):
    results = []
    for kind in (lambda _, b: b, prefix_cache.with_cached_prefixes):
        bundle = fresh(store)
        result = training.local_train(bundle, kind(bundle, batches_of(store)), CONFIG, steps=4, progress=False)
        results.append((result.losses, {n: p.detach() for n, p in bundle.policy.named_parameters()}))
    np.testing.assert_allclose(results[0][0], results[1][0], rtol=1e-5)
    for name, weight in results[0][1].items():
        torch.testing.assert_close(weight, results[1][1][name], rtol=1e-3, atol=1e-5)


@pytest.mark.unit
def test_nothing_is_stored_where_the_prefix_changes(store):
    for config in (
        replace(CONFIG, train_state_proj=True),
        replace(CONFIG, train_expert_only=False),
        replace(CONFIG, freeze_vision_encoder=False, train_expert_only=False),
    ):
        batches = batches_of(store)
        assert prefix_cache.with_cached_prefixes(fresh(store, config), batches) is batches
    augmented = batches_of(store, augment=True)
    assert prefix_cache.with_cached_prefixes(fresh(store), augmented) is augmented


@pytest.mark.unit
def test_another_model_or_normalisation_gets_prefixes_of_its_own(store, tmp_path):
    def folders():
        return [path for path in tmp_path.iterdir() if path.is_dir()]

    first = prefix_cache.ensure_prefixes(fresh(store), store, folder=tmp_path)
    again = prefix_cache.ensure_prefixes(fresh(store), store, folder=tmp_path)
    np.testing.assert_array_equal(first.cache, again.cache)
    assert len(folders()) == 1
    prefix_cache.ensure_prefixes(fresh(store, replace(CONFIG, seed=1)), store, folder=tmp_path)
    stats = normalisation.episode_stats(store, store.episodes.episode_id)
    stats[STATE_KEY]["mean"] = stats[STATE_KEY]["mean"] + 1
    prefix_cache.ensure_prefixes(model.load_policy(CONFIG, stats), store, folder=tmp_path)
    prefix_cache.ensure_prefixes(fresh(store, replace(CONFIG, lora_rank=2)), store, folder=tmp_path)  # as the first
    assert len(folders()) == 3


@pytest.mark.unit
def test_other_cameras_of_the_same_data_get_prefixes_of_their_own(recording, store, tmp_path):
    one, other = CAMERAS
    names = {one: (other,), other: (one,)}
    exchanged = open_store(recording, image_size=CONFIG.image_size, cameras=names, progress=False)
    np.testing.assert_array_equal(exchanged.states, store.states)
    bundle = fresh(store)
    found = [prefix_cache.ensure_prefixes(bundle, each, folder=tmp_path).cache for each in (store, exchanged)]
    assert not np.array_equal(*found)


@pytest.mark.unit
@pytest.mark.parametrize("settings", [{}, {"train_expert_only": False}, {"lora_rank": 2}], ids=str)
def test_held_out_frames_are_measured_as_the_policys_own_methods_would(store, settings):
    """From stored prefixes where they are constant; in any order of episodes."""
    config = replace(CONFIG, **settings)
    bundle, ids = fresh(store, config), list(store.episodes.episode_id)[::-1]
    batches = held_out.held_out_batches(store, ids, config, bundle)
    assert (prefix_cache.PREFIX_KEY in batches[0]) == prefix_cache.is_constant(bundle.policy)
    measured = held_out.measure_frames(bundle, batches, tolerance=5.0, seed=3)
    rng, losses, errors = torch.Generator().manual_seed(3), [], []
    for batch in held_out.held_out_batches(store, ids, config):
        noise, size = starting_noise(bundle, len(batch["task"]), rng), len(batch["task"])
        times, inputs = (torch.randperm(size, generator=rng) + 0.5) / size, bundle.preprocess(dict(batch))
        losses.append(bundle.policy.forward(inputs, noise=noise, time=times, reduction="none")[0].detach())
        chunks = bundle.policy.predict_action_chunk(inputs, noise=starting_noise(bundle, size, rng))
        valid = ~batch["action_is_pad"][..., None]
        wrong = (bundle.postprocess(chunks) - batch[ACTION_KEY]).abs() * valid
        errors.append(wrong.sum((1, 2)) / (6 * valid.sum((1, 2))))
    np.testing.assert_allclose(measured["loss"], torch.cat(losses), rtol=1e-5)
    np.testing.assert_allclose(measured["action_error"], torch.cat(errors), rtol=1e-4)


@pytest.mark.unit
def test_stored_batches_hold_no_images(store):
    batch = prefix_cache.with_cached_prefixes(fresh(store), batches_of(store)).at(0)
    assert not any(image_key(camera) in batch for camera in CAMERAS)
    assert batch[prefix_cache.PREFIX_KEY][1].shape[0] == CONFIG.batch_size
