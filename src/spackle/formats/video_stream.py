"""H.264 and VP9, tagged so that every player shows the same colours."""

from __future__ import annotations

import dataclasses
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from av.video.stream import VideoStream
from numpy.typing import NDArray

from spackle.errors import InputError

BT709, LIMITED_RANGE = 1, 1  # FFmpeg's numbers, the same for primaries, transfer and matrix


@dataclasses.dataclass(frozen=True)
class Codec:
    """An encoder of FFmpeg, the file that it goes into, and the options of both."""

    name: str
    container: str
    options: dict[str, str]
    container_options: dict[str, str]  # the index goes to the front: the video plays while it loads


H264 = Codec("libx264", "mp4", {"crf": "18", "preset": "fast"}, {"movflags": "+faststart"})
# VP9 at crf 24 comes near x264's 18; cpu-used 4 costs little quality and saves most of the time.
VP9 = Codec(
    "libvpx-vp9",
    "webm",
    {"crf": "24", "b": "0", "deadline": "good", "cpu-used": "4", "row-mt": "1"},
    {"cues_to_front": "1"},
)


class StreamEncoder:
    """Frames to a video stream; the whole video `plays` times, one after the other."""

    def __init__(self, codec: Codec, path: Path, width: int, height: int, rate: Fraction, plays: int) -> None:
        self._rate, self._plays, self._count = rate, plays, 0
        self._packets: list[av.Packet[VideoStream]] = []  # compressed, and held only where they are needed again
        check_encoder(codec.name)
        self._container = av.open(str(path), "w", format=codec.container, options=codec.container_options)
        self._stream = self._new_stream(codec, width + width % 2, height + height % 2)

    def _new_stream(self, codec: Codec, width: int, height: int) -> VideoStream:
        stream = self._container.add_stream(codec.name, rate=self._rate, options=codec.options)
        assert isinstance(stream, VideoStream)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        context = stream.codec_context
        context.color_range = LIMITED_RANGE
        context.colorspace = context.color_primaries = context.color_trc = BT709
        return stream

    def add(self, rgb: NDArray[np.uint8]) -> None:
        """Append [H, W, 3]; an odd side grows by one."""
        rgb = np.pad(rgb, [(0, rgb.shape[0] % 2), (0, rgb.shape[1] % 2), (0, 0)], mode="edge")
        picture = av.VideoFrame.from_ndarray(rgb, format="rgb24").reformat(
            format="yuv420p",
            src_colorspace="ITU709",
            dst_colorspace="ITU709",
            src_color_range="JPEG",
            dst_color_range="MPEG",
        )
        picture.pts, picture.time_base = self._count, 1 / self._rate
        self._write(self._stream.encode(picture))
        self._count += 1

    def finish(self) -> None:
        """What the encoder still holds, and the repetitions: the same packets again, later."""
        self._write(self._stream.encode(None))
        for repetition in range(1, self._plays):
            for packet in self._packets:
                before, after = (self._ticks(packet, plays) for plays in (repetition - 1, repetition))
                packet.pts, packet.dts = (None if t is None else t + after - before for t in (packet.pts, packet.dts))
                self._container.mux(packet)
        self.close()

    def close(self) -> None:
        """Write the index."""
        self._container.close()

    def _write(self, packets: list[av.Packet[VideoStream]]) -> None:
        for packet in packets:
            self._container.mux(packet)
            if self._plays > 1:
                self._packets.append(packet)

    def _ticks(self, packet: av.Packet[VideoStream], plays: int) -> int:
        """How long so many showings take, in the packet's unit of time."""
        assert packet.time_base is not None
        return round(plays * self._count / self._rate / packet.time_base)


def check_encoder(name: str) -> None:
    """InputError where FFmpeg was built without an encoder; PyAV's own wheels have all that are used here."""
    try:
        av.Codec(name, "w")
    except ValueError as error:  # PyAV's UnknownCodecError is one
        raise InputError(f"this PyAV has no encoder {name}: choose .mp4, or `pip install -U av`") from error
