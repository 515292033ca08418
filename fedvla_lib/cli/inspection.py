"""The command `fedvla inspect`: a thin shell around `data.inspection`."""

import argparse
from dataclasses import asdict

from fedvla_lib.cli.commands import DAMAGED, settings
from fedvla_lib.files import write_json


def inspect(options: argparse.Namespace) -> int:
    """Print what is wrong with a data set and how to mend it; status 1 if a finding is an error."""
    from fedvla_lib.data import inspection

    report = inspection.inspect(options.source, settings(options), options.reference)
    print(inspection.table(report))
    if options.json:
        write_json(options.json, asdict(report))
    return DAMAGED if report.has_errors else 0
