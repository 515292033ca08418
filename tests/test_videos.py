"""`fedvla videos` on a real run's videos: what it prints is what was measured, and a damaged file is named."""

import shutil
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from fedvla_lib import run_folder
from fedvla_lib.cli.main import main
from fedvla_lib.config import from_profile
from fedvla_lib.engines import inline
from fedvla_lib.evaluation import video, video_report

pytestmark = [pytest.mark.integration, pytest.mark.slow]


@pytest.fixture(scope="module")
def run(recording, tmp_path_factory):
    tiny = from_profile(
        "tiny", base="nano", data=str(recording), num_clients=2, num_server_rounds=1, local_steps=1, eval_rollouts=1,
        eval_every=1, client_rollouts=1, num_threads=1,
    )  # fmt: skip
    return inline.run_inline(replace(tiny, out=str(tmp_path_factory.mktemp("run"))), progress=False)


def test_what_the_videos_say_is_what_the_run_measured(run, tmp_path, capsys):
    assert main(["videos", str(run / "evaluate"), "--who", "global", "--out", str(tmp_path)]) == 0
    rounds = pd.read_csv(tmp_path / "rounds.csv").set_index(["metric", "round"]).value
    logged = run_folder.read_metrics(run, "rollout").query("who == 'global'")
    for number, part in logged.groupby("round"):
        assert rounds["success_rate", number] == pytest.approx(part.success.mean())
        assert rounds["action_smoothness", number] == pytest.approx(part.action_smoothness.mean())
    assert len(pd.read_csv(tmp_path / "rollouts.csv")) == len(logged)
    assert (tmp_path / "trend.png").stat().st_size > 1000
    assert "0 damaged files" in capsys.readouterr().out


def test_without_videos_the_global_models_rollouts_are_the_same(run, tmp_path):
    other = inline.run_inline(replace(run_folder.read_config(run), videos=False, out=str(tmp_path)), progress=False)
    seen, unseen = (run_folder.read_metrics(root, "rollout").query("who == 'global'") for root in (run, other))
    same = ["round", "task", "seed", "success", "steps", "action_smoothness"]
    pd.testing.assert_frame_equal(seen[same], unseen[same])
    assert unseen.video.isna().all() and not list(other.glob("evaluate/*/global"))


def test_damaged_files_are_listed_and_the_rest_is_counted(run, tmp_path, capsys):
    folder = tmp_path / "evaluate"
    shutil.copytree(run / "evaluate", folder)
    paths = sorted(folder.rglob("*.mp4"))
    paths[0].write_bytes(paths[0].read_bytes()[:200])
    paths[1].with_suffix(".npz").unlink()
    paths[2].write_bytes(video.encode_video(video.read_video(paths[2])[:-3]))  # plays, but ends too early
    paths[3].with_suffix(".npz").write_bytes(b"PK")
    assert main(["videos", str(folder)]) == 1
    said = capsys.readouterr()
    assert f"{len(paths) - 4} rollouts with intact videos, 4 damaged files" in said.out
    lines = said.err.strip().splitlines()
    assert len(lines) == 4 and all(any(path.name in line for line in lines) for path in paths[:4])
    assert "frames, its trajectory" in said.err


def test_bad_input_is_one_line(run, tmp_path, capsys):
    for arguments, words in (
        ([str(tmp_path)], "holds no round_N/WHO/rollout_*.mp4"),
        ([str(run / "evaluate"), "--metrics", "grace"], "unknown metric 'grace': choose from success_rate"),
        ([str(run / "evaluate"), "--who", "nobody"], "--who nobody has no video there: choose from client_0"),
    ):
        assert main(["videos", *arguments]) == 2
        said = capsys.readouterr().err
        assert words in said and len(said.splitlines()) == 1


def test_a_round_without_a_success_has_no_completion_time():
    rows = pd.DataFrame({"round": [0, 0], "success": [False, False], "completion_time": [np.nan, np.nan]})
    (line,) = video_report.trend_by_round(rows, "completion_time").to_dict("records")
    assert line["n"] == 0 and np.isnan(line["value"])
