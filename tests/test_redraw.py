"""Episodes drawn again: the same poses as the policy saw, larger, and two images a control step."""

import io

import av
import numpy as np
import pytest

from fedvla_book import redraw
from fedvla_book.video_player import MAX_BYTES
from fedvla_lib.robot.expert import Expert
from fedvla_lib.robot.labs import labs
from fedvla_lib.robot.rollout import run_episode
from fedvla_lib.robot.sim import So100Env
from fedvla_lib.robot.spec import CAMERAS

pytestmark = pytest.mark.integration
LAB = labs(2)[1]


@pytest.fixture(scope="module")
def episode():
    env = So100Env("place", 64, lab=LAB)
    found = run_episode(env, Expert(), 3)
    env.close()
    return found


def test_every_other_image_is_one_that_was_recorded(episode):
    drawn = np.stack(list(redraw.redraw("place", 3, episode.actions, lab=LAB, side=64)))
    recorded = np.concatenate([episode.images[camera] for camera in CAMERAS], axis=2)
    np.testing.assert_array_equal(drawn[::2], recorded)
    moved = np.abs(np.diff(drawn.astype(int), axis=0)).sum(axis=(1, 2, 3))
    assert moved[4] > 0 and moved[5] > 0, "the pose halfway is neither that before nor that after"


def test_the_video_is_large_and_smooth_and_small_enough_for_a_page(episode):
    video = redraw.redrawn_video("place", 3, episode.actions, lab=LAB)
    assert len(video) < MAX_BYTES
    with av.open(io.BytesIO(video)) as container:
        stream = container.streams.video[0]
        assert (stream.width, stream.height, stream.average_rate) == (2 * redraw.SIDE, redraw.SIDE, 20)
        assert stream.frames == 2 * episode.num_frames


def test_tiles_are_filled_row_by_row_and_the_last_image_stays():
    images = [[np.full((2, 2, 3), 10 * k + t, np.uint8) for t in range(1 + k)] for k in range(4)]
    shown = list(redraw.tiled(images, columns=2))
    assert [frame[::2, ::2, 0].tolist() for frame in shown[::3]] == [[[0, 10], [20, 30]], [[0, 11], [22, 33]]]
