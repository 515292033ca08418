"""The generated parts of the page on costs: the assumptions, the estimate, and what was measured on a card."""

import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import status
from fedvla_book.costs import Assumptions, cost

OPERATIONS, CARD = "benchmarks/results/operations.json", "benchmarks/results/gpu.json"
LABS = (1, 3, 10)
MEANING = {
    "usd_per_hour": "price of a card and its machine, USD per hour",
    "peak_tflops": "the card's peak, 10^12 bfloat16 operations per second",
    "utilisation": "share of the peak that training reaches",
    "line_mbit": "a lab's line, Mbit/s in each direction",
    "usd_per_gb": "price of what leaves the server, USD per GB",
    "rounds": "rounds", "local_steps": "gradient steps of a lab in a round", "batch_size": "samples of a step",
}  # fmt: skip


def parts(root: Path) -> dict[bytes, Callable[[], str]]:
    """Return what replaces each mark of the page."""
    return {
        b"<!-- assumptions -->": lambda: assumptions(Assumptions()),
        b"<!-- costs -->": lambda: estimate(json.loads((root / OPERATIONS).read_text())["rows"], Assumptions()),
        b"<!-- card -->": lambda: measured(root / CARD),
    }


def assumptions(given: Assumptions) -> str:
    """The inputs of the estimate, under the names that the code gives them."""
    values = asdict(given)
    return status.table(["input", "meaning", "value"], [[f"`{k}`", MEANING[k], f"{values[k]:g}"] for k in values])


def estimate(rows: list[dict], given: Assumptions) -> str:
    """Cost by what trains and by the number of labs."""
    lines = []
    for row in rows:
        for labs in LABS:
            one = cost(labs, row["parameters"], row["trained"], row["step [G]"], given)
            found = f"{one.hours:.1f}", f"{one.memory_gb:.1f}", f"{one.exchanged_gb:,.2f}", f"{one.usd:,.0f}"
            lines.append([row["what trains"], str(labs), *found])
    return status.table(["what trains", "labs", "hours", "GB on a card", "GB exchanged", "USD"], lines)


def measured(file: Path) -> str:
    """What a card took, or that nobody measured it."""
    if not file.is_file():
        return "Not measured: no result of `benchmarks/gpu.py` is stored.\n"
    rows = json.loads(file.read_text())["rows"]
    lines = [[f"{v:.3g}" if isinstance(v, float) else str(v) for v in row.values()] for row in rows]
    return status.table(list(rows[0]), lines)
