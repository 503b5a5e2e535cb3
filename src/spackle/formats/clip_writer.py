"""Clips out: H.264 with the times of another clip's frames, and its sound."""

from __future__ import annotations

import contextlib
import os
from fractions import Fraction
from pathlib import Path
from types import TracebackType

import av
from av.audio.stream import AudioStream
from av.video.stream import VideoStream
from torch import Tensor

from spackle.formats.atomic import atomic_path, check_writable
from spackle.formats.clip import Clip
from spackle.formats.png import to_bytes
from spackle.formats.video_stream import H264, StreamEncoder

CLOCK = Fraction(1, 90_000)  # seconds in which times are written
RATES = (Fraction(1, 1000), Fraction(1000))  # frames a second that an encoder takes


class ClipWriter:
    """Writes as many frames as a clip has, at its times, with its sound; the file appears when the block ends well."""

    def __init__(self, path: str | os.PathLike[str], clip: Clip) -> None:
        """Prepare to write an .mp4.

        Raises:
            InputError: no file can be written there.
        """
        check_writable(path)
        self.path, self.clip = path, clip
        self.sound = False  # whether it has been copied
        self._encoder: _ClipEncoder | None = None
        self._stack = contextlib.ExitStack()

    def __enter__(self) -> ClipWriter:
        self._temporary = self._stack.enter_context(atomic_path(self.path))
        return self

    def add(self, frame: Tensor) -> None:
        """Append sRGB [H, W, 3] in 0..1; all frames share one size."""
        if self._encoder is None:
            height, width = frame.shape[:2]
            self._encoder = _ClipEncoder(self._temporary, width, height, self.clip)
            self._stack.callback(self._encoder.close)
        self._encoder.add(to_bytes(frame).numpy())

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is not None or self._encoder is None:
            self._stack.__exit__(kind or ValueError, error or ValueError("no frame"), trace)
            return
        with self._stack:
            self._encoder.finish()
            self.sound = self._encoder.sound


class _ClipEncoder(StreamEncoder):
    """Frames are encoded as if they came evenly, and their packets moved to where they belong."""

    def __init__(self, path: Path, width: int, height: int, clip: Clip) -> None:
        self._even = min(max(clip.rate.limit_denominator(1001), RATES[0]), RATES[1])
        super().__init__(H264, path, width, height, self._even, 1)
        self._clip = clip
        self._input = av.open(str(clip.path)) if clip.audio in self._container.supported_codecs else None
        self.sound = False
        if self._input is not None:
            source = self._input.streams.audio[0]
            self._output = self._container.add_stream_from_template(source)
            self._sounds = self._input.demux(source)
            self._held: av.Packet[AudioStream] | None = None

    def finish(self) -> None:
        """The rest of the picture, and of the sound as long as that lasts."""
        self._write(self._stream.encode(None))
        self._copy_sound(self._clip.seconds)
        self.close()

    def close(self) -> None:
        """Write the index."""
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
        """When a frame is shown; before the first, and after the last one, at the mean rate."""
        times = self._clip.times
        if 0 <= index < len(times):
            return times[index]
        return times[0] + index / self._even if index < 0 else times[-1] + (index - len(times) + 1) / self._even

    def _copy_sound(self, until: Fraction) -> None:
        """Sound of the clip as far as a time, packet by packet; a damaged rest is left out."""
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
