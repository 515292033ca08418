"""A run on disk is never overwritten, survives a crash, and reads back as tables."""

import contextlib
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from fedvla_lib import files, provenance, run_folder
from fedvla_lib.config import Config, from_profile
from fedvla_lib.engines.inline import run_inline

pytestmark = pytest.mark.unit
ROLLOUT = {"task": "lift", "lab": "", "seed": 3, "success": True, "steps": 77}


def make(config: Config):
    with run_folder.start(config, engine="inline") as run:
        return run.root


def test_runs_of_one_second_get_folders_of_their_own(tmp_path):
    config = from_profile("tiny", out=str(tmp_path / "outputs"))
    with ThreadPoolExecutor(4) as pool:
        roots = list(pool.map(make, [config] * 8))
    assert len(set(roots)) == 8
    assert all(re.fullmatch(r"\d{8}_\d{6}", root.name) for root in roots)


@pytest.mark.parametrize(
    ("last", "every", "kept"),
    [
        (0, 0, [0, 1, 2, 3, 4, 5, 6]),
        (0, 2, [0, 1, 2, 3, 4, 5, 6]),
        (2, 0, [5, 6]),
        (2, 3, [0, 3, 5, 6]),
        (9, 1, list(range(7))),
    ],
)
def test_a_run_keeps_the_models_that_it_is_asked_to_keep(tmp_path, last, every, kept):
    with run_folder.start(from_profile("tiny", out=str(tmp_path)), engine="inline") as run:
        for number in range(7):
            files.write_atomically(run.model_dir(number) / "model.safetensors", b"12345678")
            run.remove_models(last, every)
    assert sorted(int(path.name.removeprefix("round_")) for path in run.root.glob("global_model/*")) == kept
    on_disk = sum(path.stat().st_size for path in run.root.rglob("*.*") if path.name != "stamp.json")
    assert 0 <= run_folder.read_stamp(run.root)["disk_bytes"] - on_disk < 5000  # the stamp itself


@pytest.mark.integration
def test_a_federation_keeps_its_last_model_only_if_asked_to(recording, tmp_path):
    config = from_profile(
        "tiny", data=str(recording), num_server_rounds=2, local_steps=1, fraction_evaluate=0.0, eval_rollouts=0,
        client_rollouts=0, keep_last=1, out=str(tmp_path),
    )  # fmt: skip
    root = run_inline(config, progress=False)
    assert [path.name for path in (root / "global_model").iterdir()] == ["round_2"]


def test_settings_and_stamp_read_back(tmp_path):
    config = from_profile("tiny", out=str(tmp_path), lr=3e-4, seed=7)
    began = time.time()
    root = make(config)
    assert run_folder.read_config(root) == config
    files.write_json(tmp_path / "other/config.json", {**asdict(config), "temperature": 1.0})
    with pytest.raises(ValueError, match="unknown setting 'temperature'"):
        run_folder.read_config(tmp_path / "other")  # of another version
    stamp = run_folder.read_stamp(root)
    assert stamp["status"] == "completed"
    assert 0 <= stamp["wall_s"] <= time.time() - began + 1
    assert stamp["hardware"]["cores"] >= 1
    assert stamp["versions"]["lerobot"]


def test_the_hash_follows_what_is_computed_not_where():
    config = from_profile("tiny")
    moved, changed = from_profile("tiny", out="elsewhere", num_threads=3), from_profile("tiny", seed=1)
    assert provenance.config_hash(config) == provenance.config_hash(moved)
    assert provenance.config_hash(config) != provenance.config_hash(changed)


def test_events_become_columns(tmp_path):
    with run_folder.start(from_profile("tiny", out=str(tmp_path)), engine="inline") as run:
        run.log(0, "global", "evaluate", {"loss": np.float32(2.0), "success_rate": 0.5})
        run.log(1, "client_0", "train", {"loss": 1.0, "steps": np.int64(12)})
        run.log(
            1,
            "client_1",
            "rollout",
            ROLLOUT | {"success": np.bool_(False), "completion_time_s": float("nan"), "round": 99},
        )
    table = run_folder.read_metrics(run.root)
    assert table["round"].tolist() == [0, 1, 1]
    assert table.loss.tolist()[:2] == [2.0, 1.0]
    only = run_folder.read_metrics(run.root, "train")
    assert list(only.columns) == ["round", "who", "kind", "time", "loss", "steps"]
    assert run_folder.read_metrics(run.root, "nothing").empty
    for line in (run.root / "metrics.jsonl").read_text().splitlines():
        json.loads(line, parse_constant=lambda word: pytest.fail(f"{word} is not JSON"))


def test_a_federations_steps_are_counted_by_its_clients_round_by_round(tmp_path):
    with run_folder.start(from_profile("tiny", out=str(tmp_path), num_server_rounds=9), engine="inline") as run:
        for number, who, steps in ((1, "client_0", 4), (1, "client_1", 3), (2, "client_1", 5)):
            run.log(number, who, "train", {"loss": 1.0, "steps": steps})
        run.log(2, "client_0", "rejected", {"to": "train", "reason": "hash"})
        run.log(2, "global", "rollout", ROLLOUT)  # control steps of the robot
    assert run_folder.counted_steps(run.root) == {"in_all": 4 + 3 + 5, "in_a_row": 4 + 5}


def test_a_line_cut_off_by_a_crash_is_left_out_and_a_broken_one_is_named(tmp_path):
    with run_folder.start(from_profile("tiny", out=str(tmp_path)), engine="inline") as run:
        run.log(1, "global", "evaluate", {"loss": 1.0})
    path = run.root / "metrics.jsonl"
    whole = path.read_text()
    path.write_text(whole + '{"round": 2, "who": "glo')
    assert len(run_folder.read_metrics(run.root)) == 1
    path.write_text('{"round": 2, "who": "glo\n' + whole)
    with pytest.raises(ValueError, match="metrics.jsonl line 1 is damaged"):
        run_folder.read_metrics(run.root)


@pytest.mark.parametrize(
    ("error", "status"),
    [(RuntimeError("no clients"), "failed: RuntimeError: no clients"), (KeyboardInterrupt(), "interrupted")],
)
def test_the_stamp_tells_how_a_run_ended(tmp_path, error, status):
    with pytest.raises(type(error)), run_folder.start(from_profile("tiny", out=str(tmp_path)), engine="inline") as run:
        assert run_folder.read_stamp(run.root)["status"] == "running"
        raise error
    assert run_folder.read_stamp(run.root)["status"] == status


WRITING = """
import sys, time
from fedvla_lib import run_folder
from fedvla_lib.config import from_profile
with run_folder.start(from_profile("tiny", out=sys.argv[1]), engine="inline") as run:
    print(run.root, flush=True)
    time.sleep(600)
"""


def test_a_run_is_going_on_as_long_as_its_process_lives(tmp_path):
    """No other process may resume it meanwhile; once killed, it reads as interrupted and may be resumed."""
    process = subprocess.Popen([sys.executable, "-c", WRITING, str(tmp_path)], stdout=subprocess.PIPE, text=True)
    root = Path(process.stdout.readline().strip())
    config, stamp = from_profile("tiny", out=str(tmp_path), resume=str(root)), (root / "stamp.json").read_text()
    assert run_folder.read_stamp(root)["status"] == "running"
    with pytest.raises(ValueError, match=f"{root} is in use: another process still writes to it"):
        make(config)
    assert (root / "stamp.json").read_text() == stamp
    process.kill()
    process.communicate()
    assert (root / "stamp.json").read_text() == stamp  # no process was left to update it
    assert run_folder.read_stamp(root)["status"] == "interrupted"
    assert make(config) == root and run_folder.read_stamp(root)["status"] == "completed"


def test_a_stamp_of_a_run_before_there_were_locks_is_read_too(tmp_path):
    files.write_json(
        tmp_path / "stamp.json",
        {"status": "running"} | dict.fromkeys(("engine", "started"), "") | {"seed": 0, "wall_s": None},
    )
    assert run_folder.read_stamp(tmp_path)["status"] == "interrupted"
    assert not (tmp_path / run_folder.LOCK).exists()


def test_an_unwritable_place_is_named(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(ValueError, match="cannot make the run folder .*file.*give a writable folder"):
        make(from_profile("tiny", out=str(tmp_path / "file")))


@contextlib.contextmanager
def read_only(folder):
    """Make a folder read-only for the block; root, who may write anywhere, becomes another user meanwhile."""
    is_root, everything = os.geteuid() == 0, [folder, *folder.rglob("*")]
    for path in everything:
        path.chmod(0o555)
    if is_root:
        os.seteuid(65534)
    try:
        yield
    finally:
        if is_root:
            os.seteuid(0)
        for path in everything:
            path.chmod(0o755)


@pytest.mark.skipif(os.name != "posix", reason="sets POSIX permissions")
def test_a_read_only_place_is_named_and_left_as_it_is(tmp_path, monkeypatch):
    """A new run and a resumed one, in a folder that other users can read, which pytest's is not."""
    monkeypatch.setenv("PATH", str(tmp_path))  # no git: the other user may not read this checkout
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        config = from_profile("tiny", out=str(place / "outputs"))
        with pytest.raises(KeyboardInterrupt), run_folder.start(config, engine="inline") as run:
            run.log(1, "global", "evaluate", {"loss": 1.0})
            raise KeyboardInterrupt
        before = {path: path.read_bytes() for path in place.rglob("*") if path.is_file()}
        with read_only(place):
            with pytest.raises(ValueError, match=f"cannot make the run folder {place}/outputs/.*Permission denied"):
                make(config)
            with pytest.raises(PermissionError, match=str(run.root)):
                make(replace(config, resume=str(run.root)))
        assert {path: path.read_bytes() for path in place.rglob("*") if path.is_file()} == before


def test_a_folder_that_is_no_run_is_named(tmp_path):
    with pytest.raises(ValueError, match="is not a run folder"):
        run_folder.read_metrics(tmp_path)


def test_atomic_writes_leave_no_scratch_files(tmp_path):
    files.write_json(tmp_path / "a.json", {"x": [np.float64(1), float("inf")]})
    assert json.loads((tmp_path / "a.json").read_text()) == {"x": [1.0, None]}
    assert [path.name for path in tmp_path.iterdir()] == ["a.json"]
