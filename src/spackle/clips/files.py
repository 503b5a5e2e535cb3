"""Read clips in any format of FFmpeg, and write clips as H.264 with the times and the sound of the original."""

from __future__ import annotations

import contextlib
import dataclasses
import os
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import torch
from av.audio.stream import AudioStream
from av.container import InputContainer
from av.stream import Disposition
from av.video.reformatter import VideoReformatter
from av.video.stream import VideoStream
from torch import Tensor

from spackle.core.image_files import check_pixel_count
from spackle.runtime.errors import InputError, as_input_error
from spackle.runtime.files import check_file
from spackle.runtime.progress import Progress
from spackle.video.encoding import BT709, H264, StreamEncoder, VideoWriter

SUFFIXES = {
    ".mp4",
    ".m4v",
    ".mov",
    ".webm",
    ".mkv",
    ".avi",
    ".gif",
    ".mpg",
    ".mpeg",
    ".ts",
    ".mts",
    ".m2ts",
    ".wmv",
}
SUFFIXES |= {".flv", ".3gp", ".ogv"}
UNSPECIFIED, BT601 = 2, 5  # FFmpeg's numbers of colour matrices
HD_ROWS = 720  # from this height on, a video without declared colour matrix is read as BT.709, as players do
LISTS = {
    "concat",
    "dash",
    "hls",
    "rtsp",
    "sdp",
    "webm_dash_manifest",
}  # formats that make FFmpeg open other files
DECODING = (av.FFmpegError, ValueError)  # errors of a damaged file
HDR = {16: "PQ", 18: "HLG"}  # FFmpeg's numbers of transfers
DEFAULT_RATE = Fraction(25)
CLOCK = Fraction(1, 90_000)  # unit of written times, in seconds
RATES = (Fraction(1, 1000), Fraction(1000))  # lowest and highest frame rate that an encoder accepts


@dataclasses.dataclass(frozen=True)
class Clip:
    """Facts about a clip, found by reading the whole clip."""

    path: Path
    width: int  # of an upright frame with square pixels
    height: int
    times: tuple[Fraction, ...]  # of the frames, in seconds, increasing from 0
    start: Fraction  # time of the first frame in the file
    rate: Fraction  # mean number of frames a second
    audio: str | None  # codec of the sound
    hdr: str | None  # transfer function, if it is an HDR one: "PQ" or "HLG"

    def __len__(self) -> int:
        return len(self.times)

    @property
    def seconds(self) -> Fraction:
        """The length of the clip; the last frame lasts as long as the frame before."""
        last = self.times[-1] - self.times[-2] if len(self) > 1 else 1 / self.rate
        return self.times[-1] + last


def is_clip(path: Path) -> bool:
    """Whether a file is a video, judged by the suffix; a GIF with a single frame is a photo."""
    if path.suffix.lower() not in SUFFIXES or os.path.isdir(path):
        return False
    if path.suffix.lower() != ".gif":
        return True
    try:
        with av.open(str(path), metadata_errors="replace") as container:
            pictures = (packet for packet in container.demux(video=0) if packet.size)
            return next(pictures, None) is not None and next(pictures, None) is not None
    except (av.FFmpegError, ValueError, IndexError):
        return False


def read_clip(
    path: str | os.PathLike[str],
    first: int | None = None,
    progress: Progress | None = None,
) -> Clip:
    """Decode a clip from beginning to end, so that damage in any frame is reported at once.

    Args:
        path: the file.
        first: number of frames to read; all if None.
        progress: called with (number of frames read, number of frames in the file).

    Raises:
        InputError: the file is not a clip, truncated, damaged, without video, or of an unknown codec.
    """
    check_file(path, "clip")
    try:
        return _read_clip(path, first, progress)
    except InputError as error:
        message, cause = str(error), error.__cause__
    # The first error's traceback refers to the decoder, whose threads would live as long as the error.
    raise InputError(message) from (cause and cause.with_traceback(None))


def _read_clip(path: str | os.PathLike[str], first: int | None, progress: Progress | None) -> Clip:
    ticks: list[Fraction | None] = []
    frame = None
    with _opened(path) as (container, stream):
        aspect = stream.sample_aspect_ratio or Fraction(1)
        rate = stream.average_rate or stream.guessed_rate or DEFAULT_RATE
        sounds = container.streams.audio
        audio = sounds[0].codec_context.name if sounds and sounds[0].codec_context else None
        for frame in _decoded(path, container, stream, first):
            ticks.append(
                None
                if frame.pts is None or frame.time_base is None
                else frame.pts * frame.time_base
            )
            if progress:
                progress(len(ticks), max(len(ticks), first or stream.frames))
    if frame is None:
        raise InputError(f"{path}: has no frames: give another clip")
    width, height = _square_size(frame, aspect)
    if _quarters(frame) % 2:
        width, height = height, width
    check_pixel_count(width, height, os.path.getsize(path), path)
    times = _rising(ticks, Fraction(rate))
    hdr = HDR.get(int(frame.color_trc))
    return Clip(
        Path(path), width, height, times, ticks[0] or Fraction(0), Fraction(rate), audio, hdr
    )


def clip_frames(clip: Clip) -> Iterator[Tensor]:
    """The frames of a clip, [H, W, 3] float32 sRGB in 0..1."""
    with _opened(clip.path) as (container, stream):
        aspect, reformatter = stream.sample_aspect_ratio or Fraction(1), VideoReformatter()
        for frame in _decoded(clip.path, container, stream, len(clip)):
            yield _picture(frame, aspect, reformatter)


@contextlib.contextmanager
def _opened(path: str | os.PathLike[str]) -> Iterator[tuple[InputContainer, VideoStream]]:
    """Open a file, and find the video stream."""
    with as_input_error(
        path, "not a video, or damaged at the beginning or end ({reason})", *DECODING
    ):
        container = av.open(
            str(path), metadata_errors="replace"
        )  # in strict mode, the file stays open after an error
    with container:
        if LISTS & set(container.format.name.split(",")):
            raise InputError(
                f"{path}: is a list of other files, not a video: give one of these files"
            )
        pictures = [
            s for s in container.streams.video if not s.disposition & Disposition.attached_pic
        ]
        if not pictures:
            raise InputError(f"{path}: has no moving picture: give a video")
        stream = pictures[0]
        if stream.codec_context is None:
            raise InputError(
                f"{path}: FFmpeg does not know the codec: convert the clip to H.264 first"
            )
        check_pixel_count(
            stream.codec_context.width, stream.codec_context.height, os.path.getsize(path), path
        )
        stream.thread_type = "AUTO"
        yield container, stream


def _decoded(
    path: str | os.PathLike[str], container: InputContainer, stream: VideoStream, first: int | None
) -> Iterator[av.VideoFrame]:
    """Decode frames, which must all have the same size."""
    size, count, packets = None, 0, 0
    with as_input_error(
        path, "damaged or truncated ({reason}): give a whole clip, or fewer --frames", *DECODING
    ):
        for packet in container.demux(stream):
            packets += packet.size > 0
            for frame in packet.decode():
                shape = (frame.width, frame.height, frame.rotation)
                if size not in (None, shape):
                    raise InputError(f"{path}: frame {count} has a new size: use --frames {count}")
                size = shape
                yield frame
                count += 1
                if count == first:
                    return
        if packets < stream.frames:
            raise ValueError(f"{packets} of {stream.frames} frames")


def _picture(frame: av.VideoFrame, aspect: Fraction, reformatter: VideoReformatter) -> Tensor:
    """A frame as an upright image [H, W, 3] sRGB in 0..1."""
    width, height = _square_size(frame, aspect)
    matrix = frame.colorspace
    if matrix == UNSPECIFIED:
        matrix = BT709 if frame.height >= HD_ROWS else BT601
    # `frame.reformat` would start new threads for each frame.
    rgb = reformatter.reformat(frame, width, height, "rgb24", src_colorspace=matrix).to_ndarray()
    turned = np.ascontiguousarray(np.rot90(rgb, _quarters(frame)))
    return torch.from_numpy(turned).float().div_(255)


def _quarters(frame: av.VideoFrame) -> int:
    """The number of counter-clockwise quarter turns that make a frame upright."""
    return round(frame.rotation / 90) % 4


def _square_size(frame: av.VideoFrame, aspect: Fraction) -> tuple[int, int]:
    """The size of a frame in square pixels, if its stored pixels are `aspect` times as wide as high."""
    wide, high = max(aspect, Fraction(1)), max(1 / aspect, Fraction(1))
    return max(1, round(frame.width * wide)), max(1, round(frame.height * high))


def _rising(ticks: list[Fraction | None], rate: Fraction) -> tuple[Fraction, ...]:
    """Increasing times from zero; a missing or decreasing time is replaced by the time at the mean rate."""
    times: list[Fraction] = []
    start = ticks[0] or Fraction(0)
    for tick in ticks:
        at_rate = times[-1] + 1 / rate if times else Fraction(0)
        time = at_rate if tick is None else tick - start
        times.append(time if not times or time > times[-1] else at_rate)
    return tuple(times)


class ClipWriter(VideoWriter):
    """Writes an .mp4 with the times and the sound of a clip; the file appears if the block succeeds."""

    def __init__(self, path: str | os.PathLike[str], clip: Clip) -> None:
        super().__init__(path)
        self.clip = clip

    @property
    def sound(self) -> bool:
        """Whether sound has been copied."""
        return isinstance(self.encoder, _ClipEncoder) and self.encoder.sound

    def make_encoder(self, height: int, width: int) -> StreamEncoder:
        return _ClipEncoder(self.temporary_path, width, height, self.clip)


class _ClipEncoder(StreamEncoder):
    """Encodes frames at evenly spaced times, and then gives the packets the clip's times."""

    def __init__(self, path: Path, width: int, height: int, clip: Clip) -> None:
        self._even = min(max(clip.rate.limit_denominator(1001), RATES[0]), RATES[1])
        super().__init__(H264, path, width, height, self._even, 1)
        self._clip = clip
        self._input = None
        if clip.audio in self.container.supported_codecs:
            self._input = av.open(str(clip.path), metadata_errors="replace")
        self.sound = False
        if self._input is not None:
            source = self._input.streams.audio[0]
            self._output = self.container.add_stream_from_template(source)
            self._sounds = self._input.demux(source)
            self._held: av.Packet[AudioStream] | None = None

    def finish(self) -> None:
        self.write_packets(self.stream.encode(None))
        self._copy_sound(self._clip.seconds)
        self.close()

    def close(self) -> None:
        super().close()
        if self._input is not None:
            self._input.close()

    def write_packets(self, packets: list[av.Packet[VideoStream]]) -> None:
        for packet in packets:
            assert packet.time_base is not None
            assert packet.pts is not None
            assert packet.dts is not None
            times = [
                self._time(round(ticks * packet.time_base * self._even))
                for ticks in (packet.pts, packet.dts)
            ]
            packet.time_base = CLOCK
            packet.pts, packet.dts = (round(time / CLOCK) for time in times)
            packet.duration = 0
            self._copy_sound(times[1])
            self.container.mux(packet)

    def _time(self, index: int) -> Fraction:
        """The time of a frame; before the first and after the last frame, times follow the mean rate."""
        times = self._clip.times
        if 0 <= index < len(times):
            return times[index]
        return (
            times[0] + index / self._even
            if index < 0
            else times[-1] + (index - len(times) + 1) / self._even
        )

    def _copy_sound(self, until: Fraction) -> None:
        """Copy the clip's sound up to a time; stop at the first damaged packet."""
        while self._input is not None:
            try:
                packet = self._held or next(self._sounds, None)
            except av.FFmpegError:
                return
            if packet is None or packet.pts is None or packet.time_base is None:
                return
            ticks = round(self._clip.start / packet.time_base)
            begin, lasts = packet.pts - ticks, packet.duration or 0
            self._held = packet if begin * packet.time_base >= until else None
            if self._held is not None:
                return
            if begin + lasts <= 0:
                continue  # before the first frame
            packet.pts, packet.dts = begin, None if packet.dts is None else packet.dts - ticks
            packet.stream = self._output
            self.container.mux(packet)
            self.sound = True
