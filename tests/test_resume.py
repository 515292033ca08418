"""A run that is killed in the middle of a round can be resumed and ends bit for bit like an uninterrupted one."""

import contextlib
import json
import os
import resource
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import psutil
import pytest
from safetensors.numpy import load_file, save_file

from conftest import heed_interrupts, wait_for_interrupted
from fedvla_lib import files, run_folder
from fedvla_lib.cli import main as main_module
from fedvla_lib.cli.main import main
from fedvla_lib.config import from_profile, to_run_config
from fedvla_lib.engines import inline, simulation
from fedvla_lib.federation import checkpoint, server_app
from fedvla_lib.federation.checkpoint import Checkpoint

MAIN = Path(main_module.__file__).with_name("__main__.py")
NOISED = {"normalisation": "base", "clip_norm": 0.05, "clip_quantile": 0.3, "noise": 0.1}
KEEPING = {"strategy": "scaffold", "keep_optimizer": True, "exchange": "int8", "personal": "projections"}


@pytest.fixture
def tiny(recording, tmp_path):
    return from_profile(
        "tiny", base="nano", data=str(recording), num_clients=3, num_server_rounds=4, local_steps=2, eval_rollouts=0,
        client_rollouts=0, num_threads=1, out=str(tmp_path / "outputs"),
    )  # fmt: skip


def start_until(python, config, round_number, engine_name="inline", written="checkpoints/round_{}"):
    """Start a run with a Python and wait until clients train in a round; return the process and the run folder.

    With `written` until the round before has written that.
    """
    given = {key: value for key, value in to_run_config(config).items() if key != "resume" and value != ""}
    switches = [f"--{key}" if value else f"--no-{key}" for key, value in given.items() if isinstance(value, bool)]
    values = [f"--{key}={value}" for key, value in given.items() if not isinstance(value, bool)]
    process = subprocess.Popen(
        [python, MAIN, "run", "--engine", engine_name, *switches, *values],
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, start_new_session=True,
        preexec_fn=heed_interrupts,
    )  # fmt: skip
    deadline = time.monotonic() + 300
    # Once the round before has its checkpoint, this one has begun.
    while not (found := list(Path(config.out).glob(f"*/{written.format(round_number - 1)}"))):
        assert process.poll() is None and time.monotonic() < deadline, process.stderr.read()
        time.sleep(0.005)
    return process, found[0].parents[1]


def start_and_kill(python, config, *until):
    """Kill all processes while clients train in a round, as a power cut would; return the run folder."""
    process, root = start_until(python, config, *until)
    assert run_folder.read_stamp(root)["status"] == "running"
    for one in [*psutil.Process(process.pid).children(recursive=True), process]:
        with contextlib.suppress(psutil.NoSuchProcess):
            one.send_signal(signal.SIGKILL)
    process.wait()
    wait_for_interrupted(root)
    return root


def start_kill_and_damage(python, config, round_number):
    """Kill a run and flip one bit of its last checkpoint, as a failing disk would."""
    root = start_and_kill(python, config, round_number)
    last = max((root / "checkpoints").glob("round_*"), key=lambda folder: int(folder.name.removeprefix("round_")))
    flip(last / "arrays.safetensors", -1)
    return root


def flip(file, position):
    """Flip one bit of a file."""
    content = bytearray(file.read_bytes())
    content[position] ^= 1
    file.write_bytes(content)


def start_and_interrupt(python, config, round_number):
    """Press Ctrl-C while clients train in a round: a terminal sends the signal to the whole group."""
    process, root = start_until(python, config, round_number)
    os.killpg(process.pid, signal.SIGINT)
    said = process.communicate(timeout=60)[1]
    assert process.returncode == 130 and "interrupted: completed rounds are in the run folder" in said
    assert run_folder.read_stamp(root)["status"] == "interrupted"
    return root


def start_and_fill_the_disk(_, config, round_number):
    """From this round on the process, which has to be its own, cannot write a file as large as a model: a full disk."""
    if not hasattr(resource, "prlimit"):
        pytest.skip("only Linux can limit a running process")
    process, root = start_until(sys.executable, config, round_number)
    resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (50_000, 50_000))
    last = process.communicate(timeout=60)[1].splitlines()[-1]  # after the progress bars
    assert process.returncode == 2 and last.startswith(f"fedvla run: cannot write {root}/")
    assert "failed: OSError: cannot write" in run_folder.read_stamp(root)["status"]
    return root


def last_model(root, rounds=4):
    return load_file(root / f"global_model/round_{rounds}/model.safetensors")


def assert_same_bits(left, right):
    assert left.keys() == right.keys()
    assert all(left[name].tobytes() == right[name].tobytes() for name in left)


@pytest.mark.integration
@pytest.mark.slow
@pytest.mark.parametrize(
    ("settings", "start_and_end"),
    [
        ({"strategy": "fedavg"}, start_and_fill_the_disk),
        (KEEPING, start_and_kill),
        ({"strategy": "fedavgm"}, start_and_interrupt),
        ({"strategy": "fedadam"}, start_kill_and_damage),
        (NOISED, start_and_kill),
    ],
    ids=["full disk", "killed", "interrupted", "damaged", "killed with adaptive clipping and noise"],
)
def test_a_run_that_did_not_end_is_resumed_and_ends_in_the_same_bits(
    tiny, settings, start_and_end, warm_python, caplog
):
    config = replace(tiny, **settings)
    whole = inline.run_inline(config, progress=False)
    root = start_and_end(warm_python, replace(config, out=config.out + "_ended"), 3)
    assert main(["run", "--resume", str(root)]) == 0
    assert (f"{root}/checkpoints/round_" in caplog.text) == (start_and_end is start_kill_and_damage)
    assert_same_bits(last_model(root), last_model(whole))
    assert run_folder.read_stamp(root)["status"] == "completed" and run_folder.read_stamp(root)["resumed"]
    for kind in ("train", "evaluate", "drift", "data"):
        found, wanted = (run_folder.read_metrics(one, kind)[["round", "who"]] for one in (root, whole))
        assert found.values.tolist() == wanted.values.tolist()


@pytest.mark.integration
@pytest.mark.slow
@pytest.mark.parametrize("written", ["checkpoints/round_{}", "global_model/round_{}"], ids=["in round 1", "in round 0"])
def test_a_run_killed_before_a_round_was_complete_is_resumed_too(tiny, written, warm_python, capsys):
    config = replace(tiny, num_server_rounds=1)
    whole = inline.run_inline(config, progress=False)
    root = start_and_kill(warm_python, replace(config, out=config.out + "_ended"), 1, "inline", written)
    assert main(["train", "--resume", str(root)]) == 2
    assert "is a folder of fedvla run or deploy: fedvla train cannot resume it" in capsys.readouterr().err
    assert main(["run", "--resume", str(root)]) == 0
    assert_same_bits(last_model(root, 1), last_model(whole, 1))
    for kind in ("train", "evaluate", "data"):
        found, wanted = (run_folder.read_metrics(one, kind)[["round", "who"]] for one in (root, whole))
        assert found.values.tolist() == wanted.values.tolist()


@pytest.mark.integration
@pytest.mark.slow
def test_a_simulation_killed_whole_goes_on_and_ends_in_the_same_bits(tiny):
    """SuperLink, server and workers are killed together, as in a power cut; the files that they wrote are enough."""
    whole = inline.run_inline(tiny, progress=False)
    config = replace(tiny, out=tiny.out + "_killed")
    root = start_and_kill(sys.executable, config, 2, "simulation")
    assert simulation.run_simulation(replace(config, resume=str(root))) == root
    assert_same_bits(last_model(root), last_model(whole))
    assert run_folder.read_stamp(root)["status"] == "completed"


@pytest.mark.integration
def test_what_cannot_be_resumed_is_refused_in_one_line(tiny, tmp_path, capsys):
    done = inline.run_inline(replace(tiny, num_server_rounds=1), progress=False)
    refusals = {
        (str(done),): "completed run",
        (str(tmp_path / "nowhere"),): "is not a run folder: it has no config.json",
        (str(done), "--lr", "0.1"): "--lr cannot be given with --resume",
    }
    capsys.readouterr()
    for arguments, words in refusals.items():
        assert main(["run", "--resume", *arguments]) == 2
        said = capsys.readouterr().err
        assert words in said and len(said.splitlines()) == 1
    stamp = run_folder.read_stamp(done)
    files.write_json(done / "stamp.json", stamp | {"status": "running"})
    for folder in (done / "checkpoints").glob("round_*"):
        (folder / "arrays.safetensors").write_bytes(b"half of it")
    assert main(["run", "--resume", str(done)]) == 2
    assert "no intact checkpoint before it" in capsys.readouterr().err
    assert json.loads((done / "stamp.json").read_text())["status"].startswith("failed")


@pytest.mark.unit
def test_an_engine_that_cannot_reach_what_clients_keep_says_so_instead_of_resuming(tmp_path):
    """In a deployment this state is in the clients' processes and ends with the run."""
    run, resumed = run_folder.RunFolder(tmp_path), from_profile("tiny", resume=str(tmp_path))
    checkpoint.save(tmp_path, Checkpoint(2, {"w": np.ones(3, np.float32)}, {}, {}))
    run.log(2, "global", "evaluate", {"loss": 1.0})
    for setting, value in KEEPING.items():
        with pytest.raises(ValueError, match="makes clients keep state .* resume on engine inline, or start a new run"):
            server_app._resume_from(replace(resumed, **{setting: value}), run, None)
    assert server_app._resume_from(resumed, run, None).round == 2


@pytest.mark.unit
def test_a_checkpoint_is_whole_or_absent_and_only_the_last_two_stay(tmp_path, monkeypatch):
    arrays = {"w": np.arange(3, dtype=np.float32), "v": np.float64(2.0) * np.ones((2, 2))}
    for number in range(4):
        checkpoint.save(tmp_path, Checkpoint(number, arrays, {}, checkpoint.flat({"1:control": arrays})))
    assert sorted(path.name for path in (tmp_path / "checkpoints").iterdir()) == ["round_2", "round_3"]
    found = checkpoint.load(tmp_path)
    assert found.round == 3 and found.arrays["v"].dtype == np.float64
    assert checkpoint.nested(found.clients)["1:control"]["w"].tolist() == [0, 1, 2]

    def full(content, path, **options):
        if path.name.startswith("clients"):
            raise OSError(28, "No space left on device")
        save_file(content, path, **options)

    monkeypatch.setattr(checkpoint, "save_file", full)
    with pytest.raises(OSError, match="No space left"):
        checkpoint.save(tmp_path, Checkpoint(4, arrays, {}, {}))
    assert sorted(path.name for path in (tmp_path / "checkpoints").iterdir()) == ["round_2", "round_3"]


DAMAGES = {
    "cut off": lambda file: os.truncate(file, file.stat().st_size // 2),
    "empty": lambda file: os.truncate(file, 0),
    "missing": Path.unlink,
    "another's": lambda file: save_file({"w": np.zeros(3, np.float32)}, file),
}


@pytest.mark.unit
@pytest.mark.parametrize("part", checkpoint.PARTS)
@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_checkpoint_is_named_and_the_one_before_it_taken(tmp_path, part, damage, caplog):
    for number in (1, 2):
        arrays = {"w": np.full(3, number, np.float32)}
        checkpoint.save(tmp_path, Checkpoint(number, arrays, arrays, arrays))
    DAMAGES[damage](tmp_path / f"checkpoints/round_2/{part}.safetensors")
    found = checkpoint.load(tmp_path)
    assert found.round == 1 and getattr(found, part)["w"].tolist() == [1, 1, 1]
    assert f"{tmp_path}/checkpoints/round_2 is damaged" in caplog.text and "round_1" not in caplog.text
    DAMAGES[damage](tmp_path / f"checkpoints/round_1/{part}.safetensors")
    with pytest.raises(ValueError, match="round_1 is damaged .* no intact checkpoint before it"):
        checkpoint.load(tmp_path)


@pytest.mark.unit
def test_no_flipped_bit_of_a_checkpoint_goes_unnoticed(tmp_path):
    checkpoint.save(tmp_path, Checkpoint(1, {"w": np.arange(5, dtype=np.float32)}, {}, {}))
    file = tmp_path / "checkpoints/round_1/arrays.safetensors"
    for position in range(file.stat().st_size):
        flip(file, position)
        with pytest.raises(ValueError, match="round_1 is damaged"):
            checkpoint.load(tmp_path)
        flip(file, position)
    assert checkpoint.load(tmp_path).round == 1


FULL = """
import resource, signal, sys
from pathlib import Path
import numpy as np
from fedvla_lib.federation import checkpoint
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, 50_000))
kept = {"w": np.zeros(100_000, np.float32)}
try:
    checkpoint.save(Path(sys.argv[1]), checkpoint.Checkpoint(1, {}, {}, kept))
except OSError as error:
    print(error)
"""


@pytest.mark.unit
def test_a_full_disk_is_an_error_of_one_line_that_names_the_file_and_leaves_the_checkpoint_before(tmp_path):
    """In a process with a limit on file sizes: safetensors then raises its own error, which is not an OSError."""
    checkpoint.save(tmp_path, Checkpoint(0, {"w": np.ones(3, np.float32)}, {}, {}))
    done = subprocess.run([sys.executable, "-c", FULL, str(tmp_path)], capture_output=True, text=True, check=True)
    assert done.stdout.startswith(f"cannot write {tmp_path}/checkpoints/round_1/clients.safetensors: ")
    assert done.stdout.count("\n") == 1
    assert [path.name for path in (tmp_path / "checkpoints").iterdir()] == ["round_0"]
    assert checkpoint.load(tmp_path).round == 0
