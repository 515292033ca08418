"""The book's video player: a self-contained HTML figure of a video with poster, captions and a description."""

import io
from base64 import b64encode
from fractions import Fraction
from html import escape
from pathlib import Path

import av
import numpy as np

MAX_BYTES = 1_000_000  # a page holds several videos, each a third larger in base64
STYLE = "muted loop playsinline preload='metadata' style='width:100%'"
CONTROLS = "controls"
# Instead of controls over the picture: it plays, and a click or the space bar stops it.
AT_ONCE = """autoplay tabindex='0' onclick='this.paused ? this.play() : this.pause()' \
onkeydown='if (event.key === " ") { event.preventDefault(); this.click() }'"""
CAPTION_STYLE = "color:inherit;font-weight:400"  # for light and dark pages


def video_figure(video: Path | str | bytes, sentence: str) -> str:
    """Return an HTML figure that plays an mp4 (a file or its bytes); `sentence` becomes captions and figure caption.

    Raises:
        ValueError: the video has 1 MB or more, or no readable frames.
    """
    name = "the video" if isinstance(video, bytes) else str(video)
    content = video if isinstance(video, bytes) else Path(video).read_bytes()
    if len(content) >= MAX_BYTES:
        raise ValueError(f"{name} has {len(content) / 1e6:.2f} MB: a video of the book has less than 1 MB")
    poster, seconds = _poster_and_length(content, name)
    text = escape(" ".join(sentence.split()))
    player = (
        f'<video {CONTROLS} {STYLE} aria-label="{text}" poster="{_uri("image/jpeg", poster)}" '
        f'src="{_uri("video/mp4", content)}">'
        f'<track kind="captions" srclang="en" label="English" src="{_uri("text/vtt", _captions(text, seconds))}">'
        "</video>"
    )
    return f"<figure style='margin:0'>{player}<figcaption style='{CAPTION_STYLE}'>{text}</figcaption></figure>"


def _poster_and_length(content: bytes, name: str) -> tuple[bytes, float]:
    """The middle frame as JPEG, and the length in seconds."""
    av.logging.set_level(None)  # the exception says what is wrong
    try:
        with av.open(io.BytesIO(content)) as container:
            rate = float(container.streams.video[0].average_rate)
            frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
        return _jpeg(frames[len(frames) // 2]), len(frames) / rate
    except (av.FFmpegError, ValueError, TypeError, IndexError) as error:  # the last two: no video stream
        raise ValueError(f"{name} has no frames that can be read: {error}") from error


def _jpeg(pixels: np.ndarray) -> bytes:
    codec = av.CodecContext.create("mjpeg", "w")
    codec.height, codec.width = pixels.shape[:2]
    codec.pix_fmt, codec.time_base = "yuvj420p", Fraction(1)
    frame = av.VideoFrame.from_ndarray(pixels, format="rgb24").reformat(format="yuvj420p")
    return b"".join(bytes(packet) for packet in [*codec.encode(frame), *codec.encode(None)])


def _captions(text: str, seconds: float) -> bytes:
    """WebVTT with one cue over the whole length."""
    minutes, rest = divmod(seconds, 60)
    return f"WEBVTT\n\n00:00.000 --> {int(minutes):02}:{rest:06.3f}\n{text}\n".encode()


def _uri(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{b64encode(content).decode()}"
