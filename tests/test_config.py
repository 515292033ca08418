"""Settings: one dataclass, three profiles, one parser."""

import re
from dataclasses import fields, replace

import pytest

from fedvla_lib.cli.parser import setting_texts
from fedvla_lib.config import (
    PROFILES,
    Config,
    from_profile,
    from_run_config,
    task_names,
    to_run_config,
)
from fedvla_lib.files import cache_dir

pytestmark = pytest.mark.unit


@pytest.mark.parametrize("profile", PROFILES)
def test_profiles_are_usable_and_survive_the_run_config(profile):
    config = from_profile(profile)
    assert from_run_config(to_run_config(config)) == config


def test_profiles_change_only_known_settings():
    names = {field.name for field in fields(Config)}
    assert all(set(values) <= names for values in PROFILES.values())


def test_laptop_is_the_default(monkeypatch):
    monkeypatch.delenv("FEDVLA_PROFILE", raising=False)
    assert from_profile() == Config() == from_profile("laptop")


def test_environment_names_the_profile(monkeypatch):
    monkeypatch.setenv("FEDVLA_PROFILE", "tiny")
    assert from_profile() == from_profile("tiny")


def test_overrides_win():
    assert from_profile("tiny", num_clients=7).num_clients == 7


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda: from_profile("huge"), "tiny, laptop, gpu"),
        (lambda: from_profile("tiny", learning_rate=1), "unknown setting 'learning_rate'"),
        (lambda: from_run_config({"num-rounds": 1}), "unknown setting 'num_rounds'"),
        (lambda: from_run_config({"lr": "fast"}), "lr='fast' has type str"),
        (lambda: from_profile("tiny", lr="fast"), "lr='fast' has type str"),
        (lambda: from_profile("tiny", augment="no"), "augment='no' has type str: give bool"),
        (lambda: from_run_config({"num-clients": True}), "give int"),
        (lambda: from_run_config({"num-clients": 2.5}), "give int"),
    ],
)
def test_wrong_names_and_types_are_named(call, said):
    with pytest.raises(ValueError, match=re.escape(said)) as caught:
        call()
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("num_clients", 0),
        ("lr", -1.0),
        ("seed", -1),
        ("fraction_train", 0.0),
        ("fraction_evaluate", 1.5),
        ("partition", "alphabet"),
        ("n_action_steps", 99),
        ("tasks", " , "),
    ],
)
def test_values_out_of_range_are_named(name, value):
    with pytest.raises(ValueError, match=name.replace("_", "-")) as caught:
        from_profile("tiny", **{name: value})
    assert repr(value) in str(caught.value)


def test_run_config_keys_have_dashes_and_whole_numbers_pass_for_floats():
    values = to_run_config(Config())
    assert not any("_" in key for key in values)
    assert from_run_config({**values, "lr": 1}).lr == 1.0


def test_task_names_are_stripped():
    assert task_names(replace(Config(), tasks="lift , push,")) == ["lift", "push"]


def test_cache_follows_the_environment(monkeypatch, tmp_path):
    monkeypatch.setenv("FEDVLA_CACHE", str(tmp_path))
    assert cache_dir() == tmp_path


def test_every_setting_has_a_sentence():
    assert set(setting_texts()) == {field.name for field in fields(Config)}
