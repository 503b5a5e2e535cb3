"""The boxes of a HEIF file, as far as they say which item is a depth map and what it looks like."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

from spackle.bases.photo_depth.jpeg import Bytes
from spackle.bases.photo_depth.turn import BY_IMIR, BY_IROT, UPRIGHT, Turn

DEPTH_TYPES = (
    b"urn:mpeg:hevc:2015:auxid:2",
    b"urn:mpeg:avc:2015:auxid:2",
    b"urn:mpeg:mpegB:cicp:systems:auxiliary:depth",
)
XMP_TYPE = b"application/rdf+xml"
MAX_XMP_BYTES = 1 << 20

Span = tuple[int, int]


class MalformedBoxes(Exception):
    """The file is no HEIF, or not as the standard has it."""


@dataclasses.dataclass(frozen=True)
class DepthItem:
    """The auxiliary depth map of the primary picture."""

    xmp: bytes  # empty where there is none, or none that can be reached
    own_turn: Turn  # the item's rotation and mirroring, which a decoder applies
    turn: Turn  # the primary picture's, where the item has none of its own


class _Cursor:
    """Big-endian numbers one after the other; never beyond the end."""

    def __init__(self, data: Bytes, span: Span) -> None:
        self.data, (self.at, self.end) = data, span

    def take(self, count: int) -> bytes:
        if self.at + count > self.end:
            raise MalformedBoxes
        self.at += count
        return self.data[self.at - count : self.at]

    def number(self, count: int) -> int:
        return int.from_bytes(self.take(count), "big")

    def text(self) -> bytes:
        """Up to the next zero byte."""
        stop = self.data.find(b"\0", self.at, self.end)
        found = self.take((self.end if stop < 0 else stop) - self.at)
        self.at = min(self.at + 1, self.end)
        return found

    def full(self) -> tuple[int, int]:
        """Version and flags of a full box."""
        return self.number(1), self.number(3)

    def boxes(self) -> Iterator[tuple[bytes, Span]]:
        """(type, span of the content) of the boxes from here to the end."""
        while self.at + 8 <= self.end:
            begin = self.at
            size, kind = self.number(4), self.take(4)
            size = self.number(8) if size == 1 else size or self.end - begin
            if size < self.at - begin or begin + size > self.end:
                raise MalformedBoxes
            yield kind, (self.at, begin + size)
            self.at = begin + size


def find_depth_item(data: Bytes) -> DepthItem | None:
    """The depth map of the primary picture; None where there is none.

    Raises:
        MalformedBoxes: it cannot be said.
    """
    meta = next((span for kind, span in _Cursor(data, (0, len(data))).boxes() if kind == b"meta"), None)
    if meta is None:
        raise MalformedBoxes
    found = dict(_Cursor(data, (meta[0] + 4, meta[1])).boxes())
    if not {b"pitm", b"iinf", b"iref", b"iprp"} <= set(found):
        return None
    primary = _primary(_Cursor(data, found[b"pitm"]))
    references = list(_references(_Cursor(data, found[b"iref"])))
    properties = _properties(data, found[b"iprp"])
    auxiliary = [source for kind, source, targets in references if kind == b"auxl" and primary in targets]
    depth = [item for item in auxiliary if _is_depth(data, properties.get(item, []))]
    if not depth:
        return None
    if len(depth) > 1:  # whose XMP describes the one that the decoder picks is unknown
        return DepthItem(b"", UPRIGHT, UPRIGHT)
    own, of_primary = (_turn(data, properties.get(item, [])) for item in (depth[0], primary))
    describing = {source for kind, source, targets in references if kind == b"cdsc" and depth[0] in targets}
    xmp = _xmp(data, found, describing)
    # Apple rotates the picture and leaves the map as the sensor saw it.
    return DepthItem(xmp, own or UPRIGHT, (own is None and of_primary) or UPRIGHT)


def _primary(cursor: _Cursor) -> int:
    version, _ = cursor.full()
    return cursor.number(4 if version else 2)


def _references(cursor: _Cursor) -> Iterator[tuple[bytes, int, list[int]]]:
    """(type, from, to) of each reference between items."""
    width = 4 if cursor.full()[0] else 2
    for kind, span in cursor.boxes():
        inner = _Cursor(cursor.data, span)
        source, count = inner.number(width), inner.number(2)
        yield kind, source, [inner.number(width) for _ in range(count)]


def _properties(data: Bytes, span: Span) -> dict[int, list[tuple[bytes, Span]]]:
    """The property boxes of each item, in the order in which they apply."""
    parts = list(_Cursor(data, span).boxes())
    stored = [box for kind, inner in parts if kind == b"ipco" for box in _Cursor(data, inner).boxes()]
    found: dict[int, list[tuple[bytes, Span]]] = {}
    for cursor in (_Cursor(data, inner) for kind, inner in parts if kind == b"ipma"):
        version, flags = cursor.full()
        width = 2 if flags & 1 else 1
        for _ in range(cursor.number(4)):
            item, count = cursor.number(4 if version else 2), cursor.number(1)
            indices = [cursor.number(width) & (0x7FFF if width == 2 else 0x7F) for _ in range(count)]
            found.setdefault(item, []).extend(stored[i - 1] for i in indices if 1 <= i <= len(stored))
    return found


def _is_depth(data: Bytes, properties: list[tuple[bytes, Span]]) -> bool:
    kinds = (_Cursor(data, (begin + 4, end)).text() for kind, (begin, end) in properties if kind == b"auxC")
    return any(kind in DEPTH_TYPES for kind in kinds)


def _turn(data: Bytes, properties: list[tuple[bytes, Span]]) -> Turn | None:
    """Rotations and mirrorings, in the order in which they apply; None where there is not one."""
    tables, turn = {b"irot": BY_IROT, b"imir": BY_IMIR}, None
    for kind, span in properties:
        if kind in tables:
            table = tables[kind]
            turn = (turn or UPRIGHT).then(table[_Cursor(data, span).number(1) % len(table)])
    return turn


def _xmp(data: Bytes, meta: dict[bytes, Span], items: set[int]) -> bytes:
    """The first XMP among these items; empty where there is none, or none that can be reached."""
    try:
        return next(_packets(data, meta, items & set(_xmp_items(_Cursor(data, meta[b"iinf"])))), b"")
    except MalformedBoxes:
        return b""


def _xmp_items(cursor: _Cursor) -> Iterator[int]:
    cursor.number(4 if cursor.full()[0] else 2)
    for box, span in cursor.boxes():
        entry = _Cursor(cursor.data, span)
        version = entry.full()[0] if box == b"infe" else 0
        if version not in (2, 3):
            continue
        item, _, kind, _, content = (
            entry.number(version * 2 - 2),
            entry.take(2),
            entry.take(4),
            entry.text(),
            entry.text(),
        )
        if kind == b"mime" and content == XMP_TYPE:
            yield item


def _packets(data: Bytes, meta: dict[bytes, Span], items: set[int]) -> Iterator[bytes]:
    """The bytes of these items, as far as they are in the file."""
    if not items or b"iloc" not in meta:
        return
    cursor = _Cursor(data, meta[b"iloc"])
    version, _ = cursor.full()
    sizes = cursor.number(2)
    of_offset, of_length, of_base, of_index = (sizes >> shift & 15 for shift in (12, 8, 4, 0))
    of_index = of_index if version else 0
    for _ in range(cursor.number(4 if version == 2 else 2)):
        item = cursor.number(4 if version == 2 else 2)
        method = cursor.number(2) & 15 if version else 0
        cursor.number(2)  # which file: only this one is read
        base, count = cursor.number(of_base), cursor.number(2)
        if not of_length or method > 1:
            raise MalformedBoxes
        start = base if method == 0 else base + meta.get(b"idat", (len(data), 0))[0]
        extents = []
        for _ in range(count):
            cursor.number(of_index)
            offset, length = cursor.number(of_offset), cursor.number(of_length)
            extents.append((start + offset, start + offset + length))
        if item in items and extents and sum(end - begin for begin, end in extents) <= MAX_XMP_BYTES:
            yield b"".join(data[begin:end] for begin, end in extents)
