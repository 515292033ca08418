"""The warm start: trained once, found again, another for other settings, and the same bits after an interruption."""

import shutil
from dataclasses import replace

import pytest

from fedvla_lib import config as configs
from fedvla_lib import model, warm_start
from fedvla_lib.params import digest, trainable_arrays

pytestmark = pytest.mark.integration
CONFIG = configs.from_profile("tiny", num_threads=1, warm_steps=4)  # a checkpoint after step 2 and after step 4


@pytest.fixture(scope="module")
def trained():
    """The finished training that the tests look at."""
    return warm_start.train(CONFIG, progress=False)


def weights(bundle):
    return digest(trainable_arrays(bundle.policy))


def test_resolve_trains_once_and_loads_afterwards(trained):
    first = warm_start.resolve(CONFIG)
    written = (warm_start.folder_of(CONFIG) / "model.safetensors").stat().st_mtime_ns
    second = warm_start.resolve(replace(CONFIG, num_clients=7, lr=0.5, eval_every=1))
    assert first.base == second.base == str(warm_start.folder_of(CONFIG))
    assert (warm_start.folder_of(CONFIG) / "model.safetensors").stat().st_mtime_ns == written
    everything = replace(warm_start.recipe(CONFIG), base=first.base)
    assert weights(model.load_policy(everything)) == weights(trained[0])


def test_another_base_is_left_as_it_is():
    config = replace(CONFIG, base="nano")
    assert warm_start.resolve(config) is config


@pytest.mark.parametrize("name", warm_start.SETTINGS)
def test_settings_that_change_the_weights_change_the_folder(name):
    other = replace(CONFIG, **{name: getattr(CONFIG, name) * 2 + 1})
    assert warm_start.folder_of(other) != warm_start.folder_of(CONFIG)


def test_interrupted_training_goes_on_to_the_same_bits(trained):
    shutil.rmtree(warm_start.checkpoints_of(CONFIG) / "step_000004")  # a training killed after step 3 leaves the first
    resumed, result = warm_start.train(CONFIG, progress=False)
    assert result.losses == trained[1].losses
    assert weights(resumed) == weights(trained[0])


def test_a_finished_training_returns_its_losses_and_steps_can_be_looked_at(trained):
    bundle, result = trained
    again, same = warm_start.train(CONFIG, progress=False)
    assert same.losses == result.losses and len(result.losses) == CONFIG.warm_steps
    assert warm_start.kept_steps(CONFIG) == [2, 4]
    assert weights(again) == weights(bundle) == weights(warm_start.at_step(CONFIG, 4))
    assert weights(warm_start.at_step(CONFIG, 2)) not in (weights(bundle), weights(warm_start.prepare(CONFIG)[0]))
    with pytest.raises(ValueError, match=r"step 3 .*\[2, 4\]"):
        warm_start.at_step(CONFIG, 3)
