"""`fedvla compare` on real runs: the same attempts and episodes line up, and what cannot be compared is refused."""

import json
from dataclasses import replace

import pandas as pd
import pytest

from fedvla_lib import compare_runs, engine, run_folder
from fedvla_lib.cli import main
from fedvla_lib.config import from_profile

pytestmark = [pytest.mark.integration, pytest.mark.slow]


@pytest.fixture(scope="module")
def runs(recording, tmp_path_factory):
    out = tmp_path_factory.mktemp("runs")
    tiny = from_profile(
        "tiny", base="nano", data=str(recording), num_clients=2, num_server_rounds=1, local_steps=2, eval_rollouts=2,
        client_rollouts=0, num_threads=1,
    )  # fmt: skip
    settings = {"fedavg": {}, "median": {"strategy": "fedmedian"}, "longer": {"local_steps": 3}}
    folders = {}
    for name, own in settings.items():
        made = engine.run_inline(replace(tiny, out=str(out), **own), progress=False)
        folders[name] = made.rename(out / name)
    return folders


def test_runs_are_compared_attempt_by_attempt_and_episode_by_episode(runs, tmp_path, capsys):
    names = ["fedavg", "median"]
    assert main(["compare", *(str(runs[name]) for name in names), "--out", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert "MISMATCH" not in said and "success_rate" in said
    values, differences = (pd.read_csv(tmp_path / f"{name}.csv") for name in ("values", "differences"))
    for name in names:
        rounds = run_folder.read_metrics(runs[name], "evaluate").query("who == 'global' and round == 1").iloc[0]
        found = values[values.run == name].set_index("metric")
        assert found.value["success_rate"] == pytest.approx(rounds.success_rate)
        assert found.n["success_rate"] == 6 and found.n["loss"] == len(compare_runs.read_run(runs[name]).episodes)
    by_metric = values.pivot(index="metric", columns="run", values="value")
    expected = by_metric["median"] - by_metric["fedavg"]
    found = differences.set_index("metric").difference
    pd.testing.assert_series_equal(found.sort_index(), expected.sort_index(), check_names=False)
    assert (differences.p_holm >= differences.p_value).all()
    assert (tmp_path / "differences.png").stat().st_size > 1000
    assert json.loads((tmp_path / "comparison.json").read_text())["mismatches"] == []


def test_averages_over_episodes_are_those_of_the_round(runs):
    of_round = run_folder.read_metrics(runs["fedavg"], "evaluate").query("who == 'global' and round == 1").iloc[0]
    episodes = compare_runs.read_run(runs["fedavg"]).episodes
    assert episodes.num_examples.sum() == of_round.num_examples
    low, high = episodes.loss.min(), episodes.loss.max()
    assert low < of_round.loss < high


def test_runs_that_spent_different_things_are_refused_unless_asked(runs, tmp_path, capsys):
    arguments = ["compare", str(runs["fedavg"]), str(runs["longer"]), "--metrics", "loss"]
    assert main(arguments) == 2
    refusal = capsys.readouterr().err
    assert "gradient steps: 4 and 6" in refusal and len(refusal.splitlines()) == 1
    assert main([*arguments, "--allow-mismatch", "--out", str(tmp_path)]) == 0
    assert "MISMATCH: fedavg and longer differ in gradient steps: 4 and 6" in capsys.readouterr().out
    assert json.loads((tmp_path / "comparison.json").read_text())["mismatches"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--metrics", "beauty"], "unknown metric 'beauty': choose from loss"),
        (["--confidence", "95"], "--confidence 95.0 is not usable"),
        ([], "give two or more different run folders"),
    ],
)
def test_bad_input_is_one_line(runs, arguments, words, capsys):
    twice = [str(runs["fedavg"])] * (1 if arguments else 2)
    other = [str(runs["median"])] if arguments else []
    assert main(["compare", *twice, *other, *arguments]) == 2
    said = capsys.readouterr().err
    assert words in said and len(said.splitlines()) == 1


def test_a_folder_that_is_no_run_is_named(runs, tmp_path, capsys):
    assert main(["compare", str(runs["fedavg"]), str(tmp_path)]) == 2
    assert f"{tmp_path} is not a run folder" in capsys.readouterr().err
