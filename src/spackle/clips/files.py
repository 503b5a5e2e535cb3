"""Read clips in any format of FFmpeg."""

from __future__ import annotations

import contextlib
import dataclasses
import os
from collections.abc import Iterable, Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import torch
from av.container import InputContainer
from av.sidedata.sidedata import Type as SideData
from av.stream import Disposition
from av.video.reformatter import VideoReformatter
from av.video.stream import VideoStream
from torch import Tensor

from spackle.core.color_spaces import REFERENCE_WHITE_NITS, color_space_of_cicp, to_srgb
from spackle.core.image_files import check_pixel_count
from spackle.core.image_formats import kind_of_file
from spackle.runtime.errors import InputError, as_input_error, with_detached_errors
from spackle.runtime.files import check_file
from spackle.runtime.progress import Progress
from spackle.video.encoding import BT709

CLIP_SUFFIXES = {
    *(".mp4", ".m4v", ".mov", ".webm", ".mkv", ".avi", ".gif", ".mpg", ".mpeg"),
    *(".ts", ".mts", ".m2ts", ".wmv", ".flv", ".3gp", ".ogv"),
}
# FFmpeg's numbers of colour matrices, which convert a video's YUV to RGB.
UNSPECIFIED_MATRIX, BT601 = 2, 5
# From this height on, a video without declared colour matrix is read as BT.709, as players do.
HD_ROWS = 720
# Formats of FFmpeg that only list other files, which it would open.
PLAYLIST_FORMATS = {"concat", "dash", "hls", "rtsp", "sdp", "webm_dash_manifest"}
DECODING_ERRORS = (av.FFmpegError, ValueError)  # what PyAV raises for a damaged file
HDR_TRANSFERS = {16: "PQ", 18: "HLG"}  # by FFmpeg's number of the transfer function
# The light that becomes white in all frames of an HDR clip: the peak of most mastering displays, as
# a multiple of the reference white. Each frame's own peak would let the brightness flicker.
HDR_PEAK = 1000 / REFERENCE_WHITE_NITS
UNSPECIFIED_PRIMARIES, BT2020_PRIMARIES = 2, 9  # FFmpeg's numbers, as those of CICP
DEFAULT_FRAME_RATE = Fraction(25)  # frames a second, if the file states none


@dataclasses.dataclass(frozen=True)
class Clip:
    """Facts about a clip, found by reading the whole clip."""

    path: Path
    width: int  # of an upright frame with square pixels
    height: int
    times: tuple[Fraction, ...]  # of the frames, in seconds, increasing from 0
    start: Fraction  # time of the first frame in the file, in seconds
    rate: Fraction  # mean number of frames a second
    audio: str | None  # codec of the sound
    hdr: str | None  # transfer function, if it is an HDR one: "PQ" or "HLG"

    def __len__(self) -> int:
        """The number of frames."""
        return len(self.times)

    @property
    def seconds(self) -> Fraction:
        """The length of the clip; the last frame lasts as long as the frame before."""
        if len(self) == 1:
            return 1 / self.rate
        last_duration = self.times[-1] - self.times[-2]
        return self.times[-1] + last_duration


def is_clip(path: Path) -> bool:
    """Whether a file is a video, by its suffix or its first bytes.

    A GIF with a single frame is a photo, and so is a file that cannot be read as a GIF.
    """
    suffix = path.suffix.lower()
    if path.exists() and not path.is_file():
        return False  # a folder, or a named pipe, which would be waited for
    if suffix != ".gif":
        return suffix in CLIP_SUFFIXES or _begins_as_video(path)
    try:
        with av.open(str(path), metadata_errors="replace") as container:
            # Two pictures make a clip. The packets hold one picture each; an empty packet marks the
            # end of the file.
            pictures = 0
            for packet in container.demux(video=0):
                if packet.size > 0:
                    pictures += 1
                if pictures == 2:
                    return True
    except (av.FFmpegError, ValueError, IndexError):
        return False
    return False


def _begins_as_video(path: Path) -> bool:
    """Whether a file begins as an MP4, a QuickTime, a Matroska or an AVI does."""
    try:
        return kind_of_file(path).is_video
    except InputError:
        return False  # its reader says what is wrong


def read_clip(
    path: str | os.PathLike[str],
    max_frames: int | None = None,
    progress: Progress | None = None,
) -> Clip:
    """Decode a clip from beginning to end, so that damage in any frame is reported at once.

    Args:
        path: the file.
        max_frames: number of frames to read from the beginning; None: all.
        progress: called with (number of frames read, number of frames in the file).

    Raises:
        InputError: the file is not a clip, truncated, damaged, without video, or of an unknown
            codec.
    """
    check_file(path, "clip")
    return with_detached_errors(lambda: _read_clip(path, max_frames, progress))


def _read_clip(
    path: str | os.PathLike[str], max_frames: int | None, progress: Progress | None
) -> Clip:
    """Decode the first `max_frames` frames of a clip (None: all), and collect its facts.

    `progress` is called with (number of frames read, number of frames in the file). InputError if
    the file is not a clip, damaged, or has no frames.
    """
    times_in_file: list[Fraction | None] = []
    frame = None
    with _open_video(path) as (container, stream):
        pixel_aspect = stream.sample_aspect_ratio or Fraction(1)
        rate = stream.average_rate or stream.guessed_rate or DEFAULT_FRAME_RATE
        audio = None
        audio_streams = container.streams.audio
        if audio_streams and audio_streams[0].codec_context:
            audio = audio_streams[0].codec_context.name

        for frame in _decode_frames(path, container, stream, max_frames):
            if frame.pts is None or frame.time_base is None:
                times_in_file.append(None)
            else:
                times_in_file.append(frame.pts * frame.time_base)
            if progress is not None:
                frames_read = len(times_in_file)
                # A file may state too few frames, or none.
                progress(frames_read, max(frames_read, max_frames or stream.frames))
    if frame is None:
        raise InputError(f"{path}: has no frames: give another clip")
    # mypy takes the elements for keys, because the container is a Mapping.
    side_data: Iterable[Any] = frame.side_data
    if any(data.type is SideData.SPHERICAL for data in side_data):
        raise InputError(
            f"{path}: a 360° panorama: cut a flat view out of it first, at most 100° wide "
            "(docs/inputs.md has a command)"
        )

    # All frames have the size and the rotation of the last one.
    width, height = _square_pixel_size(frame, pixel_aspect)
    if _quarter_turns(frame) % 2 == 1:
        width, height = height, width
    check_pixel_count(width, height, os.path.getsize(path), path)
    return Clip(
        path=Path(path),
        width=width,
        height=height,
        times=_increasing_times(times_in_file, Fraction(rate)),
        start=times_in_file[0] or Fraction(0),
        rate=Fraction(rate),
        audio=audio,
        hdr=HDR_TRANSFERS.get(int(frame.color_trc)),  # by the number of the transfer function
    )


def clip_frames(clip: Clip) -> Iterator[Tensor]:
    """The frames of a clip, upright, [H, W, 3] float32 sRGB in 0..1.

    InputError if the file has changed or gone since the clip was read.
    """
    with _open_video(clip.path) as (container, stream):
        pixel_aspect = stream.sample_aspect_ratio or Fraction(1)
        reformatter = VideoReformatter()
        for frame in _decode_frames(clip.path, container, stream, len(clip)):
            yield _frame_to_rgb(frame, pixel_aspect, reformatter)


@contextlib.contextmanager
def _open_video(path: str | os.PathLike[str]) -> Iterator[tuple[InputContainer, VideoStream]]:
    """Open a file, and find the video in it; both are closed after the `with` block.

    InputError if the file is no video, only a list of files, too large, or of an unknown codec.
    """
    with as_input_error(
        path, "not a video, or damaged at the beginning or end ({reason})", *DECODING_ERRORS
    ):
        # Metadata that is no valid text is replaced. Otherwise it would raise an error, after which
        # the file stays open.
        container = av.open(str(path), metadata_errors="replace")
    with container:
        if PLAYLIST_FORMATS & set(container.format.name.split(",")):
            raise InputError(
                f"{path}: is a list of other files, not a video: give one of these files"
            )
        # A music file's cover is a stream of pictures, too.
        videos = [
            stream
            for stream in container.streams.video
            if not stream.disposition & Disposition.attached_pic
        ]
        if not videos:
            raise InputError(f"{path}: has no moving picture: give a video")
        stream = videos[0]
        codec = stream.codec_context
        if codec is None:
            raise InputError(
                f"{path}: FFmpeg does not know the codec: convert the clip to H.264 first"
            )
        check_pixel_count(codec.width, codec.height, os.path.getsize(path), path)
        stream.thread_type = "AUTO"
        yield container, stream


def _decode_frames(
    path: str | os.PathLike[str],
    container: InputContainer,
    stream: VideoStream,
    max_frames: int | None,
) -> Iterator[av.VideoFrame]:
    """Decode the first `max_frames` frames of a video (None: all), all of the same size.

    InputError, which names `path`, if a frame is damaged or missing or has another size.
    """
    first_shape: tuple[int, int, int] | None = None
    frame_count = 0
    packet_count = 0
    with as_input_error(
        path,
        "damaged or truncated ({reason}): give a whole clip, or fewer `frames`",
        *DECODING_ERRORS,
    ):
        for packet in container.demux(stream):
            if packet.size > 0:  # the last packet is empty
                packet_count += 1
            for frame in packet.decode():
                shape = (frame.width, frame.height, frame.rotation)
                if first_shape is None:
                    first_shape = shape
                if shape != first_shape:
                    raise InputError(
                        f"{path}: frame {frame_count} has a new size: use `frames` {frame_count}"
                    )
                yield frame
                frame_count += 1
                if frame_count == max_frames:
                    return
        # FFmpeg ends a truncated file without an error.
        if packet_count < stream.frames:
            raise ValueError(f"{packet_count} of {stream.frames} frames")


def _frame_to_rgb(
    frame: av.VideoFrame, pixel_aspect: Fraction, reformatter: VideoReformatter
) -> Tensor:
    """A frame as an upright image [H, W, 3] sRGB in 0..1 with square pixels.

    `pixel_aspect` is the width of a stored pixel over its height.
    """
    width, height = _square_pixel_size(frame, pixel_aspect)
    # The colour matrix, which converts the video's YUV to RGB. Where a file declares none, it is
    # chosen by the height, as players do.
    matrix = frame.colorspace
    if matrix == UNSPECIFIED_MATRIX:
        matrix = BT709 if frame.height >= HD_ROWS else BT601
    # `frame.reformat` would start new threads for each frame.
    if int(frame.color_trc) in HDR_TRANSFERS:
        return _hdr_frame_to_rgb(frame, width, height, matrix, reformatter)
    rgb = reformatter.reformat(frame, width, height, "rgb24", src_colorspace=matrix).to_ndarray()
    upright = np.ascontiguousarray(np.rot90(rgb, _quarter_turns(frame)))
    return torch.from_numpy(upright).float().div_(255)


def _hdr_frame_to_rgb(
    frame: av.VideoFrame, width: int, height: int, matrix: int, reformatter: VideoReformatter
) -> Tensor:
    """A frame in PQ or HLG as an upright image [H, W, 3] sRGB in 0..1.

    Args:
        frame: the frame.
        width: of the frame in square pixels, before it is turned upright.
        height: of the frame in square pixels.
        matrix: FFmpeg's number of the matrix from YUV to RGB.
        reformatter: converts YUV to RGB.
    """
    # 16 bits, because a step of 8 bits of these functions is visible.
    codes = reformatter.reformat(frame, width, height, "rgb48le", src_colorspace=matrix)
    upright = np.ascontiguousarray(np.rot90(codes.to_ndarray(), _quarter_turns(frame)))
    primaries = int(frame.color_primaries)
    if primaries == UNSPECIFIED_PRIMARIES:
        primaries = BT2020_PRIMARIES
    space = color_space_of_cicp(primaries, int(frame.color_trc))
    return to_srgb(upright, 65535, space, peak=HDR_PEAK)


def _quarter_turns(frame: av.VideoFrame) -> int:
    """The number of counter-clockwise quarter turns that make a frame upright, 0 to 3."""
    return round(frame.rotation / 90) % 4


def _square_pixel_size(frame: av.VideoFrame, pixel_aspect: Fraction) -> tuple[int, int]:
    """The width and height of a frame in square pixels, before it is turned upright.

    The frame's stored pixels are `pixel_aspect` times as wide as high. The shorter of their sides
    becomes the side of the square pixels, so that no detail is lost.
    """
    stretch_x = max(pixel_aspect, Fraction(1))
    stretch_y = max(1 / pixel_aspect, Fraction(1))
    return max(1, round(frame.width * stretch_x)), max(1, round(frame.height * stretch_y))


def _increasing_times(times_in_file: list[Fraction | None], rate: Fraction) -> tuple[Fraction, ...]:
    """Increasing times from zero, in seconds, for frames whose times may be missing or wrong.

    A missing or decreasing time is replaced by that of the frame before, plus 1 / `rate`.
    """
    times: list[Fraction] = []
    start = times_in_file[0] or Fraction(0)
    for time_in_file in times_in_file:
        expected = times[-1] + 1 / rate if times else Fraction(0)
        time = expected if time_in_file is None else time_in_file - start
        is_increasing = not times or time > times[-1]
        times.append(time if is_increasing else expected)
    return tuple(times)
