"""A digest of code follows what the code does, and only the code that is reached."""

import ast
import shutil
from pathlib import Path

import pytest

from fedvla_lib import provenance
from fedvla_lib.data import record
from fedvla_lib.experiments.experiment import measure_cell
from fedvla_lib.robot import rollout

pytestmark = pytest.mark.unit


@pytest.fixture
def copied(tmp_path, monkeypatch):
    """A copy of the library's source that a test may edit; digests are of the copy."""
    library = tmp_path / "fedvla_lib"
    shutil.copytree(provenance.LIBRARY, library, ignore=shutil.ignore_patterns("nano_base", "__pycache__"))
    monkeypatch.setattr(provenance, "LIBRARY", library)
    forget()
    yield library
    forget()


def forget():
    provenance.reached_modules.cache_clear()
    provenance._statements.cache_clear()


def digest_after(file: Path, old: str, new: str) -> str:
    text = file.read_text()
    assert text.count(old) == 1, f"{file.name} holds {old!r} {text.count(old)} times"
    file.write_text(text.replace(old, new))
    forget()
    return provenance.code_digest(measure_cell)


def file_of(thing) -> Path:
    return provenance._file(thing.__module__)


def test_words_do_not_count(copied):
    before = provenance.code_digest(measure_cell)
    file = file_of(record.record)
    assert digest_after(file, "MAX_ATTEMPTS = 20  #", "MAX_ATTEMPTS = 20  # by the way,") == before
    assert digest_after(file, '"""Records expert demonstrations', '"""Writes demonstrations') == before
    file.write_text(file.read_text().replace("\nimport numpy as np\n", "\nimport math\nimport numpy as np\n"))
    forget()
    assert provenance.code_digest(measure_cell) == before


def test_a_constant_counts_also_in_a_module_far_below(copied):
    before = provenance.code_digest(measure_cell)
    assert digest_after(file_of(record.record), "MAX_ATTEMPTS = 20", "MAX_ATTEMPTS = 21") != before


def test_code_that_moves_to_another_module_keeps_its_digest(copied):
    before, file = provenance.code_digest(record.record), file_of(record.record)
    (moved,) = [node for node in ast.parse(file.read_text()).body if getattr(node, "name", "") == "demonstration_seed"]
    code = ast.get_source_segment(file.read_text(), moved)
    target = file_of(rollout.run_episode)
    file.write_text(file.read_text().replace(code, ""))
    target.write_text(target.read_text() + f"\n\n{code}\n")
    forget()
    assert provenance.code_digest(record.record) == before


def test_the_order_of_questions_does_not_matter(copied):
    first = [provenance.code_digest(record.record), provenance.code_digest(measure_cell)]
    forget()
    assert [provenance.code_digest(measure_cell), provenance.code_digest(record.record)] == first[::-1]


def test_only_what_is_reached_counts_and_it_is_found_from_imports():
    reached = provenance.reached_modules(record.record.__module__)
    everything = provenance.reached_modules(measure_cell.__module__)
    assert {one.rpartition(".")[2] for one in reached} >= {"record", "expert", "sim", "tasks"}
    assert reached < everything and not any(one.endswith((".train", ".training")) for one in reached)
    assert not any(one.startswith("fedvla_lib.cli.") or one == "fedvla_lib.cli" for one in everything)
