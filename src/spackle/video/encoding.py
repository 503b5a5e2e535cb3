"""Write videos: the file's suffix selects H.264, VP9, GIF or animated WebP."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import os
from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Any, TypeVar

import av
import av.filter
import numpy as np
from av.video.reformatter import VideoReformatter
from av.video.stream import VideoStream
from numpy.typing import NDArray
from torch import Tensor

from spackle.core.color import to_uint8
from spackle.runtime.errors import InputError
from spackle.runtime.files import atomic_path, check_writable

MAX_REPEATS = 1000  # for files that store every repetition
MAX_GIF_PIXELS = 300 * 1536 * 1152  # of all frames, which take 4 bytes a pixel of memory
MAX_PLAYS = 65_535  # GIF's and WebP's counters have 16 bits
QUEUE = 4  # frames that may wait to be encoded; some frames are made at once, others take long
BT709, LIMITED_RANGE = 1, 1  # FFmpeg's numbers, the same for primaries, transfer and matrix


@dataclasses.dataclass(frozen=True)
class VideoFormat:
    """A video format's limits, and its settings for FFmpeg."""

    codec: str
    container: str
    options: dict[str, str]  # of the encoder
    container_options: dict[
        str, str
    ]  # put the index at the front, so that the video plays while it loads
    pixels: str  # pixel format
    counts: bool  # True: the file states how often it plays (0: for ever). False: the file stores every repetition
    fps: tuple[float, float]  # lowest and highest rate
    max_side: int

    @property
    def loop(self) -> int:
        """How often a video plays by default; 0: for ever."""
        return 0 if self.counts else 1


# Without cpu-independent, x264 reads uninitialised memory, and equal frames give different bytes. The short search for
# motion (me, subme) saves a third of the time; files grow by 8 %, and PSNR falls by 0.02 dB.
_X264 = {"crf": "17", "preset": "veryfast", "x264-params": "cpu-independent=1:me=dia:subme=1"}
# VP9 at crf 24 comes close to x264 at 17; cpu-used 4 costs little quality and saves most of the time.
_VPX = {"crf": "24", "b": "0", "deadline": "good", "cpu-used": "4", "row-mt": "1"}
_FAST_START = {"movflags": "+faststart"}
H264 = VideoFormat("libx264", "mp4", _X264, _FAST_START, "yuv420p", False, (0.001, 1000), 16_384)
_CUES_FIRST = {
    "cues_to_front": "1",
    "fflags": "+bitexact",
}  # without bitexact the track number is random
VP9 = VideoFormat("libvpx-vp9", "webm", _VPX, _CUES_FIRST, "yuv420p", False, (0.001, 1000), 16_384)
# Browsers show a frame of 10 ms or less for 100 ms; GIF counts time in 1/100 s, WebP in 1/1000 s.
GIF = VideoFormat("gif", "gif", {}, {}, "pal8", True, (0.01, 50), 65_535)
# libwebp converts to YUV better than FFmpeg. The encoder libwebp_anim would keep old blocks where little changes.
WEBP = VideoFormat("libwebp", "webp", {"quality": "85"}, {}, "bgra", True, (0.01, 90), 16_383)
VIDEO_FORMATS = {".mp4": H264, ".m4v": H264, ".mov": H264, ".webm": VP9, ".gif": GIF, ".webp": WEBP}


def check_video(path: str | os.PathLike[str], fps: float, loop: int | None = None) -> VideoFormat:
    """Check a video's name, rate and loop count, and return its format.

    Raises:
        InputError: the suffix is unknown, or the format does not allow the rate or loop count.
    """
    kind = VIDEO_FORMATS.get(Path(path).suffix.lower())
    if kind is None:
        raise InputError(f"{path}: not a name for a video: end it with {', '.join(VIDEO_FORMATS)}")
    least, most = kind.fps
    if not (math.isfinite(fps) and least <= fps <= most):
        raise InputError(
            f"{path}: frames a second must be a number from {least:g} to {most:g}, got {fps}"
        )
    least, most = (0, MAX_PLAYS) if kind.counts else (1, MAX_REPEATS)
    if loop is not None and not least <= loop <= most:
        hint = (
            "0 is for ever"
            if kind.counts
            else "it holds every repetition; .gif and .webp can play for ever"
        )
        raise InputError(
            f"{path}: a loop count of such a file must be from {least} to {most}, got {loop} ({hint})"
        )
    return kind


W = TypeVar("W", bound="VideoWriter")


class VideoWriter:
    """Writes frames to a video; the file appears if the `with` block ends without error.

    .mp4, .m4v, .mov (H.264) and .webm (VP9) are yuv420p with BT.709 colours, and play while they load. An odd width or
    height grows by one: the last column or row is repeated. .gif has one palette for all frames, which are in
    memory until the end; .webp is lossy. A thread encodes frames while the caller makes the next ones.
    """

    encoder: StreamEncoder

    def __init__(
        self, path: str | os.PathLike[str], fps: float = 30, loop: int | None = None
    ) -> None:
        """Prepare to write.

        Args:
            path: file name; the suffix selects the format.
            fps: frames a second; at most 50 for GIF and 90 for WebP, because browsers slow down faster animations.
            loop: how often the video plays. GIF and WebP store this number; 0, their default, means for ever. Other
                formats store every repetition; their default is 1.

        Raises:
            InputError: unknown suffix, unsuitable fps or loop, or a path that cannot be written.
        """
        self._kind = check_video(path, fps, loop)
        check_writable(path)
        self.path = path
        self.frames = 0
        self._plays = self._kind.loop if loop is None else loop
        self._rate = max(
            Fraction(fps).limit_denominator(1001), Fraction(1, 1001)
        )  # 29.97 is 30000/1001
        self._encoding = deque[Future[None]]()
        self._stack = contextlib.ExitStack()

    def __enter__(self: W) -> W:
        self.temporary_path = self._stack.enter_context(atomic_path(self.path))
        return self

    def add(self, frame: Tensor) -> None:
        """Append sRGB [H, W, 3] in 0..1, or uint8; all frames share one size."""
        if frame.ndim != 3 or frame.shape[2] != 3 or 0 in frame.shape:
            raise ValueError(f"a video frame is [H, W, 3], got {tuple(frame.shape)}")
        if self.frames == 0:
            self.encoder = self.make_encoder(*frame.shape[:2])
            self._stack.callback(self.encoder.close)
            self._aside = self._stack.enter_context(ThreadPoolExecutor(1))
            self._shape = frame.shape
        if frame.shape != self._shape:
            raise ValueError(
                f"frame {self.frames} is {tuple(frame.shape)}, the first one was {tuple(self._shape)}"
            )
        if self._kind is GIF and (self.frames + 1) * frame.shape.numel() // 3 > MAX_GIF_PIXELS:
            most = f"at most {MAX_GIF_PIXELS // 10**6} megapixels in all frames of a GIF"
            raise InputError(f"{self.path}: {most}: write an mp4, or fewer or smaller frames")
        self._wait(QUEUE - 1)
        pixels = np.array(
            to_uint8(frame).numpy()
        )  # a copy, because the caller may reuse a frame of bytes
        self._encoding.append(self._aside.submit(self.encoder.add, pixels))
        self.frames += 1

    def _wait(self, most: int) -> None:
        """Wait until at most `most` frames are left to encode; raises the encoder's error."""
        while len(self._encoding) > most:
            self._encoding.popleft().result()

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if error is not None:
            self._stack.__exit__(kind, error, trace)  # closes the file and removes it
            return
        with self._stack:  # closes the file and renames it, or removes it
            if self.frames == 0:
                raise ValueError(f"{self.path}: a video needs at least one frame")
            self._wait(0)
            self.encoder.finish()

    def make_encoder(self, height: int, width: int) -> StreamEncoder:
        if max(height, width) > (largest := self._kind.max_side):
            raise InputError(
                f"{self.path}: {width}×{height} is too large for this format (at most {largest})"
            )
        return StreamEncoder(
            self._kind, self.temporary_path, width, height, self._rate, self._plays
        )


def save_video(
    frames: Iterable[Tensor], path: str | os.PathLike[str], fps: float = 30, loop: int | None = None
) -> None:
    """Write frames, sRGB [H, W, 3] in 0..1, as a video; the arguments are those of `VideoWriter`.

    If `frames` is a generator that raises, no file is left.
    """
    with VideoWriter(path, fps, loop) as writer:
        for frame in frames:
            writer.add(frame)


class StreamEncoder:
    """Encodes frames into a video that plays `plays` times."""

    def __init__(
        self, kind: VideoFormat, path: Path, width: int, height: int, rate: Fraction, plays: int
    ) -> None:
        self._kind, self._rate, self._count = kind, rate, 0
        self._plays = 1 if kind.counts else plays
        self._packets: list[
            av.Packet[VideoStream]
        ] = []  # compressed; kept only if they must be repeated
        options = dict(kind.container_options)
        if (
            kind.counts
        ):  # GIF counts repetitions, and -1 means none; WebP counts how often the video plays
            loop = {0: 0, 1: -1}.get(plays, plays - 1) if kind is GIF else plays
            options["loop"] = str(loop)
        self.container = av.open(str(path), "w", format=kind.container, options=options)
        stream = self.container.add_stream(kind.codec, rate=rate, options=kind.options)
        assert isinstance(stream, VideoStream)
        self.stream = stream
        self._reformatter = VideoReformatter()
        self._palette = PaletteFilter(width, height, 1 / rate) if kind is GIF else None
        stream.width, stream.height, stream.pix_fmt = width, height, kind.pixels
        if kind.pixels == "yuv420p":
            stream.width, stream.height = width + width % 2, height + height % 2
            context = stream.codec_context
            context.color_range = LIMITED_RANGE
            context.colorspace = context.color_primaries = context.color_trc = BT709

    def add(self, rgb: NDArray[np.uint8]) -> None:
        """Append a frame [H, W, 3]."""
        pixels, colors = self._kind.pixels, dict[str, Any]()
        if pixels == "yuv420p":
            rgb = np.pad(rgb, [(0, rgb.shape[0] % 2), (0, rgb.shape[1] % 2), (0, 0)], mode="edge")
            colors = {"src_colorspace": "ITU709", "dst_colorspace": "ITU709"}
            colors |= {"src_color_range": "JPEG", "dst_color_range": "MPEG"}
        picture = av.VideoFrame.from_ndarray(rgb, format="rgb24")
        picture = self._reformatter.reformat(
            picture, format="bgra" if self._palette else pixels, **colors
        )
        picture.pts, picture.time_base = self._count, 1 / self._rate
        self._encode(picture)
        self._count += 1

    def _encode(self, picture: av.VideoFrame | None) -> None:
        """Encode a frame; None: the video ends."""
        for each in [picture] if self._palette is None else self._palette.push(picture):
            self.write_packets(self.stream.encode(each))

    def finish(self) -> None:
        """Write the packets that the encoder still holds, and repeat all packets as often as needed."""
        self._encode(None)
        for repetition in range(1, self._plays):
            for packet in self._packets:
                before, after = (
                    self._ticks(packet, plays) for plays in (repetition - 1, repetition)
                )
                packet.pts, packet.dts = (
                    None if t is None else t + after - before for t in (packet.pts, packet.dts)
                )
                self.container.mux(packet)
        self.close()

    def close(self) -> None:
        """Close the file; may be called twice."""
        self.container.close()

    def write_packets(self, packets: list[av.Packet[VideoStream]]) -> None:
        for packet in packets:
            self.container.mux(packet)
            if self._plays > 1:
                self._packets.append(packet)

    def _ticks(self, packet: av.Packet[VideoStream], plays: int) -> int:
        """Duration of `plays` repetitions, in the packet's time unit."""
        assert packet.time_base is not None
        return round(plays * self._count / self._rate / packet.time_base)


class PaletteFilter:
    """Converts frames to one palette, so that no colour flickers, with error diffusion; keeps all frames in memory."""

    def __init__(self, width: int, height: int, tick: Fraction) -> None:
        graph = av.filter.Graph()
        self._source = graph.add_buffer(
            width=width, height=height, format=av.VideoFormat("bgra"), time_base=tick
        )
        split, self._sink = graph.add("split"), graph.add("buffersink")
        palette, use = graph.add("palettegen"), graph.add("paletteuse", "dither=sierra2_4a")
        self._source.link_to(split)
        split.link_to(palette, 0)
        split.link_to(use, 1, 0)
        palette.link_to(use, 0, 1)
        use.link_to(self._sink)
        graph.configure()
        self._graph = graph

    def push(self, frame: av.VideoFrame | None) -> Iterator[av.VideoFrame | None]:
        """Take a frame in "bgra" (None at the end), and yield the frames that are ready, at the end None."""
        self._source.push(frame)
        with contextlib.suppress(av.BlockingIOError, av.EOFError):
            while True:
                ready = self._sink.pull()
                assert isinstance(ready, av.VideoFrame)
                yield ready
        if frame is None:
            yield None
