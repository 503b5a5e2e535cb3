"""The formats of videos, and what each allows. To add one, add it to `VIDEO_FORMATS`."""

from __future__ import annotations

import dataclasses
import math
import os
from pathlib import Path

from spackle.runtime.errors import InputError, unknown_suffix

DEFAULT_FPS = 30

# A file that stores every repetition plays at most this often.
MAX_STORED_REPETITIONS = 1000
# GIF's and WebP's counters of repetitions have 16 bits.
MAX_PLAY_COUNT = 65_535
PLAY_FOREVER = 0

StrPath = str | os.PathLike[str]


@dataclasses.dataclass(frozen=True, kw_only=True)
class VideoFormat:
    """A video format's limits, and its settings for FFmpeg."""

    codec: str
    container: str
    codec_options: dict[str, str] = dataclasses.field(default_factory=dict)
    container_options: dict[str, str] = dataclasses.field(default_factory=dict)
    pixel_format: str
    # Whether the file states how often it plays; else it stores every repetition.
    states_play_count: bool
    min_fps: float
    max_fps: float
    max_side_px: int

    @property
    def default_play_count(self) -> int:
        """How often a video plays by default: animations for ever, others once."""
        return PLAY_FOREVER if self.states_play_count else 1


H264 = VideoFormat(
    codec="libx264",
    container="mp4",
    # Without cpu-independent, x264 reads uninitialised memory, and equal frames give different
    # bytes. The short search for motion (me, subme) saves a third of the time; files grow by 8 %,
    # and PSNR falls by 0.02 dB.
    codec_options={
        "crf": "17",
        "preset": "veryfast",
        "x264-params": "cpu-independent=1:me=dia:subme=1",
    },
    # The index comes first, so that the video plays while it loads.
    container_options={"movflags": "+faststart"},
    pixel_format="yuv420p",
    states_play_count=False,
    min_fps=0.001,
    max_fps=1000,
    max_side_px=16_384,
)
VP9 = VideoFormat(
    codec="libvpx-vp9",
    container="webm",
    # VP9 at crf 24 comes close to x264 at 17; cpu-used 4 costs little quality and saves most of
    # the time.
    codec_options={"crf": "24", "b": "0", "deadline": "good", "cpu-used": "4", "row-mt": "1"},
    # The index comes first, as above. Without bitexact the track number would be random.
    container_options={"cues_to_front": "1", "fflags": "+bitexact"},
    pixel_format="yuv420p",
    states_play_count=False,
    min_fps=0.001,
    max_fps=1000,
    max_side_px=16_384,
)
# Browsers show a frame of 10 ms or less for 100 ms; GIF counts time in 1/100 s, WebP in 1/1000 s.
GIF = VideoFormat(
    codec="gif",
    container="gif",
    pixel_format="pal8",
    states_play_count=True,
    min_fps=0.01,
    max_fps=50,
    max_side_px=65_535,
)
# libwebp converts to YUV better than FFmpeg. The encoder libwebp_anim would keep old blocks where
# little changes.
WEBP = VideoFormat(
    codec="libwebp",
    container="webp",
    codec_options={"quality": "85"},
    pixel_format="bgra",
    states_play_count=True,
    min_fps=0.01,
    max_fps=90,
    max_side_px=16_383,
)
VIDEO_FORMATS = {
    ".mp4": H264,
    ".m4v": H264,
    ".mov": H264,
    ".webm": VP9,
    ".gif": GIF,
    ".webp": WEBP,
}


def check_video(path: StrPath, fps: float, loop: int | None = None) -> VideoFormat:
    """Check a video's name, frame rate and loop count, and return its format.

    Args:
        path: the file's name, whose suffix selects the format.
        fps: frames a second.
        loop: how often the video plays, 0 for ever; None: the format's default.

    Raises:
        InputError: the suffix is unknown, or the format does not allow the rate or loop count.
    """
    video_format = VIDEO_FORMATS.get(Path(path).suffix.lower())
    if video_format is None:
        raise unknown_suffix(path, "not a name for a video", [*VIDEO_FORMATS])
    check_fps(path, fps, video_format)
    if loop is not None:
        check_loop(path, loop, video_format)
    return video_format


def check_fps(subject: object, fps: float, video_format: VideoFormat) -> None:
    """Raise an InputError, beginning with `subject`, unless the format allows the frame rate."""
    low = video_format.min_fps
    high = video_format.max_fps
    if not (math.isfinite(fps) and low <= fps <= high):
        limits = f"from {low:g} to {high:g}"
        raise InputError(f"{subject}: frames a second must be a number {limits}, got {fps}")


def check_loop(subject: object, loop: int, video_format: VideoFormat) -> None:
    """Raise an InputError, beginning with `subject`, unless the format allows the loop count."""
    if video_format.states_play_count:
        low = PLAY_FOREVER
        high = MAX_PLAY_COUNT
        hint = "0 is for ever"
    else:
        # Such a file plays once. To play longer, it must hold the frames as often.
        low = 1
        high = MAX_STORED_REPETITIONS
        hint = "it holds every repetition; .gif and .webp can play for ever"
    if not low <= loop <= high:
        limits = f"from {low} to {high}"
        problem = f"a loop count of such a file must be {limits}, got {loop}"
        raise InputError(f"{subject}: {problem} ({hint})")
