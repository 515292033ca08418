"""The doctor finds real faults: a wrong driver, a missing package, a full disk, an unwritable folder."""

import os
from pathlib import Path

import pytest

from fedvla_lib.cli import doctor
from fedvla_lib.cli.main import main

pytestmark = pytest.mark.unit


def test_packages_in_range_pass():
    assert doctor.check_packages(["numpy>=2", "pandas"]).ok
    assert doctor.check_packages().ok  # the ranges this library declares


@pytest.mark.parametrize(("line", "said"), [("numpy<1", "is not <1"), ("surely-not-a-package>1", "is missing")])
def test_package_problems_are_named(line, said):
    check = doctor.check_packages([line, "pandas"])
    assert not check.ok and said in check.found and "make env" in check.fix


def test_requirements_of_other_systems_and_extras_do_not_count():
    assert doctor.check_packages(["nope; sys_platform == 'amiga'", "nope; extra == 'book'"]).ok


def test_lock_reports_what_differs(tmp_path):
    lock = tmp_path / "requirements.lock"
    digest = " \\\n    --hash=sha256:00\n"
    lock.write_text(f"# made by\nnumpy==0.0.1{digest}pip==9 ; sys_platform == 'amiga'{digest}")
    check = doctor.check_lock(lock)
    assert not check.ok and not check.required
    assert check.found.startswith("0 of 1 ") and "is not ==0.0.1" in check.found


def test_missing_lock_is_named(tmp_path):
    assert "does not exist" in doctor.check_lock(tmp_path / "none.lock").found


def test_rendering_draws_a_frame():
    check = doctor.check_rendering()
    assert check.ok, check.found


@pytest.mark.parametrize("backend", ["nonsense", "cgl"])
def test_rendering_fails_with_a_wrong_driver(monkeypatch, backend):
    monkeypatch.setenv("MUJOCO_GL", backend)
    check = doctor.check_rendering()
    assert not check.ok and backend in check.found
    assert "MUJOCO_GL=egl" in check.fix and "apt-get install" in check.fix


def test_rendering_that_never_ends_is_a_failure():
    check = doctor.check_rendering(timeout_s=0.01)
    assert not check.ok and "no frame within" in check.found


def test_video_comes_back():
    assert doctor.check_video().ok


def test_unknown_codec_is_a_failure():
    check = doctor.check_video("no-such-codec")
    assert not check.ok and "no-such-codec" in check.found and check.fix


def test_disk_threshold(tmp_path):
    missing = tmp_path / "not" / "made" / "yet"
    assert doctor.check_disk(missing, min_free_gib=0).ok
    check = doctor.check_disk(missing, min_free_gib=1e9)
    assert not check.ok and "FEDVLA_CACHE" in check.fix and str(tmp_path) in check.found


def test_cache_that_cannot_be_made(tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("not a folder")
    check = doctor.check_cache(blocked / "cache")
    assert not check.ok and "FEDVLA_CACHE" in check.fix
    assert doctor.check_cache(tmp_path / "cache").ok


def test_table_shows_the_fix_and_only_required_checks_decide():
    good = doctor.Check("disk", True, "10 GiB", "buy one")
    advice = doctor.Check("hub", False, "no answer", "connect", required=False)
    missing = doctor.Check("rendering", False, "no driver", "apt-get install it")
    assert doctor.can_run([good, advice]) and not doctor.can_run([good, missing])
    text = doctor.table([good, advice, missing])
    assert "-> apt-get install it" in text and "-> connect" in text and "buy one" not in text


def test_command_exits_1_when_a_chapter_could_not_run(monkeypatch, capsys, tmp_path):
    monkeypatch.setenv("FEDVLA_CACHE", os.fspath(tmp_path))
    monkeypatch.setenv("MUJOCO_GL", "nonsense")
    assert main(["doctor"]) == 1
    assert "MISSING  rendering" in capsys.readouterr().out


def test_command_exits_0_here(monkeypatch, capsys, tmp_path):
    monkeypatch.setenv("FEDVLA_CACHE", os.fspath(tmp_path))
    status = main(["doctor"])
    assert status == 0, capsys.readouterr().out


def test_examine_looks_at_the_folder_it_is_given(tmp_path):
    found = {check.name: check.found for check in doctor.examine(Path(tmp_path))}
    assert str(tmp_path) in found["cache"] and str(tmp_path) in found["disk"]
