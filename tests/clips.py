"""Small clips on disk."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray
from photos import picture

Bytes = NDArray[np.uint8]


def moving(count: int = 4, height: int = 48, width: int = 64) -> list[Bytes]:
    """Frames of a picture that moves to the right by one pixel per frame."""
    wide = picture(width + count, height)
    return [np.ascontiguousarray(wide[:, count - k : count - k + width]) for k in range(count)]


def write_clip(
    path: Path,
    frames: Iterable[Bytes],
    codec: str = "libx264",
    pix_fmt: str = "yuv420p",
    ticks: list[int] | None = None,
    sound: str | None = None,
    turned: int = 0,
) -> Path:
    """Write a clip of 10 frames per second, or with frames at `ticks` of 1/10 s."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=10, options={"crf": "10"} if codec == "libx264" else {})
        voice = container.add_stream(sound, rate=8000) if sound else None
        for index, rgb in enumerate(frames):
            if index == 0:
                stream.height, stream.width = rgb.shape[:2]
                stream.pix_fmt = pix_fmt
                if turned:
                    stream.set_display_rotation(turned)
            frame = av.VideoFrame.from_ndarray(rgb, format="rgb24")
            frame.pts, frame.time_base = ticks[index] if ticks else index, Fraction(1, 10)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
        if voice is not None:
            for block in range(4):
                tone = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.int16), format="s16", layout="mono")
                tone.rate, tone.pts, tone.time_base = 8000, 1024 * block, Fraction(1, 8000)
                container.mux(voice.encode(tone))
            container.mux(voice.encode(None))
    return path
