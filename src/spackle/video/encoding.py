"""Write videos: the file's suffix selects H.264, VP9, GIF or animated WebP.

`save_video` writes all frames, `VideoWriter` one after the other, with a `StreamEncoder`.
"""

from __future__ import annotations

import contextlib
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
from spackle.video.video_formats import (
    DEFAULT_FPS,
    GIF,
    PLAY_FOREVER,
    StrPath,
    VideoFormat,
    check_video,
)

# Of all frames of a GIF together, which take 4 bytes of memory a pixel.
MAX_GIF_PIXELS = 300 * 1536 * 1152

# So many frames may wait to be encoded, because some frames are made at once and others take long.
MAX_WAITING_FRAMES = 4

# Frame rates are fractions with denominators up to this, such as 30000/1001 for 29.97.
MAX_RATE_DENOMINATOR = 1001

# FFmpeg's numbers; BT.709 has the same one as primaries, transfer function and matrix.
BT709 = 1
LIMITED_RANGE = 1


Writer = TypeVar("Writer", bound="VideoWriter")


class VideoWriter:
    """Writes frames to a video; the file appears if the `with` block ends without error.

    .mp4, .m4v, .mov (H.264) and .webm (VP9) have yuv420p pixels with BT.709 colours, and play
    while they load. An odd width or height grows by one: the last column or row is repeated. .gif
    has one palette for all frames, which are in memory until the end; .webp is lossy. A thread
    encodes frames while the caller makes the next ones.
    """

    temporary_path: Path  # where the file is written, once the `with` block has begun
    encoder: StreamEncoder  # once the first frame has come

    def __init__(
        self,
        path: StrPath,
        fps: float = DEFAULT_FPS,
        loop: int | None = None,
        *,
        name_in_messages: StrPath | None = None,
    ) -> None:
        """Prepare to write.

        Args:
            path: the file's name; the suffix selects the format.
            fps: frames a second; at most 50 for GIF and 90 for WebP, because browsers slow down
                faster animations.
            loop: how often the video plays. GIF and WebP store this number; 0, their default,
                means for ever. Other formats store every repetition; their default is 1.
            name_in_messages: what messages call the file, if `path` is a temporary name.

        Raises:
            InputError: the suffix is unknown, the format does not allow the rate or loop count,
                or the file cannot be written.
        """
        self.path = path
        self.frame_count = 0
        self._name = path if name_in_messages is None else name_in_messages
        self._format = check_video(self._name, fps, loop)
        self._play_count = self._format.default_play_count if loop is None else loop
        rate = Fraction(fps).limit_denominator(MAX_RATE_DENOMINATOR)
        # A very low rate was rounded to 0, which is no rate.
        self._rate = max(rate, Fraction(1, MAX_RATE_DENOMINATOR))
        self._waiting = deque[Future[None]]()  # the frames that are being encoded
        self._resources = contextlib.ExitStack()
        check_writable(path)

    def __enter__(self: Writer) -> Writer:
        """Begin the file under a temporary name."""
        self.temporary_path = self._resources.enter_context(atomic_path(self.path))
        return self

    def add(self, frame: Tensor) -> None:
        """Append a frame; returns before it is encoded.

        Args:
            frame: [H, W, 3] sRGB in 0..1, or uint8; all frames share one size. The caller may
                reuse its memory afterwards.

        Raises:
            InputError: the frames are too large for the format.
            ValueError: the frame has another shape.
        """
        if frame.ndim != 3 or frame.shape[2] != 3 or 0 in frame.shape:
            raise ValueError(f"a video frame is [H, W, 3], got {tuple(frame.shape)}")
        if self.frame_count == 0:
            self._start_encoding(frame)
        if frame.shape != self._shape:
            shapes = f"is {tuple(frame.shape)}, the first one was {tuple(self._shape)}"
            raise ValueError(f"frame {self.frame_count} {shapes}")
        self._check_gif_size(frame)

        # Frames that wait to be encoded take memory, so there must be room for one more.
        self._wait_until(MAX_WAITING_FRAMES - 1)
        # A copy, because the caller may reuse the memory of a frame of bytes.
        pixels = np.array(to_uint8(frame).numpy())
        self._waiting.append(self._thread.submit(self.encoder.add, pixels))
        self.frame_count += 1

    def __exit__(
        self,
        error_type: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Finish the file and give it its name; after an error, remove it.

        Raises:
            ValueError: there are no frames.
        """
        if error is not None:
            # The resources, told of the error, close the file and remove it.
            self._resources.__exit__(error_type, error, trace)
            return
        # At its end, the block closes the file and gives it its name. If a step in the block fails,
        # the file is removed instead.
        with self._resources:
            if self.frame_count == 0:
                raise ValueError(f"{self._name}: a video needs at least one frame")
            self._wait_until(0)
            self.encoder.finish()

    def make_encoder(self, height: int, width: int) -> StreamEncoder:
        """Open the encoder for frames of this size in pixels; a subclass may open another one.

        Raises:
            InputError: a side is too large for the format.
        """
        max_side = self._format.max_side_px
        if max(height, width) > max_side:
            problem = f"{width}×{height} is too large for this format (at most {max_side})"
            raise InputError(f"{self._name}: {problem}")
        return StreamEncoder(
            self._format, self.temporary_path, width, height, self._rate, self._play_count
        )

    def _start_encoding(self, first_frame: Tensor) -> None:
        """Open the encoder for the size of the first frame [H, W, 3], and start its thread."""
        height, width = first_frame.shape[:2]
        self._shape = first_frame.shape
        self.encoder = self.make_encoder(height, width)
        # Resources are closed in reverse order: the thread ends before the encoder is closed.
        self._resources.callback(self.encoder.close)
        self._thread = self._resources.enter_context(ThreadPoolExecutor(1))

    def _check_gif_size(self, frame: Tensor) -> None:
        """Raise an InputError if a GIF's frames with this one [H, W, 3] take too much memory."""
        frame_pixels = frame.shape[0] * frame.shape[1]
        if self._format is GIF and (self.frame_count + 1) * frame_pixels > MAX_GIF_PIXELS:
            megapixels = MAX_GIF_PIXELS // 10**6
            problem = f"at most {megapixels} megapixels in all frames of a GIF"
            raise InputError(f"{self._name}: {problem}: write an mp4, or fewer or smaller frames")

    def _wait_until(self, max_waiting: int) -> None:
        """Wait until at most so many frames are left to encode; raises the encoder's error."""
        while len(self._waiting) > max_waiting:
            self._waiting.popleft().result()


def save_video(
    frames: Iterable[Tensor],
    path: StrPath,
    fps: float = DEFAULT_FPS,
    loop: int | None = None,
    *,
    name_in_messages: StrPath | None = None,
) -> None:
    """Write frames as a video; if `frames` is a generator that raises, no file is left.

    Args:
        frames: [H, W, 3] sRGB in 0..1 each, all of one size.
        path, fps, loop, name_in_messages: as in `VideoWriter`: the file's name, whose suffix
            selects the format; frames a second; how often the video plays, 0 for ever; and what
            messages call the file, if `path` is a temporary name.

    Raises:
        InputError: the format does not allow what is asked for, or the file cannot be written.
        ValueError: there are no frames, or they differ in shape.
    """
    with VideoWriter(path, fps, loop, name_in_messages=name_in_messages) as writer:
        for frame in frames:
            writer.add(frame)


class StreamEncoder:
    """Encodes frames into a video file, and repeats them as often as the video plays."""

    def __init__(
        self,
        video_format: VideoFormat,
        path: Path,
        width: int,
        height: int,
        rate: Fraction,
        play_count: int,
    ) -> None:
        """Open the file.

        Args:
            video_format: one of VIDEO_FORMATS.
            path: the file, whose name may have any suffix.
            width, height: size of the frames in pixels.
            rate: frames a second.
            play_count: how often the video plays; 0 for ever, where the format can state it.
        """
        self._format = video_format
        self._rate = rate
        self._frame_count = 0
        # A format that cannot state the play count stores the compressed packets as often as the
        # video plays. For this, the packets are kept until the end.
        self._stored_repetitions = 1 if video_format.states_play_count else play_count
        self._kept_packets: list[av.Packet[VideoStream]] = []

        container_options = dict(video_format.container_options)
        if video_format.states_play_count:
            container_options["loop"] = str(_loop_option(video_format, play_count))
        self.container = av.open(
            str(path), "w", format=video_format.container, options=container_options
        )
        stream = self.container.add_stream(
            video_format.codec, rate=rate, options=video_format.codec_options
        )
        assert isinstance(stream, VideoStream)
        self.stream = stream
        self._set_stream_size(width, height)
        self._reformatter = VideoReformatter()
        self._palette: PaletteFilter | None = None
        if video_format is GIF:
            self._palette = PaletteFilter(width, height, 1 / rate)

    def _set_stream_size(self, width: int, height: int) -> None:
        """Set the stream's pixel format, its size in pixels, and for yuv420p its colour space."""
        self.stream.pix_fmt = self._format.pixel_format
        self.stream.width = width
        self.stream.height = height
        if self._format.pixel_format == "yuv420p":
            # Each 2×2 pixels share a colour, so both sides must be even.
            self.stream.width = width + width % 2
            self.stream.height = height + height % 2
            # The file names its colours, because players would have to guess them otherwise.
            context = self.stream.codec_context
            context.color_range = LIMITED_RANGE
            context.colorspace = BT709
            context.color_primaries = BT709
            context.color_trc = BT709

    def add(self, rgb: NDArray[np.uint8]) -> None:
        """Append a frame [H, W, 3] of sRGB bytes."""
        target_format = self._format.pixel_format
        conversion: dict[str, Any] = {}
        if target_format == "yuv420p":
            # An odd side grows by one, which repeats the last row or column.
            odd_rows = rgb.shape[0] % 2
            odd_columns = rgb.shape[1] % 2
            rgb = np.pad(rgb, [(0, odd_rows), (0, odd_columns), (0, 0)], mode="edge")
            # BT.709 (ITU709), from full range (JPEG) to limited range (MPEG).
            conversion = {
                "src_colorspace": "ITU709",
                "dst_colorspace": "ITU709",
                "src_color_range": "JPEG",
                "dst_color_range": "MPEG",
            }
        if self._palette is not None:
            # The palette is found, and applied, by a filter that takes these pixels.
            target_format = "bgra"

        picture = av.VideoFrame.from_ndarray(rgb, format="rgb24")
        picture = self._reformatter.reformat(picture, format=target_format, **conversion)
        picture.pts = self._frame_count
        picture.time_base = 1 / self._rate
        self._encode(picture)
        self._frame_count += 1

    def finish(self) -> None:
        """Write what the encoder still holds, repeat all packets as often as needed, and close.

        A packet is a compressed frame; it has the times of its presentation (pts) and decoding
        (dts).
        """
        # None ends the video: the encoder gives the packets that it still holds.
        self._encode(None)
        for repetition in range(1, self._stored_repetitions):
            for packet in self._kept_packets:
                # The packets still have the times of the repetition before. Both offsets are
                # rounded from exact times, so that errors do not add up.
                old_offset = self._ticks(packet, repetition - 1)
                new_offset = self._ticks(packet, repetition)
                if packet.pts is not None:
                    packet.pts += new_offset - old_offset
                if packet.dts is not None:
                    packet.dts += new_offset - old_offset
                self.container.mux(packet)
        self.close()

    def close(self) -> None:
        """Close the file; may be called twice."""
        self.container.close()

    def write_packets(self, packets: list[av.Packet[VideoStream]]) -> None:
        """Write compressed packets to the file, and keep them if they must be repeated."""
        for packet in packets:
            self.container.mux(packet)
            if self._stored_repetitions > 1:
                self._kept_packets.append(packet)

    def _encode(self, picture: av.VideoFrame | None) -> None:
        """Encode a frame, and write the packets that are ready; None ends the video."""
        if self._palette is None:
            self.write_packets(self.stream.encode(picture))
            return
        for filtered_picture in self._palette.push(picture):
            self.write_packets(self.stream.encode(filtered_picture))

    def _ticks(self, packet: av.Packet[VideoStream], repetitions: int) -> int:
        """Return the duration of some repetitions of the video, in the packet's unit of time."""
        assert packet.time_base is not None
        seconds = repetitions * self._frame_count / self._rate
        return round(seconds / packet.time_base)


def _loop_option(video_format: VideoFormat, play_count: int) -> int:
    """Return FFmpeg's option `loop` for a GIF or WebP that plays `play_count` times, 0 for ever."""
    # WebP counts how often the video plays, with 0 for ever.
    if video_format is not GIF or play_count == PLAY_FOREVER:
        return play_count
    # GIF counts the repetitions after the first time, and -1 means none.
    if play_count == 1:
        return -1
    return play_count - 1


class PaletteFilter:
    """Converts frames to one palette with error diffusion; keeps all frames in memory.

    With one palette for all frames, no colour flickers.
    """

    def __init__(self, width: int, height: int, frame_duration: Fraction) -> None:
        """Connect FFmpeg's filters.

        Args:
            width, height: size of the frames in pixels.
            frame_duration: in seconds.
        """
        # The frames go to palettegen, which gives one palette at the end, and to paletteuse,
        # which waits for the palette.
        graph = av.filter.Graph()
        self._source = graph.add_buffer(
            width=width, height=height, format=av.VideoFormat("bgra"), time_base=frame_duration
        )
        split = graph.add("split")
        palette = graph.add("palettegen")
        # A kind of dithering that spreads the error of a pixel's colour to the pixels around it.
        apply_palette = graph.add("paletteuse", "dither=sierra2_4a")
        self._sink = graph.add("buffersink")
        self._source.link_to(split)
        split.link_to(palette, output_idx=0, input_idx=0)
        split.link_to(apply_palette, output_idx=1, input_idx=0)
        palette.link_to(apply_palette, output_idx=0, input_idx=1)
        apply_palette.link_to(self._sink)
        graph.configure()
        self._graph = graph  # must live as long as its filters

    def push(self, frame: av.VideoFrame | None) -> Iterator[av.VideoFrame | None]:
        """Take a frame in "bgra", or None at the end, and yield the frames that are ready.

        All frames are ready at the end; None comes after the last one.
        """
        self._source.push(frame)
        # pull() raises a BlockingIOError if no frame is ready yet, and an EOFError after the last
        # one. Either ends the loop.
        with contextlib.suppress(av.BlockingIOError, av.EOFError):
            while True:
                ready_frame = self._sink.pull()
                assert isinstance(ready_frame, av.VideoFrame)
                yield ready_frame
        if frame is None:
            yield None
