"""The video player: one self-contained figure with a description of what the video shows."""

import io
from base64 import b64decode
from html.parser import HTMLParser

import av
import numpy as np
import pytest

from fedvla_book import video_player
from fedvla_lib.evaluation.video import encode_video

pytestmark = pytest.mark.unit
SENTENCE = 'The arm lifts "the <red> cube" & stops.'


class Tags(HTMLParser):
    def __init__(self, text):
        super().__init__()
        self.found, self.opened, self.words = {}, [], ""
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.found[tag] = dict(attrs)
        self.opened += [] if tag == "track" else [tag]  # an element without an end

    def handle_endtag(self, tag):
        assert self.opened.pop() == tag

    def handle_data(self, data):
        self.words += data


@pytest.fixture(scope="module")
def mp4():
    return encode_video(np.random.default_rng(0).integers(0, 255, (25, 48, 64, 3), np.uint8))


def content(uri, kind):
    head, data = uri.split(",")
    assert head == f"data:{kind};base64"
    return b64decode(data)


def test_the_figure_holds_video_poster_and_sentence(mp4, tmp_path):
    path = tmp_path / "video.mp4"
    path.write_bytes(mp4)
    page = Tags(video_player.video_figure(path, SENTENCE))
    video = page.found["video"]
    assert not page.opened and page.words == video["aria-label"] == SENTENCE
    assert {"muted", "loop", "controls", "playsinline", "preload"} <= set(video)
    assert content(video["src"], "video/mp4") == mp4
    with av.open(io.BytesIO(content(video["poster"], "image/jpeg"))) as poster:
        assert next(poster.decode(video=0)).to_ndarray(format="rgb24").shape == (48, 64, 3)


def test_captions_say_the_sentence_over_the_whole_video(mp4):
    track = Tags(video_player.video_figure(mp4, SENTENCE)).found["track"]
    assert track["kind"] == "captions"
    head, time, text = content(track["src"], "text/vtt").decode().strip().replace("\n\n", "\n").split("\n")
    assert (head, time) == ("WEBVTT", "00:00.000 --> 00:02.500")
    assert text == "The arm lifts &quot;the &lt;red&gt; cube&quot; &amp; stops."


def test_too_large_a_video_and_one_without_frames_are_refused(mp4):
    for wrong, words in ((mp4.ljust(video_player.MAX_BYTES, b"0"), "less than 1 MB"), (b"no video", "no frames")):
        with pytest.raises(ValueError, match=words) as refused:
            video_player.video_figure(wrong, SENTENCE)
        assert "\n" not in str(refused.value)
