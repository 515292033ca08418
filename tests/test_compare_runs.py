"""`fedvla compare` on real runs: the same rollouts and episodes line up, and what cannot be compared is refused."""

import json
import shutil
from dataclasses import replace

import pandas as pd
import pytest

from conftest import short_rollouts
from fedvla_lib import run_folder
from fedvla_lib.cli.main import main
from fedvla_lib.config import from_profile
from fedvla_lib.engines import inline
from fedvla_lib.evaluation import compare_runs

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
    with short_rollouts():
        for name, own in settings.items():
            made = inline.run_inline(replace(tiny, out=str(out), **own), progress=False)
            folders[name] = made.rename(out / name)
    return folders


def copied(run, out, *, settings=None, kind="", name="", change=lambda value: value):
    """A copy of a run with other settings, or with a value changed in its events of a kind."""
    shutil.copytree(run, out)
    config = json.loads((out / "config.json").read_text()) | (settings or {})
    (out / "config.json").write_text(json.dumps(config))
    events = run_folder.read_events(out)
    for event in events:
        if event["kind"] == kind:
            event["values"][name] = change(event["values"][name])
    (out / "metrics.jsonl").write_text("".join(json.dumps(event) + "\n" for event in events))
    return out


def test_runs_are_compared_rollout_by_rollout_and_episode_by_episode(runs, tmp_path, capsys):
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
    effect, rest = ["difference", "low", "high", "visible"], ["p_value", "p_holm"]
    assert [name for name in differences if name in effect + rest] == effect + rest  # what is large before what is rare
    header = next(line for line in said.splitlines() if "difference" in line).split()
    assert [name for name in header if name in effect + rest] == effect + rest
    assert differences[effect[:3]].notna().all(axis=None) and differences.mismatch.isna().all()
    assert (tmp_path / "differences.png").stat().st_size > 1000
    assert json.loads((tmp_path / "comparison.json").read_text())["mismatches"] == []


def test_steps_are_those_that_clients_counted(runs, tmp_path):
    assert compare_runs.read_run(runs["longer"]).gradient_steps == 6
    more = copied(runs["longer"], tmp_path / "more", kind="train", name="steps", change=lambda steps: steps + 1)
    assert compare_runs.read_run(more).gradient_steps == 8


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


OTHER = {  # what another run has otherwise, what the refusal says of it, and the pairs that are left
    "held-out set": (
        {"kind": "held-out", "name": "episode_id", "change": lambda i: i + 100 * (i % 3 == 0)}, "loss",
        "held-out episodes", {"loss": 2},
    ),
    "rollout seeds": (
        {"kind": "rollout", "name": "seed", "change": lambda seed: seed + 1}, "success_rate,loss", "rollouts",
        {"success_rate": 3, "loss": 3},
    ),
    "share held out": ({"settings": {"val_fraction": 0.25}}, "loss", "val-fraction: 0.1 and 0.25", {"loss": 3}),
    "unit of the loss": (
        {"settings": {"normalisation": "none"}}, "loss,success_rate", "normalisation: 'pooled' and 'none'",
        {"loss": 3, "success_rate": 6},
    ),
}  # fmt: skip


@pytest.mark.parametrize("other", OTHER)
def test_what_cannot_be_compared_is_refused_by_name_and_labelled_if_asked_for(runs, other, tmp_path, capsys):
    change, metrics, words, pairs = OTHER[other]
    theirs = copied(runs["median"], tmp_path / "other", **change)
    arguments = ["compare", str(runs["fedavg"]), str(theirs), "--metrics", metrics, "--out", str(tmp_path / "out")]
    assert main(arguments) == 2
    said = capsys.readouterr()
    assert len(said.err.splitlines()) == 1 and f"fedavg and other differ in {words}" in said.err
    assert said.err.count("differ in") == 1 and not said.out and not (tmp_path / "out").exists()

    assert main([*arguments, "--allow-mismatch"]) == 0
    what, said = words.split(":")[0], capsys.readouterr().out
    assert f"MISMATCH: fedavg and other differ in {words}" in said
    table = pd.read_csv(tmp_path / "out" / "differences.csv").set_index("metric")
    kept = json.loads((tmp_path / "out" / "comparison.json").read_text())
    assert table.n.to_dict() == pairs and any(words in line for line in kept["mismatches"])
    labelled = {row["metric"] for row in kept["differences"] if row["mismatch"] == what}
    concerned = {"rollouts": {"success_rate"}, "normalisation": {"loss"}}.get(what, {"loss"})
    assert labelled == set(table.index[table.mismatch == what]) == concerned
    assert sum(line.endswith(what) for line in said.splitlines()) == 2 * len(concerned)  # values, and differences
    values = pd.read_csv(tmp_path / "out" / "values.csv", keep_default_na=False)
    assert set(values[values.run == "fedavg"].mismatch) == {""}
    assert set(values[values.mismatch == what].metric) == concerned


def test_runs_without_a_common_rollout_leave_nothing_to_compare(runs, tmp_path, capsys):
    theirs = copied(runs["median"], tmp_path / "other", kind="rollout", name="seed", change=lambda seed: seed + 1000)
    arguments = ["compare", str(runs["fedavg"]), str(theirs), "--metrics", "success_rate", "--allow-mismatch"]
    assert main(arguments) == 2
    said = capsys.readouterr().err
    assert "other and fedavg share no rollout" in said and len(said.splitlines()) == 1


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
