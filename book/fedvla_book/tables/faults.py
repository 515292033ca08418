"""The table of faults and of the tests that find them (`fedvla_book.faults`), stored or just made."""

from pathlib import Path

import pandas as pd

from fedvla_book.sentences import rate
from fedvla_lib.files import read_json

OWN = {  # fault -> the test that belongs to it, in the order of the tree
    "none": "", "statistics missing": "statistics", "cameras exchanged": "cameras", "cameras upside down": "cameras",
    "half a chunk late": "chunk", "zero off by 10 degrees": "zero", "cube where none was": "table",
    "another instruction": "instruction",
}  # fmt: skip
TESTS = tuple(dict.fromkeys(test for test in OWN.values() if test))


def read_faults(file: Path) -> pd.DataFrame:
    """Return the stored table of `book/tools/fault_study.py`."""
    return pd.DataFrame(read_json(file)["rows"])


def found_faults(found: pd.DataFrame) -> str:
    """Return in words how often each arm succeeded, and which tests fired where."""
    rows = found.to_dict("records")
    rates = "; ".join(f"{row['fault']} {rate(row_)}" for row, row_ in zip(rows, found.itertuples(), strict=True))
    own = sum(row[row["test"]] for row in rows if row["test"])
    others = [f"*{test}* ({row['fault']})" for row in rows for test in TESTS if row[test] and test != row["test"]]
    faults = sum(bool(row["test"]) for row in rows)
    return (
        f"Success: {rates}. Its own test finds {own} of {faults} faults. Tests that fire besides: "
        f"{', '.join(others) or 'none'}."
    )
