"""Grounding: the scenes show what their answers say, and a model that learns from them points at what is named."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from fedvla_lib.policy import model
from fedvla_lib.policy.training import Objective, local_train
from fedvla_lib.pretraining import grounding, pretrain
from fedvla_lib.pretraining.recipe import Recipe
from fedvla_lib.pretraining.scenes import OBJECTS, draw_scenes
from fedvla_lib.robot.spec import ACTION_KEY, CAMERAS, STATE_KEY
from fedvla_lib.robot.tasks import ALL_TASKS

pytestmark = pytest.mark.integration
SMALL = Recipe(scenes=24, image_size=64, batch_size=8, grounding_steps=2, checkpoint_every=0)
IDENTITY = {key: {"mean": np.zeros(6), "std": np.ones(6)} for key in (STATE_KEY, ACTION_KEY)}


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scenery") / "scenes"
    return draw_scenes(folder, SMALL.scenes, image_size=64, seed=3, jitter=1.0, progress=False)


@pytest.fixture
def bundle():
    config = pretrain.settings(SMALL)
    return model.load_policy(
        replace(config, freeze_vision_encoder=False, train_expert_only=False, train_state_proj=True), IDENTITY
    )


def test_what_is_drawn_at_a_things_place_has_its_colour(scenes):
    channel = {"red cube": 0, "green cube": 1, "blue cube": 2}
    seen = right = 0
    for row in range(SMALL.scenes):
        for camera, name in enumerate(CAMERAS):
            for obj, strongest in channel.items():
                share = scenes.shares[row, camera, OBJECTS.index(obj)]
                if np.isfinite(share).all() and (share >= 0).all() and (share < 1).all():
                    across, down = (share * 64).astype(int)
                    seen += 1
                    right += int(scenes.images[name][row, down, across].argmax() == strongest)
    assert seen > SMALL.scenes and right / seen > 0.8  # the arm hides some


def test_scenes_vary_and_are_drawn_once(scenes, tmp_path):
    there = np.isfinite(scenes.places_m[..., 0])
    assert set(there[:, :3].sum(axis=1)) == {1, 2} and set(there[:, 3:].sum(axis=1)) == {0, 1, 2}
    again = draw_scenes(tmp_path / "again", SMALL.scenes, image_size=64, seed=3, jitter=1.0, progress=False)
    assert all(np.array_equal(again.images[camera], scenes.images[camera]) for camera in CAMERAS)
    np.testing.assert_array_equal(again.places_m, scenes.places_m)
    kept = draw_scenes(tmp_path / "again", 2, image_size=64, seed=9, jitter=0.0, progress=False)
    assert len(kept.places_m) == SMALL.scenes  # what is there is not drawn again


def test_a_sentence_names_what_is_there_and_says_where_in_it():
    rng = np.random.default_rng(0)
    for _ in range(50):
        there = rng.permutation(len(OBJECTS))[: rng.integers(1, 5)]
        text, phrases = grounding.sentence(there, rng)
        assert 1 <= len(phrases) <= grounding.MOST_NAMED
        assert {obj for obj, _, _ in phrases} <= set(there)
        assert all(text[start:end] == OBJECTS[obj] for obj, start, end in phrases)


def test_no_sentence_is_one_of_a_task():
    verbs = {wording.split()[0] for task in ALL_TASKS.values() for wording in task.wordings}
    assert not verbs & {opening.strip().split(" ")[0] for opening in grounding.OPENINGS}


def test_things_are_marked_in_their_cells():
    shares = np.full((1, 1, 2, 2), np.nan)
    shares[0, 0, 1] = (0.8, 0.3)  # right, upper half
    np.testing.assert_array_equal(grounding.in_cells(shares, 2)[0], [[0, 0], [0, 1], [0, 0], [0, 0]])
    assert not grounding.in_cells(shares + 0.25, 2).any()  # now outside the image


def test_the_tokens_of_a_phrase_spell_it(scenes, bundle):
    questions = grounding.Questions(scenes, bundle, 8, seed=1)
    batch = questions.at(0)
    tokens = bundle.preprocess({key: batch[key] for key in (STATE_KEY, "task")})["observation.language.tokens"]
    spell = bundle.policy.model.vlm_with_expert.processor.tokenizer.decode
    for row in range(8):
        for obj in set(batch["named"][batch["named"][:, 0] == row, 2].tolist()):
            mine = (batch["named"][:, 0] == row) & (batch["named"][:, 2] == obj)
            assert spell(tokens[row, batch["named"][mine, 1]]).strip() == OBJECTS[obj]
    assert torch.equal(questions.at(4)["named"], questions.at(4)["named"])


def test_training_lowers_the_error_and_moves_what_sees_only(scenes, bundle):
    batch = grounding.Questions(scenes, bundle, 8, seed=1).plain(np.arange(8))
    before = {name: p.detach().clone() for name, p in bundle.policy.named_parameters()}
    with grounding.probing(bundle, seed=0):
        first = grounding.grounding_loss(bundle, batch).item()
        local_train(bundle, _Same(batch), replace(pretrain.settings(SMALL), warmup_steps=1), steps=30,
                    progress=False, objective=Objective(grounding.grounding_loss))  # fmt: skip
        assert grounding.grounding_loss(bundle, batch).item() < 0.7 * first
    after = dict(bundle.policy.named_parameters())
    assert after.keys() == before.keys()  # the probes are gone
    moved = {name for name in before if not torch.equal(before[name], after[name])}
    assert moved and all("vlm_with_expert.vlm." in name for name in moved)


class _Same:
    """The same batch at every step."""

    seed, num_examples = 0, 8

    def __init__(self, batch):
        self._batch = batch

    def at(self, step):
        return self._batch
