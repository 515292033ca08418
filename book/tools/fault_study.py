"""Examine an arm without a fault and arms with one each, with more rollouts than a chapter can afford.

    python book/tools/fault_study.py --rollouts 48 --out book/reference/faults.json

The policy is the nano base, at a task that it was pretrained for. Takes minutes.
"""

import argparse
from dataclasses import replace
from pathlib import Path

from fedvla_book import faults
from fedvla_lib import files, provenance
from fedvla_lib.config import from_profile
from fedvla_lib.data import normalisation
from fedvla_lib.policy import model

RECORDED = 8  # demonstrations that stand for the recordings
FRESH = 3_000_000  # first seed of the rollouts
OTHER = "Reach for the red cube."


def study(rollouts: int) -> dict[str, object]:
    """Return a stamp and the rows of `faults.examine_all`."""
    config = from_profile("laptop", tasks="pull", normalisation="base", num_threads=1)
    stamp = provenance.first_stamp(config, "faults")
    nothing = normalisation.common_statistics(replace(config, normalisation="none"), {})
    good = faults.Arm(model.load_policy(config), faults.PULL)
    known = faults.Known(faults.by_hand(good, config, range(RECORDED)), range(RECORDED), faults.PULL)
    arms = faults.planted(good, config, missing=model.load_policy(config, nothing), instruction=OTHER)
    found = faults.examine_all(arms, known, config, range(FRESH, FRESH + rollouts))
    return stamp | {"status": "completed", "rows": found.to_dict("records")}


def main() -> None:
    """Write the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rollouts", type=int, default=48, help="of each arm")
    parser.add_argument("--out", type=Path, required=True, help="file to write")
    given = parser.parse_args()
    files.write_json(given.out, study(given.rollouts))
    print(given.out)


if __name__ == "__main__":
    main()
