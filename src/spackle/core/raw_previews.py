"""The preview inside a camera's raw file.

A raw file holds what the sensor measured, which only a raw developer turns into a photo. But
cameras put finished pictures beside it: thumbnails, and mostly a large preview. `read_raw_file`
lists them.
"""

from __future__ import annotations

import dataclasses
import io
import struct
from collections.abc import Iterator, Mapping
from typing import BinaryIO

from spackle.core.image_formats import JPEG, RAW, TIFF, FileKind
from spackle.core.tiff_directories import (
    BITS_PER_SAMPLE,
    COMPRESSION,
    DNG_VERSION,
    JPEG_LENGTH,
    JPEG_OFFSET,
    ORIENTATION,
    PHOTOMETRIC,
    PREVIEW_COLOR_SPACE,
    STRIP_BYTE_COUNTS,
    STRIP_OFFSETS,
    TIFF_NUMBER,
    TiffDirectory,
    read_directories,
    read_exif,
)

# A preview is used if its long side has so many pixels, or half of those of the sensor's. Most
# scenes are computed at 1536 pixels; the thumbnails of cameras have 160 to 640.
MIN_PREVIEW_SIDE_PX = 1024
MIN_PREVIEW_PER_SENSOR = 0.5
MAX_PREVIEWS = 32  # a camera's file has three
MAX_JPEG_BEGINS = 20_000  # sensor data may consist of thousands of tiles, each a lossless JPEG
MAX_JPEG_SEGMENTS = 200  # before the picture's size; a preview has a dozen

_JPEG_BEGIN = b"\xff\xd8\xff"
# Markers of frames that viewers decode: baseline, extended and progressive, with Huffman codes. A
# sensor's data may be JPEG, too, but lossless, with another marker.
_JPEG_FRAMES = (0xC0, 0xC1, 0xC2)
_OTHER_JPEG_FRAMES = (0xC3, 0xC5, 0xC6, 0xC7, 0xC9, 0xCA, 0xCB, 0xCD, 0xCE, 0xCF)
_JPEG_COMPRESSIONS = (6, 7)  # TIFF's numbers of old and new JPEG
_PICTURE_PHOTOMETRICS = (1, 2, 6)  # grey, RGB and YCbCr
_BOX_OF_CANON_TAGS = (b"CMT1", b"CMT2")  # of a CR3: tags of the picture, and of EXIF


@dataclasses.dataclass(frozen=True)
class Preview:
    """A finished picture inside a raw file."""

    width: int  # before it is turned upright
    height: int
    kind: FileKind
    pieces: tuple[bytes | memoryview, ...]  # of its bytes, which are a file of their own

    def open(self) -> BinaryIO:
        """The preview as an open file."""
        return io.BytesIO(b"".join(self.pieces))


@dataclasses.dataclass(frozen=True)
class RawFile:
    """What a raw file holds beside the sensor's data."""

    previews: list[Preview]  # the largest first
    sensor_size: tuple[int, int] | None  # width and height in pixels, if the file states them
    exif: dict[int, object]  # by number, with the orientation

    @property
    def usable_previews(self) -> list[Preview]:
        """The previews that are large enough for a photo, the largest first."""
        return [preview for preview in self.previews if self._is_usable(preview)]

    def _is_usable(self, preview: Preview) -> bool:
        """Whether a preview is large, or not much smaller than the sensor's picture."""
        side = max(preview.width, preview.height)
        if side >= MIN_PREVIEW_SIDE_PX:
            return True
        if self.sensor_size is None:
            return False
        return side >= MIN_PREVIEW_PER_SENSOR * max(self.sensor_size)


def read_raw_file(file: BinaryIO, kind: FileKind) -> RawFile | None:
    """The previews and tags of a raw file; None for a TIFF that is a picture, no raw file.

    Args:
        file: the open file.
        kind: its format by its first bytes. Most raw files begin as a TIFF.
    """
    directories = read_directories(file)
    if kind is not RAW and not _is_raw_tiff(file, directories):
        return None

    sensor_sizes = [directory.size for directory in directories if directory.is_sensor_data]
    exif = read_exif(file)
    file.seek(0)
    content = file.read()
    if not exif:  # not a TIFF
        exif = _canon_exif(content)

    previews: dict[tuple[int, int], Preview] = {}
    for preview in (*_tiff_previews(content, directories), *_jpegs_within(content)):
        # The same picture is found twice: by its directory and by its first bytes.
        previews.setdefault((preview.width, preview.height), preview)
        if len(previews) >= MAX_PREVIEWS:
            break
    # The largest first.
    by_area = sorted(previews.values(), key=lambda preview: -preview.width * preview.height)
    # DNG says with a preview which colours it has; the first such statement counts.
    for directory in directories:
        if PREVIEW_COLOR_SPACE in directory.tags:
            exif.setdefault(PREVIEW_COLOR_SPACE, directory.number(PREVIEW_COLOR_SPACE))
    return RawFile(
        previews=by_area,
        sensor_size=max(sensor_sizes, default=None, key=lambda size: size[0] * size[1]),
        exif=exif,
    )


def _is_raw_tiff(file: BinaryIO, directories: list[TiffDirectory]) -> bool:
    """Whether a TIFF is a raw file: it holds a sensor's data, or says so."""
    file.seek(8)
    is_canon = file.read(2) == b"CR"  # CR2, whose directory of sensor data looks like a picture
    return is_canon or any(
        directory.is_sensor_data or DNG_VERSION in directory.tags for directory in directories
    )


def _tiff_previews(content: bytes, directories: list[TiffDirectory]) -> Iterator[Preview]:
    """The finished pictures that directories describe."""
    view = memoryview(content)
    for directory in directories:
        if directory.is_sensor_data:
            continue
        # A JPEG has tags of its own, or is the only strip of the picture.
        jpeg_begin = directory.number(JPEG_OFFSET)
        jpeg_end = jpeg_begin + directory.number(JPEG_LENGTH)
        offsets = directory.numbers(STRIP_OFFSETS)
        is_jpeg_strip = len(offsets) == 1 and directory.number(COMPRESSION) in _JPEG_COMPRESSIONS
        if not jpeg_begin and is_jpeg_strip:
            jpeg_begin = directory.number(STRIP_OFFSETS)
            jpeg_end = jpeg_begin + directory.number(STRIP_BYTE_COUNTS)
        size = jpeg_size(content, jpeg_begin) if jpeg_begin > 0 else None
        if size is not None:
            yield Preview(*size, JPEG, (view[jpeg_begin:jpeg_end],))
            continue

        # A picture that is not JPEG is read as a TIFF whose first directory is this one: the
        # header of the file says where the first directory begins.
        bits = directory.numbers(BITS_PER_SAMPLE)
        is_picture = directory.number(PHOTOMETRIC, -1) in _PICTURE_PHOTOMETRICS
        width, height = directory.size
        if is_picture and bits and set(bits) == {8} and width > 0 and height > 0:
            order = "<" if content[:2] == b"II" else ">"
            head = content[:2] + struct.pack(f"{order}HI", TIFF_NUMBER, directory.offset)
            yield Preview(width, height, TIFF, (head, view[8:]))


def _jpegs_within(content: bytes) -> Iterator[Preview]:
    """The JPEGs anywhere in a file, such as those in the notes of a camera's maker."""
    view = memoryview(content)
    begin = -1
    for _ in range(MAX_JPEG_BEGINS):
        begin = content.find(_JPEG_BEGIN, begin + 1)
        if begin < 0:
            return
        size = jpeg_size(content, begin)
        if size is not None:
            # A JPEG's end is not stated here; its decoder stops there.
            yield Preview(*size, JPEG, (view[begin:],))


def jpeg_size(content: bytes, begin: int) -> tuple[int, int] | None:
    """Width and height of the JPEG that begins at a place; None if there is none to decode."""
    if content[begin : begin + 3] != _JPEG_BEGIN:
        return None
    position = begin + 2
    for _ in range(MAX_JPEG_SEGMENTS):
        # Each segment begins with 255 and its marker, then the length with these two bytes.
        head = content[position : position + 4]
        if len(head) < 4 or head[0] != 0xFF:
            return None
        marker = head[1]
        length = int.from_bytes(head[2:], "big")
        if marker in _JPEG_FRAMES:
            # Bits (1 byte), height and width (2 bytes each), and the number of channels (1 byte).
            # A JPEG of more bits holds the sensor's numbers, and is no finished picture.
            frame = content[position + 4 : position + 10]
            if len(frame) < 6 or frame[0] != 8 or frame[5] not in (1, 3):
                return None
            height, width = struct.unpack_from(">HH", frame, 1)
            return (width, height) if width and height else None
        if marker in _OTHER_JPEG_FRAMES or marker < 0xC0 or length < 2:
            return None
        position += 2 + length
    return None


def _canon_exif(content: bytes) -> dict[int, object]:
    """The tags of a CR3, which consists of boxes; each box of tags is a small TIFF."""
    exif: dict[int, object] = {}
    for name in _BOX_OF_CANON_TAGS:
        # A box begins with its size (4 bytes), which counts these and the name, and its name.
        place = content.find(name)
        if place < 4:
            continue
        size = int.from_bytes(content[place - 4 : place], "big")
        exif |= read_exif(io.BytesIO(content[place + 4 : place - 4 + size]))
    return exif


def orientation_of(exif: Mapping[int, object]) -> int:
    """EXIF's number of the orientation; 1, which turns nothing, if it is missing or impossible."""
    orientation = exif.get(ORIENTATION)
    return orientation if isinstance(orientation, int) and 1 <= orientation <= 8 else 1
