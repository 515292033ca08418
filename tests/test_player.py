"""The video player: one self-contained figure that says in words what the film shows."""

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
def film():
    return encode_video(np.random.default_rng(0).integers(0, 255, (25, 48, 64, 3), np.uint8))


def content(uri, kind):
    head, data = uri.split(",")
    assert head == f"data:{kind};base64"
    return b64decode(data)


def test_the_figure_holds_film_poster_and_sentence(film, tmp_path):
    path = tmp_path / "film.mp4"
    path.write_bytes(film)
    page = Tags(video_player.video_figure(path, SENTENCE))
    video = page.found["video"]
    assert not page.opened and page.words == video["aria-label"] == SENTENCE
    assert {"muted", "loop", "controls", "playsinline", "preload"} <= set(video)
    assert content(video["src"], "video/mp4") == film
    with av.open(io.BytesIO(content(video["poster"], "image/jpeg"))) as poster:
        assert next(poster.decode(video=0)).to_ndarray(format="rgb24").shape == (48, 64, 3)


def test_captions_say_the_sentence_over_the_whole_film(film):
    track = Tags(video_player.video_figure(film, SENTENCE)).found["track"]
    assert track["kind"] == "captions"
    head, time, text = content(track["src"], "text/vtt").decode().strip().replace("\n\n", "\n").split("\n")
    assert (head, time) == ("WEBVTT", "00:00.000 --> 00:02.500")
    assert text == "The arm lifts &quot;the &lt;red&gt; cube&quot; &amp; stops."


def test_too_large_a_film_and_one_without_frames_are_refused(film):
    for wrong, words in ((film.ljust(video_player.MAX_BYTES, b"0"), "less than 1 MB"), (b"no film", "no frames")):
        with pytest.raises(ValueError, match=words) as refused:
            video_player.video_figure(wrong, SENTENCE)
        assert "\n" not in str(refused.value)
