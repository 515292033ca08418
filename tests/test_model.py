"""The policy: same classes for every base, exact round trip to disk, clear errors, reproducible actions."""

import json
import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from lerobot.policies.smolvla import SmolVLAPolicy
from safetensors.torch import load_file, save_file

from fedvla_book import tables
from fedvla_lib.config import from_profile, granted_cores
from fedvla_lib.policy import model
from fedvla_lib.policy.actor import PolicyActor, starting_noise
from fedvla_lib.robot.spec import ACTION_KEY, CAMERAS, STATE_KEY, image_key

CONFIG = from_profile("tiny", base="nano-random", num_threads=1)
STATS = {key: {"mean": np.arange(6.0), "std": np.full(6, 5.0)} for key in (STATE_KEY, ACTION_KEY)}
SCENE = SimpleNamespace(instruction="Lift the red cube.")


def observation(seed=0):
    rng = np.random.default_rng(seed)
    size = CONFIG.image_size
    pixels = {camera: rng.integers(0, 255, (size, size, 3), np.uint8) for camera in CAMERAS}
    return {"pixels": pixels, "agent_pos": rng.normal(size=6).astype(np.float32)}


def drive(bundle, steps=5, seed=0, episode=7, scene=SCENE):
    actor = PolicyActor(bundle, seed)
    actor.reset(scene, episode)
    return np.stack([actor.act(observation(i)) for i in range(steps)])


@pytest.mark.unit
def test_the_seed_fixes_the_random_weights():
    first, second = (model.load_policy(CONFIG, STATS).policy.state_dict() for _ in range(2))
    assert all(torch.equal(first[name], second[name]) for name in first)
    other = model.load_policy(replace(CONFIG, seed=1), STATS).policy.state_dict()
    assert any(not torch.equal(first[name], other[name]) for name in first)


@pytest.mark.unit
def test_a_saved_policy_drives_the_same_after_it_was_moved(tmp_path):
    bundle = model.load_policy(CONFIG, STATS)
    model.save_policy(bundle, tmp_path / "a" / "policy")
    shutil.move(tmp_path / "a", tmp_path / "b")
    loaded = model.load_policy(replace(CONFIG, base=str(tmp_path / "b" / "policy")))
    assert isinstance(loaded.policy, SmolVLAPolicy)
    np.testing.assert_array_equal(drive(bundle), drive(loaded))
    with pytest.raises(FileExistsError, match="never overwritten"):
        model.save_policy(bundle, tmp_path / "b" / "policy")


@pytest.mark.unit
def test_driving_depends_on_seed_and_instruction_only():
    bundle = model.load_policy(CONFIG, STATS)
    first = drive(bundle)
    assert first.shape == (5, 6) and first.dtype == np.float32
    torch.manual_seed(99)
    np.testing.assert_array_equal(first, drive(bundle))
    assert not np.array_equal(first, drive(bundle, episode=8))
    assert not np.array_equal(first, drive(bundle, scene=SimpleNamespace(instruction="Push the blue cube.")))


@pytest.mark.unit
@pytest.mark.parametrize("settings", [{}, {"train_expert_only": False}, {"lora_rank": 2}], ids=str)
def test_the_arm_is_told_what_lerobots_own_prediction_says(settings):
    """For several observations at once, whose instructions are of several lengths."""
    bundle = model.load_policy(replace(CONFIG, **settings), STATS)
    scenes = [SCENE, SimpleNamespace(instruction="Push the blue cube into the circle beside the red square.")]
    actors, seen = [PolicyActor(bundle) for _ in scenes], [observation(1), observation(2)]
    for actor, scene in zip(actors, scenes, strict=True):
        actor.reset(scene, 3)
    generators = [torch.Generator().set_state(actor._generator.get_state()) for actor in actors]
    noise = torch.cat([starting_noise(bundle, 1, generator) for generator in generators])
    raw = {image_key(name): torch.from_numpy(np.stack([each["pixels"][name] for each in seen])) for name in CAMERAS}
    images = {key: pixels.permute(0, 3, 1, 2) / 255 for key, pixels in raw.items()}
    states = torch.from_numpy(np.stack([each["agent_pos"] for each in seen]))
    batch = images | {STATE_KEY: states, "task": [scene.instruction for scene in scenes]}
    wanted = bundle.postprocess(bundle.policy.predict_action_chunk(bundle.preprocess(batch), noise=noise))
    found = PolicyActor.act_together(actors, seen)
    np.testing.assert_allclose(found, wanted[:, 0], atol=1e-4)


@pytest.mark.unit
def test_actions_come_out_in_the_units_of_the_statistics():
    shifted = {STATE_KEY: STATS[STATE_KEY], ACTION_KEY: {"mean": np.arange(6.0) + 40, "std": np.full(6, 5.0)}}
    near, far = (drive(model.load_policy(CONFIG, stats)) for stats in (STATS, shifted))
    np.testing.assert_allclose(far - near, 40, atol=1e-4)


@pytest.mark.unit
@pytest.mark.parametrize(
    ("freeze", "expert_only", "trained"),
    [(True, True, {"expert"}), (True, False, {"expert", "text"}), (False, False, {"expert", "text", "vision"})],
)
def test_what_trains_is_what_the_config_says(freeze, expert_only, trained):
    config = replace(CONFIG, freeze_vision_encoder=freeze, train_expert_only=expert_only)
    policy = model.load_policy(config, STATS).policy
    rows = {row["module"].rsplit(".", 1)[-1]: row for row in tables.module_table(policy)}
    assert (rows["vision_model"]["trainable"] > 0) == ("vision" in trained)
    assert (rows["text_model"]["trainable"] > 0) == ("text" in trained)
    assert rows["lm_expert"]["trainable"] == rows["lm_expert"]["parameters"] > 0
    assert sum(row["parameters"] for row in rows.values()) == sum(p.numel() for p in policy.parameters())
    trainable = sum(p.numel() for p in policy.parameters() if p.requires_grad)
    assert sum(row["trainable"] for row in rows.values()) == trainable


@pytest.mark.unit
def test_bad_bases_are_named(tmp_path):
    with pytest.raises(ValueError, match="no-such-folder.*'nano'.*hub id"):
        model.load_policy(replace(CONFIG, base=str(tmp_path / "no-such-folder")), STATS)
    with pytest.raises(ValueError, match="nobody/nothing"):
        model.load_policy(replace(CONFIG, base="nobody/nothing"), STATS)
    with pytest.raises(ValueError, match="statistics"):
        model.load_policy(CONFIG)
    with pytest.raises(ValueError, match="observation.state"):
        model.load_policy(CONFIG, {ACTION_KEY: STATS[ACTION_KEY]})


@pytest.mark.unit
def test_a_partly_random_policy_does_not_pass_for_a_pretrained_one(tmp_path):
    folder = tmp_path / "policy"
    model.save_policy(model.load_policy(CONFIG, STATS), folder)
    tensors = load_file(folder / "model.safetensors")
    tensors.pop("model.state_proj.weight")
    save_file(tensors, folder / "model.safetensors")
    with pytest.raises(ValueError, match="lacks 1 tensors.*state_proj"):
        model.load_policy(replace(CONFIG, base=str(folder)))


@pytest.mark.unit
def test_another_kind_of_policy_is_refused(tmp_path):
    model.save_policy(model.load_policy(CONFIG, STATS), tmp_path / "p")
    saved = json.loads((tmp_path / "p" / "config.json").read_text())
    (tmp_path / "p" / "config.json").write_text(json.dumps({"type": "act", "device": saved["device"]}))
    with pytest.raises(ValueError, match="'act' policy: give a smolvla"):
        model.load_policy(replace(CONFIG, base=str(tmp_path / "p")), STATS)


@pytest.mark.unit
def test_a_small_policy_uses_one_thread_unless_told_and_a_large_one_all_cores(monkeypatch):
    policy, chosen = model.load_policy(CONFIG, STATS).policy, []
    monkeypatch.setattr(model.torch, "set_num_threads", chosen.append)
    for threads, smallest in ((0, model.SMALL), (3, model.SMALL), (0, 1)):
        monkeypatch.setattr(model, "SMALL", smallest)
        model.use_threads(replace(CONFIG, num_threads=threads), policy)
    assert chosen == [1, 3, granted_cores()]
