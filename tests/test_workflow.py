"""The checklist ticks what was tested, and nothing else."""

import pytest

from fedvla_lib import workflow

pytestmark = pytest.mark.unit


def test_a_tick_needs_a_test_that_holds():
    shown = repr(workflow.checklist(data=True, global_update=True))
    assert shown.count("☑") == 2 and "☑ data" in shown and "☑ global update" in shown and "☐ model" in shown
    with pytest.raises(AssertionError, match="'training'"):
        workflow.checklist(data=True, training=False)
    with pytest.raises(ValueError, match="'dta'.*environment"):
        workflow.checklist(dta=True)
