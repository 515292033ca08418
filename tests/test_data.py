"""Batches equal LeRobot's and depend on seed and step only; statistics use the given episodes only."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import torch
from lerobot.datasets import LeRobotDataset

from fedvla_lib.config import from_profile
from fedvla_lib.data.batches import Batches, batch_of_rows, frame_rows
from fedvla_lib.data.frame_store import open_store
from fedvla_lib.data.normalisation import episode_stats, implausible, pool_stats
from fedvla_lib.data.recordings import resolve
from fedvla_lib.data.splits import split
from fedvla_lib.robot.spec import ACTION_KEY, CAMERAS, STATE_KEY, image_key

CHUNK = 8


def episode_table(per_task: int, tasks: tuple[str, ...] = ("lift", "place", "push")) -> pd.DataFrame:
    """Return the table of a recording: the tasks alternate."""
    count = per_task * len(tasks)
    return pd.DataFrame({"episode_id": range(count), "task": [tasks[i % len(tasks)] for i in range(count)]})


def equal(one: dict, other: dict) -> bool:
    return all(torch.equal(one[key], other[key]) if key != "task" else one[key] == other[key] for key in one)


# --- split ----------------------------------------------------------------------------------------------------------


@pytest.mark.unit
@pytest.mark.parametrize(("per_task", "fraction", "held_out"), [(40, 0.1, 4), (4, 0.1, 1), (4, 0.9, 3), (4, 0.0, 0)])
def test_split_is_by_episode_and_per_task(per_task, fraction, held_out):
    table = episode_table(per_task)
    train, val = split(table, fraction, seed=0)
    assert sorted(train + val) == list(table["episode_id"])
    counts = table[table["episode_id"].isin(val)]["task"].value_counts()
    assert all(counts.get(task, 0) == held_out for task in ("lift", "place", "push"))


@pytest.mark.unit
def test_split_depends_on_the_seed_and_not_on_the_order_of_the_table():
    table = episode_table(20)
    assert split(table, 0.2, seed=1) == split(table.iloc[::-1], 0.2, seed=1)
    assert split(table, 0.2, seed=1) != split(table, 0.2, seed=2)


@pytest.mark.unit
def test_one_episode_of_a_task_stays_in_training():
    assert split(episode_table(1), 0.5, seed=0) == ([0, 1, 2], [])


@pytest.mark.unit
def test_a_fraction_above_one_is_refused():
    with pytest.raises(ValueError, match=r"val_fraction=1\.5"):
        split(episode_table(4), 1.5, seed=0)


# --- statistics -----------------------------------------------------------------------------------------------------


@pytest.mark.integration
def test_statistics_are_of_the_given_episodes_only(store):
    ids = [1, 4, 7]
    rows = frame_rows(store, ids)
    found = episode_stats(store, ids)
    for key, values in ((STATE_KEY, store.states), (ACTION_KEY, store.actions)):
        inside = values[rows].astype(np.float64)
        np.testing.assert_allclose(found[key]["mean"], inside.mean(axis=0), rtol=1e-12)
        np.testing.assert_allclose(found[key]["std"], inside.std(axis=0), rtol=1e-12)
        np.testing.assert_array_equal(found[key]["min"], inside.min(axis=0))
        np.testing.assert_array_equal(found[key]["max"], inside.max(axis=0))
        assert found[key]["count"] == len(rows)
        assert not np.allclose(found[key]["mean"], values.mean(axis=0)), "the other episodes would change the mean"


@pytest.mark.integration
@pytest.mark.parametrize(
    "clients",
    [
        [[0, 3, 6, 9], [1, 4, 7, 10], [2, 5, 8, 11]],
        [[0], [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11]],
        [[i] for i in range(12)],
    ],
)
def test_pooled_client_statistics_are_those_of_the_pooled_episodes(store, clients):
    pooled = pool_stats([episode_stats(store, ids) for ids in clients])
    assert not any(implausible([episode_stats(store, ids) for ids in clients]))  # few episodes, different tasks
    whole = episode_stats(store, [episode_id for ids in clients for episode_id in ids])
    for key in (STATE_KEY, ACTION_KEY):
        for name in ("mean", "std", "min", "max", "count"):
            np.testing.assert_allclose(pooled[key][name], whole[key][name], rtol=1e-10, atol=1e-10)


@pytest.mark.integration
@pytest.mark.parametrize(("ids", "message"), [([], "no episodes"), ([0, 12], "has no episode 12")])
def test_unknown_or_no_episodes_are_refused(store, ids, message):
    with pytest.raises(ValueError, match=message):
        episode_stats(store, ids)


# --- batches --------------------------------------------------------------------------------------------------------


@pytest.mark.integration
def test_a_sample_is_what_lerobot_gives_for_delta_timestamps(recording, store):
    deltas = {ACTION_KEY: [step / store.fps for step in range(CHUNK)]}
    dataset = LeRobotDataset("fedvla/test", root=recording, delta_timestamps=deltas, video_backend="pyav")
    ends = store.episodes["end"].to_numpy()
    rows = [0, 5, ends[0] - CHUNK, ends[0] - CHUNK + 1, ends[0] - 1, ends[0], ends[5] - 3, ends[-1] - 1]
    batch = batch_of_rows(store, rows, CHUNK)
    for place, row in enumerate(rows):
        item = dataset[int(row)]
        assert torch.equal(batch[STATE_KEY][place], item[STATE_KEY])
        assert torch.equal(batch[ACTION_KEY][place], item[ACTION_KEY])
        assert torch.equal(batch["action_is_pad"][place], item["action_is_pad"])
        assert batch["task"][place] == item["task"]
        for camera in CAMERAS:
            torch.testing.assert_close(batch[image_key(camera)][place], item[image_key(camera)], atol=1e-6, rtol=0)


@pytest.mark.integration
def test_chunks_end_with_their_episode(store):
    last = int(store.episodes["end"].iloc[0]) - 1
    batch = batch_of_rows(store, [last - 1], CHUNK)
    assert batch["action_is_pad"][0].tolist() == [False, False] + [True] * (CHUNK - 2)
    assert torch.equal(batch[ACTION_KEY][0, 1:], torch.from_numpy(store.actions[last]).expand(CHUNK - 1, 6))


@pytest.mark.integration
@pytest.mark.parametrize("augment", [False, True])
def test_a_batch_is_a_function_of_seed_and_step(store, augment):
    batches = Batches(store, [0, 1, 2], CHUNK, batch_size=8, seed=3, augment=augment)
    expected = batches.at(5)
    again = Batches(store, [2, 1, 0], CHUNK, batch_size=8, seed=3, augment=augment)
    again.at(11)
    assert equal(again.at(5), expected)
    assert not equal(again.at(6), expected)
    assert not equal(replace(batches, seed=4).at(5), expected)


@pytest.mark.integration
def test_an_epoch_visits_every_frame_once_in_an_order_of_its_own(store):
    batches = Batches(store, [0, 3], CHUNK, batch_size=7, seed=0)
    count = batches.num_examples
    assert count == store.episodes["num_frames"].iloc[[0, 3]].sum()
    visited = replace(batches, batch_size=3 * count).rows_at(0).reshape(3, count)
    for epoch in visited:
        np.testing.assert_array_equal(np.sort(epoch), frame_rows(store, [0, 3]))
    assert not np.array_equal(visited[0], visited[1])
    over_the_end = count // 7  # this batch spans two epochs
    assert torch.equal(
        batches.at(over_the_end)[STATE_KEY], torch.from_numpy(store.states[visited.ravel()[7 * over_the_end :][:7]])
    )


@pytest.mark.integration
def test_a_batch_may_be_larger_than_the_data(store):
    batches = Batches(store, [0], CHUNK, batch_size=100, seed=0)
    assert batches.at(0)[STATE_KEY].shape == (100, 6)


@pytest.mark.integration
def test_augmentation_changes_images_only_and_a_little(store):
    plain = Batches(store, range(12), CHUNK, batch_size=16, seed=0, augment=False).at(2)
    varied = Batches(store, range(12), CHUNK, batch_size=16, seed=0, augment=True).at(2)
    for key in (STATE_KEY, ACTION_KEY, "action_is_pad"):
        assert torch.equal(plain[key], varied[key])
    assert plain["task"] == varied["task"]
    for camera in CAMERAS:
        before, after = plain[image_key(camera)], varied[image_key(camera)]
        assert after.shape == before.shape == (16, 3, 64, 64) and after.dtype == torch.float32
        assert 0 <= after.min() and after.max() <= 1
        change = (after - before).abs().mean(dim=(1, 2, 3))
        assert (change > 0).all() and change.max() < 0.25
    assert not np.shares_memory(varied[image_key("front")].numpy(), store.images["front"])


@pytest.mark.unit
def test_a_shift_moves_the_image_and_repeats_the_edge():
    from fedvla_lib.data.augmentation import _shift

    image = np.tile(np.arange(50, dtype=np.uint8)[None, :, None, None], (6, 1, 50, 3))  # brightness = row
    shifted = _shift(image, np.random.default_rng(0)).astype(int)
    steps = shifted[:, 25, 0, 0] - 25
    assert (np.abs(steps) <= 2).all() and len(set(steps)) > 1
    for one, step in zip(shifted, steps, strict=True):
        np.testing.assert_array_equal(one[:, 0, 0], np.clip(np.arange(50) + step, 0, 49))


# --- where the data comes from --------------------------------------------------------------------------------------


@pytest.mark.integration
def test_a_run_without_data_records_into_the_cache_once(tmp_path, monkeypatch):
    monkeypatch.setenv("FEDVLA_CACHE", str(tmp_path))
    config = from_profile("tiny", tasks="lift", episodes_per_task=1, image_size=32)
    root = resolve(config)
    assert root.is_relative_to(tmp_path)
    before = (root / "meta/info.json").stat().st_mtime_ns
    assert resolve(config) == root and (root / "meta/info.json").stat().st_mtime_ns == before
    assert open_store(root, image_size=32, progress=False).episodes["task"].tolist() == ["lift"]


@pytest.mark.unit
def test_a_run_with_data_uses_it(tmp_path):
    assert resolve(from_profile("tiny", data=str(tmp_path))) == tmp_path
    assert resolve(from_profile("tiny", data="lerobot/svla_so100_stacking")) == "lerobot/svla_so100_stacking"
