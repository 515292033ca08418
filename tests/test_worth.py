"""What a federation is worth, against cases worked out by hand and against simulated truths."""

import numpy as np
import pandas as pd
import pytest
from scipy.stats import norm

from fedvla_book.tables.worth import alone_at_best, demonstrations_to_match, worth

pytestmark = pytest.mark.unit

COUNTS = [1, 2, 4, 8, 16]


@pytest.mark.parametrize(
    ("rates", "wanted", "needed"),
    [
        ([0.1, 0.2, 0.4, 0.6, 0.8], 0.4, 4),
        ([0.1, 0.2, 0.4, 0.6, 0.8], 0.5, 4 * 2**0.5),  # half way between 4 and 8, on a logarithmic axis
        ([0.1, 0.2, 0.4, 0.6, 0.8], 0.05, 1),
        ([0.1, 0.2, 0.4, 0.6, 0.8], 0.81, np.inf),
        ([0.1, 0.4, 0.3, 0.6, 0.5], 0.4, 2),  # reached before it falls by chance
        ([0.1, 0.4, 0.3, 0.6, 0.5], 0.6, 8),
        ([0.1, 0.4, 0.3, 0.6, 0.5], 0.5, 4 * 2**0.5),  # not below 4, where less was measured
    ],
)
def test_the_number_that_a_lab_alone_needs_is_read_off_its_curve(rates, wanted, needed):
    assert demonstrations_to_match(COUNTS, rates, wanted) == pytest.approx(needed)


def simulated(rng, centres, seeds=5, rollouts=100, of_seeds=0.25, of_rollouts=0.7):
    """Rollouts of methods with a true success rate of norm.cdf(centre), some seeds and some scenes being harder."""
    spread, lines = np.sqrt(1 + of_seeds**2 + of_rollouts**2), []
    scene = rng.normal(0, of_rollouts, rollouts)
    for (method, count), centre in centres.items():
        latent = spread * centre + rng.normal(0, of_seeds, (seeds, 1)) + scene + rng.normal(size=(seeds, rollouts))
        run, seed = np.indices(latent.shape)
        columns = {"run": run.ravel(), "seed": seed.ravel(), "success": latent.ravel() > 0}
        lines.append(pd.DataFrame({"method": method, "demonstrations": count, "task": "square", **columns}))
    return pd.concat(lines, ignore_index=True)


CENTRES = {("alone", count): centre for count, centre in zip(COUNTS, (-1.2, -0.7, -0.2, 0.3, 0.8), strict=True)}
CENTRES |= {("federated", 2): 0.05, ("federated", 4): 0.4}


def test_worth_of_a_large_sample_is_the_true_one():
    found = worth(simulated(np.random.default_rng(0), CENTRES, seeds=200, rollouts=300), "federated", "alone", seed=0)
    assert found.demonstrations.tolist() == [2, 4]
    assert found.success_rate.tolist() == pytest.approx(norm.cdf([0.05, 0.4]).tolist(), abs=0.03)
    alone = norm.cdf([CENTRES["alone", count] for count in COUNTS])
    truth = [demonstrations_to_match(COUNTS, alone, rate) for rate in norm.cdf([0.05, 0.4])]
    assert found.needed.tolist() == pytest.approx(truth, rel=0.1)
    assert (found.low < found.needed).all() and (found.needed < found.high).all()


def test_beyond_what_was_measured_the_interval_is_open():
    centres = CENTRES | {("federated", 2): 0.7, ("federated", 4): 1.6}
    found = worth(simulated(np.random.default_rng(1), centres), "federated", "alone", seed=0)
    found = found.set_index("demonstrations")
    assert np.isinf(found.needed[4]) and np.isinf(found.high[4]) and np.isinf(found.high[2])
    assert np.isfinite(found.low[2])


def test_a_training_seed_that_one_method_lacks_is_left_out():
    rows = simulated(np.random.default_rng(2), CENTRES)
    lacking = rows[(rows.run != 4) | (rows.method != "federated") | (rows.demonstrations != 4)]
    pd.testing.assert_frame_equal(
        worth(lacking, "federated", "alone", seed=0), worth(rows[rows.run != 4], "federated", "alone", seed=0)
    )


def test_labs_alone_are_taken_at_the_number_of_steps_that_served_them_best_in_their_own_place():
    rows = pd.DataFrame([
        {"method": method, "kind": kind, "demonstrations": count, "place": place, "success": success}
        for method, kind, count, own in (
            ("alone-400", "local-only", 8, 1), ("alone-800", "local-only", 8, 0), ("alone-400", "local-only", 16, 0),
            ("alone-800", "local-only", 16, 1), ("federated", "federated", 8, 0),
        ) for place, success in (("own", own), ("unseen", 1 - own))
    ])  # fmt: skip
    found = alone_at_best(rows)
    alone = found[found.method == "local-only"].set_index(["demonstrations", "place"]).success
    assert alone.to_dict() == {(8, "own"): 1, (8, "unseen"): 0, (16, "own"): 1, (16, "unseen"): 0}
    assert (found.method == "federated").sum() == 2 and len(found) == 6


@pytest.mark.slow
def test_the_interval_of_five_training_seeds_covers_the_truth_as_often_as_it_says():
    """In 200 simulated experiments of the size of the book's: about 94 and 96 times of a hundred."""
    alone = norm.cdf([CENTRES["alone", count] for count in COUNTS])
    truth = [demonstrations_to_match(COUNTS, alone, rate) for rate in norm.cdf([0.05, 0.4])]
    covered = []
    for k in range(200):
        found = worth(simulated(np.random.default_rng(k), CENTRES), "federated", "alone", seed=k, resamples=500)
        covered.append((found.low <= truth) & (truth <= found.high))
    rates = np.mean(covered, axis=0)
    assert (rates >= 0.92).all()
