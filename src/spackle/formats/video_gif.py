"""Write GIFs with one palette for the whole video, so that no colour flickers."""

from __future__ import annotations

import contextlib
import gzip
import tempfile
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path

import av
import av.filter
import numpy as np
from av.video.stream import VideoStream
from numpy.typing import NDArray

DITHER = "sierra2_4a"  # error diffusion, which shows no grid as ordered dithering does


class GifEncoder:
    """Encodes frames as a GIF. Until all colours are known, they are stored, compressed, in a temporary file."""

    def __init__(self, path: Path, width: int, height: int, rate: Fraction, plays: int) -> None:
        self._path, self._size, self._rate, self._plays = path, (width, height), rate, plays
        self._waiting = tempfile.TemporaryFile(dir=path.parent)  # noqa: SIM115  # closed by `close`
        self._packed, self._count = gzip.GzipFile(fileobj=self._waiting, mode="wb", compresslevel=1), 0
        self._colors = Filter("palettegen", "", [self._size], 1 / rate)

    def add(self, rgb: NDArray[np.uint8]) -> None:
        """Append a frame [H, W, 3]."""
        self._colors.push(0, _picture(rgb), self._count)
        self._packed.write(rgb.tobytes())
        self._count += 1

    def finish(self) -> None:
        """Choose the palette and write the file."""
        loop = {0: "0", 1: "-1"}.get(self._plays, str(self._plays - 1))  # the file counts repetitions
        with av.open(str(self._path), "w", format="gif", options={"loop": loop}) as container:
            stream = container.add_stream("gif", rate=self._rate)
            assert isinstance(stream, VideoStream)
            stream.width, stream.height = self._size
            stream.pix_fmt = "pal8"
            for frame in self._dithered():
                container.mux(stream.encode(frame))
            container.mux(stream.encode(None))
        self.close()

    def close(self) -> None:
        """Discard the stored frames."""
        self._waiting.close()

    def _dithered(self) -> Iterator[av.VideoFrame]:
        """The frames in the colours of the palette."""
        (palette,) = self._colors.ended()
        use = Filter("paletteuse", f"dither={DITHER}", [self._size, (palette.width, palette.height)], 1 / self._rate)
        use.push(1, palette, 0)
        use.end(1)
        self._packed.close()
        self._waiting.seek(0)
        width, height = self._size
        with gzip.GzipFile(fileobj=self._waiting) as packed:
            for index in range(self._count):
                rgb = np.frombuffer(packed.read(3 * width * height), np.uint8).reshape(height, width, 3)
                use.push(0, _picture(rgb), index)
                yield from use.ready()
        yield from use.ended()


class Filter:
    """One of FFmpeg's filters; each input takes frames of one of the `sizes` (width, height)."""

    def __init__(self, name: str, options: str, sizes: list[tuple[int, int]], tick: Fraction) -> None:
        self._graph, self._tick, pixels = av.filter.Graph(), tick, av.VideoFormat("bgra")
        self._inputs = [self._graph.add_buffer(width=w, height=h, format=pixels, time_base=tick) for w, h in sizes]
        work, self._sink = self._graph.add(name, options), self._graph.add("buffersink")
        for index, source in enumerate(self._inputs):
            source.link_to(work, 0, index)
        work.link_to(self._sink)
        self._graph.configure()

    def push(self, source: int, frame: av.VideoFrame, index: int) -> None:
        frame.pts, frame.time_base = index, self._tick
        self._inputs[source].push(frame)

    def end(self, source: int) -> None:
        self._inputs[source].push(None)

    def ready(self) -> Iterator[av.VideoFrame]:
        """The frames that the filter has ready."""
        with contextlib.suppress(av.BlockingIOError, av.EOFError):
            while True:
                frame = self._sink.pull()
                assert isinstance(frame, av.VideoFrame)
                yield frame

    def ended(self) -> Iterator[av.VideoFrame]:
        """The remaining frames, after the first input has ended."""
        self.end(0)
        return self.ready()


def _picture(rgb: NDArray[np.uint8]) -> av.VideoFrame:
    return av.VideoFrame.from_ndarray(rgb, format="rgb24").reformat(format="bgra")
