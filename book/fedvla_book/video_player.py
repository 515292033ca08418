"""The book's video player: a film and a sentence that says what happens -> one HTML figure with everything inside."""

import io
from base64 import b64encode
from collections.abc import Sequence
from fractions import Fraction
from html import escape
from pathlib import Path

import av
import numpy as np

MAX_BYTES = 1_000_000  # a page holds several films, each a third larger in base64
PLAYS = "muted loop controls playsinline preload='metadata' style='width:100%'"
LOOKS = "color:inherit;font-weight:400"  # on light and dark pages


def video_figure(film: Path | str | bytes, sentence: str) -> str:
    """Return an HTML figure that plays an mp4 (a file or its bytes), with a poster, captions and the sentence below.

    Raises:
        ValueError: the film has 1 MB or more, or no frames that can be read.
    """
    name = "the film" if isinstance(film, bytes) else str(film)
    content = film if isinstance(film, bytes) else Path(film).read_bytes()
    if len(content) >= MAX_BYTES:
        raise ValueError(f"{name} has {len(content) / 1e6:.2f} MB: a film of the book has less than 1 MB")
    poster, seconds = _poster_and_length(content, name)
    text = escape(" ".join(sentence.split()))
    video = (
        f'<video {PLAYS} aria-label="{text}" poster="{_uri("image/jpeg", poster)}" src="{_uri("video/mp4", content)}">'
        f'<track kind="captions" srclang="en" label="English" src="{_uri("text/vtt", _captions(text, seconds))}">'
        "</video>"
    )
    return f"<figure style='margin:0'>{video}<figcaption style='{LOOKS}'>{text}</figcaption></figure>"


def side_by_side(films: Sequence[np.ndarray]) -> np.ndarray:
    """Return films of one height, uint8 (T, H, W, 3), beside each other; one that ends earlier stands still."""
    longest = max(map(len, films))
    held = [np.concatenate([film, film[-1:].repeat(longest - len(film), axis=0)]) for film in films]
    return np.concatenate(held, axis=2)


def _poster_and_length(content: bytes, name: str) -> tuple[bytes, float]:
    """The middle frame as JPEG, and the film's seconds."""
    av.logging.set_level(None)  # the exception says what is wrong
    try:
        with av.open(io.BytesIO(content)) as container:
            rate = float(container.streams.video[0].average_rate)
            frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
        return _jpeg(frames[len(frames) // 2]), len(frames) / rate
    except (av.FFmpegError, ValueError, TypeError, IndexError) as error:  # the last two: no pictures in it
        raise ValueError(f"{name} has no frames that can be read: {error}") from error


def _jpeg(pixels: np.ndarray) -> bytes:
    codec = av.CodecContext.create("mjpeg", "w")
    codec.height, codec.width = pixels.shape[:2]
    codec.pix_fmt, codec.time_base = "yuvj420p", Fraction(1)
    frame = av.VideoFrame.from_ndarray(pixels, format="rgb24").reformat(format="yuvj420p")
    return b"".join(bytes(packet) for packet in [*codec.encode(frame), *codec.encode(None)])


def _captions(text: str, seconds: float) -> bytes:
    """WebVTT: one cue over the film's whole length."""
    minutes, rest = divmod(seconds, 60)
    return f"WEBVTT\n\n00:00.000 --> {int(minutes):02}:{rest:06.3f}\n{text}\n".encode()


def _uri(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{b64encode(content).decode()}"
