"""Labs from recording to evaluation: stored in the data, assigned to clients, and used in rollouts."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from fedvla_book import tables
from fedvla_lib.config import from_profile
from fedvla_lib.data import normalisation, partition, recordings, splits
from fedvla_lib.data.frame_store import open_store
from fedvla_lib.evaluation import rollouts
from fedvla_lib.federation.client import open_client
from fedvla_lib.policy import model
from fedvla_lib.policy.actor import PolicyActor
from fedvla_lib.robot import labs

pytestmark = pytest.mark.integration
CONFIG = from_profile("tiny", tasks="lift,push", num_labs=3, partition="lab", num_threads=1, episodes_per_task=6)


@pytest.fixture(scope="module")
def store():
    return open_store(recordings.resolve(CONFIG), image_size=CONFIG.image_size, progress=False)


def test_labs_do_not_depend_on_how_many_there_are():
    assert labs.labs(3) == labs.labs(5)[:3] and labs.labs(1) == [labs.REFERENCE]
    assert len(set(labs.labs(5))) == 5


def test_a_recording_says_in_which_lab_each_episode_was_made(store):
    assert list(store.episodes.lab) == [(i // 2) % 3 for i in range(12)]
    counts = pd.crosstab(store.episodes.lab, store.episodes.task)
    assert (counts == 2).all().all()


def test_labs_look_different_and_report_other_angles(store):
    first = store.images["overhead"][store.episodes.start.to_numpy()].astype(float)
    means = np.array([first[(store.episodes.lab == k).to_numpy()].mean(axis=(0, 1, 2)) for k in range(3)])
    assert np.abs(np.diff(means, axis=0)).max() > 2  # grey levels, between the mean images of two labs


@pytest.mark.parametrize("num_clients", [2, 3, 6])
def test_clients_get_labs(store, num_clients):
    parts = partition.partition(store.episodes, num_clients, "lab")
    held = [set(store.episodes.set_index("episode_id").lab[part]) for part in parts]
    assert all(len(one) == (1 if num_clients >= 3 else held.index(one) == 0 and 2 or 1) for one in held)
    mixes = [store.episodes.set_index("episode_id").task[part].value_counts() for part in parts]
    assert all(mix["lift"] == mix["push"] for mix in mixes)
    assert tables.heterogeneity(parts, store.episodes)["total_variation"] == 0
    assert tables.heterogeneity(parts, store.episodes, by="lab")["total_variation"] > 0.3


def test_runs_with_other_seeds_use_the_labs_of_the_recording(store):
    ids = store.episodes.episode_id
    assert splits.labs_of(store, ids, replace(CONFIG, seed=5)) == splits.labs_of(store, ids, CONFIG)


def test_a_client_acts_in_its_own_lab(store, tmp_path):
    there = labs.labs(3)
    bundle = model.load_policy(
        from_profile("tiny", base="nano-random", num_threads=1), normalisation.episode_stats(store, [0])
    )
    for k in range(3):
        client = open_client(CONFIG, k)
        assert splits.labs_of(store, client.share.train_ids, CONFIG) == [there[k]]
        (row,) = client.roll_out(bundle, tmp_path / str(k))
        assert row["lab"] == there[k].name


def test_an_evaluation_visits_the_labs_in_turn(store):
    bundle = model.load_policy(
        from_profile("tiny", base="nano-random", num_threads=1), normalisation.episode_stats(store, [0])
    )
    actor, there = PolicyActor(bundle), labs.labs(2)
    rows = rollouts.evaluate(actor, ["lift"], [1, 2, 3], image_size=64, labs=there, progress=False)
    assert [row["lab"] for row in rows] == [there[1].name, there[0].name, there[1].name]
    again = rollouts.evaluate(actor, ["lift"], [2], image_size=64, labs=there, progress=False)
    assert again[0]["lab"] == rows[1]["lab"]  # a seed gives the same scene whichever seeds run beside it
    assert again[0]["action_smoothness"] == pytest.approx(rows[1]["action_smoothness"], rel=1e-4)
