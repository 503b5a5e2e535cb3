"""Videos out: the file's suffix decides between H.264, VP9, GIF and animated WebP."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import os
from collections.abc import Callable, Iterable
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from spackle.errors import InputError
from spackle.formats.atomic import atomic_path, check_writable
from spackle.formats.png import to_bytes
from spackle.formats.video_gif import GifEncoder
from spackle.formats.video_stream import H264, VP9, StreamEncoder
from spackle.formats.video_webp import WebpEncoder

MAX_REPEATS = 1000  # of a file that has to hold every repetition
MAX_PLAYS = 65_535  # GIF's and WebP's counters have 16 bits


class Encoder(Protocol):
    """Puts frames of one size into one file."""

    def add(self, rgb: NDArray[np.uint8]) -> None:
        """Append [H, W, 3]."""

    def finish(self) -> None:
        """All frames are there: complete the file."""

    def close(self) -> None:
        """Let go of the file, finished or not; may be called twice."""


@dataclasses.dataclass(frozen=True)
class VideoFormat:
    """What a kind of file can do."""

    encoder: Callable[[Path, int, int, Fraction, int], Encoder]  # path, width, height, rate, plays
    counts: bool  # the file says how often it plays (0: for ever); others hold every repetition
    fps: tuple[float, float]
    max_side: int

    @property
    def loop(self) -> int:
        """How often a file plays where nobody says so."""
        return 0 if self.counts else 1


_H264 = VideoFormat(lambda *file: StreamEncoder(H264, *file), False, (0.001, 1000), 16_384)
_VP9 = VideoFormat(lambda *file: StreamEncoder(VP9, *file), False, (0.001, 1000), 16_384)
# Browsers show a picture of 10 ms or less for 100 ms; GIF counts hundredths of a second, WebP thousandths.
_GIF = VideoFormat(GifEncoder, True, (0.01, 50), 65_535)
_WEBP = VideoFormat(WebpEncoder, True, (0.01, 90), 16_383)
FORMATS = {".mp4": _H264, ".m4v": _H264, ".mov": _H264, ".webm": _VP9, ".gif": _GIF, ".webp": _WEBP}


def is_video_name(path: str | os.PathLike[str]) -> bool:
    """Whether `VideoWriter` takes a file of this name."""
    return Path(path).suffix.lower() in FORMATS


def check_video(path: str | os.PathLike[str], fps: float, loop: int | None = None) -> VideoFormat:
    """The format that a name stands for.

    Raises:
        InputError: no video has such a name, or the format does not know such a rate or count.
    """
    kind = FORMATS.get(Path(path).suffix.lower())
    if kind is None:
        raise InputError(f"{path}: not a name for a video: end it with {', '.join(FORMATS)}")
    least, most = kind.fps
    if not (math.isfinite(fps) and least <= fps <= most):
        raise InputError(f"{path}: frames a second must be a number from {least:g} to {most:g}, got {fps}")
    if loop is not None and kind.counts and not 0 <= loop <= MAX_PLAYS:
        raise InputError(f"{path}: a loop count must be from 0 (for ever) to {MAX_PLAYS}, got {loop}")
    if loop is not None and not kind.counts and not 1 <= loop <= MAX_REPEATS:
        raise InputError(
            f"{path}: a loop count must be from 1 to {MAX_REPEATS}, got {loop}: such a file holds every repetition "
            "(.gif and .webp can play for ever)"
        )
    return kind


class VideoWriter:
    """Writes frames to a video, which appears when the `with` block ends well.

    .mp4, .m4v, .mov (H.264) and .webm (VP9) are yuv420p in the BT.709 colours that the file declares, with
    the index first, so that they play while they load; an odd width or height grows by one: the last column
    or row is repeated. .gif has one palette for all frames, .webp is lossy, both keep odd sizes. One frame at
    a time is held; besides, until the end, GIF keeps the frames in an unnamed temporary file, and WebP the
    compressed video in memory.
    """

    def __init__(self, path: str | os.PathLike[str], fps: float = 30, loop: int | None = None) -> None:
        """Prepare to write.

        Args:
            path: its suffix decides the format.
            fps: frames a second; at most 50 for GIF and 90 for WebP, or browsers slow down.
            loop: how often the frames are shown. GIF and WebP count, 0 means for ever, their default; the
                others hold every repetition, 1 by default.

        Raises:
            InputError: where no such file can be written.
        """
        self._kind = check_video(path, fps, loop)
        check_writable(path)
        self.path = path
        self.frames = 0
        self._plays = self._kind.loop if loop is None else loop
        self._rate = max(Fraction(fps).limit_denominator(1001), Fraction(1, 1001))  # 29.97 is 30000/1001
        self._shape: tuple[int, ...] = ()
        self._stack = contextlib.ExitStack()

    def __enter__(self) -> VideoWriter:
        self._temporary = self._stack.enter_context(atomic_path(self.path))
        return self

    def add(self, frame: Tensor) -> None:
        """Append sRGB [H, W, 3] in 0..1; all frames share one size."""
        if frame.ndim != 3 or frame.shape[2] != 3 or 0 in frame.shape:
            raise ValueError(f"a video frame is [H, W, 3], got {tuple(frame.shape)}")
        if self.frames == 0:
            self._encoder = self._open(*frame.shape[:2])
            self._shape = tuple(frame.shape)
        if tuple(frame.shape) != self._shape:
            raise ValueError(f"frame {self.frames} is {tuple(frame.shape)}, the first one was {self._shape}")
        self._encoder.add(to_bytes(frame).numpy())
        self.frames += 1

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is not None:
            self._stack.__exit__(kind, error, trace)  # closes the file and removes it
            return
        with self._stack:  # closes the file and renames it, or removes it
            if self.frames == 0:
                raise ValueError(f"{self.path}: a video needs at least one frame")
            self._encoder.finish()

    def _open(self, height: int, width: int) -> Encoder:
        if max(height, width) > self._kind.max_side:
            raise InputError(
                f"{self.path}: {width}×{height} is too large for this format (at most {self._kind.max_side})"
            )
        encoder = self._kind.encoder(self._temporary, width, height, self._rate, self._plays)
        self._stack.callback(encoder.close)
        return encoder


def save_video(
    frames: Iterable[Tensor], path: str | os.PathLike[str], fps: float = 30, loop: int | None = None
) -> None:
    """Write frames, sRGB [H, W, 3] in 0..1, in the format of the name; see `VideoWriter`.

    `frames` may be a generator: one frame at a time is held. Where it raises, no file is left.
    """
    with VideoWriter(path, fps, loop) as writer:
        for frame in frames:
            writer.add(frame)
