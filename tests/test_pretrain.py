"""The nano base: reproducible by one command, trained on none of the clients' tasks, complete in the package."""

import json
import re
import shutil

import numpy as np
import pytest
from safetensors.numpy import load_file

from fedvla_lib.config import PROFILES, Config, from_profile
from fedvla_lib.policy import model, nano
from fedvla_lib.pretraining import pretrain
from fedvla_lib.pretraining.recipe import Recipe
from fedvla_lib.robot.sim import So100Env
from fedvla_lib.robot.tasks import PRETRAINING_TASKS, TASKS, draw_layout

pytestmark = pytest.mark.integration
SMALL = Recipe(
    scenes=8, unseen_scenes=4, grounding_steps=2, steps=4, episodes_per_task=1, image_size=64, batch_size=4, rollouts=1,
    checkpoint_every=2,
)  # fmt: skip


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return pretrain.pretrain(SMALL, tmp_path_factory.mktemp("base") / "nano", progress=False)


def test_no_task_of_the_clients_is_pretrained():
    assert not set(TASKS) & set(PRETRAINING_TASKS)
    assert set(Config().tasks.split(",")) <= set(TASKS)
    told = {text for task in TASKS.values() for text in task.wordings}
    assert not told & {text for task in PRETRAINING_TASKS.values() for text in task.wordings}
    assert not {t.success for t in TASKS.values()} & {t.success for t in PRETRAINING_TASKS.values()}
    assert set(pretrain.settings(Recipe()).tasks.split(",")) == set(PRETRAINING_TASKS)


def test_the_account_says_how_the_base_was_made_and_what_it_can_do(made):
    account = pretrain.read_account(made)
    assert account["recipe"]["steps"] == 4 and account["episodes"] == len(PRETRAINING_TASKS)
    assert {row["task"] for row in account["success"]} == {*PRETRAINING_TASKS, *TASKS}
    assert {(row["task"], row["told"]) for row in account["language"]} == {
        (task, told) for task in pretrain.TWO_CUBES for told in ("right", "other")
    }
    assert all(0 <= row["low"] <= row["success_rate"] <= row["high"] <= 1 for row in account["success"])


def test_the_same_recipe_gives_the_same_bits_after_an_interruption(made, tmp_path, monkeypatch):
    monkeypatch.setattr(pretrain, "measure", lambda *_: [])  # measured above
    monkeypatch.setattr(pretrain, "follows_instructions", lambda *_: [])
    checkpoints = pretrain._work_folder(SMALL) / "checkpoints"

    shutil.rmtree(checkpoints / "step_000004")  # a training killed after step 2
    again = pretrain.pretrain(SMALL, tmp_path / "nano", progress=False)
    one, other = (load_file(folder / nano.WEIGHTS_FILE) for folder in (made, again))
    assert one.keys() == other.keys() and all(np.array_equal(one[name], other[name]) for name in one)


def test_an_existing_folder_is_not_overwritten(made):
    with pytest.raises(FileExistsError, match="exists already"):
        pretrain.pretrain(SMALL, made, progress=False)


def test_a_base_can_be_moved_and_names_no_place_of_the_machine_that_made_it(made, tmp_path):
    for path in made.rglob("*.json"):
        assert not re.search(r'"/[^"]*/', path.read_text()), path
    moved = tmp_path / "elsewhere"
    made.rename(moved)
    try:
        bundle = model.load_policy(from_profile("tiny", base=str(moved)))
        assert bundle.policy.config.vlm_model_name == str((moved / nano.VLM_FOLDER).resolve())
    finally:
        moved.rename(made)


# --- the base in the package


def test_the_base_in_the_package_is_small_whole_and_has_its_account():
    size = sum(path.stat().st_size for path in nano.nano_base().rglob("*") if path.is_file())
    assert size <= 10e6
    account = pretrain.read_account()
    assert account["recipe"] == json.loads(json.dumps(Recipe().__dict__))
    assert {row["task"] for row in account["success"]} == {*PRETRAINING_TASKS, *TASKS}
    for profile in ("tiny", "laptop"):
        assert from_profile(profile).base == nano.NANO
        bundle = model.load_policy(from_profile(profile))  # with its own statistics
        assert sum(p.numel() for p in bundle.policy.parameters()) == account["parameters"]
    assert "base" in PROFILES["gpu"]


def test_two_cubes_and_the_wrong_colour_are_what_the_misled_actor_gets():
    bundle = model.load_policy(from_profile("laptop", num_threads=1))
    (seed,) = pretrain._seeds_with_two_cubes("grip", 1)
    env = So100Env("grip", image_size=64)
    env.reset(seed=seed)
    actor = pretrain._Misled(bundle, 0)
    actor.reset(env, seed)
    asked, other = (cube.color for cube in env.layout.cubes)
    assert asked in env.instruction and other in actor._instruction and asked not in actor._instruction
    env.close()


def test_pretraining_draws_every_wording():
    rng = np.random.default_rng(0)
    for task in PRETRAINING_TASKS.values():
        texts = {draw_layout(task, rng, "red").instruction for _ in range(60)}
        assert len(texts) == len(task.wordings)


def test_a_bundle_without_weights_finds_the_installed_package(tmp_path, monkeypatch):
    """Flower's app bundle contains .py files only, so there are no weights next to its library."""
    monkeypatch.setattr(nano, "__file__", str(tmp_path / "fedvla_lib" / "policy" / "nano.py"))
    assert (nano.nano_base() / nano.WEIGHTS_FILE).is_file()
    monkeypatch.setattr(nano, "PACKAGE", "fedvla-lib-that-is-not-installed")
    with pytest.raises(ValueError, match="install it on every machine"):
        nano.nano_base()
