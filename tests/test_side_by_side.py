"""Whatever runs side by side in worker processes gives what one process gives, bit for bit."""

import hashlib
import shutil
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest

from fedvla_book.tables import results
from fedvla_lib import run_folder
from fedvla_lib.config import from_profile
from fedvla_lib.data import normalisation, record
from fedvla_lib.engines import inline
from fedvla_lib.evaluation import rollouts
from fedvla_lib.experiments import experiment
from fedvla_lib.experiments.experiment_file import read_plan
from fedvla_lib.federation import checkpoint, client_app
from fedvla_lib.policy import model
from fedvla_lib.policy.actor import PolicyActor

pytestmark = pytest.mark.integration
PLAN = """
profile = "tiny"
seeds = [0, 1]
rollouts = 1
[settings]
tasks = "lift,push"
data = {data!r}
num_server_rounds = 1
[partitions.mixed]
[methods.start]
kind = "base"
[methods.averaged]
"""


def bytes_of(folder: Path) -> str:
    """SHA-256 of names and contents of all files below a folder."""
    whole = hashlib.sha256()
    for path in sorted(path for path in folder.rglob("*") if path.is_file() and path.name != ".lock"):
        whole.update(path.relative_to(folder).as_posix().encode() + path.read_bytes())
    return whole.hexdigest()


def test_episodes_of_a_recording(tmp_path, monkeypatch):
    monkeypatch.setattr(record, "WORTH_WORKERS", 1)
    found = set()
    for jobs in ("1", "3"):
        monkeypatch.setenv("FEDVLA_JOBS", jobs)
        folder = tmp_path / jobs
        record.record(["lift", "push"], 2, folder, image_size=64, num_labs=2, jitter=0.5, progress=False)
        found.add(bytes_of(folder))
    assert len(found) == 1


def test_rollouts_of_an_evaluation(store, tmp_path, monkeypatch):
    monkeypatch.setattr(rollouts, "WORTH_WORKERS", 1)
    bundle = model.load_policy(from_profile("tiny"), normalisation.episode_stats(store, [0, 1]))
    tables = []
    for jobs in (1, 2):
        seeds, options = rollouts.rollout_seeds(rollouts.AT_ONCE + 2), {"image_size": 64, "progress": False}
        found = rollouts.evaluate(PolicyActor(bundle), ["push"], seeds, jobs=jobs, **options)
        tables.append(pd.DataFrame(found))
    pd.testing.assert_frame_equal(*tables)
    videos = rollouts.evaluate(PolicyActor(bundle), ["lift", "push"], seeds[:1], videos_dir=tmp_path, jobs=2, **options)
    assert all(Path(row["video"]).is_file() for row in videos)


def test_clients_of_a_federation(recording, tmp_path):
    kept = {"strategy": "scaffold", "keep_optimizer": True, "exchange": "int8"}  # by clients, from round to round
    config = from_profile("tiny", data=str(recording), num_server_rounds=2, num_clients=3, **kept)
    ended = {}
    for jobs in (1, 2):
        run = inline.run_inline(replace(config, out=str(tmp_path / str(jobs))), progress=False, jobs=jobs)
        last, rows = checkpoint.load(run), run_folder.read_metrics(run, "rollout")
        ended[jobs] = last, rows.drop(columns=["time", "video"])
    (one, rows), (several, same_rows) = ended.values()
    for part in ("arrays", "strategy", "clients"):
        left, right = getattr(one, part), getattr(several, part)
        assert left.keys() == right.keys() and all((left[name] == right[name]).all() for name in left), part
    assert one.clients and len(rows) > 0
    pd.testing.assert_frame_equal(rows, same_rows)


def test_a_client_that_fails_in_a_worker_is_rejected_by_name(recording, tmp_path):
    data = [recording, shutil.copytree(recording, tmp_path / "damaged")]
    config = from_profile("tiny", data=str(recording), num_clients=2, eval_rollouts=0, client_rollouts=0,
                          num_server_rounds=1, out=str(tmp_path / "runs"))  # fmt: skip
    next((tmp_path / "damaged").rglob("*.mp4")).write_bytes(b"")
    run = inline.run_inline(config, data=data, progress=False, jobs=2)
    (rejected,) = run_folder.read_metrics(run, "rejected").to_dict("records")
    assert rejected["to"] == "query" and "DataError" in rejected["detail"]


def test_a_client_app_of_ones_own_stays_in_this_process(recording):
    config = from_profile("tiny", data=str(recording))
    with pytest.raises(ValueError, match="jobs=2: clients_app and raise_errors need jobs=1"):
        inline.run_inline(config, clients_app=client_app.app, jobs=2)


def test_cells_of_an_experiment(recording, tmp_path, monkeypatch):
    (tmp_path / "plan.toml").write_text(PLAN.format(data=str(recording)))
    plan, tables, lines = read_plan(tmp_path / "plan.toml"), [], []
    for jobs in (1, 2):
        monkeypatch.setenv("FEDVLA_CACHE", str(tmp_path / f"cache-{jobs}"))  # not the first's
        experiment.run_plan(plan, tmp_path / str(jobs), say=lines.append, jobs=jobs)
        found = results.read_results(tmp_path / str(jobs))
        tables.append(found.sort_values(list(found.columns[:6])).reset_index(drop=True))
    varying = [name for name in tables[0] if name in ("time", "train_s", "seconds", "in_a_row_s")]
    pd.testing.assert_frame_equal(*(table.drop(columns=varying) for table in tables))
    assert sum(line.startswith("[4/4]") for line in lines) == 2
