"""GIF with one palette for the whole video, so that no colour flickers."""

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

PALETTE = 255  # the last of 256 says "as in the frame before", which keeps files small
BITS = 6  # of a channel in the histogram
RARITY = 0.6  # a colour counts as its number of pixels to this power: small signals keep their colour
ROUNDS = 8  # of k-means
PART = 16_384  # colours whose distances to the palette are in memory at once
DITHER = "sierra2_4a"  # error diffusion without the grid that an ordered pattern shows


class GifEncoder:
    """Frames to a GIF. They wait, packed, in an unnamed file beside the result until all colours are known."""

    def __init__(self, path: Path, width: int, height: int, rate: Fraction, plays: int) -> None:
        self._path, self._size, self._rate, self._plays = path, (width, height), rate, plays
        self._waiting = tempfile.TemporaryFile(dir=path.parent)  # noqa: SIM115  # closed by `close`
        self._packed, self._count = gzip.GzipFile(fileobj=self._waiting, mode="wb", compresslevel=1), 0
        self._colors = Histogram()

    def add(self, rgb: NDArray[np.uint8]) -> None:
        """Append [H, W, 3]."""
        self._colors.add(rgb)
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
        """Let the waiting frames go."""
        self._waiting.close()

    def _dithered(self) -> Iterator[av.VideoFrame]:
        """The frames in the colours of the palette."""
        graph, tick = av.filter.Graph(), 1 / self._rate
        pixels = av.VideoFormat("bgra")
        source = graph.add_buffer(width=self._size[0], height=self._size[1], format=pixels, time_base=tick)
        palette = graph.add_buffer(width=16, height=16, format=pixels, time_base=tick)
        use, sink = graph.add("paletteuse", f"dither={DITHER}"), graph.add("buffersink")
        source.link_to(use, 0, 0)
        palette.link_to(use, 0, 1)
        use.link_to(sink)
        graph.configure()
        colors = _palette_frame(self._colors.palette())
        colors.pts, colors.time_base = 0, tick
        palette.push(colors)
        palette.push(None)
        for index, rgb in enumerate(self._frames()):
            frame = av.VideoFrame.from_ndarray(rgb, format="rgb24").reformat(format="bgra")
            frame.pts, frame.time_base = index, tick
            source.push(frame)
            yield from _pulled(sink)
        source.push(None)
        yield from _pulled(sink)

    def _frames(self) -> Iterator[NDArray[np.uint8]]:
        self._packed.close()
        self._waiting.seek(0)
        width, height = self._size
        with gzip.GzipFile(fileobj=self._waiting) as packed:
            for _ in range(self._count):
                yield np.frombuffer(packed.read(3 * width * height), np.uint8).reshape(height, width, 3)


class Histogram:
    """How often each of 262,144 cells of the colour cube was seen, and the mean colour in it."""

    def __init__(self) -> None:
        cells = 1 << 3 * BITS
        self._counts, self._sums = np.zeros(cells), np.zeros((cells, 3))

    def add(self, rgb: NDArray[np.uint8]) -> None:
        """Count the pixels of [H, W, 3]."""
        r, g, b = (rgb[..., c].astype(np.int64).ravel() >> 8 - BITS for c in range(3))
        cell = r << 2 * BITS | g << BITS | b
        self._counts += np.bincount(cell, minlength=len(self._counts))
        for c in range(3):
            self._sums[:, c] += np.bincount(cell, rgb[..., c].ravel(), len(self._counts))

    def palette(self) -> NDArray[np.float64]:
        """At most 255 colours [P, 3] in 0..255 that stand for all: k-means from far-apart beginnings."""
        seen = self._counts > 0
        colors, weights = self._sums[seen] / self._counts[seen, None], self._counts[seen] ** RARITY
        centers = _far_apart(colors, weights)
        for _ in range(ROUNDS):
            nearest = _nearest(colors, centers)
            mass = np.bincount(nearest, weights, len(centers))
            sums = np.stack([np.bincount(nearest, weights * colors[:, c], len(centers)) for c in range(3)], axis=1)
            centers = np.where(mass[:, None] > 0, sums / np.maximum(mass, 1e-12)[:, None], centers)
        return centers


def _far_apart(colors: NDArray[np.float64], weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Up to 255 of the colours, each the one that the earlier ones serve worst."""
    chosen = [int(weights.argmax())]
    distance = np.square(colors - colors[chosen[0]]).sum(axis=1)
    while len(chosen) < PALETTE and (distance * weights).max() > 0:
        chosen.append(int((distance * weights).argmax()))
        distance = np.minimum(distance, np.square(colors - colors[chosen[-1]]).sum(axis=1))
    return colors[chosen]


def _nearest(colors: NDArray[np.float64], centers: NDArray[np.float64]) -> NDArray[np.int64]:
    """Index [N] of the centre that is nearest to each colour [N, 3]."""
    length = np.square(centers).sum(axis=1)
    parts = range(0, len(colors), PART)
    return np.concatenate([(length - 2 * colors[k : k + PART] @ centers.T).argmin(axis=1) for k in parts])


def _palette_frame(colors: NDArray[np.float64]) -> av.VideoFrame:
    """The picture of 16×16 pixels that paletteuse reads; its last pixel is the transparent one."""
    pixels = np.zeros((256, 4), np.uint8)
    pixels[:PALETTE, 3] = 255
    pixels[: len(colors), :3] = np.round(colors)[:, ::-1]
    pixels[len(colors) : PALETTE, :3] = pixels[0, :3]
    return av.VideoFrame.from_ndarray(pixels.reshape(16, 16, 4), format="bgra")


def _pulled(sink: av.filter.context.FilterContext) -> Iterator[av.VideoFrame]:
    """What the filters have ready."""
    with contextlib.suppress(av.BlockingIOError, av.EOFError):
        while True:
            frame = sink.pull()
            assert isinstance(frame, av.VideoFrame)
            yield frame
