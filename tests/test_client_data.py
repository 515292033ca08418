"""A federation over several data sets: other cameras, rates and calibrations, one model, and no success of no task."""

import pytest

from fedvla_lib import run_folder
from fedvla_lib.cli.main import main
from fedvla_lib.config import absolute, from_profile
from fedvla_lib.data.recordings import resolve
from fedvla_lib.engines.inline import run_inline
from fedvla_lib.evaluation.rollouts import tasks_to_roll_out
from fedvla_lib.federation.client import open_client
from test_community_data import write_as_a_lab_would

TINY = ["--profile", "tiny", "--base", "nano", "--num-server-rounds", "1", "--local-steps", "1", "--no-videos"]


@pytest.fixture(scope="module")
def labs(tmp_path_factory, store):
    """The data sets of two labs: 30 and 15 frames a second, top and wrist, phone and laptop."""
    folder = tmp_path_factory.mktemp("two labs")
    phone = {"phone": "overhead", "laptop": "front"}
    one = write_as_a_lab_would(folder / "a", store)
    return one, write_as_a_lab_would(folder / "b", store, phone, "Stack the blocks.", 15)


@pytest.mark.integration
def test_labs_without_a_task_of_the_simulator_share_a_model_and_nothing_is_rolled_out(labs, tmp_path, capsys):
    paths = ",".join(map(str, labs))
    assert main(["run", *TINY, "--client-data", paths, "--out", str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    (root,) = run_folder.run_folders(from_profile("tiny", out=str(tmp_path)))
    assert "no rollouts of lift, place, push: the data show none of them\n" in printed
    assert "success" not in printed and run_folder.read_metrics(root, "rollout").empty
    assert (root / "global_model/round_1/model.safetensors").is_file()
    trained, measured = run_folder.read_metrics(root, "train"), run_folder.read_metrics(root, "evaluate")
    assert trained.num_examples.tolist() == [12, 12], "of one episode each, at the policy's rate"
    clients = measured[measured.who != "global"]
    assert clients.who.tolist() == ["client_0", "client_1"] and (clients.loss > 0).all()
    assert all(who in printed for who in clients.who)
    assert (measured[measured.who == "global"].num_examples == 0).all()


@pytest.mark.integration
def test_beside_a_lab_with_a_simulated_task_only_that_task_is_rolled_out(labs, recording, tmp_path, capsys):
    paths = ",".join(map(str, [labs[0], recording]))
    settings = ["--client-data", paths, "--tasks", "lift,stack", "--client-rollouts", "0", "--out", str(tmp_path)]
    assert main(["run", *TINY, *settings]) == 0
    printed = capsys.readouterr().out
    (root,) = run_folder.run_folders(from_profile("tiny", out=str(tmp_path)))
    rolled_out = run_folder.read_metrics(root, "rollout")
    assert set(rolled_out.task) == {"lift"} and "success_rate.lift" in printed and "success_rate.stack" not in printed
    assert "no rollouts of stack: the data show none of them; they show place, push: give them as tasks" in printed


@pytest.mark.integration
def test_a_client_reads_its_own_data_set_with_its_own_cameras_and_held_out_episodes(labs):
    config = from_profile("tiny", client_data=",".join(map(str, labs)))
    assert config.num_clients == 2
    for k, path in enumerate(labs):
        client = open_client(config, k)
        assert client.store.root == path and client.store.fps == 10
        assert sorted(client.store.images) == ["front", "overhead"]
        assert len(client.share.train_ids) == len(client.share.val_ids) == 1
    with pytest.raises(ValueError, match="data is empty: give data for all, or a client"):
        resolve(config)


@pytest.mark.integration
def test_nodes_that_name_their_own_folder_need_no_path_in_the_settings(labs, tmp_path):
    settings = {"base": "nano", "num_server_rounds": 1, "local_steps": 1, "client_rollouts": 0, "out": str(tmp_path)}
    root = run_inline(from_profile("tiny", client_data="lab a,lab b", **settings), data=labs, progress=False)
    assert run_folder.read_metrics(root, "train").who.tolist() == ["client_0", "client_1"]
    assert run_folder.read_metrics(root, "note").detail.str.contains("no rollouts of lift, place, push").all()


@pytest.mark.integration
def test_train_on_data_without_a_simulated_task_says_so(labs, tmp_path, capsys):
    arguments = ["--profile", "tiny", "--steps", "1", "--data", str(labs[0]), "--out", str(tmp_path)]
    assert main(["train", *arguments]) == 0
    printed = capsys.readouterr().out
    assert "no rollouts of lift, place, push" in printed and "success_rate" not in printed


@pytest.mark.unit
def test_what_is_rolled_out():
    config = from_profile("tiny")
    assert tasks_to_roll_out(config, {"lift", "place", "push", "Wait."}) == (["lift", "place", "push"], "")
    assert tasks_to_roll_out(config, set()) == (["lift", "place", "push"], ""), "clients may keep their tasks secret"
    tasks, why = tasks_to_roll_out(from_profile("tiny", fps=30), {"lift"})
    assert not tasks and why == "no rollouts: the policy acts fps=30 times a second, the simulator 10"


@pytest.mark.unit
def test_unusable_client_data_is_one_line_and_status_2(labs, tmp_path, capsys):
    for arguments, said in (
        (["--client-data", f"{labs[0]},{tmp_path}/none"], f"no data set at {tmp_path}/none"),
        (["--client-data", "a/b,c/d", "--num-clients", "3"], "num-clients=3 is not usable: give 2, one for each"),
        (["--client-data", "a/b,c/d", "--normalisation", "held-out"], "normalisation='held-out' is not usable"),
    ):
        assert main(["run", *TINY, *arguments, "--out", str(tmp_path)]) == 2
        error = capsys.readouterr().err
        assert said in error and error.count("\n") == 1


@pytest.mark.unit
def test_local_folders_become_absolute_and_hub_ids_stay(labs, monkeypatch):
    monkeypatch.chdir(labs[0].parent)
    config = absolute(from_profile("tiny", client_data="a,someone/so100"))
    assert config.client_data == f"{labs[0]},someone/so100"
