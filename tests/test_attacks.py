"""The attacks of the chapter on privacy: they find what is there, find nothing where nothing is, and know chance."""

import json
from dataclasses import replace

import numpy as np
import pytest

from fedvla_book.attacks import membership, reconstruction, results, separation, traits
from fedvla_lib.config import from_profile
from fedvla_lib.data.batches import batch_of_rows
from fedvla_lib.experiments import methods
from fedvla_lib.federation.client import open_client
from fedvla_lib.policy.parameters import load_arrays, trainable_arrays
from fedvla_lib.robot.spec import CAMERAS, image_key

pytestmark = pytest.mark.unit


def test_a_trait_is_guessed_from_the_direction_of_an_update_whatever_its_length():
    rng = np.random.default_rng(0)
    common, kinds = rng.normal(size=5000), {name: rng.normal(size=5000) for name in "abc"}
    shadows = {name: [common + kind + rng.normal(size=5000) for _ in range(3)] for name, kind in kinds.items()}
    for name, kind in kinds.items():
        assert traits.guess(common + kind + rng.normal(size=5000), shadows) == name
        assert traits.guess(1.2 * (common + kind), shadows) == name
    noise = [traits.guess(100 * rng.normal(size=5000), shadows) for _ in range(300)]
    assert 0.2 < noise.count("a") / 300 < 0.5  # of three


def test_separation_is_measured_against_chance():
    rng = np.random.default_rng(1)
    same, apart = rng.normal(size=400), rng.normal(size=400) + 5
    assert separation.auc(same, rng.normal(size=400)) == pytest.approx(0.5, abs=0.06)
    assert separation.auc(apart, same) > 0.99
    assert separation.auc(np.array([1.0, 3.0]), np.array([2.0, 0.0])) == 0.75


def test_the_interval_of_an_area_covers_it_in_nineteen_of_twenty_samples():
    rng, true, covered = np.random.default_rng(2), 0.7602, 0  # two normal distributions, one apart by 1
    for _ in range(300):
        low, high = separation.auc_interval(rng.normal(size=40) + 1, rng.normal(size=40))
        covered += low <= true <= high
    assert 0.91 < covered / 300 < 0.985


@pytest.fixture(scope="module")
def tiny(recording, tmp_path_factory):
    out = str(tmp_path_factory.mktemp("outputs"))
    return from_profile("tiny", base="nano", data=str(recording), out=out, train_state_proj=True, warmup_steps=0)


def states(config):
    """The joint state read from one step of client 0, and those of the frames in it, in degrees."""
    bundle = methods.base(config)
    start, one = trainable_arrays(bundle.policy), open_client(replace(config, local_steps=1), 0)
    one.train(bundle, 1)
    change = {name: array - start[name] for name, array in trainable_arrays(bundle.policy).items()}
    read = reconstruction.joints_deg(bundle, reconstruction.normalised_state(change))
    return read, one.store.states[one.batches().rows_at(0)]


@pytest.mark.integration
def test_the_joint_state_is_read_from_one_frame_and_one_step_of_sgd_only(tiny):
    read, (true,) = states(replace(tiny, batch_size=1, local_optimizer="sgd"))
    np.testing.assert_allclose(read, true, atol=0.01)
    read, true = states(replace(tiny, batch_size=4, local_optimizer="sgd"))
    assert np.abs(read - true).max(axis=1).min() > 0.1
    read, (true,) = states(replace(tiny, batch_size=1))
    assert np.abs(read - true).max() > 1
    with pytest.raises(ValueError, match="is not exchanged"):
        states(replace(tiny, batch_size=1, local_optimizer="sgd", train_state_proj=False))


@pytest.mark.integration
def test_a_model_gives_away_the_demonstrations_that_it_was_trained_on(tiny):
    config = replace(tiny, num_clients=1, lr=2e-3, local_steps=60)
    bundle, one = methods.base(config), open_client(config, 0)
    asked = [*one.share.train_ids, *one.share.val_ids]
    before = membership.losses(bundle, one.store, asked, config.chunk_size, 0)
    assert np.array_equal(before, membership.losses(bundle, one.store, asked, config.chunk_size, 0))
    one.train(bundle, 1)
    scores = before - membership.losses(bundle, one.store, asked, config.chunk_size, 0)
    inside, outside = np.split(scores, [len(one.share.train_ids)])
    assert inside.mean() > outside.mean() and separation.auc(inside, outside) > 0.5


@pytest.mark.integration
def test_the_search_for_an_image_lowers_its_distance_in_gradients(tiny):
    bundle, one = methods.base(tiny), open_client(tiny, 0)
    batch = batch_of_rows(one.store, one.batches().rows_at(0)[:1], tiny.chunk_size)
    load_arrays(bundle.policy, trainable_arrays(bundle.policy))
    wanted = reconstruction.gradients(bundle, batch, 0)
    first, last = (reconstruction.search_images(bundle, batch, wanted, seed=0, steps=n) for n in (1, 12))
    assert last[1] > first[1]
    images = last[0][image_key(CAMERAS[0])]
    assert images.shape == batch[image_key(CAMERAS[0])].shape and 0 <= images.min() <= images.max() <= 1
    assert reconstruction.psnr_db(images, images + 0.1) == pytest.approx(20)


def stored(folder):
    """A file of attacks as the study writes it, with numbers that make its tables plain."""
    rows = []
    for noise in (0.0, 0.01, 0.1, 0.3):
        for saw in ("one update", "the mean of ten"):
            for trait, right in (("task", 10 if noise < 0.1 else 5), ("place", 4 if noise < 0.1 else 1)):
                rows.append({"attack": trait, "saw": saw, "steps": 40, "noise": noise, "right": right, "of": 10})
        scores = {"members": [2.0, 3.0, 4.0], "strangers": [0.0, 1.0, 2.5]}
        rows.append({"attack": "member", "saw": "one update", "round": 1, "demos": 2, "noise": noise, **scores})
    rows.append({"attack": "member", "saw": "the global model", "round": 1, "demos": 2, "noise": 0.0, **scores})
    rows += [{"attack": "state", "saw": saw, "case": "gradient", "blind_deg": 10.0, "error_deg": error}
             for saw, error in (("update", 0.001), ("update in 8 bits", None))]  # fmt: skip
    rows += [{"attack": "image", "saw": "gradient", "trained": "everything", "camera": "front", "cosine": 0.99,
              "psnr_db": 9.0, "blind_db": 14.0}]  # fmt: skip
    (folder / "seed_0.json").write_text(json.dumps({"rows": [{"seed": 0, **row} for row in rows]}))
    return results.read(folder)


def test_stored_attacks_become_tables(tmp_path):
    with pytest.raises(ValueError, match="has no attacks"):
        results.read(tmp_path)
    found = stored(tmp_path)
    lines = results.by_noise(found)
    assert lines.index.tolist() == [results.LOWEST, 0.01, 0.1, 0.3] and lines.iloc[0, 0] == 1.0
    read = {"update": 0.0, "update in 8 bits": "not possible", "blind": 10.0}
    assert results.states(found).loc["gradient"].to_dict() == read
    assert "9.0 dB" in results.images(found) and "0% of 1 images" in results.images(found)
    table = results.protections(found, lambda noise, rounds: 5 * rounds / noise, 1e-5)
    assert table["epsilon of 1 round, delta 1e-05"].tolist() == ["none", "500.0", "50.0", "16.7", "none", "0.0"]
    assert [name for name in table.index if "noise" in name] == [f"noise {z} of each lab" for z in (0.01, 0.1, 0.3)]
    assert table.loc["none", "task"].startswith("100%") and table.loc["sums only", "member (area)"].startswith("0.8")
    assert results.members(found).loc["one update", "asked"] == 6
