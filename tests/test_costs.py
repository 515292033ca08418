"""The page on costs: its estimate follows its equation, its tables the stored counts; what is not measured says so."""

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest

import cost_page
from fedvla_book.costs import Assumptions, cost

pytestmark = pytest.mark.unit
ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "book" / "costs.md").read_text()
ROWS = json.loads((ROOT / cost_page.OPERATIONS).read_text())["rows"]
ROUND = Assumptions(
    usd_per_hour=3.0, peak_tflops=100.0, utilisation=0.5, line_mbit=8.0, usd_per_gb=2.0, rounds=10, local_steps=100,
    batch_size=18,
)  # fmt: skip


def test_the_estimate_by_hand():
    """1,000 steps of 18 x 100 G at 50 T/s take 36 s; 10 rounds of 2 x 4 MB at 1 MB/s take 80 s more."""
    alone, three = (cost(labs, 5_000_000, 1_000_000, 100.0, ROUND) for labs in (1, 3))
    assert alone.hours * 3600 == pytest.approx(36) and three.hours * 3600 == pytest.approx(116)
    assert alone.memory_gb == three.memory_gb == pytest.approx(4 * 8e6 / 1e9)
    assert alone.exchanged_gb == 0 and three.exchanged_gb == pytest.approx(10 * 3 * 2 * 0.004)
    assert alone.usd == pytest.approx(3 * 36 / 3600)
    assert three.usd == pytest.approx(3 * 3 * 116 / 3600 + 2 * 10 * 3 * 0.004)


@pytest.mark.parametrize("wrong", [{"utilisation": 0.0}, {"peak_tflops": -1.0}, {"line_mbit": 0.0}])
def test_an_estimate_of_nothing_is_refused(wrong):
    with pytest.raises(ValueError, match="above 0"):
        cost(3, 10, 1, 1.0, replace(ROUND, **wrong))
    with pytest.raises(ValueError, match="0 labs"):
        cost(0, 10, 1, 1.0, ROUND)


def test_every_part_has_its_mark_and_every_input_is_shown():
    said = cost_page.parts(ROOT)
    assert all(PAGE.count(mark.decode()) == 1 for mark in said) and PAGE.count("<!--") == len(said)
    table = said[b"<!-- assumptions -->"]()
    assert all(f"`{name}`" in table for name in vars(ROUND)) and table.count("\n|") == len(vars(ROUND)) + 1
    lines = said[b"<!-- costs -->"]().strip().splitlines()
    assert len(lines) == 2 + len(ROWS) * len(cost_page.LABS)


def test_what_was_not_measured_says_so(tmp_path):
    assert "Not measured" in cost_page.measured(tmp_path / "none.json")
    (tmp_path / "gpu.json").write_text(json.dumps({"rows": [{"what trains": "all", "step [s]": 0.5}]}))
    assert "| all | 0.5 |" in cost_page.measured(tmp_path / "gpu.json")


def test_the_counts_are_of_the_full_model_and_the_code_of_the_page_runs():
    count = {row["what trains"]: row for row in ROWS}
    whole, expert, adapters = (count[name] for name in ("all weights", "action expert", "LoRA, rank 16"))
    assert whole["parameters"] == 450_046_176 and expert["trained"] == 99_880_992 and adapters["trained"] < 1e6
    assert whole["step [G]"] > 2 * expert["step [G]"] > 2 * expert["forward [G]"]
    (code,) = re.findall(r"^```python\n(.*?)^```", PAGE, flags=re.DOTALL | re.MULTILINE)
    space = {}
    exec(code, space)
    assert space["cost"](10, 450_046_176, 99_880_992, 578, space["mine"]).usd > 0
