"""A good policy that fails on the arm: each planted fault is found by its own test, and only where it is."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fedvla_book import faults
from fedvla_book.tables.faults import OWN, TESTS, found_faults, read_faults
from fedvla_lib.config import from_profile
from fedvla_lib.data import normalisation
from fedvla_lib.evaluation import diagnosis
from fedvla_lib.policy import model

CONFIG = from_profile("tiny", image_size=96, normalisation="base")
TASK = faults.PULL
pytestmark = pytest.mark.integration


@pytest.fixture(scope="module")
def arms():
    nothing = normalisation.common_statistics(replace(CONFIG, normalisation="none"), {})
    good = faults.Arm(model.load_policy(CONFIG), TASK)
    missing = model.load_policy(CONFIG, nothing)
    return faults.planted(good, CONFIG, missing=missing, instruction="Reach for the red cube.")


@pytest.fixture(scope="module")
def known(arms):
    return faults.Known(faults.by_hand(arms["none"], CONFIG, range(4)), range(2), TASK)


@pytest.fixture(scope="module")
def frames(known):
    return diagnosis.frames_of(known.store, CONFIG)


def test_each_fault_is_found_by_its_test_and_a_good_arm_raises_no_alarm(arms, known):
    found = faults.examine_all(arms, known, CONFIG, range(3_000_000, 3_000_004)).set_index("fault")
    fired = {name: {test for test in TESTS if row[test]} for name, row in found.iterrows()}
    others = {"statistics missing": {"chunk"}}  # of numbers that mean nothing no shift fits
    assert fired == {name: {test} - {""} | others.get(name, set()) for name, test in OWN.items()}
    assert found.success_rate["none"] == 1.0
    failing = set(OWN) - {"none", "cameras exchanged"}  # this policy knows the table in either view
    assert found.success_rate[list(failing)].max() <= 0.25
    assert "finds 7 of 7 faults. Tests that fire besides: *chunk* (statistics missing)." in found_faults(
        found.reset_index()
    )


def test_a_chunk_offset_is_measured_in_steps(arms, frames):
    good = arms["none"].bundle
    assert diagnosis.lag_steps(good, frames) == 0
    for steps in (3, 6):
        assert diagnosis.lag_steps(faults.shifted(good, steps), frames) == steps


def test_arrangements_done_twice_are_the_images_and_the_policy_sees_the_wrong_ones(arms, frames):
    for images in diagnosis.arrangements(frames.batch):
        wrong = diagnosis.arrangements(frames.batch)[images]
        again = diagnosis.arrangements(frames.batch | wrong)[images]
        assert all((again[key] == frames.batch[key]).all() and (wrong[key] != frames.batch[key]).any() for key in wrong)
    straight, mounted = (
        diagnosis.loss_by_arrangement(arms[name].bundle, frames) for name in ("none", "cameras upside down")
    )
    assert mounted["upside down"] == pytest.approx(straight["as given"])
    assert mounted["as given"] == pytest.approx(straight["upside down"])


def test_statistics_in_other_units_are_noticed(arms, known):
    good = arms["none"].bundle
    assert diagnosis.beyond_statistics(good, known.store) == 0
    ticks = replace(known.store, states=known.store.states * 4095 / 360)
    assert 0.1 < diagnosis.beyond_statistics(good, ticks) <= 0.5, "half of the joint values are actions"


def test_a_moved_zero_is_reported_where_it_is(arms):
    arm = faults.zero_moved(arms["none"], 2, -7.0)
    there, here = (faults.by_hand(each, CONFIG, range(2)).states[0] for each in (arms["none"], arm))
    np.testing.assert_allclose(here - there, [0, 0, -7, 0, 0, 0], atol=1e-3)


def test_stored_faults_are_those_of_today():
    stored = read_faults(Path(__file__).parents[1] / "book/reference/faults.json")
    assert stored.fault.tolist() == list(OWN) and stored.test.tolist() == list(OWN.values())
    assert (stored.rollouts >= 40).all()
    assert (stored.low <= stored.success_rate + 1e-9).all() and (stored.success_rate <= stored.high).all()
