"""What a video is to be, as `predict` and `render` are told."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from typing import Literal, cast

from spackle.errors import InputError
from spackle.formats.video import FORMATS, check_video
from spackle.stereo import StereoLayout

VideoFormat = Literal["mp4", "webm", "gif", "webp"]
Show = Literal["color", "depth"]
MAX_VIDEO_SIDE = 8192
MAX_IPD = 1e6
DEFAULT_FPS = 30


@dataclasses.dataclass(frozen=True)
class VideoOptions:
    """The choices that every video has."""

    format: VideoFormat | None = None  # mp4 where None
    fps: float | None = None  # 30 where None; a clip keeps its own, and takes none
    loop: int | None = None  # the format's where None: gif and webp for ever, the others once
    size: tuple[int, int] | None = None  # width and height of one eye's view; the photo's where None
    show: Show = "color"
    stereo: StereoLayout | None = None
    ipd: float | None = None  # as `default_ipd` has it where None
    convergence: float | None = None  # the focus depth where None

    @property
    def suffix(self) -> str:
        """What the file's name ends with."""
        return f".{self.format or 'mp4'}"

    @property
    def rate(self) -> float:
        """Frames a second."""
        return DEFAULT_FPS if self.fps is None else self.fps

    @property
    def plays(self) -> int:
        """How often the video is shown; 0: for ever."""
        return FORMATS[self.suffix].loop if self.loop is None else self.loop


def check_video_options(options: VideoOptions) -> None:
    """InputError for a choice that no video can have."""
    _named(f"--fps {options.rate:g}", options.rate, None, options)
    _named(f"--loop {options.loop}", options.rate, options.loop, options)
    for option, value in {"--ipd": options.ipd, "--convergence": options.convergence}.items():
        if value is None:
            continue
        if options.stereo is None:
            raise InputError(f"{option} {value:g}: is for two eyes: add --stereo, or leave it out")
        if not value > 0 or (option == "--ipd" and value > MAX_IPD):
            raise InputError(f"{option} must be a positive number, got {value:g}")
    if options.show == "depth" and options.stereo == "anaglyph":
        raise InputError("--show depth: an anaglyph mixes the colours that stand for depth: give --stereo sbs or ou")


def _named(option: str, fps: float, loop: int | None, options: VideoOptions) -> None:
    """Blame an option for what the format refuses."""
    try:
        check_video(name := f"video{options.suffix}", fps, loop)
    except InputError as error:
        raise InputError(f"{option}: {str(error).removeprefix(f'{name}: ')}") from error


def named_format(options: VideoOptions, file: Path) -> VideoOptions:
    """The options with the format that a file's name stands for.

    Raises:
        InputError: --format says something else.
    """
    suffix = file.suffix.lower()
    meant = "mp4" if suffix in (".m4v", ".mov") else cast(VideoFormat, suffix[1:])
    if options.format not in (None, meant):
        raise InputError(f"--format {options.format}: {file} is a name for {meant}: leave one of them out")
    return dataclasses.replace(options, format=meant)


def parse_size(text: str) -> tuple[int, int]:
    """WxH to (width, height).

    Raises:
        InputError: anything else.
    """
    match = re.fullmatch(r"([0-9]{1,5})[xX×]([0-9]{1,5})", text)
    width, height = (int(side) for side in match.groups()) if match else (0, 0)
    if not (1 <= width <= MAX_VIDEO_SIDE and 1 <= height <= MAX_VIDEO_SIDE):
        raise InputError(f"--size {text}: give width and height up to {MAX_VIDEO_SIDE}, such as 1280x720")
    return width, height
