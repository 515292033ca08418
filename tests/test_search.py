"""The search keeps its budget, resumes, and reports on data not used to select."""

import json
from dataclasses import asdict, replace

import optuna
import pytest

from fedvla_book import tables
from fedvla_lib.cli.main import main
from fedvla_lib.config import Config, from_profile
from fedvla_lib.data import recordings, splits
from fedvla_lib.evaluation import measure
from fedvla_lib.evaluation.statistics import wilson
from fedvla_lib.experiments import methods, search
from fedvla_lib.federation.strategies.build import SERVER_LR


@pytest.mark.unit
@pytest.mark.parametrize("strategy", ["fedavg", "fedprox", "fedavgm", "fedadam", "fedyogi"])
def test_every_trial_has_the_same_budget(strategy):
    also = {"fedavg": set(), "fedprox": {"proximal_mu"}}.get(strategy, {"server_lr"})
    config = from_profile("laptop", strategy=strategy)
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    for _ in range(30):
        trial = study.ask()
        tried = search.suggest(trial, config)
        assert methods.total_steps(tried) == methods.total_steps(config)
        assert set(trial.params) == {"local_steps", "fraction_train", "lr"} | also
        assert all(getattr(tried, name) == value for name, value in trial.params.items())
        assert set(trial.params) <= set(tables.SEARCHED)


@pytest.fixture
def evaluated(monkeypatch):
    """The episodes behind each loss that the search computes, in order; the runs of its trials name none."""
    episodes, measured = [], measure.measure

    def noting(*arguments, episode_ids=None, **options):
        episodes.extend([] if episode_ids is None else [list(episode_ids)])
        return measured(*arguments, episode_ids=episode_ids, **options)

    monkeypatch.setattr(measure, "measure", noting)
    return episodes


@pytest.mark.integration
def test_a_search_goes_on_and_reports_on_other_episodes(recording, tmp_path, capsys, evaluated):
    command = ["search", "--profile", "tiny", "--data", str(recording), "--tasks", "lift,push", "--num-clients", "2"]
    out = tmp_path / "fedavg"
    command += ["--val-fraction", "0.5", "--rollouts", "1", "--search-out", str(out)]
    assert main([*command, "--trials", "1"]) == 0
    first = json.loads((out / "search.json").read_text())
    assert main([*command, "--trials", "2"]) == 0
    found = json.loads((out / "search.json").read_text())
    assert tables.compared(tables.read_searches(tmp_path)).trials.to_list() == [2, 2]
    said = capsys.readouterr().out
    assert f"2 trials of {found['budget']} gradient steps" in said and "winner: " in said
    assert found["trials"][0] == first["trials"][0] and len(found["trials"]) == 2
    losses = [trial["selection_loss"] for trial in found["trials"]]
    assert found["selection_loss"] == min(losses)
    assert found["best"]["loss"] != found["selection_loss"]  # measured on other episodes
    assert found["start"]["n"] == found["best"]["n"] == 2
    assert found["stamp"]["code"] == methods.trained_by()  # as in a run folder of an experiment
    assert found["first_rollout_seed"] == search.ROLLOUTS_FROM
    config = from_profile("tiny", tasks="lift,push", num_clients=2, data=str(recording), val_fraction=0.5)
    store = recordings.open_frames(config)
    held_out, shares = splits.held_out_episodes(store, config), splits.shares(store, config)
    trial, start, best = held_out[0::2], held_out[1::2], held_out[1::2]
    assert evaluated == [trial, start, best, trial, start, best]  # of the first call, and of the one that went on
    assert trial and not set(trial) & set(best)
    assert not set(held_out) & {episode for share in shares for episode in share.train_ids}
    assert main([*command, "--trials", "2", "--lr", "0.01"]) == 2
    assert "other settings" in capsys.readouterr().err


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


def found_by(strategy, losses, **also):
    """What a search leaves behind, as far as tables need it."""
    config = asdict(from_profile("laptop", strategy=strategy, lr=1e-3, local_steps=5, fraction_train=0.4))
    winner = {"local_steps": 2, "fraction_train": 0.1, "lr": 2e-3, **also}
    trials = [{"number": i, **winner, "selection_loss": loss} for i, loss in enumerate(losses)]
    report = {"loss": 0.3, "n": 30, "successes": 12}
    return {
        "config": config, "winner": winner, "trials": trials, "selection_loss": 0.1, "start": report,
        "best": report | {"loss": 0.2, "successes": 21},
    }  # fmt: skip


@pytest.mark.unit
def test_searches_are_read_by_strategy_and_compared_line_by_line(tmp_path):
    given = [
        found_by("fedadam", [0.2, 0.1, 0.4], server_lr=0.05), found_by("fedprox", [None, 0.1], proximal_mu=2.0),
        found_by("fedavg", [0.1]),
    ]  # fmt: skip
    for number, found in enumerate(given):
        (tmp_path / str(number)).mkdir()
        (tmp_path / str(number) / "search.json").write_text(json.dumps(found))
    searches = tables.read_searches(tmp_path)
    assert searches == {found["config"]["strategy"]: found for found in given}
    table = tables.compared(searches).set_index(["strategy", "settings"])
    assert [name for name, _ in table.index[::2]] == ["fedavg", "fedprox", "fedadam"]  # as strategies are listed
    assert table.trials.to_list() == [1, 1, 2, 2, 3, 3] and table.diverged.to_list() == [0, 0, 1, 1, 0, 0]
    start, winner = (table.xs(which, level="settings") for which in ("start", "winner"))
    assert (start[["lr", "local_steps", "fraction_train"]] == [1e-3, 5, 0.4]).all(axis=None)
    assert (winner[["lr", "local_steps", "fraction_train"]] == [2e-3, 2, 0.1]).all(axis=None)
    assert start.server_lr.dropna().to_dict() == {"fedadam": SERVER_LR["fedadam"]}  # 0 stands for this
    assert winner.server_lr.dropna().to_dict() == {"fedadam": 0.05}
    assert start.proximal_mu.dropna().to_dict() == {"fedprox": Config.proximal_mu}
    assert winner.proximal_mu.dropna().to_dict() == {"fedprox": 2.0}
    assert start.selection_loss.isna().all() and (winner.selection_loss == 0.1).all()
    assert (start.loss == 0.3).all() and (winner.loss == 0.2).all()
    assert (start.success_rate == 0.4).all() and (winner.success_rate == 0.7).all()
    assert [*winner.loc["fedavg", ["low", "high"]]] == [*wilson(21, 30)]


@pytest.mark.unit
def test_no_search_and_two_of_one_strategy_are_refused(tmp_path):
    with pytest.raises(ValueError, match="has 0 searches"):
        tables.read_searches(tmp_path)
    for name in ("one", "other"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "search.json").write_text(json.dumps(found_by("fedavg", [0.1])))
    with pytest.raises(ValueError, match="has 2 searches of 1 strategies"):
        tables.read_searches(tmp_path)
