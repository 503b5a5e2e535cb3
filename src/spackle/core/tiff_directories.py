"""The directories of a TIFF, which also raw files and EXIF are made of.

A TIFF holds pictures; each has a directory of tags, such as its size. A directory names the next
one, and may name further ones below it (`SubIFDs`), in which cameras keep previews and the sensor's
data. Nothing is decoded here.
"""

from __future__ import annotations

import dataclasses
import io
import math
import struct
from collections.abc import Iterator
from typing import BinaryIO

MAX_DIRECTORIES = 64  # a camera's file has a dozen
MAX_ENTRIES = 2048  # of a directory; a camera's has a hundred
MAX_VALUE_BYTES = 1 << 20  # of a tag; longer ones are pictures or private data
MAX_FILE_BYTES = 1 << 25  # of all tags; a broken file may name the same bytes again and again

# The third and fourth byte of a TIFF, as a number.
TIFF_NUMBER = 42
BIG_TIFF_NUMBER = 43

# Numbers of tags.
SUBFILE_TYPE = 254
WIDTH = 256
HEIGHT = 257
BITS_PER_SAMPLE = 258
COMPRESSION = 259
PHOTOMETRIC = 262
MAKE = 271
MODEL = 272
STRIP_OFFSETS = 273
ORIENTATION = 274
SAMPLES_PER_PIXEL = 277
STRIP_BYTE_COUNTS = 279
SUB_DIRECTORIES = 330
JPEG_OFFSET = 513
JPEG_LENGTH = 514
XMP = 700
EXIF_DIRECTORY = 0x8769
INTEROPERABILITY_DIRECTORY = 0xA005
DNG_VERSION = 50706
PREVIEW_COLOR_SPACE = 50970

# Bits of SUBFILE_TYPE: of thumbnails and previews, and of masks.
REDUCED_RESOLUTION = 1
MASK = 4
SIDEWAYS_ORIENTATIONS = (5, 6, 7, 8)  # values of ORIENTATION that swap rows and columns
CFA = 32803  # values of PHOTOMETRIC for the sensor's data: of a colour filter array,
LINEAR_RAW = 34892  # and of one that is interpolated already

# Struct's letter for each type of TIFF that is a number.
_NUMBER_LETTERS = {
    1: "B", 3: "H", 4: "I", 6: "b", 8: "h", 9: "i", 11: "f", 12: "d", 13: "I", 16: "Q", 17: "q",
    18: "Q",
}  # fmt: skip
_BYTE_TYPES = (2, 7)  # text, and bytes of any meaning
_FRACTION_LETTERS = {5: "I", 10: "i"}  # two numbers each
Value = tuple[float, ...] | bytes


@dataclasses.dataclass(frozen=True)
class TiffDirectory:
    """A picture's tags."""

    offset: int  # where the directory begins, in bytes
    tags: dict[int, Value]  # numbers, or bytes for text and values of any meaning

    def number(self, tag: int, default: int = 0) -> int:
        """The first number of a tag, or the default if it is missing or not finite."""
        numbers = self.numbers(tag)
        return int(numbers[0]) if numbers and math.isfinite(numbers[0]) else default

    def numbers(self, tag: int) -> tuple[float, ...]:
        """The numbers of a tag; empty if it is missing or no number."""
        value = self.tags.get(tag, ())
        return () if isinstance(value, bytes) else value

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the picture in pixels; 0 if they are missing."""
        return self.number(WIDTH), self.number(HEIGHT)

    @property
    def is_reduced(self) -> bool:
        """Whether the picture is a thumbnail or preview of another one in the file."""
        return bool(self.number(SUBFILE_TYPE) & REDUCED_RESOLUTION)

    @property
    def is_page(self) -> bool:
        """Whether the picture is meant to be seen: no thumbnail, mask or sensor's data."""
        is_helper = self.number(SUBFILE_TYPE) & (REDUCED_RESOLUTION | MASK)
        return min(self.size) > 0 and not is_helper and not self.is_sensor_data

    @property
    def is_sensor_data(self) -> bool:
        """Whether the picture is what the sensor measured, which needs a developer."""
        return self.number(PHOTOMETRIC) in (CFA, LINEAR_RAW)


def read_directories(file: BinaryIO) -> list[TiffDirectory]:
    """All directories of a TIFF that describe pictures, the first one first; empty if broken.

    The file may also be a raw file that is a TIFF but for its third and fourth byte.
    """
    reader = _Reader.of(file)
    if reader is None:
        return []
    directories: list[TiffDirectory] = []
    seen: set[int] = set()
    waiting = [reader.first_directory()]  # where directories begin that are still to be read
    while waiting and len(directories) < MAX_DIRECTORIES:
        offset = waiting.pop(0)
        if offset == 0 or offset in seen:  # the end, or a circle
            continue
        seen.add(offset)
        entry = reader.directory(offset)
        if entry is None:
            continue
        directory, following = entry
        directories.append(directory)
        waiting.append(following)
        below = directory.numbers(SUB_DIRECTORIES)
        waiting += [int(place) for place in below if math.isfinite(place) and place > 0]
    return directories


def tiff_from_directory(file: BinaryIO, directory: TiffDirectory) -> BinaryIO:
    """The same TIFF, in memory, whose first directory is `directory`."""
    file.seek(0)
    content = file.read()
    # The header is the byte order, the number 42, and where the first directory begins. BigTIFF has
    # another header.
    order = "<" if content[:2] == b"II" else ">"
    if content[2:4] == struct.pack(f"{order}H", BIG_TIFF_NUMBER):
        head = content[:8] + struct.pack(f"{order}Q", directory.offset)
    else:
        head = content[:2] + struct.pack(f"{order}HI", TIFF_NUMBER, directory.offset)
    return io.BytesIO(head + content[len(head) :])


def read_exif(file: BinaryIO) -> dict[int, object]:
    """The tags of a TIFF's first directory, and of the directories of EXIF that it names.

    A tag with one value has this value, one with several has a tuple; texts are str.
    """
    reader = _Reader.of(file)
    if reader is None:
        return {}
    tags: dict[int, Value] = {}
    offset = reader.first_directory()
    # EXIF's directory hangs below the first one, and that of interoperability below EXIF's.
    for pointer in (EXIF_DIRECTORY, INTEROPERABILITY_DIRECTORY, 0):
        entry = reader.directory(offset) if offset else None
        if entry is None:
            break
        tags |= entry[0].tags
        offset = entry[0].number(pointer)
    return {tag: _plain(value) for tag, value in tags.items()}


def _plain(value: Value) -> object:
    """A tag's value as Pillow gives it: a text, a number, or a tuple of several."""
    if isinstance(value, bytes):
        return value.rstrip(b"\0").decode("latin-1")
    return value[0] if len(value) == 1 else value


@dataclasses.dataclass
class _Reader:
    """Reads numbers of a TIFF's byte order at places of a file."""

    file: BinaryIO
    order: str  # struct's letter
    is_big: bool  # BigTIFF: places and counts have 8 bytes
    bytes_left: int = MAX_FILE_BYTES  # how much may still be read

    @staticmethod
    def of(file: BinaryIO) -> _Reader | None:
        """The reader for an open TIFF; None if the file is none."""
        file.seek(0)
        head = file.read(4)
        order = {b"II": "<", b"MM": ">"}.get(head[:2])
        if order is None or len(head) < 4:
            return None
        is_big = head[2:] == struct.pack(f"{order}H", BIG_TIFF_NUMBER)
        return _Reader(file, order, is_big)

    def first_directory(self) -> int:
        """Where the first directory begins; 0 if there is none."""
        place = self._numbers(8, "Q", 1) if self.is_big else self._numbers(4, "I", 1)
        return int(place[0]) if place else 0

    def directory(self, offset: int) -> tuple[TiffDirectory, int] | None:
        """The directory at a place, and where the next one begins; None if it is broken."""
        # BigTIFF counts entries and places with 8 bytes, where TIFF has 2 and 4.
        count_letter, entry_size = ("Q", 20) if self.is_big else ("H", 12)
        counts = self._numbers(offset, count_letter, 1)
        if not counts or not 0 < counts[0] <= MAX_ENTRIES:
            return None
        entry_count = int(counts[0])
        start = offset + struct.calcsize(f"={count_letter}")
        table = self._bytes(start, entry_count * entry_size)
        if table is None:
            return None
        tags = dict(self._entries(table, entry_size))
        following = self._numbers(start + len(table), "Q" if self.is_big else "I", 1)
        return TiffDirectory(offset, tags), int(following[0]) if following else 0

    def _entries(self, table: bytes, entry_size: int) -> Iterator[tuple[int, Value]]:
        """The tags of a directory's table with their values; unreadable ones are left out."""
        # An entry: the tag's number, its type, how many elements it has, and its value.
        layout = struct.Struct(f"{self.order}{'HHQ8s' if self.is_big else 'HHI4s'}")
        place = struct.Struct(f"{self.order}{'Q' if self.is_big else 'I'}")
        for start in range(0, len(table), entry_size):
            tag, kind, count, content = layout.unpack_from(table, start)
            size = self._size_of_value(kind, count)
            if size is None:
                continue
            # A value that does not fit into the entry lies elsewhere, and the entry says where.
            value = content[:size] if size <= len(content) else None
            if value is None:
                value = self._bytes(place.unpack(content)[0], size)
            if value is not None:
                yield tag, self._value(kind, count, value)

    @staticmethod
    def _size_of_value(kind: int, count: int) -> int | None:
        """Bytes of a value of `count` elements; None for an unknown type or a huge value."""
        if kind in _BYTE_TYPES:
            size = count
        elif kind in _NUMBER_LETTERS:
            size = count * struct.calcsize(f"={_NUMBER_LETTERS[kind]}")
        elif kind in _FRACTION_LETTERS:
            size = count * 8
        else:
            return None
        return size if 0 < size <= MAX_VALUE_BYTES else None

    def _value(self, kind: int, count: int, content: bytes) -> Value:
        """The numbers or bytes of a tag; a fraction with the denominator 0 becomes NaN.

        Args:
            kind: TIFF's number of the type of the elements.
            count: how many elements there are.
            content: their bytes.
        """
        if kind in _BYTE_TYPES:
            return content
        if kind in _NUMBER_LETTERS:
            numbers = struct.unpack(f"{self.order}{count}{_NUMBER_LETTERS[kind]}", content)
            return tuple(numbers)
        pairs = struct.unpack(f"{self.order}{2 * count}{_FRACTION_LETTERS[kind]}", content)
        return tuple(
            above / below if below else math.nan
            for above, below in zip(pairs[::2], pairs[1::2], strict=True)
        )

    def _numbers(self, offset: int, letter: str, count: int) -> tuple[float, ...]:
        """Numbers at a place of the file; empty beyond its end."""
        layout = f"{self.order}{count}{letter}"
        content = self._bytes(offset, struct.calcsize(layout))
        return () if content is None else struct.unpack(layout, content)

    def _bytes(self, offset: int, size: int) -> bytes | None:
        """Bytes at a place of the file; None if they end beyond its end, or too much was read."""
        self.bytes_left -= size
        if self.bytes_left < 0:
            return None
        try:
            self.file.seek(offset)
            content = self.file.read(size)
        except (OSError, ValueError, OverflowError):
            return None
        return content if len(content) == size else None
