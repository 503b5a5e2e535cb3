"""Animated WebP."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from av.video.stream import VideoStream
from numpy.typing import NDArray

from spackle.formats.video_stream import check_encoder

QUALITY = "85"


class WebpEncoder:
    """Frames to an animated WebP; libwebp holds the compressed frames until the end."""

    def __init__(self, path: Path, width: int, height: int, rate: Fraction, plays: int) -> None:
        self._rate, self._count = rate, 0
        check_encoder("libwebp_anim")
        self._container = av.open(str(path), "w", format="webp", options={"loop": str(plays)})
        stream = self._container.add_stream("libwebp_anim", rate=rate, options={"quality": QUALITY})
        assert isinstance(stream, VideoStream)
        stream.width, stream.height, stream.pix_fmt = width, height, "bgra"  # libwebp's own way to YUV is the best
        self._stream = stream

    def add(self, rgb: NDArray[np.uint8]) -> None:
        """Append [H, W, 3]."""
        picture = av.VideoFrame.from_ndarray(rgb, format="rgb24").reformat(format="bgra")
        picture.pts, picture.time_base = self._count, 1 / self._rate
        self._container.mux(self._stream.encode(picture))
        self._count += 1

    def finish(self) -> None:
        """Write the file."""
        self._container.mux(self._stream.encode(None))
        self.close()

    def close(self) -> None:
        """Let go of the file."""
        self._container.close()
