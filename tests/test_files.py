"""Files and folders are complete or absent, whatever happens while they are written."""

import os

import pytest

from fedvla_lib.files import new_file, new_folder

pytestmark = pytest.mark.unit


def test_an_error_leaves_the_old_content_and_no_draft(tmp_path):
    (tmp_path / "kept").mkdir()
    (tmp_path / "kept" / "a.txt").write_text("old")
    with pytest.raises(RuntimeError), new_folder(tmp_path / "kept", replace=True) as draft:
        (draft / "a.txt").write_text("new")
        raise RuntimeError
    with pytest.raises(RuntimeError), new_file(tmp_path / "kept" / "a.txt") as draft:
        draft.write_text("new")
        raise RuntimeError
    assert [path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*")] == ["kept", "kept/a.txt"]
    assert (tmp_path / "kept" / "a.txt").read_text() == "old"


@pytest.mark.parametrize(("replace", "content"), [(False, "first"), (True, "second")])
def test_of_two_writers_of_one_folder_both_write_a_whole_one(tmp_path, replace, content):
    """At the same time, as threads of one process or processes of two containers with the same number would."""
    with new_folder(tmp_path / "one", replace=replace) as slow:
        (slow / "a.txt").write_text("second")
        with new_folder(tmp_path / "one") as quick:
            (quick / "a.txt").write_text("first")
    assert [path.name for path in tmp_path.iterdir()] == ["one"]
    assert (tmp_path / "one" / "a.txt").read_text() == content


def test_a_folder_that_cannot_be_replaced_is_an_error(tmp_path, monkeypatch):
    """Else a checkpoint would be lost in silence."""
    with new_folder(tmp_path / "one") as draft:
        (draft / "a.txt").write_text("old")
    monkeypatch.setattr("shutil.rmtree", lambda *_, **__: None)  # the system does not let it go
    with pytest.raises(OSError, match="not empty"), new_folder(tmp_path / "one", replace=True) as draft:
        (draft / "a.txt").write_text("new")


def test_a_folder_has_the_permissions_of_any_other(tmp_path):
    (tmp_path / "plain").mkdir()
    with new_folder(tmp_path / "one"):
        pass
    assert os.stat(tmp_path / "one").st_mode == os.stat(tmp_path / "plain").st_mode
