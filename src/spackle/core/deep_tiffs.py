"""TIFFs with 16 bits a channel, of which Pillow keeps 8, and of which it confuses some layouts.

A TIFF stores its pixels in blocks: strips of rows, or tiles, of all channels together or of each
one alone. libtiff, by way of Pillow, unpacks the bytes of a block, whatever the compression; what
the bytes mean is worked out here.
"""

from __future__ import annotations

import dataclasses
import io
import math
import struct
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from spackle.core.image_files import open_image
from spackle.core.tiff_directories import (
    BITS_PER_SAMPLE,
    COMPRESSION,
    PHOTOMETRIC,
    SAMPLES_PER_PIXEL,
    STRIP_BYTE_COUNTS,
    STRIP_OFFSETS,
    TIFF_NUMBER,
    TiffDirectory,
    read_directories,
)

Codes = NDArray[np.uint16]
_ROWS_PER_STRIP = 278
_PLANAR_CONFIGURATION = 284
_PREDICTOR = 317
_TILE_WIDTH = 322
_TILE_HEIGHT = 323
_TILE_OFFSETS = 324
_TILE_BYTE_COUNTS = 325
_EXTRA_SAMPLES = 338
_SAMPLE_FORMAT = 339

_RGB = 2  # values of the tags
_UNCOMPRESSED = 1
_SEPARATE_PLANES = 2
_DIFFERENCES = 2  # of PREDICTOR: each pixel is stored as the difference from its left neighbour
_WHOLE_NUMBERS = 1  # of SAMPLE_FORMAT
_PREMULTIPLIED_ALPHA = 1  # of EXTRA_SAMPLES
_ALPHA = 2
MAX_BLOCKS = 20_000  # a strip of each row of a large photo, or small tiles
MAX_SAMPLES = 8  # channels; more are no photo


def read_deep_tiff(file: BinaryIO) -> Codes | None:
    """[H, W, 3 or 4] of the first picture of a TIFF, if it is RGB of 16 bits; otherwise None.

    Rows and columns are as they are stored. ValueError for a layout that is not read, or for a
    damaged file.
    """
    directories = read_directories(file)
    if not directories:
        return None
    directory = directories[0]
    bits = directory.numbers(BITS_PER_SAMPLE)
    is_deep_rgb = directory.number(PHOTOMETRIC) == _RGB and len(bits) >= 3 and set(bits) == {16}
    if not is_deep_rgb:
        return None

    layout = _Layout.of(directory)
    file.seek(0)
    content = file.read()
    planes = np.zeros((layout.height, layout.width, layout.samples), np.uint16)
    if layout.block_count > MAX_BLOCKS:
        raise ValueError(f"a TIFF of {layout.block_count:,} pieces")
    for block in range(layout.block_count):
        _read_block(content, directory, layout, block, planes)
    return _with_opacity(planes, directory)


@dataclasses.dataclass(frozen=True)
class _Layout:
    """How the pixels of a picture are cut into blocks."""

    width: int
    height: int
    samples: int  # channels
    block_width: int
    block_height: int
    is_tiled: bool  # tiles at the border are whole; the last strip has the rows that are left
    is_planar: bool  # each block has one channel

    @staticmethod
    def of(directory: TiffDirectory) -> _Layout:
        """The layout of a directory's picture; ValueError for one that is not read."""
        width, height = directory.size
        samples = directory.number(SAMPLES_PER_PIXEL, 3)
        is_tiled = _TILE_OFFSETS in directory.tags
        if is_tiled:
            block_width = directory.number(_TILE_WIDTH)
            block_height = directory.number(_TILE_HEIGHT)
        else:
            block_width = width
            block_height = min(directory.number(_ROWS_PER_STRIP, height), height)
        sides = (width, height, block_width, block_height)
        # A block that is much larger than the picture is damage that would cost memory. A tile of a
        # small picture may have up to a million pixels (1 << 20).
        is_sensible = min(sides) > 0 and 3 <= samples <= MAX_SAMPLES
        if not is_sensible or block_width * block_height > 4 * width * height + (1 << 20):
            raise ValueError("an impossible layout of a TIFF")
        if directory.number(_SAMPLE_FORMAT, _WHOLE_NUMBERS) != _WHOLE_NUMBERS:
            raise ValueError("numbers of a TIFF that are not whole")
        return _Layout(
            width=width,
            height=height,
            samples=samples,
            block_width=block_width,
            block_height=block_height,
            is_tiled=is_tiled,
            is_planar=directory.number(_PLANAR_CONFIGURATION, 1) == _SEPARATE_PLANES,
        )

    @property
    def columns(self) -> int:
        """The number of blocks beside each other."""
        return math.ceil(self.width / self.block_width)

    @property
    def rows(self) -> int:
        """The number of blocks below each other."""
        return math.ceil(self.height / self.block_height)

    @property
    def block_count(self) -> int:
        """The number of blocks of all channels."""
        return self.rows * self.columns * (self.samples if self.is_planar else 1)


def _read_block(
    content: bytes, directory: TiffDirectory, layout: _Layout, block: int, planes: Codes
) -> None:
    """Write a block's pixels to its place in the picture [H, W, samples].

    Args:
        content: the file.
        directory: the tags of the picture.
        layout: how the picture is cut.
        block: the number of the block.
        planes: the picture.
    """
    offsets = directory.numbers(_TILE_OFFSETS if layout.is_tiled else STRIP_OFFSETS)
    counts = directory.numbers(_TILE_BYTE_COUNTS if layout.is_tiled else STRIP_BYTE_COUNTS)
    if len(offsets) < layout.block_count or len(counts) < layout.block_count:
        raise ValueError("a TIFF without some of its pixels")

    # Blocks lie row by row; those of a channel follow those of the channel before.
    plane, place = divmod(block, layout.rows * layout.columns)
    block_row, block_column = divmod(place, layout.columns)
    top = block_row * layout.block_height
    left = block_column * layout.block_width
    row_count = layout.block_height
    if not layout.is_tiled:
        row_count = min(row_count, layout.height - top)
    channels = 1 if layout.is_planar else layout.samples

    begin = int(offsets[block])
    packed = content[begin : begin + int(counts[block])]
    row_bytes = layout.block_width * channels * 2
    unpacked = _unpack(packed, directory.number(COMPRESSION, 1), row_bytes, row_count)
    order = "<u2" if content[:2] == b"II" else ">u2"
    pixels = np.frombuffer(unpacked, order).reshape(row_count, layout.block_width, channels)
    codes = pixels.astype(np.uint16)
    if directory.number(_PREDICTOR, 1) == _DIFFERENCES:
        codes = np.cumsum(codes, axis=1, dtype=np.uint16)  # modulo 2^16, as they were stored

    # A tile at the border reaches beyond the picture.
    first_channel = plane if layout.is_planar else 0
    target = planes[top : top + row_count, left : left + layout.block_width]
    target = target[..., first_channel : first_channel + channels]
    target[:] = codes[: target.shape[0], : target.shape[1]]


def _unpack(packed: bytes, compression: int, row_bytes: int, row_count: int) -> bytes:
    """The bytes of a block, `row_count` rows of `row_bytes`; ValueError if they are too few.

    libtiff gets the block as a grey picture of 8 bits, so that it only unpacks the bytes.
    """
    size = row_bytes * row_count
    if compression == _UNCOMPRESSED:
        unpacked = packed[:size]
    else:
        grey = _grey_tiff(packed, compression, row_bytes, row_count)
        with open_image(grey, ("TIFF",)) as image:
            unpacked = image.tobytes()
    if len(unpacked) != size:
        raise ValueError("a TIFF without some of its pixels")
    return unpacked


def _grey_tiff(packed: bytes, compression: int, width: int, height: int) -> BinaryIO:
    """A TIFF of one grey picture of 8 bits, whose compressed bytes are these."""
    # The numbers of tags are those of TIFF 6.0.
    tags: dict[int, int] = {
        256: width,
        257: height,
        258: 8,  # bits of a sample
        259: compression,
        262: 1,  # 0 is black
        277: 1,  # samples of a pixel
        278: height,  # rows of a strip: there is one strip
        279: len(packed),  # bytes of the strip
    }
    # The strip lies behind the header (8 bytes) and the directory: the count of its entries (2
    # bytes), the entries (12 bytes each), and where another directory lies (4 bytes, 0 for none).
    entry_count = len(tags) + 1
    head_size = 8 + 2 + 12 * entry_count + 4
    tags[273] = head_size  # where the strip begins
    # An entry has the tag, the type (4 is a number of 4 bytes), how many numbers, and the number.
    entries = b"".join(struct.pack("<HHII", tag, 4, 1, tags[tag]) for tag in sorted(tags))
    head = b"II" + struct.pack("<HIH", TIFF_NUMBER, 8, entry_count)
    return io.BytesIO(head + entries + bytes(4) + packed)


def _with_opacity(planes: Codes, directory: TiffDirectory) -> Codes:
    """RGB, or RGB with opacity if the fourth channel is that; colours are not premultiplied."""
    kind = directory.number(_EXTRA_SAMPLES)
    if planes.shape[2] < 4 or kind not in (_ALPHA, _PREMULTIPLIED_ALPHA):
        return np.ascontiguousarray(planes[..., :3])
    codes = np.ascontiguousarray(planes[..., :4])
    if kind == _PREMULTIPLIED_ALPHA:
        opacity = np.maximum(codes[..., 3:].astype(np.float32), 1) / 65535
        colors: NDArray[Any] = codes[..., :3] / opacity
        codes[..., :3] = np.minimum(np.rint(colors), 65535).astype(np.uint16)
    return codes
