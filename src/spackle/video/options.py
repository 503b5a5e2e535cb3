"""What a video may look like: its format, size, frame rate, and what the frames show."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from typing import cast, get_args

from spackle.runtime.declared_options import Fit as Fit
from spackle.runtime.declared_options import Show as Show
from spackle.runtime.declared_options import StereoLayout as StereoLayout
from spackle.runtime.declared_options import VideoFormatName as VideoFormatName
from spackle.runtime.errors import InputError, check_name
from spackle.video.video_formats import DEFAULT_FPS, VIDEO_FORMATS, check_fps, check_loop

# Names for a video's width and height in pixels.
SIZE_PRESETS = {"16:9": (1920, 1080), "9:16": (1080, 1920), "1:1": (1080, 1080)}
MAX_VIDEO_SIDE_PX = 8192

# The largest distance between the eyes, in the scene's unit.
MAX_IPD = 1e6


@dataclasses.dataclass(frozen=True, kw_only=True)
class VideoOptions:
    """Options that all videos share."""

    # None: mp4.
    format: VideoFormatName | None = None
    # Frames a second. None: 30; must be None for a clip, whose frame rate is kept.
    fps: float | None = None
    # How often the video plays, 0 for ever. None: gif and webp for ever, mp4 and webm once.
    loop: int | None = None
    # Width and height of one eye's image in pixels. None: the photo's.
    size: tuple[int, int] | None = None
    fit: Fit = "pad"
    show: Show = "color"
    # None: one eye.
    stereo: StereoLayout | None = None
    # The distance between the eyes, in the scene's unit (metres if the base is metric).
    # None: `spackle.video.stereo.default_ipd`.
    ipd: float | None = None
    # The depth that appears at the screen. None: that of the point at which the camera looks.
    convergence: float | None = None
    # Whether each frame shows the scene without filled holes on the left, and with them on the
    # right.
    compare: bool = False

    @property
    def suffix(self) -> str:
        """The suffix of the video's file name, such as ".mp4"."""
        return f".{self.format or 'mp4'}"

    @property
    def frames_per_second(self) -> float:
        """The frame rate, or its default."""
        return DEFAULT_FPS if self.fps is None else self.fps

    @property
    def play_count(self) -> int:
        """How often the video is shown; 0 for ever."""
        if self.loop is None:
            return VIDEO_FORMATS[self.suffix].default_play_count
        return self.loop

    def check(self) -> None:
        """Check each option, and that no two options contradict each other.

        Raises:
            InputError: a name is unknown, or an option is impossible.
        """
        check_name("fit", self.fit, get_args(Fit))
        check_name("show", self.show, get_args(Show))
        if self.stereo is not None:
            check_name("stereo", self.stereo, get_args(StereoLayout))

        video_format = VIDEO_FORMATS[self.suffix]
        check_fps(f"`fps` {self.frames_per_second:g}", self.frames_per_second, video_format)
        if self.loop is not None:
            check_loop(f"`loop` {self.loop}", self.loop, video_format)

        self._check_stereo_number("ipd", self.ipd)
        self._check_stereo_number("convergence", self.convergence)
        if self.compare and self.stereo is not None:
            both = f"`compare` and `stereo` {self.stereo} are given together"
            raise InputError(f"{both}: leave one of them out")
        if self.show == "depth" and self.stereo == "anaglyph":
            problem = "an anaglyph would mix the colours that stand for depth"
            raise InputError(f"`show` depth: {problem}: give `stereo` sbs or ou")

    def _check_stereo_number(self, option: str, value: float | None) -> None:
        """Raise an InputError if `ipd` or `convergence` is impossible, or has no effect.

        Args:
            option: "ipd" or "convergence".
            value: its value; None if it is not given.
        """
        if value is None:
            return
        if self.stereo is None:
            advice = f"add `stereo`, or leave `{option}` out"
            raise InputError(f"`{option}` {value:g} needs `stereo`: {advice}")
        # A convergence may be infinite: then the screen is infinitely far. NaN is refused.
        is_too_large = option == "ipd" and value > MAX_IPD
        if not value > 0 or is_too_large:
            raise InputError(f"`{option}` must be a positive number, got {value:g}")

    def for_file(self, file: Path) -> VideoOptions:
        """Return these options with the format that a file's suffix means.

        Raises:
            InputError: `format` contradicts the suffix.
        """
        suffix = file.suffix.lower()
        if suffix in (".m4v", ".mov"):  # other names of mp4
            suffix = ".mp4"
        format_of_file = cast(VideoFormatName, suffix.removeprefix("."))
        if self.format not in (None, format_of_file):
            problem = f"the name {file} means {format_of_file}"
            raise InputError(f"`format` {self.format}: {problem}: leave one of them out")
        return dataclasses.replace(self, format=format_of_file)


def parse_size(text: str) -> tuple[int, int]:
    """Parse a video's size.

    Args:
        text: width and height in pixels, such as "1280x720", or a name in SIZE_PRESETS.

    Returns:
        (width, height) in pixels.

    Raises:
        InputError: `text` is something else, or a side is too large.
    """
    if text in SIZE_PRESETS:
        return SIZE_PRESETS[text]
    width = 0
    height = 0
    match = re.fullmatch(r"([0-9]{1,5})[xX×]([0-9]{1,5})", text)
    if match is not None:
        width = int(match[1])
        height = int(match[2])
    if not (1 <= width <= MAX_VIDEO_SIDE_PX and 1 <= height <= MAX_VIDEO_SIDE_PX):
        examples = ", ".join(["1280x720", *SIZE_PRESETS])
        advice = f"give width and height up to {MAX_VIDEO_SIDE_PX}, such as {examples}"
        raise InputError(f"`size` {text}: {advice}")
    return width, height
