"""PLY headers: what a file claims to hold, checked against what it can hold."""

from __future__ import annotations

import dataclasses
import os
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from spackle.errors import InputError, reason_in_a_line

MAX_HEADER_BYTES = 1 << 16
MAX_EXTRA_ROWS = 64  # SHARP's elements after the vertices hold at most 16 numbers

_NAMES = ["char", "uchar", "short", "ushort", "int", "uint", "float", "double"]
_SIZED = ["int8", "uint8", "int16", "uint16", "int32", "uint32", "float32", "float64"]
_CODES = dict(zip([*_NAMES, *_SIZED], ["i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8"] * 2, strict=True))
_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}


@dataclasses.dataclass
class Element:
    """One table of a PLY file."""

    name: str
    count: int
    fields: list[tuple[str, str]] = dataclasses.field(default_factory=list)  # (name, NumPy type)
    has_list: bool = False  # rows have no fixed size

    @property
    def dtype(self) -> np.dtype[Any]:
        return np.dtype(self.fields)


@dataclasses.dataclass(frozen=True)
class Header:
    """The elements in file order, and where their data begins."""

    ascii: bool
    elements: list[Element]
    data_start: int  # bytes
    path: str | os.PathLike[str]
    comments: dict[str, list[str]] = dataclasses.field(default_factory=dict)  # first word → the others

    def readable(self) -> list[tuple[Element, int]]:
        """Elements up to the first one without a fixed size, each with its offset from `data_start`.

        The offset counts bytes, or lines in an ASCII file.
        """
        offset, found = 0, []
        for element in self.elements:
            if element.has_list:
                break
            found.append((element, offset))
            offset += element.count * (1 if self.ascii else element.dtype.itemsize)
        return found

    def check_size(self, file_size: int) -> None:
        """InputError where the file is too short for its tables; nothing has been allocated yet."""
        for element, offset in self.readable():
            # A number and its separator take two characters at least.
            row = 2 * len(element.fields) if self.ascii else element.dtype.itemsize
            needed = (0 if self.ascii else offset) + element.count * row
            if self.data_start + needed - self.ascii > file_size:
                raise InputError(
                    f"{self.path}: cut off: {element.count} rows of {element.name!r} are announced, "
                    f"but the file ends after {file_size} bytes"
                )


def read_header(file: IO[bytes], path: str | os.PathLike[str]) -> Header:
    """Parse the header of a PLY file that is open at its start.

    Raises:
        InputError: not a PLY file, or a header that is endless or makes no sense.
    """
    head = file.read(MAX_HEADER_BYTES)
    if head.split(b"\n", 1)[0].rstrip() != b"ply":
        raise InputError(f"{path}: not a PLY file: its first line must be 'ply'")
    lines: list[list[str]] = []
    start = 0
    while not lines or lines[-1] != ["end_header"]:
        end = head.find(b"\n", start) + 1
        if end == 0:
            raise InputError(f"{path}: the header has no end: the file is damaged or cut off")
        lines.append(head[start:end].decode("latin-1").split())
        start = end
    try:
        order, elements = _parse(lines[1:-1])
    except (ValueError, KeyError, IndexError) as error:
        raise InputError(f"{path}: broken PLY header: {reason_in_a_line(error)}") from error
    comments = {words[1]: words[2:] for words in lines if words[:1] == ["comment"] and len(words) > 1}
    return Header(order == "=", elements, start, path, comments)


def _parse(lines: list[list[str]]) -> tuple[str, list[Element]]:
    """Byte order and elements; ValueError, KeyError or IndexError where a line makes no sense."""
    order = ""
    elements: list[Element] = []
    for words in lines:
        match words:
            case [] | ["comment" | "obj_info", *_]:
                continue
            case ["format", name, _] if name in _ORDERS:
                order = _ORDERS[name]
            case ["element", name, count] if int(count) >= 0:
                elements.append(Element(name, int(count)))
            case ["property", "list", _, _, _]:
                elements[-1].has_list = True
            case ["property", kind, name] if order:
                elements[-1].fields.append((name, order + _CODES[kind]))
            case _:
                raise ValueError(f"cannot understand the line {' '.join(words)[:80]!r}")
    for element in elements:
        np.dtype(element.fields)  # ValueError for a name given twice
    if not order:
        raise ValueError("there is no format line")
    return order, elements


def read_extras(file: IO[bytes], header: Header) -> dict[str, NDArray[np.float64]]:
    """The small tables of a binary or ASCII file, property name → numbers, such as SHARP's camera."""
    extras: dict[str, NDArray[np.float64]] = {}
    line = 0
    file.seek(header.data_start)
    for element, offset in header.readable():
        small = element.name != "vertex" and element.count <= MAX_EXTRA_ROWS and bool(element.fields)
        if small and header.ascii:
            skip_lines(file, offset - line)
            rows = read_lines(file, element, element.count, header.path)
            line = offset + element.count
        elif small:
            file.seek(header.data_start + offset)
            rows = np.frombuffer(file.read(element.count * element.dtype.itemsize), element.dtype)
        if small:
            extras |= {name: rows[name].astype(np.float64) for name, _ in element.fields}
    return extras


def skip_lines(file: IO[bytes], count: int) -> None:
    """Pass over the rows of an ASCII table."""
    for _ in range(count):
        if not file.readline():
            return  # whoever reads on finds the end


def read_lines(file: IO[bytes], element: Element, count: int, path: str | os.PathLike[str]) -> NDArray[Any]:
    """`count` rows of an ASCII table as a structured array of float64.

    Raises:
        InputError: a row with too few or too many numbers, or with something else.
    """
    columns = len(element.fields)
    words = b" ".join(file.readline(MAX_HEADER_BYTES) for _ in range(count)).split()
    try:
        numbers = np.array(words, dtype=np.float64)
    except ValueError as error:
        raise InputError(f"{path}: {element.name!r} holds something that is no number: {error}") from error
    if len(numbers) != count * columns:
        raise InputError(f"{path}: {element.name!r} is cut off or has rows without exactly {columns} numbers")
    return numbers.view([(name, "f8") for name, _ in element.fields])
