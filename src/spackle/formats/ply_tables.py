"""The container of a PLY file: a text header, then tables. Knows nothing of Gaussians.

`PlyTables` reads a file; `ply_header` writes the header of one.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import os
import re
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spackle.core.camera import Camera
from spackle.core.image_formats import GIT_LFS, HEAD_BYTES, WEB_PAGE, kind_of_bytes
from spackle.formats.scene_content import is_at_origin
from spackle.runtime.errors import InputError, as_input_error
from spackle.runtime.files import check_file

MAX_HEADER_BYTES = 1 << 16

# NumPy's codes of PLY's types, by their old and their new names; the byte order is put before.
NUMPY_TYPES = {
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "float": "f4",
    "double": "f8",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "float32": "f4",
    "float64": "f8",
}
NUMPY_BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}

MIN_TEXT_BYTES = 2  # of a number in a text file: a digit, and a space or the line's end
TEXT_BLOCK_LINES = 1 << 13  # lines of a text file that are parsed at once

# PlayCanvas's compressed files have a table of chunks, and names of packed columns begin like this.
CHUNK_TABLE = "chunk"
PACKED_PREFIX = "packed_"

# The type, in `PlyElement.fields`, of a property that is a list, and so has no fixed size.
LIST_TYPE = "list"


@dataclasses.dataclass(frozen=True, kw_only=True)
class NewTable:
    """A table for the header of a new file."""

    name: str
    row_count: int
    type: str  # PLY's name of the type that all properties have, such as "float"
    properties: Sequence[str]


def ply_header(
    *tables: NewTable,
    camera: Camera | None = None,
    base_count: int | None = None,
    disparity: float | None = None,
    is_metric: bool = False,
) -> bytes:
    """Return the header of a binary PLY file, with what Spackle knows of the scene as comments.

    Args:
        tables: the file's tables, in their order.
        camera: the photo's camera; its pose is a comment of its own, unless it is at the origin.
        base_count: how many Gaussians come from the photo; those that fill holes come after.
        disparity: how far to the side the camera may go, because the holes that it uncovers are
            filled; a disparity of 1 shifts the nearest surface by the picture's diagonal.
        is_metric: whether the unit of length is known to be the metre.
    """
    lines = ["ply", "format binary_little_endian 1.0"]
    if camera is not None:
        principal_point = camera.K[:2, 2].tolist()
        numbers = [*camera.focal, *principal_point, camera.width, camera.height]
        # repr() writes as many digits as the exact number needs.
        lines.append("comment spackle_camera " + " ".join(repr(number) for number in numbers))
        if not is_at_origin(camera):
            # The last row is always 0 0 0 1.
            rows = camera.world_to_camera.double()[:3].flatten().tolist()
            lines.append("comment spackle_pose " + " ".join(repr(number) for number in rows))
    if base_count is not None:
        lines.append(f"comment spackle_base {base_count!r}")
    if disparity is not None:
        lines.append(f"comment spackle_disparity {disparity!r}")
    if is_metric:
        lines.append("comment spackle_metric 1")

    for table in tables:
        lines.append(f"element {table.name} {table.row_count}")
        for property_name in table.properties:
            lines.append(f"property {table.type} {property_name}")
    lines.append("end_header")
    return "".join(f"{line}\n" for line in lines).encode()


def with_vertex_count(header: bytes, count: int) -> bytes:
    """A PLY file's header that announces another number of vertices; all else stays."""
    return re.sub(
        rb"(\n[ \t]*element[ \t]+vertex[ \t]+)\d+",
        lambda match: match.group(1) + str(count).encode(),
        header[:MAX_HEADER_BYTES],
        count=1,
    )


@dataclasses.dataclass
class PlyElement:
    """One table of a PLY file, which PLY calls an element."""

    name: str
    row_count: int
    # (name of a property, NumPy's type or LIST_TYPE), in the file's order.
    fields: list[tuple[str, str]] = dataclasses.field(default_factory=list)
    # The offset of the first row in the file, in bytes; -1 from the first table with lists on,
    # because the size of such a table is known only after reading it, and in text files.
    start_byte: int = -1
    start_line: int = -1  # the first row's line after the header of a text file; -1 in binary files

    @property
    def property_names(self) -> list[str]:
        """The names of the properties, in the file's order."""
        return [name for name, _ in self.fields]

    @property
    def has_lists(self) -> bool:
        """Whether a property is a list."""
        return any(field_type == LIST_TYPE for _, field_type in self.fields)


class PlyTables:
    """The header of a PLY file, and its tables; in a binary file up to the first one with lists."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        """Read the header of a file.

        Raises:
            InputError: the file is no PLY file, its header is broken or has no end, or the file
                is too short for the tables that the header announces.
        """
        self.path = path
        self.file_bytes = check_file(path, "PLY file")
        self.elements: list[PlyElement] = []
        # The first word of each comment, and its other words.
        self.comments: dict[str, list[str]] = {}
        self.generator: str | None = None  # the program that wrote the file, if a comment says so
        self.is_text = False
        self._byte_order = ""  # NumPy's sign of it, once the format line has been read
        self._first_byte = 0  # of the tables

        with open(path, "rb") as file:
            head = file.read(MAX_HEADER_BYTES)
        first_line = head.split(b"\n", 1)[0].rstrip()
        kind = kind_of_bytes(head[:HEAD_BYTES])
        if kind in (GIT_LFS, WEB_PAGE):
            raise InputError(f"{path}: a {kind.name} file, no scene: {kind.advice}")
        if first_line != b"ply":
            problem = "not a PLY file: its first line must be 'ply'"
            raise InputError(f"{path}: {problem} (`spackle predict` makes one)")
        end_line = re.search(rb"\n[ \t]*end_header[ \t\r]*\n", head)
        if end_line is None:
            raise InputError(f"{path}: the header has no end: the file is damaged or cut off")

        # The parser unpacks whatever a line holds; a broken one raises one of these errors.
        with as_input_error(path, "broken PLY header: {reason}", ValueError, KeyError, IndexError):
            lines = head[: end_line.start()].decode("latin-1").split("\n")
            for line in lines[1:]:  # the first line is "ply"
                self._parse_line(line.split())
            if not self._byte_order:
                raise ValueError("there is no format line")
            self._first_byte = end_line.end()
            if self.is_text:
                self._set_start_lines()
            else:
                self._set_start_bytes(self._first_byte)

    def elements_named(self, name: str) -> list[PlyElement]:
        """Return the tables with this name; a sound file has at most one."""
        return [element for element in self.elements if element.name == name]

    def has_known_place(self, element: PlyElement) -> bool:
        """Return whether the rows of a table can be read: they have no lists, nor tables before."""
        is_placed = element.start_byte >= 0 or element.start_line >= 0
        return is_placed and not element.has_lists

    @property
    def is_compressed(self) -> bool:
        """Whether the vertices are packed between the bounds of chunks, or are said to be so."""
        vertex_names = [
            name for element in self.elements_named("vertex") for name in element.property_names
        ]
        has_packed_vertices = any(name.startswith(PACKED_PREFIX) for name in vertex_names)
        return has_packed_vertices or bool(self.elements_named(CHUNK_TABLE))

    @property
    def movable_vertices(self) -> PlyElement | None:
        """The table of Gaussians if its rows can be copied byte for byte, else None.

        They cannot in a text file, or in a compressed one, whose chunks refer to places of rows.
        """
        vertices = self.elements_named("vertex")
        if self.is_text or self.is_compressed or len(vertices) != 1:
            return None
        return vertices[0] if self.has_known_place(vertices[0]) else None

    def rows(self, element: PlyElement) -> NDArray[Any]:
        """Read the rows of a table, as a structured array [row_count].

        Raises:
            InputError: a row of a text file is no row of numbers, or is missing.
        """
        if self.is_text:
            return self._text_rows(element)
        return np.fromfile(self.path, element.fields, element.row_count, offset=element.start_byte)

    def _text_rows(self, element: PlyElement) -> NDArray[Any]:
        """Read the rows of a table of a text file, as a structured array [row_count]."""
        table = np.empty(element.row_count, element.fields)
        problem = f"a row of {element.name!r} cannot be read: {{reason}}: export the file again"
        with open(self.path, "rb") as file, as_input_error(self.path, problem, ValueError):
            file.seek(self._first_byte)
            filled_lines = (line for line in file if line.strip())
            last_line = element.start_line + element.row_count
            lines = itertools.islice(filled_lines, element.start_line, last_line)
            for start in range(0, element.row_count, TEXT_BLOCK_LINES):
                stop = min(start + TEXT_BLOCK_LINES, element.row_count)
                block_lines = list(itertools.islice(lines, stop - start))
                if len(block_lines) < stop - start:
                    raise ValueError("the file is cut off")
                numbers = np.loadtxt(block_lines, np.float64, comments=None, ndmin=2)
                if numbers.shape != (stop - start, len(element.fields)):
                    raise ValueError(f"{numbers.shape[1]} numbers for {len(element.fields)}")
                # Numbers beyond their type become infinite, or any whole number.
                with np.errstate(over="ignore", invalid="ignore"):
                    for column, name in enumerate(element.property_names):
                        table[name][start:stop] = numbers[:, column]
        return table

    def small_columns(self, max_rows: int) -> dict[str, NDArray[np.float64]]:
        """Read all tables of at most `max_rows` rows, except that of the vertices.

        Programs store a camera, for example, in such tables.

        Returns:
            The numbers of each property [row_count] by the property's name.
        """
        columns = {}
        for element in self.elements:
            is_readable = self.has_known_place(element) and bool(element.fields)
            if element.name == "vertex" or not is_readable or element.row_count > max_rows:
                continue
            for name in element.property_names:
                columns[name] = self.rows(element)[name].astype(np.float64)
        return columns

    def numbers_in_comment(
        self, comment: str, count: int, lowest: float = 0, highest: float = math.inf
    ) -> list[float] | None:
        """Return the numbers after the first word `comment` of one of Spackle's comments.

        Args:
            comment: the comment's first word, such as "spackle_camera".
            count: how many numbers the comment must have.
            lowest, highest: bounds of the numbers.

        Returns:
            The numbers; None if the file does not have this comment.

        Raises:
            InputError: there are more or fewer numbers, or one is out of bounds or not finite.
        """
        words = self.comments.get(comment)
        if words is None:
            return None
        subject = comment.removeprefix("spackle_")
        problem = f"the stored {subject} makes no sense: {{reason}}"
        with as_input_error(self.path, problem, ValueError):
            numbers = [float(word) for word in words]
            are_in_bounds = all(
                math.isfinite(number) and lowest <= number <= highest for number in numbers
            )
            if len(numbers) != count or not are_in_bounds:
                raise ValueError(" ".join(words))
        return numbers

    def _parse_line(self, words: list[str]) -> None:
        """Take one line of the header into `elements` and `comments`.

        Lines are, for example, "format binary_little_endian 1.0", "comment made by hand",
        "element vertex 100" (a table of 100 rows), and "property float x" (a column of the
        table before).

        Args:
            words: the line, split into words.

        Raises:
            ValueError, KeyError, IndexError: the line has no meaning, or stands in a wrong place.
        """
        match words:
            case ["comment", name, *others]:
                self.comments[name] = others
                # As in "Generated by Nerfstudio 1.1.5".
                if name.lower() == "generated" and others[:1] == ["by"]:
                    self.generator = " ".join(others[1:])
            case [] | ["comment" | "obj_info", *_]:
                pass
            case ["format", format_name, _]:
                self._byte_order = NUMPY_BYTE_ORDERS[format_name]
                self.is_text = format_name == "ascii"
            case ["element", name, row_count] if int(row_count) >= 0:
                self.elements.append(PlyElement(name, int(row_count)))
            case ["property", "list", _, _, name]:
                self.elements[-1].fields.append((name, LIST_TYPE))
            case ["property", type_name, name] if self._byte_order:
                numpy_type = self._byte_order + NUMPY_TYPES[type_name]
                self.elements[-1].fields.append((name, numpy_type))
            case _:
                raise ValueError(f"cannot understand the line {' '.join(words)[:80]!r}")

    def _set_start_lines(self) -> None:
        """Set in which line of a text file each table starts; each row is a line.

        Raises:
            InputError: the file is too short.
            ValueError: two properties of a table have the same name.
        """
        start_line = 0
        for element in self.elements:
            element.start_line = start_line
            start_line += element.row_count
            if not element.has_lists:
                np.dtype(element.fields)  # raises for two equal names
            # A list has at least the number of its items.
            min_bytes = element.row_count * MIN_TEXT_BYTES * len(element.fields)
            if min_bytes > self.file_bytes + 1:  # the last line may have no end
                announced = f"{element.row_count} rows of {element.name!r} are announced"
                ending = f"but the file ends after {self.file_bytes} bytes"
                raise InputError(f"{self.path}: cut off: {announced}, {ending}")

    def _set_start_bytes(self, first_byte: int) -> None:
        """Set where each table starts, up to the first one with lists.

        Args:
            first_byte: the offset of the first table in the file.

        Raises:
            InputError: the file is too short.
            ValueError: two properties of a table have the same name.
        """
        start_byte = first_byte
        for element in self.elements:
            if element.has_lists:
                return
            element.start_byte = start_byte
            row_bytes = np.dtype(element.fields).itemsize
            start_byte += element.row_count * row_bytes
            if start_byte > self.file_bytes:
                announced = f"{element.row_count} rows of {element.name!r} are announced"
                ending = f"but the file ends after {self.file_bytes} bytes"
                raise InputError(f"{self.path}: cut off: {announced}, {ending}")
