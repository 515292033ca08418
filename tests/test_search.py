"""The search spends what it says, goes on where it stopped, and judges on what did not choose."""

import json
from dataclasses import replace

import optuna
import pytest

from fedvla_lib import arms, clients, search
from fedvla_lib.cli import main
from fedvla_lib.config import code_digest, from_profile


@pytest.mark.unit
@pytest.mark.parametrize("strategy", ["fedavg", "fedprox", "fedavgm", "fedadam", "fedyogi"])
def test_every_trial_has_the_same_budget(strategy):
    also = {"fedavg": set(), "fedprox": {"proximal_mu"}}.get(strategy, {"server_lr"})
    config = from_profile("laptop", strategy=strategy)
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    for _ in range(30):
        trial = study.ask()
        tried = search.suggest(trial, config)
        assert arms.total_steps(tried) == arms.total_steps(config)
        assert set(trial.params) == {"local_steps", "fraction_train", "lr"} | also
        assert all(getattr(tried, name) == value for name, value in trial.params.items())


@pytest.mark.integration
def test_a_search_goes_on_and_reports_on_other_episodes(recording, tmp_path, capsys):
    command = ["search", "--profile", "tiny", "--data", str(recording), "--tasks", "lift,push", "--num-clients", "2"]
    command += ["--val-fraction", "0.5", "--rollouts", "1", "--search-out", str(tmp_path)]
    assert main([*command, "--trials", "1"]) == 0
    first = json.loads((tmp_path / "search.json").read_text())
    assert main([*command, "--trials", "2"]) == 0
    found = json.loads((tmp_path / "search.json").read_text())
    said = capsys.readouterr().out
    assert f"2 trials of {found['budget']} gradient steps" in said and "winner: " in said
    assert found["trials"][0] == first["trials"][0] and len(found["trials"]) == 2
    losses = [trial["selection_loss"] for trial in found["trials"]]
    assert found["selection_loss"] == min(losses)
    assert found["best"]["loss"] != found["selection_loss"]  # measured on other episodes
    assert found["start"]["n"] == found["best"]["n"] == 2
    assert found["stamp"]["code"] == code_digest(*arms.TRAINED_BY)  # as in a run folder of an experiment
    assert found["first_rollout_seed"] == search.ROLLOUTS_FROM
    assert main([*command, "--trials", "2", "--lr", "0.01"]) == 2
    assert "other settings" in capsys.readouterr().err


@pytest.mark.unit
def test_the_halves_of_the_validation_episodes_share_none(store):
    config = from_profile("tiny", val_fraction=0.5)
    held_out = clients.held_out_episodes(store, config)
    assert not set(held_out[0::2]) & set(held_out[1::2]) and len(held_out) >= 2


@pytest.mark.integration
def test_a_search_without_validation_episodes_is_refused(recording, tmp_path, capsys):
    command = ["search", "--profile", "tiny", "--data", str(recording), "--val-fraction", "0"]
    assert main([*command, "--search-out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert "val-fraction=0" in said and len(said.splitlines()) == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.integration
def test_a_trial_that_diverges_counts_and_does_not_end_the_search(recording, tmp_path, monkeypatch, capsys):
    draw = search.suggest

    def ruinous(trial, config):
        drawn = draw(trial, config)
        return replace(drawn, lr=1e30, local_steps=2, num_server_rounds=1) if trial.number in ruined else drawn

    monkeypatch.setattr(search, "suggest", ruinous)
    command = ["search", "--profile", "tiny", "--data", str(recording), "--tasks", "lift,push", "--num-clients", "2"]
    command += ["--val-fraction", "0.5", "--rollouts", "1", "--search-out", str(tmp_path)]
    ruined = {0}
    assert main([*command, "--trials", "1"]) == 2
    assert "all 1 trials" in capsys.readouterr().err
    assert main([*command, "--trials", "2"]) == 0
    found = json.loads((tmp_path / "search.json").read_text())
    assert [trial["selection_loss"] is None for trial in found["trials"]] == [True, False]
    assert found["config"]["data"] == str(recording) and found["stamp"]["status"] == "completed"
