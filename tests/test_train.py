"""Local training: resume is exact, the seed fixes everything, frozen parts stay frozen, validation is deterministic."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from fedvla_lib.config import from_profile
from fedvla_lib.evaluation.held_out import average, measure_frames
from fedvla_lib.federation import messages
from fedvla_lib.policy import model, optimizers, training
from fedvla_lib.policy.parameters import load_arrays, trainable, trainable_arrays
from fedvla_lib.policy.training import Checkpoints, Objective, Start
from fedvla_lib.robot.spec import ACTION_KEY, CAMERAS, STATE_KEY, image_key

CONFIG = from_profile("tiny", base="nano-random", checkpoint_every=2, num_threads=1, train_expert_only=False)
STATS = {key: {"mean": np.full(6, 10.0), "std": np.full(6, 5.0)} for key in (STATE_KEY, ACTION_KEY)}


class SyntheticBatches:
    """A learnable stream: the action is the state, plus ten, held over the chunk."""

    seed = 3
    num_examples = 40

    def at(self, step: int) -> dict:
        rng = np.random.default_rng([self.seed, step])
        state = torch.from_numpy(rng.normal(10, 5, (4, 6)).astype(np.float32))
        images = {
            image_key(c): torch.from_numpy(rng.random((4, 3, CONFIG.image_size, CONFIG.image_size), np.float32))
            for c in CAMERAS
        }
        padded = torch.zeros(4, CONFIG.chunk_size, dtype=torch.bool)
        padded[0, -3:] = True
        action = state[:, None].repeat(1, CONFIG.chunk_size, 1) + 10
        task = ["Lift the red cube.", "Push the blue cube into the zone."] * 2
        return {**images, STATE_KEY: state, ACTION_KEY: action, "action_is_pad": padded, "task": task}


def weights(bundle):
    return {name: p.detach().clone() for name, p in bundle.policy.named_parameters()}


def same(left, right):
    return all(torch.equal(left[name], right[name]) for name in left)


def run(steps, **kwargs):
    bundle = model.load_policy(CONFIG, STATS)
    result = training.local_train(bundle, SyntheticBatches(), CONFIG, steps=steps, progress=False, **kwargs)
    return bundle, result


@pytest.mark.unit
def test_resume_is_bit_exact_even_after_a_crash(tmp_path):
    whole, whole_result = run(6, checkpoints=Checkpoints(tmp_path / "whole"))

    class Dies(SyntheticBatches):
        def at(self, step):
            if step == 5:
                raise KeyboardInterrupt
            return super().at(step)

    broken = model.load_policy(CONFIG, STATS)
    with pytest.raises(KeyboardInterrupt):
        training.local_train(broken, Dies(), CONFIG, steps=6, checkpoints=Checkpoints(tmp_path / "cut"), progress=False)
    assert [p.name for p in sorted((tmp_path / "cut").iterdir())] == ["step_000002", "step_000004"]
    resumed, resumed_result = run(6, checkpoints=Checkpoints(tmp_path / "cut", resume=True))
    assert resumed_result.losses == whole_result.losses and resumed_result.steps == whole_result.steps == 6
    assert same(weights(whole), weights(resumed))


@pytest.mark.unit
def test_steps_are_those_that_were_done_not_those_that_were_asked_for(tmp_path):
    run(6, checkpoints=Checkpoints(tmp_path))
    _, again = run(4, checkpoints=Checkpoints(tmp_path, resume=True))  # its newest checkpoint is at step 6
    assert again.steps == len(again.losses) == 6


@pytest.mark.unit
def test_one_seed_fixes_training_and_leaves_the_callers_random_state_alone():
    torch.manual_seed(1)
    before = torch.get_rng_state()
    first, _ = run(2)
    assert torch.equal(before, torch.get_rng_state())
    torch.manual_seed(2)
    second, _ = run(2)
    assert same(weights(first), weights(second))


@pytest.mark.unit
@pytest.mark.parametrize("frozen", [True, False])
def test_only_what_is_trainable_changes(frozen):
    config = replace(CONFIG, train_expert_only=frozen, freeze_vision_encoder=True)
    bundle = model.load_policy(config, STATS)
    before = weights(bundle)
    training.local_train(bundle, SyntheticBatches(), config, steps=2, progress=False)
    changed = {name for name, p in bundle.policy.named_parameters() if not torch.equal(before[name], p)}
    trainable = {name for name, p in bundle.policy.named_parameters() if p.requires_grad}
    assert changed <= trainable
    assert any("lm_expert" in name for name in changed)
    assert not any("vision_model" in name for name in changed)
    assert any("text_model" in name for name in changed) is not frozen


@pytest.mark.unit
def test_training_lowers_the_held_out_loss():
    config = replace(CONFIG, lr=3e-3, warmup_steps=2)
    bundle = model.load_policy(config, STATS)
    held_out = [SyntheticBatches().at(10_000 + i) for i in range(4)]
    before = average(measure_frames(bundle, held_out, tolerance=5.0))
    training.local_train(bundle, SyntheticBatches(), config, steps=40, progress=False)
    after = average(measure_frames(bundle, held_out, tolerance=5.0))
    assert after["loss"] < 0.8 * before["loss"]
    assert after["action_error"] < before["action_error"]


@pytest.mark.unit
def test_validation_is_deterministic_and_ignores_padded_actions():
    bundle = model.load_policy(CONFIG, STATS)
    held_out = [SyntheticBatches().at(0)]
    first = average(measure_frames(bundle, held_out, tolerance=5.0))
    held_out[0][ACTION_KEY][0, -3:] = 1e6
    assert average(measure_frames(bundle, held_out, tolerance=5.0)) == first
    with pytest.raises(ValueError, match="held-out"):
        measure_frames(bundle, [], tolerance=5.0)


@pytest.mark.unit
def test_schedule_continues_where_the_last_round_stopped():
    bundle = model.load_policy(CONFIG, STATS)
    config = replace(CONFIG, lr=1e-2, warmup_steps=4)
    whole, whole_schedule = optimizers.adamw(bundle, config, 0, 20)
    rates = []
    for _ in range(20):
        rates.append(whole.param_groups[0]["lr"])
        whole.step()
        whole_schedule.step()
    later, later_schedule = optimizers.adamw(bundle, config, 7, 20)
    for expected in rates[7:]:
        assert later.param_groups[0]["lr"] == pytest.approx(expected)
        later.step()
        later_schedule.step()


@pytest.mark.unit
def test_a_diverging_loss_stops_with_a_clear_line():
    class Poison(SyntheticBatches):
        def at(self, step):
            return {**super().at(step), STATE_KEY: torch.full((4, 6), float("nan"))}

    with pytest.raises(FloatingPointError, match="step 0: lower lr"):
        training.local_train(model.load_policy(CONFIG, STATS), Poison(), CONFIG, steps=1, progress=False)


def _decay(bundle, batch):
    """A loss that draws nothing, so that two phases can equal one."""
    return sum(p.square().sum() for p in trainable(bundle.policy).values())


@pytest.mark.unit
def test_a_kept_optimiser_state_makes_two_phases_equal_to_one():
    whole, parts, fresh = (model.load_policy(CONFIG, STATS) for _ in range(3))
    common = {"objective": Objective(_decay), "progress": False}
    training.local_train(whole, SyntheticBatches(), CONFIG, steps=6, **common)
    first = training.local_train(parts, SyntheticBatches(), CONFIG, steps=2, start=Start(0, 6, {}), **common)
    travelled = messages.unpack_arrays(messages.pack_arrays(first.moments))  # as a client's context keeps it
    training.local_train(parts, SyntheticBatches(), CONFIG, steps=4, start=Start(2, 6, travelled), **common)
    assert same(weights(whole), weights(parts))
    for steps, start in ((2, 0), (4, 2)):
        result = training.local_train(fresh, SyntheticBatches(), CONFIG, steps=steps, start=Start(start, 6), **common)
        assert result.moments == {}  # nobody asked for it
    assert not same(weights(whole), weights(fresh))


@pytest.mark.unit
def test_a_kept_optimiser_state_survives_a_resume(tmp_path):
    bundle = model.load_policy(CONFIG, STATS)
    before = training.local_train(
        bundle, SyntheticBatches(), CONFIG, steps=2, start=Start(moments={}), progress=False
    ).moments
    started = trainable_arrays(bundle.policy)
    settings = {"start": Start(2, 6, before), "progress": False}
    whole = training.local_train(bundle, SyntheticBatches(), CONFIG, steps=4, **settings)
    expected = weights(bundle)
    load_arrays(bundle.policy, started)
    training.local_train(bundle, SyntheticBatches(), CONFIG, steps=2, checkpoints=Checkpoints(tmp_path), **settings)
    load_arrays(bundle.policy, started)
    again = training.local_train(
        bundle, SyntheticBatches(), CONFIG, steps=4, checkpoints=Checkpoints(tmp_path, resume=True), **settings
    )
    assert same(expected, weights(bundle))
    assert whole.moments and all(np.array_equal(whole.moments[key], again.moments[key]) for key in whole.moments)
