"""What a stranger's JPEG, HEIF or XMP holds beside the picture, read within bounds."""

from __future__ import annotations

import dataclasses
import math
import re
import struct
from collections.abc import Iterator
from mmap import mmap
from typing import NoReturn
from xml.parsers import expat

from spackle.bases.photo_depth.coded import BY_IMIR, BY_IROT, UPRIGHT, BrokenDepth, Turn
from spackle.errors import reason_in_a_line

Bytes = bytes | mmap

SOI = b"\xff\xd8"
APP1, APP2, SOS, EOI = 0xE1, 0xE2, 0xDA, 0xD9
XMP, MORE_XMP, PICTURES = b"http://ns.adobe.com/xap/1.0/\0", b"http://ns.adobe.com/xmp/extension/\0", b"MPF\0"
GUID = re.compile(rb"HasExtendedXMP\s*(?:=\s*[\"']|>\s*)([0-9A-Fa-f]{32})")
MAX_SEGMENTS = 10_000  # 64 KiB each at most: a hundred times the largest depth map seen
MAX_PICTURES = 64
_PICTURE_LIST = 0xB002
_MARKER = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]")  # in compressed data all others are data or restarts


def segments(data: Bytes, start: int = 0) -> Iterator[tuple[int, int, int]]:
    """(marker, begin, end) of the payloads from the head of the JPEG at `start` to its first scan, that included."""
    at = start + 2
    for _ in range(MAX_SEGMENTS):
        if at + 4 > len(data) or data[at] != 0xFF:
            return
        marker = data[at + 1]
        if marker == 0xFF:  # a fill byte
            at += 1
            continue
        (length,) = struct.unpack(">H", data[at + 2 : at + 4])
        if marker == EOI or length < 2 or at + 2 + length > len(data):
            return
        yield marker, at + 4, at + 2 + length
        if marker == SOS:
            return
        at += 2 + length


def payloads(data: Bytes, start: int, marker: int, signature: bytes) -> Iterator[tuple[int, bytes]]:
    """(place, bytes) of what follows the signature in each segment that has it."""
    for found, begin, end in segments(data, start):
        if found == marker and data[begin : min(end, begin + len(signature))] == signature:
            yield begin + len(signature), data[begin + len(signature) : end]


def xmp_of(data: Bytes, start: int = 0) -> bytes:
    """The main XMP packet of the JPEG at `start`; empty where there is none."""
    return next((body for _, body in payloads(data, start, APP1, XMP)), b"")


def extended_xmp_of(data: Bytes, main: bytes) -> tuple[bytes, bool]:
    """The XMP that did not fit into the main packet, as far as it is there, and whether that is all."""
    named = GUID.search(main)
    if named is None:
        return b"", True
    parts = [body for _, body in payloads(data, 0, APP1, MORE_XMP) if body[:32].lower() == named[1].lower()]
    whole = [(*struct.unpack(">II", part[32:40]), part[40:]) for part in parts if len(part) >= 40]
    joined, lengths = bytearray(), {length for length, _, _ in whole}
    for _, offset, text in sorted(whole, key=lambda part: part[1]):
        if offset != len(joined):
            break
        joined += text
    return bytes(joined), not whole or lengths == {len(joined)}


def end_of_picture(data: Bytes) -> int | None:
    """The first byte behind the JPEG that the file begins with; None where it has no end."""
    at = next((end for marker, _, end in segments(data) if marker == SOS), None)
    for _ in range(MAX_SEGMENTS):
        found = None if at is None else _MARKER.search(data, at)
        if found is None:
            return None
        if data[found.start() + 1] == EOI:
            return found.end()
        lengths = data[found.end() : found.end() + 2]  # tables between two scans, or the next scan's head
        if len(lengths) < 2:
            return None
        at = found.end() + int.from_bytes(lengths, "big")
    return None


def further_pictures(data: Bytes) -> list[tuple[int, int]]:
    """(begin, end) of the pictures that the Multi-Picture Format lists behind the first, as far as they are there."""
    for place, body in payloads(data, 0, APP2, PICTURES):
        order = {b"II*\0": "<", b"MM\0*": ">"}.get(body[:4])
        try:
            entries = _picture_list(body, order) if order else b""
            found = [struct.unpack_from(f"{order}4xII", entries, 16 * i) for i in range(len(entries) // 16)]
        except struct.error:
            return []
        # The first entry is the photo; the offsets of the others count from the byte order mark.
        spans = [(place + offset, place + offset + size) for size, offset in found[1:]]
        return [(begin, end) for begin, end in spans if data[begin : begin + 2] == SOI]
    return []


def _picture_list(body: bytes, order: str) -> bytes:
    """The 16-byte entries of an MPF directory."""
    (directory,) = struct.unpack_from(f"{order}I", body, 4)
    (count,) = struct.unpack_from(f"{order}H", body, directory)
    for index in range(count):
        tag, _, size, at = struct.unpack_from(f"{order}HHII", body, directory + 2 + 12 * index)
        if tag == _PICTURE_LIST:
            return body[at : at + min(size, 16 * MAX_PICTURES)]
    return b""


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


def find_depth_item(data: Bytes) -> tuple[bytes, Turn, Turn] | None:
    """The auxiliary depth map of the primary picture; None without any, MalformedBoxes where the boxes are broken.

    Returns:
        Its XMP, empty if unreachable; its own rotation and mirroring, which a decoder applies; and those of the
        primary picture if it has none of its own.
    """
    meta = next((span for kind, span in _Cursor(data, (0, len(data))).boxes() if kind == b"meta"), None)
    if meta is None:
        raise MalformedBoxes
    found = dict(_Cursor(data, (meta[0] + 4, meta[1])).boxes())
    if not {b"pitm", b"iinf", b"iref", b"iprp"} <= set(found):
        return None
    cursor = _Cursor(data, found[b"pitm"])
    primary = cursor.number(4 if cursor.full()[0] else 2)
    references = list(_references(_Cursor(data, found[b"iref"])))
    properties = _properties(data, found[b"iprp"])
    auxiliary = [source for kind, source, targets in references if kind == b"auxl" and primary in targets]
    depth = []
    for item in auxiliary:
        kinds = (_Cursor(data, (a + 4, b)).text() for kind, (a, b) in properties.get(item, []) if kind == b"auxC")
        if any(kind in DEPTH_TYPES for kind in kinds):
            depth.append(item)
    if not depth:
        return None
    if len(depth) > 1:  # whose XMP describes the one that the decoder picks is unknown
        return b"", UPRIGHT, UPRIGHT
    own, of_primary = (_turn(data, properties.get(item, [])) for item in (depth[0], primary))
    describing = {source for kind, source, targets in references if kind == b"cdsc" and depth[0] in targets}
    try:  # empty where there is none, or none that can be reached
        describing &= set(_xmp_items(_Cursor(data, found[b"iinf"])))
        xmp = next(_packets(data, found, describing), b"")
    except MalformedBoxes:
        xmp = b""
    # Apple rotates the picture and leaves the map as the sensor saw it.
    return xmp, own or UPRIGHT, (own is None and of_primary) or UPRIGHT


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


def _turn(data: Bytes, properties: list[tuple[bytes, Span]]) -> Turn | None:
    """Rotations and mirrorings, in the order in which they apply; None where there is not one."""
    tables, turn = {b"irot": BY_IROT, b"imir": BY_IMIR}, None
    for kind, span in properties:
        if kind in tables:
            table = tables[kind]
            turn = (turn or UPRIGHT).then(table[_Cursor(data, span).number(1) % len(table)])
    return turn


def _xmp_items(cursor: _Cursor) -> Iterator[int]:
    cursor.number(4 if cursor.full()[0] else 2)
    for box, span in cursor.boxes():
        entry = _Cursor(cursor.data, span)
        version = entry.full()[0] if box == b"infe" else 0
        if version not in (2, 3):
            continue
        item, _, kind = entry.number(version * 2 - 2), entry.take(2), entry.take(4)
        _, content = entry.text(), entry.text()
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


MAX_NODES = 20_000
MAX_DEPTH = 64
RDF_ITEM = "http://www.w3.org/1999/02/22-rdf-syntax-ns# li"


@dataclasses.dataclass
class Node:
    """An element. Names are "namespace local"; a property is an attribute or a child element."""

    name: str
    attributes: dict[str, str]
    children: list[Node] = dataclasses.field(default_factory=list)
    texts: list[str] = dataclasses.field(default_factory=list)

    def walk(self) -> Iterator[Node]:
        """Itself and everything below, in the document's order."""
        waiting = [self]
        while waiting:
            node = waiting.pop()
            yield node
            waiting.extend(reversed(node.children))

    def get(self, name: str) -> str | None:
        """A property of this very element."""
        if name in self.attributes:
            return self.attributes[name].strip()
        found = next((child for child in self.children if child.name == name), None)
        return None if found is None else "".join(found.texts).strip()

    def find(self, name: str) -> str | None:
        """A property of this element or the first one below that has it."""
        return next((value for node in self.walk() if (value := node.get(name)) is not None), None)

    def number(self, name: str) -> float | None:
        """A property of this element or one below as a finite number; BrokenDepth where it is something else."""
        text = self.find(name)
        return None if text is None else to_number(text, name)

    def numbers(self, name: str) -> list[float]:
        """A list property, wherever it is; empty where it is missing or holds something else."""
        lists = (node for node in self.walk() if node.name == name)
        entries = [entry for found in lists for entry in found.walk() if entry.name == RDF_ITEM]
        try:
            return [float("".join(entry.texts)) for entry in entries]
        except ValueError:
            return []


def to_number(text: str, name: str) -> float:
    """A finite number; BrokenDepth with the property's name otherwise."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise BrokenDepth(f"has {text[:40]!r} for {name.rpartition(' ')[2]}, which is no number")
    return value


def parse_xmp(packet: bytes) -> Node:
    """The tree under one root; BrokenDepth where the text is no XML, or hostile."""
    root = Node("", {})
    open_nodes, count = [root], 0

    def start(name: str, attributes: dict[str, str]) -> None:
        nonlocal count
        count += 1
        if count > MAX_NODES or len(open_nodes) > MAX_DEPTH:
            raise BrokenDepth("is described by XMP that is too large or too deep")
        node = Node(name, attributes)
        open_nodes[-1].children.append(node)
        open_nodes.append(node)

    def refuse(*_: object) -> NoReturn:
        raise BrokenDepth("is described by XMP with a document type, which is not read")

    parser = expat.ParserCreate(namespace_separator=" ")
    parser.buffer_text = True
    parser.StartElementHandler = start
    parser.EndElementHandler = lambda _: open_nodes.pop()
    parser.CharacterDataHandler = lambda text: open_nodes[-1].texts.append(text)
    parser.StartDoctypeDeclHandler = refuse
    try:
        parser.Parse(packet.strip(b"\0"), True)
    except (expat.ExpatError, ValueError, LookupError) as error:  # the latter two: an encoding that is none
        raise BrokenDepth(f"is described by XMP that cannot be read ({reason_in_a_line(error)})") from error
    return root
