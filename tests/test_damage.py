"""Damaged files and odd settings: every command ends in one line that it meant to say, whatever the damage."""

import json
import shutil
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fedvla_lib.cli.main import main
from fedvla_lib.config import Config, from_run_config
from fedvla_lib.experiments.experiment_file import read_plan
from fedvla_lib.policy import nano

REFERENCE = Path(__file__).parents[1] / "book" / "reference"
RUN, OTHER = (REFERENCE / "replay" / name for name in ("task_federated_0", "task_centralized_0"))
GONE = object()
OURS = "this should not happen"
# The same examples each time: a failure in CI must be there on a laptop too.
often = settings(
    max_examples=60, deadline=None, derandomize=True, database=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)  # fmt: skip

numbers = st.integers() | st.floats() | st.sampled_from([10**30, -1, 1e308])
values = st.none() | st.booleans() | numbers | st.text(max_size=5) | st.just([]) | st.just({}) | st.just([[1]])


def places(content, path=()):
    """Every place in a JSON content, as the keys that lead to it."""
    yield path
    inner = content.items() if isinstance(content, dict) else enumerate(content) if isinstance(content, list) else ()
    for key, part in inner:
        yield from places(part, (*path, key))


def changed(content, path, value):
    """The content with another value at a place, or without the place if the value is `GONE`."""
    if not path:
        return None if value is GONE else value
    whole = content.copy()
    if len(path) == 1 and value is GONE:
        del whole[path[0]]
    else:
        whole[path[0]] = changed(whole[path[0]], path[1:], value)
    return whole


@st.composite
def damages(draw, text):
    """A text of JSON with one value replaced, or cut off, or with other bytes in it."""
    where = draw(st.integers(0, len(text)))
    kind = draw(st.sampled_from(["value", "value", "value", "cut", "bytes"]))
    if kind == "cut":
        return text[:where]
    if kind == "bytes":
        return text[:where] + draw(st.binary(min_size=1, max_size=3)) + text[where:]
    content = json.loads(text)
    path = draw(st.sampled_from(list(places(content))))
    return json.dumps(changed(content, path, draw(values | st.just(GONE)))).encode()


def ends_well(arguments, capsys):
    """A command does its work, or says in one line why not; nothing that it did not expect happened."""
    capsys.readouterr()
    status = main([str(one) for one in arguments])
    said = capsys.readouterr().err
    assert OURS not in said, said
    if status:
        assert status == 2 and said.count("\n") == 1, said
    return status


@pytest.mark.unit
@pytest.mark.parametrize(
    ("name", "commands"),
    [
        ("config.json", (["compare", OTHER], ["run", "--resume"])),
        ("stamp.json", (["run", "--resume"], ["train", "--resume"])),
        ("metrics.jsonl", (["compare", OTHER],)),
    ],
)
def test_a_run_folder_with_a_damaged_file(name, commands, tmp_path, capsys):
    lines = (RUN / name).read_bytes().splitlines(keepends=True)
    parts = st.sampled_from(range(len(lines))) if name == "metrics.jsonl" else st.just(slice(None))

    @often
    @given(st.data())
    def check(data):
        part = data.draw(parts)
        text = b"".join(lines[part] if isinstance(part, slice) else [lines[part]])
        found = data.draw(damages(text))
        whole = found if isinstance(part, slice) else b"".join([*lines[:part], found, *lines[part + 1 :]])
        folder = tmp_path / "damaged"
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(RUN, folder)
        (folder / name).write_bytes(whole)
        for command in commands:
            ends_well([*command, folder], capsys)

    check()


@pytest.mark.unit
@often
@given(st.sampled_from(sorted(vars(Config()))), values)
def test_settings_of_any_type(name, value):
    try:
        from_run_config({name.replace("_", "-"): value})
    except ValueError as error:
        assert "\n" not in str(error)


@pytest.mark.unit
def test_flags_with_any_text(capsys):
    @often
    @given(st.sampled_from(sorted(set(vars(Config())) - {"resume"})), numbers.map(str) | st.text(max_size=5))
    def check(name, text):
        try:
            ends_well(["config", f"--{name.replace('_', '-')}={text}"], capsys)
        except SystemExit as usage:  # argparse's own way to say it
            assert usage.code == 2

    check()


@pytest.mark.unit
def test_a_plan_with_a_damaged_line(tmp_path):
    lines = (REFERENCE / "replay.toml").read_text().splitlines()
    written = [number for number, line in enumerate(lines) if "=" in line and not line.startswith("#")]
    texts = st.sampled_from(
        ["3", "true", '"x"', "[]", "[1]", "{a = 1}", "nan", "inf", "1e400", "10000000000000000", "?"]
    )

    @often
    @given(st.sampled_from(written), texts)
    def check(number, text):
        name = lines[number].split("=")[0]
        file = tmp_path / "plan.toml"
        file.write_text("\n".join([*lines[:number], f"{name}= {text}", *lines[number + 1 :]]))
        try:
            read_plan(file)
        except ValueError as error:
            assert str(error) and "\n" not in str(error)

    check()


@pytest.mark.integration
@pytest.mark.parametrize(
    ("file", "damage", "said"),
    [
        ("config.json", lambda text: text.replace(b'"chunk_size"', b'"chunks"'), "config.json is damaged: chunk_size"),
        ("config.json", lambda text: text.replace(b'"n_obs_steps"', b'"oddity"'), "oddity"),
        ("model.safetensors", lambda text: text[: len(text) // 2], "could not be loaded"),
    ],
)
def test_a_policy_with_a_damaged_file(file, damage, said, tmp_path, capsys):
    folder = shutil.copytree(nano.nano_base(), tmp_path / "policy")
    (folder / file).write_bytes(damage((folder / file).read_bytes()))
    assert ends_well(["evaluate", folder, "--task", "lift", "--rollouts", "1"], capsys) == 2
    main(["evaluate", str(folder), "--task", "lift", "--rollouts", "1"])
    assert said in capsys.readouterr().err
