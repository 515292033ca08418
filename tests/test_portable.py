"""A saved policy loads with LeRobot alone after a copy, a rename and on another machine; no saved file names a path."""

import json
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from fedvla_lib.cli.main import main
from fedvla_lib.config import from_profile
from fedvla_lib.policy import model
from fedvla_lib.policy.portable import PREPROCESSOR_FILE, name_backbone
from fedvla_lib.robot.spec import ACTION_KEY, CAMERAS, STATE_KEY, image_key

pytestmark = pytest.mark.integration
CONFIG = from_profile("tiny", base="nano-random", num_threads=1)
STATS = {key: {"mean": np.arange(6.0), "std": np.full(6, 5.0)} for key in (STATE_KEY, ACTION_KEY)}

# What somebody does who has LeRobot and the folder, nothing else: load, and ask for one chunk. argv: pairs of a working
# directory and the folder to load there.
STRANGER = """
import importlib.util, json, os, sys
sys.modules["fedvla_lib"] = None  # importing it fails, as on a machine without it
import torch
from lerobot.policies import make_pre_post_processors
from lerobot.policies.smolvla import SmolVLAPolicy
torch.set_num_threads(1)
for place, folder in zip(sys.argv[1::2], sys.argv[2::2]):
    os.chdir(place)
    policy = SmolVLAPolicy.from_pretrained(folder)
    before, after = make_pre_post_processors(policy.config, pretrained_path=folder)
    shapes = {key: feature.shape for key, feature in policy.config.input_features.items()}
    batch = before({key: torch.full(shape, 0.5) for key, shape in shapes.items()} | {"task": "Lift the red cube."})
    noise = torch.zeros(1, policy.config.chunk_size, policy.config.max_action_dim)
    print("chunk", json.dumps(after(policy.predict_action_chunk(batch, noise=noise)).tolist()))
"""


def chunk(bundle: model.Bundle) -> list:
    """The same chunk, from a policy of this process."""
    size = CONFIG.image_size
    batch = {image_key(camera): torch.full((3, size, size), 0.5) for camera in CAMERAS}
    batch = bundle.preprocess(batch | {STATE_KEY: torch.full((6,), 0.5), "task": "Lift the red cube."})
    noise = torch.zeros(1, CONFIG.chunk_size, bundle.policy.config.max_action_dim)
    return bundle.postprocess(bundle.policy.predict_action_chunk(batch, noise=noise)).tolist()


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list]:
    """A saved policy, and the chunk that it predicts."""
    folder = tmp_path_factory.mktemp("saved") / "policy"
    bundle = model.load_policy(CONFIG, STATS)
    model.save_policy(bundle, folder)
    return folder, chunk(bundle)


def named_paths(folder: Path) -> list[str]:
    texts = [path.read_text() for path in folder.rglob("*.json")]
    assert texts
    return [found for text in texts for found in re.findall(r'"[^"]*(?:/[^"]*/|[A-Z]:\\)[^"]*"', text)]


def test_a_moved_policy_loads_with_lerobot_where_this_library_is_not(saved, tmp_path):
    folder, expected = saved
    assert named_paths(folder) == []
    renamed = tmp_path / "a stranger's disk" / "renamed"
    shutil.copytree(folder, renamed)
    here, there = tmp_path / "exported here", tmp_path / "another machine" / "arm"
    assert main(["export", str(folder), "--for", str(here)]) == 0
    assert main(["export", str(renamed), "--for", str(there), "--out", str(tmp_path / "upload")]) == 0
    assert {path.rsplit("/", 1)[0].strip('"') for path in named_paths(tmp_path / "upload")} == {str(there)}
    there.parent.mkdir()
    (tmp_path / "upload").rename(there)
    hidden = folder.with_name("hidden")
    folder.rename(hidden)  # what was copied is out of reach
    try:
        done = subprocess.run(
            [sys.executable, "-I", "-c", STRANGER, renamed, ".", tmp_path, here, tmp_path, there],
            capture_output=True, text=True, timeout=600,
        )  # fmt: skip
    finally:
        hidden.rename(folder)
    assert done.returncode == 0, done.stderr[-2000:]
    found = [json.loads(line.removeprefix("chunk ")) for line in done.stdout.splitlines() if line.startswith("chunk ")]
    assert found == [expected] * 3


def test_the_library_loads_a_moved_folder_of_any_age(saved, tmp_path):
    folder, expected = saved
    for name in ("vlm", "/gone/fedvla_lib/nano_base/vlm"):  # now, and as older versions saved it
        moved = tmp_path / name.replace("/", "_")
        shutil.copytree(folder, moved)
        name_backbone(moved, name)
        assert chunk(model.load_policy(replace(CONFIG, base=str(moved)))) == expected
        again = tmp_path / f"{moved.name} again"
        model.save_policy(model.load_policy(replace(CONFIG, base=str(moved))), again)
        assert named_paths(again) == []
        for file in (PREPROCESSOR_FILE, "model.safetensors"):
            assert (again / file).read_bytes() == (folder / file).read_bytes()


def test_export_refuses_in_one_line(saved, tmp_path, capsys):
    folder, _ = saved
    (tmp_path / "empty").mkdir()
    bare = shutil.copytree(folder, tmp_path / "bare")
    shutil.rmtree(bare / "vlm")
    out = ["--out", str(tmp_path / "new")]
    for arguments, said in (
        ([tmp_path / "empty", "--for", tmp_path / "x"], "empty is not a pretrained_model folder"),
        ([bare, "--for", tmp_path / "x"], "bare has no folder vlm: its backbone 'vlm' was not saved with it"),
        ([folder, "--for", "somewhere", *out], "--for somewhere is not an absolute path"),
        ([folder, "--for", tmp_path / "empty"], "empty exists already"),
    ):
        assert main(["export", *map(str, arguments)]) == 2
        line = capsys.readouterr().err
        assert said in line and line.count("\n") == 1
    assert not (tmp_path / "x").exists() and not (tmp_path / "new").exists()
    assert main(["export", str(folder), "--for", "C:\\policies\\arm", *out]) == 0
