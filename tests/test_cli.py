"""The command line: one line and status 2 for bad input, status 130 and a kept recording after Ctrl-C."""

import argparse
import ctypes
import json
import os
import re
import signal
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import pandas as pd
import pytest

from conftest import heed_interrupts
from fedvla_lib import run_folder
from fedvla_lib.cli import commands
from fedvla_lib.cli.commands import settings
from fedvla_lib.cli.main import main
from fedvla_lib.cli.parser import build_parser
from fedvla_lib.config import Config, from_profile, from_run_config
from fedvla_lib.engines import inline
from fedvla_lib.evaluation.statistics import P_VALUES
from fedvla_lib.files import write_json

COMMANDS = ["doctor", "record", "inspect", "pretrain", "experts", "config", "train", "run", "evaluate"]


@pytest.mark.unit
def test_no_table_shows_a_p_value_of_zero(capsys):
    commands._print_table(pd.DataFrame({"difference": [0.00041], **dict.fromkeys(P_VALUES, [4e-7])}))
    assert capsys.readouterr().out.splitlines()[1].split() == ["0.000", *["<", "0.001"] * len(P_VALUES)]


@pytest.mark.unit
@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help(command, capsys):
    with pytest.raises(SystemExit) as ended:
        main([command, "--help"])
    assert ended.value.code == 0 and "usage: fedvla " + command in capsys.readouterr().out


@pytest.mark.unit
def test_config_prints_toml_that_flower_can_read(capsys):
    assert main(["config", "--profile", "tiny", "--num-server-rounds", "3", "--lr", "2e-5", "--augment"]) == 0
    printed = tomllib.loads(capsys.readouterr().out)
    assert from_run_config(printed) == from_profile("tiny", num_server_rounds=3, lr=2e-5, augment=True)


@pytest.mark.unit
def test_every_setting_is_a_flag_and_unset_flags_leave_the_profile_alone():
    parser = build_parser()
    assert settings(parser.parse_args(["run", "--profile", "laptop"])) == Config()
    assert settings(parser.parse_args(["run", "--profile", "gpu"])) == from_profile("gpu")
    assert settings(parser.parse_args(["train", "--no-freeze-vision-encoder"])).freeze_vision_encoder is False


BEYOND = (
    "lr=inf", "lr=nan", "lr=1e30", "clip-norm=inf", "dirichlet-alpha=inf", "chunk-size=100000000", "seed=10" + 29 * "0",
    "num-threads=100000000", "num-clients=1000000", "warmup-steps=1" + 20 * "0", "lora-rank=1000000", "device=nope",
    "tasks=lift,lift", "round-timeout-s=inf", "delta=2", "seed=-1",
)  # fmt: skip


@pytest.mark.unit
@pytest.mark.parametrize("setting", BEYOND)
def test_a_setting_beyond_its_limits_is_refused_in_one_line(setting, capsys):
    name, value = setting.split("=")
    assert main(["config", f"--{name}", value]) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"fedvla config: {name}=") and "is not usable: give" in said and said.count("\n") == 1


@pytest.mark.unit
def test_more_malicious_clients_than_krum_can_withstand_are_refused(capsys):
    assert main(["config", "--profile", "laptop", "--strategy", "krum", "--num-malicious", "50"]) == 2
    assert "num-malicious=50 is not usable: give less than half of the 4 clients of a round" in capsys.readouterr().err


@pytest.mark.unit
@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["config", "--profile", "huge"], "unknown profile 'huge': choose one of tiny, laptop, gpu"),
        (["config", "--num-clients", "0"], "num-clients=0 is not usable"),
        (["run", "--partition", "alphabet"], "partition='alphabet' is not usable"),
        (["record", "--task", "juggle", "--out", "{tmp}/rec"], "unknown task 'juggle': choose one of lift"),
        (["record", "--episodes", "0"], "episodes-per-task=0 is not usable"),
        (["experts", "--episodes", "0"], "--episodes 0 is not usable: give 1 or more"),
        (["experts", "--task", "juggle"], "unknown task 'juggle'"),
        (["pretrain", "--out", "{tmp}"], "{tmp} exists already: give a folder that does not"),
        (["pretrain", "--out", "{tmp}/new", "--steps", "0"], "--steps 0 is not usable: give 1 or more"),
        (["evaluate", "{tmp}"], "{tmp} is not a pretrained_model folder: it has no config.json"),
        (["evaluate", "{tmp}", "--rollouts", "0"], "--rollouts 0 is not usable"),
        (["train", "--resume", "{tmp}/none"], "{tmp}/none"),
        (["train", "--resume", "{tmp}", "--lr", "1e-4"], "--lr cannot be given with --resume"),
        (["train", "--steps", "-5", "--out", "{tmp}/out"], "--steps -5 is not usable: give 1 or more"),
        (["compare", "{tmp}", "{tmp}/b", "--metrics", ""], "unknown metric ''"),
        (["train", "--profile", "tiny", "--client", "9", "--out", "{tmp}/out"], "partition-id=9"),
    ],
)
def test_bad_input_is_one_line_and_status_2(arguments, said, capsys, tmp_path, monkeypatch):
    monkeypatch.setenv("FEDVLA_CACHE", os.fspath(tmp_path / "cache"))
    assert main([part.format(tmp=tmp_path) for part in arguments]) == 2
    captured = capsys.readouterr()
    assert said.format(tmp=tmp_path) in captured.err and captured.err.startswith(f"fedvla {arguments[0]}: ")
    assert captured.err.count("\n") == 1 and "Traceback" not in captured.err and captured.out == ""


@pytest.mark.unit
@pytest.mark.parametrize("arguments", [[], ["cook"], ["config", "--lr", "fast"], ["run", "--rounds", "3"]])
def test_bad_usage_is_one_line_and_status_2(arguments, capsys):
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    captured = capsys.readouterr()
    assert ended.value.code == 2 and captured.err.count("\n") == 1 and "--help" in captured.err


@pytest.mark.unit
def test_traceback_on_request(capsys):
    assert main(["--traceback", "config", "--num-clients", "0"]) == 2
    assert "Traceback" in capsys.readouterr().err


@pytest.mark.unit
def test_policy_without_our_cameras_is_refused(tmp_path, capsys):
    (tmp_path / "config.json").write_text(json.dumps({"input_features": {}, "chunk_size": 4, "n_action_steps": 2}))
    assert main(["evaluate", str(tmp_path)]) == 2
    assert "has no camera 'overhead'" in capsys.readouterr().err


@pytest.mark.integration
def test_experts_prints_a_rate_with_its_interval(capsys):
    assert main(["experts", "--task", "lift", "--episodes", "2"]) == 0
    header, row = capsys.readouterr().out.strip().splitlines()
    assert header.split() == ["task", "n", "successes", "success_rate", "low", "high"]
    assert row.split()[:3] == ["lift", "2", "2"]


TINY = ["--profile", "tiny", "--tasks", "lift", "--episodes-per-task", "4", "--base", "nano", "--num-clients", "2"]


@pytest.mark.integration
def test_train_then_evaluate(tmp_path, capsys):
    out = tmp_path / "outputs"
    assert main(["train", *TINY, "--steps", "2", "--val-fraction", "0.25", "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "2 steps in" in printed and "held-out frames: loss" in printed
    policy = Path(printed.splitlines()[-1])
    assert (policy / "model.safetensors").is_file() and policy.parent.parent == out
    rollouts = tmp_path / "rollouts"
    assert main(["evaluate", str(policy), "--task", "lift", "--rollouts", "1", "--out", str(rollouts)]) == 0
    assert capsys.readouterr().out.splitlines()[1].split()[:2] == ["lift", "1"]
    assert len((rollouts / "rows.csv").read_text().splitlines()) == 2
    assert len(list((rollouts / "videos").glob("*.mp4"))) == 1


@pytest.mark.integration
def test_resumed_training_ends_like_an_uninterrupted_one(tmp_path, capsys):
    common = [*TINY, "--client", "1", "--checkpoint-every", "1", "--out"]
    whole, halves = tmp_path / "whole", tmp_path / "halves"
    assert main(["train", "--steps", "2", *common, str(whole)]) == 0
    assert main(["train", "--steps", "2", *common, str(halves)]) == 0
    root = next(halves.iterdir())
    _undo_last_step(root)
    for wrong in ("--client=0", "--steps=5"):
        assert main(["train", "--resume", str(root), wrong]) == 2
        assert "cannot be given with --resume: a training keeps its own" in capsys.readouterr().err
    assert main(["run", "--resume", str(root)]) == 2
    assert "is a folder of fedvla train: fedvla run or deploy cannot resume it" in capsys.readouterr().err
    assert main(["train", "--resume", str(root)]) == 0
    counted = run_folder.read_metrics(root, "evaluate").gradient_steps
    assert counted.iloc[-1] == 2 and "2 steps in" in capsys.readouterr().out
    weights = [next(path.glob("*/model/model.safetensors")) for path in (whole, halves)]
    assert weights[0].read_bytes() == weights[1].read_bytes()
    stamp = json.loads((root / "stamp.json").read_text())
    assert stamp["status"] == "completed" and (stamp["client"], stamp["steps"]) == (1, 2)


def _undo_last_step(root: Path) -> None:
    """Restore a run folder to its state after the first checkpoint, as if training had been killed then."""
    checkpoints = sorted((root / "checkpoints").iterdir())
    assert len(checkpoints) == 2
    for folder in (checkpoints[-1], root / "model"):
        for path in sorted(folder.rglob("*"), reverse=True):
            path.rmdir() if path.is_dir() else path.unlink()
        folder.rmdir()
    write_json(root / "stamp.json", {**run_folder.read_stamp(root), "status": "interrupted"})


@pytest.mark.integration
def test_run_prints_the_rounds_and_the_run_folder(tmp_path, capsys):
    out = tmp_path / "outputs"
    assert main(["run", *TINY, "--num-server-rounds", "1", "--client-rollouts", "0", "--out", str(out)]) == 0
    lines = capsys.readouterr().out.strip().splitlines()
    assert "round" in lines[0].split() and "loss" in lines[0].split()
    root = Path(lines[-1])
    assert root.parent == out and (root / "global_model" / "round_1" / "model.safetensors").is_file()


@pytest.mark.integration
def test_a_run_that_fails_is_status_2_and_a_line_with_the_reason(recording, tmp_path, capfd):
    flags = ["--profile", "tiny", "--data", str(recording), "--min-replies", "9", "--out", str(tmp_path)]
    assert main(["run", *flags]) == 2
    said = capfd.readouterr().err.splitlines()[-1]
    assert said.startswith("fedvla run: 3 of 3 clients could be used, min-replies=9 are required")


@pytest.mark.unit
def test_a_small_run_starts_no_workers_unless_told_to(monkeypatch):
    asked = []
    monkeypatch.setattr(inline, "run_inline", lambda config, jobs: asked.append(jobs))
    monkeypatch.setattr(commands, "_print_rounds", lambda root: None)
    monkeypatch.setenv("FEDVLA_JOBS", "3")
    for words in (["--profile", "tiny"], ["--profile", "tiny", "--jobs", "2"], ["--profile", "laptop"]):
        assert main(["run", *words]) == 0
    assert asked == [1, 2, 3]


@pytest.mark.integration
@pytest.mark.skipif(os.name != "posix", reason="sends a POSIX signal")
@pytest.mark.parametrize("error", [ctypes.ArgumentError, RuntimeError])
def test_an_interruption_stays_one_if_the_code_makes_another_error_of_it(error, monkeypatch, capsys):
    """As ctypes does where it converts an argument."""

    def interrupted(_):
        try:
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(10)
        except KeyboardInterrupt:
            raise error("argument 1: KeyboardInterrupt") from None

    parser = argparse.ArgumentParser()
    parser.set_defaults(handler=interrupted, kept="all of it", traceback=False, command="record")
    monkeypatch.setattr("fedvla_lib.cli.main.build_parser", lambda: parser)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a background job ignores it
    try:
        assert main([]) == 130 and capsys.readouterr().err == (
            f"\ninterrupted: all of it (then {error.__name__}: argument 1: KeyboardInterrupt)\n"
        )
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)


@pytest.mark.integration
@pytest.mark.skipif(os.name != "posix", reason="sends a POSIX signal")
def test_ctrl_c_keeps_complete_episodes_and_the_recording_goes_on(tmp_path):
    root = tmp_path / "demos"
    arguments = ["record", "--task", "lift", "--image-size", "64", "--out", str(root), "--episodes"]
    command = [sys.executable, "-m", "fedvla_lib.cli", *arguments, "500"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, preexec_fn=heed_interrupts)
    _wait_for_episodes(root, process, at_least=2)
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=60)
    assert process.returncode == 130, said
    assert "interrupted: complete episodes are kept, the same command continues" in said
    assert "Traceback" not in said
    kept = _num_episodes(root)
    assert 2 <= kept < 500
    assert main([*arguments, str(kept + 1)]) == 0
    assert _num_episodes(root) == kept + 1


def _wait_for_episodes(root: Path, process: subprocess.Popen, at_least: int) -> None:
    deadline = time.monotonic() + 180
    while _num_episodes(root) < at_least:
        assert process.poll() is None and time.monotonic() < deadline, "the recording did not get going"
        time.sleep(0.1)


def _num_episodes(root: Path) -> int:
    info = root / "meta" / "info.json"
    return json.loads(info.read_text())["total_episodes"] if info.is_file() else 0


@pytest.mark.unit
def test_no_heavy_package_is_loaded_for_help_and_settings():
    script = "from fedvla_lib.cli.main import main; main(['config'])"
    code = f"import sys; {script}; print(sorted(sys.modules), file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = set(re.findall(r"'(\w+)'", done.stderr))
    assert not loaded & {"torch", "lerobot", "flwr", "mujoco", "matplotlib", "pandas"}
