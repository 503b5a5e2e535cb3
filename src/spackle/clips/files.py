"""Read the frames of any video that FFmpeg decodes, upright, in sRGB, with their times; and write clips.

A written clip is H.264, with the frame times and the sound of the clip that it was made from.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
from collections.abc import Callable, Iterator
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

from spackle.errors import InputError, reason_in_a_line
from spackle.files import check_file
from spackle.formats.video import BT709, H264, StreamEncoder, VideoWriter
from spackle.image import check_pixels

SUFFIXES = {".mp4", ".m4v", ".mov", ".webm", ".mkv", ".avi", ".gif", ".mpg", ".mpeg", ".ts", ".mts", ".m2ts", ".wmv"}
SUFFIXES |= {".flv", ".3gp", ".ogv"}
UNSPECIFIED, BT601 = 2, 5  # FFmpeg's numbers of matrices
HD_ROWS = 720  # a video that does not declare its colours is read as BT.709 from this height on, as players do
LISTS = {"concat", "dash", "hls", "rtsp", "sdp", "webm_dash_manifest"}  # formats whose files make FFmpeg open others
HDR = {16: "PQ", 18: "HLG"}  # FFmpeg's numbers of transfers
DEFAULT_RATE = Fraction(25)
CLOCK = Fraction(1, 90_000)  # unit of written times, in seconds
RATES = (Fraction(1, 1000), Fraction(1000))  # lowest and highest frame rate that an encoder takes


@dataclasses.dataclass(frozen=True)
class Clip:
    """Facts about a clip, found by reading all of it."""

    path: Path
    width: int  # of an upright frame with square pixels
    height: int
    times: tuple[Fraction, ...]  # each frame's time in seconds, increasing from 0
    start: Fraction  # the first frame's time by the file's clock
    rate: Fraction  # mean number of frames a second
    audio: str | None  # codec of the sound
    hdr: str | None  # transfer function, if it is an HDR one: "PQ" or "HLG"

    def __len__(self) -> int:
        return len(self.times)

    @property
    def seconds(self) -> Fraction:
        """The clip's length: the last frame lasts as long as the one before it."""
        last = self.times[-1] - self.times[-2] if len(self) > 1 else 1 / self.rate
        return self.times[-1] + last


def is_clip(path: Path) -> bool:
    """Whether a file is a video, by its suffix; a GIF with a single frame is a photo."""
    if path.suffix.lower() not in SUFFIXES or os.path.isdir(path):
        return False
    if path.suffix.lower() != ".gif":
        return True
    try:
        with av.open(str(path), metadata_errors="replace") as container:
            pictures = (packet for packet in container.demux(video=0) if packet.size)
            return next(pictures, None) is not None and next(pictures, None) is not None
    except (av.FFmpegError, ValueError, IndexError):
        return False  # reading it as a photo then reports what is wrong


def read_clip(
    path: str | os.PathLike[str], first: int | None = None, progress: Callable[[int, int], None] | None = None
) -> Clip:
    """Decode a clip from beginning to end, so that damage in any frame is reported at once.

    Only the first `first` frames are read, all if None. `progress` is called with (frames read, number of frames that
    the file states). InputError if the file is no clip, cut off, damaged, without video, or of an unknown codec.
    """
    check_file(path, "clip")
    try:
        return _read_clip(path, first, progress)
    except InputError as error:
        line, cause = str(error), error.__cause__
    # A new error: the first one's traceback refers to the decoder, whose threads would live as long as the error.
    raise InputError(line) from (cause and cause.with_traceback(None))


def _read_clip(path: str | os.PathLike[str], first: int | None, progress: Callable[[int, int], None] | None) -> Clip:
    ticks: list[Fraction | None] = []
    frame = None
    with _opened(path) as (container, stream):
        aspect = stream.sample_aspect_ratio or Fraction(1)
        rate = stream.average_rate or stream.guessed_rate or DEFAULT_RATE
        sounds = container.streams.audio
        audio = sounds[0].codec_context.name if sounds and sounds[0].codec_context else None
        for frame in _decoded(path, container, stream, first):
            ticks.append(None if frame.pts is None or frame.time_base is None else frame.pts * frame.time_base)
            if progress:
                progress(len(ticks), max(len(ticks), first or stream.frames))
    if frame is None:
        raise InputError(f"{path}: it has no frames: give another clip")
    width, height = _square_size(frame, aspect)
    if _quarters(frame) % 2:
        width, height = height, width
    check_pixels(width, height, os.path.getsize(path), path)
    times = _rising(ticks, Fraction(rate))
    hdr = HDR.get(int(frame.color_trc))
    return Clip(Path(path), width, height, times, ticks[0] or Fraction(0), Fraction(rate), audio, hdr)


def clip_frames(clip: Clip) -> Iterator[Tensor]:
    """The frames of a clip, [H, W, 3] float32 sRGB in 0..1; InputError if the file has become shorter meanwhile."""
    with _opened(clip.path) as (container, stream):
        aspect, count = stream.sample_aspect_ratio or Fraction(1), 0
        reformatter = VideoReformatter()
        for frame in _decoded(clip.path, container, stream, len(clip)):
            count += 1
            yield _picture(frame, aspect, reformatter)
    if count < len(clip):
        raise InputError(f"{clip.path}: has become shorter while it was read: start again")


@contextlib.contextmanager
def _opened(path: str | os.PathLike[str]) -> Iterator[tuple[InputContainer, VideoStream]]:
    """Open a file, and find its video stream."""
    try:
        container = av.open(str(path), metadata_errors="replace")  # in strict mode, the file stays open after an error
    except (av.FFmpegError, ValueError) as error:
        reason = reason_in_a_line(error)
        raise InputError(f"{path}: not a video, or damaged at its beginning or end ({reason})") from error
    with container:
        if LISTS & set(container.format.name.split(",")):
            raise InputError(f"{path}: is a list of other files, not a video: give one of these files")
        pictures = [s for s in container.streams.video if not s.disposition & Disposition.attached_pic]
        if not pictures:
            what = "has sound but no moving picture" if container.streams.audio else "has no moving picture"
            raise InputError(f"{path}: {what}: give a video")
        stream = pictures[0]
        if stream.codec_context is None:
            raise InputError(f"{path}: its codec is unknown to this FFmpeg: convert it to H.264 first")
        check_pixels(stream.codec_context.width, stream.codec_context.height, os.path.getsize(path), path)
        stream.thread_type = "AUTO"
        yield container, stream


def _decoded(
    path: str | os.PathLike[str], container: InputContainer, stream: VideoStream, first: int | None
) -> Iterator[av.VideoFrame]:
    """Decode frames, which must all have the same size; an error names the frame."""
    size, count, packets = None, 0, 0
    try:
        for packet in container.demux(stream):
            packets += packet.size > 0
            for frame in packet.decode():
                shape = (frame.width, frame.height, frame.rotation)
                if size not in (None, shape):
                    raise InputError(
                        f"{path}: frame {count} has another size than the frames before it: cut the clip there"
                    )
                size = shape
                yield frame
                count += 1
                if count == first:
                    return
    except InputError:
        raise
    except (av.FFmpegError, ValueError) as error:
        raise InputError(
            f"{path}: frame {count} cannot be decoded ({reason_in_a_line(error)}): the clip is damaged or cut off"
            + (f"; --frames {count} takes what is before" if count else "")
        ) from error
    if packets < stream.frames:
        raise InputError(
            f"{path}: cut off after {packets} of {stream.frames} frames: give a whole clip, or --frames {max(1, count)}"
        )


def _picture(frame: av.VideoFrame, aspect: Fraction, reformatter: VideoReformatter) -> Tensor:
    """A frame as [H, W, 3]: FFmpeg converts it from its colour matrix and range; then it is turned upright."""
    width, height = _square_size(frame, aspect)
    matrix = frame.colorspace
    if matrix == UNSPECIFIED:
        matrix = BT709 if frame.height >= HD_ROWS else BT601
    # Not `frame.reformat`, which would start new threads for each frame.
    rgb = reformatter.reformat(frame, width, height, "rgb24", src_colorspace=matrix).to_ndarray()
    turned = np.ascontiguousarray(np.rot90(rgb, _quarters(frame)))
    return torch.from_numpy(turned).float().div_(255)


def _quarters(frame: av.VideoFrame) -> int:
    """The number of counter-clockwise quarter turns that bring a frame upright."""
    return round(frame.rotation / 90) % 4


def _square_size(frame: av.VideoFrame, aspect: Fraction) -> tuple[int, int]:
    """A frame's size in square pixels, enlarged along one side; its own pixels are `aspect` times as wide as high."""
    wide, high = max(aspect, Fraction(1)), max(1 / aspect, Fraction(1))
    return max(1, round(frame.width * wide)), max(1, round(frame.height * high))


def _rising(ticks: list[Fraction | None], rate: Fraction) -> tuple[Fraction, ...]:
    """Increasing times from zero; a frame whose time is missing or does not increase follows at the mean rate."""
    times: list[Fraction] = []
    start = ticks[0] or Fraction(0)
    for tick in ticks:
        at_rate = times[-1] + 1 / rate if times else Fraction(0)
        time = at_rate if tick is None else tick - start
        times.append(time if not times or time > times[-1] else at_rate)
    return tuple(times)


class ClipWriter(VideoWriter):
    """Writes as many frames as a clip has, at its times, with its sound; the file appears if the block succeeds."""

    def __init__(self, path: str | os.PathLike[str], clip: Clip) -> None:
        """Prepare to write an .mp4; InputError if no file can be written there."""
        super().__init__(path)
        self.clip = clip

    @property
    def sound(self) -> bool:
        """Whether sound has been copied."""
        return isinstance(self._encoder, _ClipEncoder) and self._encoder.sound

    def _open(self, height: int, width: int) -> StreamEncoder:
        return _ClipEncoder(self._temporary, width, height, self.clip)


class _ClipEncoder(StreamEncoder):
    """Encodes frames at evenly spaced times, and then gives their packets the clip's times."""

    def __init__(self, path: Path, width: int, height: int, clip: Clip) -> None:
        self._even = min(max(clip.rate.limit_denominator(1001), RATES[0]), RATES[1])
        super().__init__(H264, path, width, height, self._even, 1)
        self._clip = clip
        self._input = None
        if clip.audio in self._container.supported_codecs:
            self._input = av.open(str(clip.path), metadata_errors="replace")
        self.sound = False
        if self._input is not None:
            source = self._input.streams.audio[0]
            self._output = self._container.add_stream_from_template(source)
            self._sounds = self._input.demux(source)
            self._held: av.Packet[AudioStream] | None = None

    def finish(self) -> None:
        """Flush the encoder, and copy the sound up to the video's end."""
        self._write(self._stream.encode(None))
        self._copy_sound(self._clip.seconds)
        self.close()

    def close(self) -> None:
        """Close both files; this writes the index."""
        super().close()
        if self._input is not None:
            self._input.close()

    def _write(self, packets: list[av.Packet[VideoStream]]) -> None:
        for packet in packets:
            assert packet.time_base is not None
            assert packet.pts is not None
            assert packet.dts is not None
            times = [self._time(round(ticks * packet.time_base * self._even)) for ticks in (packet.pts, packet.dts)]
            packet.time_base = CLOCK
            packet.pts, packet.dts = (round(time / CLOCK) for time in times)
            packet.duration = 0
            self._copy_sound(times[1])
            self._container.mux(packet)

    def _time(self, index: int) -> Fraction:
        """The time of a frame; times before the first and after the last frame follow at the mean rate."""
        times = self._clip.times
        if 0 <= index < len(times):
            return times[index]
        return times[0] + index / self._even if index < 0 else times[-1] + (index - len(times) + 1) / self._even

    def _copy_sound(self, until: Fraction) -> None:
        """Copy the clip's sound up to a time, packet by packet; stop at the first damaged packet."""
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
                continue  # before the first picture
            packet.pts, packet.dts = begin, None if packet.dts is None else packet.dts - ticks
            packet.stream = self._output
            self._container.mux(packet)
            self.sound = True
