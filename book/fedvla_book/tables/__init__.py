"""Tables of the book, from stored results and from what chapters trained.

One module per subject; chapters import all functions from this package.
"""

from fedvla_book.tables.checkpoints import clear_pairs, correlations, disagreements
from fedvla_book.tables.clients import heterogeneity
from fedvla_book.tables.grids import (
    at_own_task,
    by_steps,
    crossed_bootstrap,
    differences,
    fill_in,
    paired,
    paired_difference,
    read_rounds,
    shared_seeds,
)
from fedvla_book.tables.model import adapters, averaging_error, learning_rates, module_table

__all__ = [
    "crossed_bootstrap",
    "paired",
    "paired_difference",
    "adapters",
    "at_own_task",
    "averaging_error",
    "by_steps",
    "clear_pairs",
    "correlations",
    "differences",
    "disagreements",
    "fill_in",
    "heterogeneity",
    "learning_rates",
    "module_table",
    "read_rounds",
    "shared_seeds",
]
