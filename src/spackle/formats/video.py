"""Videos out: H.264 that plays everywhere."""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path
from types import TracebackType

import av
import numpy as np
from av.video.stream import VideoStream
from torch import Tensor

from spackle.errors import InputError
from spackle.formats.atomic import atomic_path, check_writable
from spackle.formats.png import to_bytes

SUFFIXES = (".mp4", ".m4v", ".mov")
BT709, LIMITED_RANGE = 1, 1  # FFmpeg's numbers, the same for primaries, transfer and matrix
MAX_FPS = 1000


class VideoWriter:
    """Writes frames to an H.264 file, which appears when the `with` block ends well.

    yuv420p in the BT.709 colours that the file declares, with its index first, so that it plays while it
    loads. An odd width or height grows by one: the last column or row is repeated.
    """

    def __init__(self, path: str | os.PathLike[str], fps: float = 30, crf: int = 18) -> None:
        """Prepare to write.

        Args:
            path: ends with .mp4, .m4v or .mov.
            fps: frames a second.
            crf: x264's constant quality; lower is better and larger.

        Raises:
            InputError: where no such file can be written, or fps is not in 0..1000.
        """
        if Path(path).suffix.lower() not in SUFFIXES:
            raise InputError(f"{path}: not a name for a video: end it with {', '.join(SUFFIXES)}")
        if not (math.isfinite(fps) and 0 < fps <= MAX_FPS):
            raise InputError(f"frames a second must be a number above 0 and at most {MAX_FPS}, got {fps}")
        check_writable(path)
        self.path = path
        self.frames = 0
        self._rate = max(Fraction(fps).limit_denominator(1001), Fraction(1, 1001))  # 29.97 is 30000/1001
        self._options = {"crf": str(crf), "preset": "fast"}
        self._shape: tuple[int, ...] = ()
        self._stack = contextlib.ExitStack()

    def __enter__(self) -> VideoWriter:
        with contextlib.ExitStack() as stack:
            temporary = stack.enter_context(atomic_path(self.path))
            options = {"movflags": "+faststart"}
            self._container = stack.enter_context(av.open(str(temporary), "w", format="mp4", options=options))
            self._stack = stack.pop_all()
        return self

    def add(self, frame: Tensor) -> None:
        """Append sRGB [H, W, 3] in 0..1; all frames share one size."""
        if frame.ndim != 3 or frame.shape[2] != 3 or 0 in frame.shape:
            raise ValueError(f"a video frame is [H, W, 3], got {tuple(frame.shape)}")
        rgb = to_bytes(frame).numpy()
        rgb = np.pad(rgb, [(0, rgb.shape[0] % 2), (0, rgb.shape[1] % 2), (0, 0)], mode="edge")
        if self.frames == 0:
            self._shape = tuple(frame.shape)
            self._stream = self._new_stream(rgb.shape[1], rgb.shape[0])
        if tuple(frame.shape) != self._shape:
            raise ValueError(f"frame {self.frames} is {tuple(frame.shape)}, the first one was {self._shape}")
        picture = av.VideoFrame.from_ndarray(rgb, format="rgb24").reformat(
            format="yuv420p",
            src_colorspace="ITU709",
            dst_colorspace="ITU709",
            src_color_range="JPEG",
            dst_color_range="MPEG",
        )
        picture.pts, picture.time_base = self.frames, 1 / self._rate
        self._container.mux(self._stream.encode(picture))
        self.frames += 1

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is not None:
            self._stack.__exit__(kind, error, trace)  # closes the container and removes the file
            return
        with self._stack:  # closes the container and renames the file, or removes it
            if self.frames == 0:
                raise ValueError(f"{self.path}: a video needs at least one frame")
            self._container.mux(self._stream.encode(None))

    def _new_stream(self, width: int, height: int) -> VideoStream:
        stream = self._container.add_stream("libx264", rate=self._rate, options=self._options)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        context = stream.codec_context
        context.color_range = LIMITED_RANGE
        context.colorspace = context.color_primaries = context.color_trc = BT709
        return stream


def save_video(frames: Iterable[Tensor], path: str | os.PathLike[str], fps: float = 30) -> None:
    """Write frames, sRGB [H, W, 3] in 0..1, as H.264; see `VideoWriter`.

    `frames` may be a generator: one frame at a time is held. Where it raises, no file is left.
    """
    with VideoWriter(path, fps) as writer:
        for frame in frames:
            writer.add(frame)
