"""What a stranger's JPEG, HEIF or XMP holds beside the picture, read within bounds."""

from __future__ import annotations

import contextlib
import io
import re
import struct
from collections.abc import Iterator
from itertools import accumulate
from xml.etree import ElementTree

from PIL import Image
from PIL.TiffImagePlugin import ImageFileDirectory_v2

from spackle.bases.photo_depth.coded import BrokenDepth, decoding, to_number
from spackle.errors import reason_in_a_line

SOI, SOS, EOI = b"\xff\xd8", 0xDA, 0xD9
XMP, MORE_XMP, PICTURES = b"http://ns.adobe.com/xap/1.0/\0", b"http://ns.adobe.com/xmp/extension/\0", b"MPF\0"
GUID = re.compile(rb"HasExtendedXMP\s*(?:=\s*[\"']|>\s*)([0-9A-Fa-f]{32})")
MAX_SCANS = 10_000
MAX_PICTURES = 64
_PICTURE_LIST = 0xB002
_MARKER = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]")  # in compressed data all others are data or restarts

Segments = list[bytes]  # what a JPEG's application segments hold, in the file's order


def segments_of(data: bytes) -> Segments:
    """The application segments before the first scan of a JPEG; none where Pillow cannot open it."""
    try:
        with decoding(), Image.open(io.BytesIO(data), formats=("JPEG",)) as image:
            return [body for name, body in getattr(image, "applist", []) if name in ("APP1", "APP2")]
    except BrokenDepth:
        return []


def main_xmp(segments: Segments) -> bytes:
    """The main XMP packet of a JPEG; empty where there is none."""
    return next((body[len(XMP) :] for body in segments if body.startswith(XMP)), b"")


def extended_xmp(segments: Segments) -> tuple[bytes, bool]:
    """The XMP that did not fit into the main packet, as far as it is there, and whether that is all."""
    named = GUID.search(main_xmp(segments))
    digest = named[1].lower() if named else b"none"
    bodies = [body[len(MORE_XMP) :] for body in segments if body.startswith(MORE_XMP)]
    parts = [(*struct.unpack(">II", b[32:40]), b[40:]) for b in bodies if len(b) >= 40 and b[:32].lower() == digest]
    parts.sort(key=lambda part: part[1])
    *starts, total = accumulate((len(text) for _, _, text in parts), initial=0)
    whole = all(part[:2] == (total, start) for part, start in zip(parts, starts, strict=True))
    return b"".join(text for _, _, text in parts), whole


def further_pictures(data: bytes, segments: Segments) -> list[tuple[int, int]]:
    """(begin, end) of the pictures that the Multi-Picture Format lists behind the first, as far as they are there."""
    for body in segments:
        if not body.startswith(PICTURES):
            continue
        tags, place = body[len(PICTURES) :], data.find(body) + len(PICTURES)
        with contextlib.suppress(Exception):  # a list that cannot be read names no pictures
            directory = ImageFileDirectory_v2(tags[:8])
            stream = io.BytesIO(tags)
            stream.seek(directory.next)
            directory.load(stream)
            entries = directory[_PICTURE_LIST][: 16 * MAX_PICTURES]
            order = "<" if tags.startswith(b"II") else ">"
            # The first entry is the photo; the offsets of the others count from the byte order mark.
            spans = [(place + at, place + at + size) for size, at in struct.iter_unpack(f"{order}4xII4x", entries)]
            return [(begin, end) for begin, end in spans[1:] if data[begin : begin + 2] == SOI]
    return []


def end_of_picture(data: bytes) -> int | None:
    """The first byte behind the JPEG that the file begins with; None where it has no end."""
    at = 2
    for _ in range(MAX_SCANS):
        found = _MARKER.search(data, at)
        if found is None:
            return None
        if data[found.start() + 1] == EOI:
            return found.end()
        at = found.end() + int.from_bytes(data[found.end() : found.end() + 2], "big")  # a segment, and any scan
    return None


DEPTH_TYPES = (
    b"urn:mpeg:hevc:2015:auxid:2",
    b"urn:mpeg:avc:2015:auxid:2",
    b"urn:mpeg:mpegB:cicp:systems:auxiliary:depth",
)
# How a picture with this EXIF orientation gets upright: t swaps rows and columns, x left and right, y top and bottom.
BY_ORIENTATION = {2: "x", 3: "xy", 4: "y", 5: "t", 6: "tx", 7: "txy", 8: "ty"}
# HEIF's `irot`: so many quarter turns anticlockwise. Its `imir`: 0 swaps top and bottom, 1 left and right.
BY_IROT, BY_IMIR = ("", "ty", "xy", "tx"), ("y", "x")
MAX_PACKETS, MAX_XMP_BYTES = 64, 1 << 20


def heif_turns(data: bytes) -> tuple[str | None, str | None]:
    """How a HEIF turns its auxiliary depth image and its primary picture; None where it does not say, or is broken."""
    with contextlib.suppress(struct.error, KeyError, IndexError):
        meta = dict(_boxes(dict(_boxes(memoryview(data)))[b"meta"][4:]))
        pitm, iref = meta[b"pitm"], meta[b"iref"]
        (primary,) = struct.unpack_from(">I" if pitm[0] else ">H", pitm, 4)
        properties = _properties(meta[b"iprp"])
        for kind, body in _boxes(iref[4:]):
            source, _, target = struct.unpack_from(">IHI" if iref[0] else ">HHH", body)
            auxiliary = [bytes(content) for name, content in properties.get(source, []) if name == b"auxC"]
            if kind == b"auxl" and target == primary and any(c[4:].startswith(DEPTH_TYPES) for c in auxiliary):
                return _turn(properties[source]), _turn(properties.get(primary, []))
    return None, None


def _boxes(body: memoryview) -> Iterator[tuple[bytes, memoryview]]:
    """(type, content) of boxes in a row."""
    at = 0
    while at + 8 <= len(body):
        size, kind = struct.unpack_from(">I4s", body, at)
        head = 16 if size == 1 else 8
        size = struct.unpack_from(">Q", body, at + 8)[0] if size == 1 else size or len(body) - at
        if size < head or at + size > len(body):
            raise IndexError("a box beyond its box")
        yield kind, body[at + head : at + size]
        at += size


def _properties(iprp: memoryview) -> dict[int, list[tuple[bytes, memoryview]]]:
    """The property boxes of each item, in the order in which they apply."""
    parts = dict(_boxes(iprp))
    stored, table = list(_boxes(parts[b"ipco"])), parts[b"ipma"]
    entry = struct.Struct(">IB" if table[0] else ">HB")
    index, mask = ("H", 0x7FFF) if table[3] & 1 else ("B", 0x7F)
    found: dict[int, list[tuple[bytes, memoryview]]] = {}
    at = 8
    for _ in range(*struct.unpack_from(">I", table, 4)):
        item, count = entry.unpack_from(table, at)
        indices = struct.unpack_from(f">{count}{index}", table, at + entry.size)
        at += entry.size + count * struct.calcsize(index)
        found[item] = [stored[(i & mask) - 1] for i in indices if i & mask]
    return found


def _turn(properties: list[tuple[bytes, memoryview]]) -> str | None:
    tables = {b"irot": BY_IROT, b"imir": BY_IMIR}
    turns = [tables[kind][body[0] % len(tables[kind])] for kind, body in properties if kind in tables]
    return "".join(turns) if turns else None


def xmp_packets(data: bytes) -> Iterator[bytes]:
    """XMP packets wherever they are in a file, as XMP is made to be found."""
    begin = data.find(b"<x:xmpmeta")
    for _ in range(MAX_PACKETS):
        end = data.find(b"</x:xmpmeta>", begin) + 12
        if begin < 0 or end < 12:
            return
        if end - begin <= MAX_XMP_BYTES:
            yield data[begin:end]
        begin = data.find(b"<x:xmpmeta", end)


MAX_TAGS = 20_000  # a portrait has some hundreds; deeply nested, so many are still safe
Node = ElementTree.Element  # names are "{namespace}local"; a property is an attribute or a child element


def parse_xmp(packet: bytes) -> Node:
    """The tree of a packet; BrokenDepth where the text is no XML, or hostile."""
    try:
        text = packet.strip(b"\0").decode("utf-8-sig")
        if "<!DOCTYPE" in text:
            raise BrokenDepth("is described by XMP with a document type, which is not read")
        if text.count("<") > MAX_TAGS:
            raise BrokenDepth("is described by XMP that is too large")
        return ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError) as error:
        raise BrokenDepth(f"is described by XMP that cannot be read ({reason_in_a_line(error)})") from error


def get(node: Node, name: str) -> str | None:
    """A property of this very element."""
    text = node.get(name, node.findtext(name))
    return None if text is None else text.strip()


def find(tree: Node, name: str) -> str | None:
    """A property of this element, or the first one below that has it."""
    return next((value for node in tree.iter() if (value := get(node, name)) is not None), None)


def find_number(tree: Node, name: str) -> float | None:
    """The same as a finite number; BrokenDepth where it is something else."""
    text = find(tree, name)
    return None if text is None else to_number(text, name)
