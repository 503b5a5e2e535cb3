"""Read what an untrusted JPEG, HEIF or XMP holds beside the picture."""

from __future__ import annotations

import io
import math
import re
import struct
from collections.abc import Iterator
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

from PIL.JpegImagePlugin import JpegImageFile

XMP, MORE_XMP = b"http://ns.adobe.com/xap/1.0/\0", b"http://ns.adobe.com/xmp/extension/\0"
MAX_PICTURES = 64
_GUID = re.compile(rb"HasExtendedXMP\s*(?:=\s*[\"']|>\s*)([0-9A-Fa-f]{32})")
_PICTURES = 0xB002


def open_jpeg(data: bytes) -> JpegImageFile | None:
    """A JPEG, opened with only its header read; None if Pillow cannot open it."""
    try:
        return JpegImageFile(io.BytesIO(data))
    except Exception:
        return None


def xmp_of(image: JpegImageFile | None) -> bytes:
    """The main XMP packet; empty if there is none."""
    segments = [] if image is None else image.applist
    return next(
        (body[len(XMP) :] for name, body in segments if name == "APP1" and body.startswith(XMP)),
        b"",
    )


def extended_xmp_of(image: JpegImageFile) -> bytes:
    """The extended XMP, which did not fit into the main packet; empty if there is none or a part is missing."""
    named = _GUID.search(xmp_of(image))
    bodies = [
        body.removeprefix(MORE_XMP)
        for name, body in image.applist
        if name == "APP1" and MORE_XMP in body[:40]
    ]
    parts = [body for body in bodies if named and body[:32].lower() == named[1].lower()]
    joined = b"".join(part[40:] for part in sorted(parts, key=lambda part: part[36:40]))
    return joined if parts and parts[0][32:36] == len(joined).to_bytes(4, "big") else b""


def further_pictures(image: JpegImageFile) -> list[tuple[int, int]]:
    """(begin, end) of the pictures that the Multi-Picture Format lists after the first, even beyond the file's end."""
    try:  # the offsets count from the list's byte order mark
        starts = [
            (image.info["mpoffset"] + entry["DataOffset"], entry["Size"])
            for entry in (image._getmp() or {})[_PICTURES]
        ]
    except Exception:  # there is no list, or none that can be read
        return []
    return [(start, start + size) for start, size in starts[1:MAX_PICTURES]]


def xmp_packets(data: bytes) -> Iterator[bytes]:
    """The XMP packets that are stored uncompressed in a file."""
    for part in data.split(b"<x:xmpmeta", MAX_PICTURES)[1:]:
        body, end, _ = part.partition(b"</x:xmpmeta>")
        yield b"<x:xmpmeta" + body + end


# Turns are steps: t swaps rows and columns, x left and right, y top and bottom.
BY_ORIENTATION = {
    2: "x",
    3: "xy",
    4: "y",
    5: "t",
    6: "tx",
    7: "txy",
    8: "ty",
}  # steps that make EXIF's upright
# `irot` holds the number of anticlockwise quarter turns; `imir` is 0 if top and bottom are swapped.
_TURNS = {b"irot": ("", "ty", "xy", "tx"), b"imir": ("y", "x")}
_DEPTH_TYPES = {b"urn:mpeg:hevc:2015:auxid:2", b"urn:mpeg:avc:2015:auxid:2"}
_DEPTH_TYPES |= {b"urn:mpeg:mpegB:cicp:systems:auxiliary:depth"}
Boxes = Iterator[tuple[bytes, memoryview]]


def turn_of_depth_item(data: bytes) -> str | None:
    """The turn that a HEIF's depth map still needs after decoding; None for broken boxes, no map or several maps."""
    try:
        content = next(body for kind, body in _boxes(memoryview(data)) if kind == b"meta")
        meta = dict(_boxes(content[4:]))
        (primary,) = struct.unpack_from(">I" if meta[b"pitm"][0] else ">H", meta[b"pitm"], 4)
        properties = _properties(meta[b"iprp"])
    except (struct.error, KeyError, IndexError, ValueError, StopIteration):
        return None
    depth = [boxes for boxes in properties.values() if _types(boxes) & _DEPTH_TYPES]
    if len(depth) != 1:
        return None
    # A decoder applies the map's turn. Apple turns the picture and leaves the map as the sensor saw it.
    own, of_primary = _turn(depth[0]), _turn(properties.get(primary, []))
    return of_primary or "" if own is None else ""


def _boxes(body: memoryview) -> Boxes:
    """(type, content) of consecutive boxes."""
    at = 0
    while at + 8 <= len(body):
        size, kind = struct.unpack_from(">I4s", body, at)
        head = 16 if size == 1 else 8
        size = struct.unpack_from(">Q", body, at + 8)[0] if size == 1 else size or len(body) - at
        if not head <= size <= len(body) - at:
            raise ValueError("a box that ends beyond its parent")
        yield kind, body[at + head : at + size]
        at += size


def _properties(iprp: memoryview) -> dict[int, list[tuple[bytes, memoryview]]]:
    """The property boxes of each item, in the order in which they apply."""
    parts = list(_boxes(iprp))
    stored = [box for kind, body in parts if kind == b"ipco" for box in _boxes(body)]
    found: dict[int, list[tuple[bytes, memoryview]]] = {}
    for table in (body for kind, body in parts if kind == b"ipma"):
        entry, at = struct.Struct(">IB" if table[0] else ">HB"), 8
        index, mask = ("H", 0x7FFF) if table[3] & 1 else ("B", 0x7F)
        for _ in range(*struct.unpack_from(">I", table, 4)):
            item, count = entry.unpack_from(table, at)
            indices = struct.unpack_from(f">{count}{index}", table, at + entry.size)
            at += entry.size + struct.calcsize(f">{count}{index}")
            found.setdefault(item, []).extend(
                stored[(i & mask) - 1] for i in indices if 1 <= i & mask <= len(stored)
            )
    return found


def _types(properties: list[tuple[bytes, memoryview]]) -> set[bytes]:
    return {bytes(body[4:]).partition(b"\0")[0] for kind, body in properties if kind == b"auxC"}


def _turn(properties: list[tuple[bytes, memoryview]]) -> str | None:
    """Rotations and mirrorings, in the order in which they apply; None if there are none."""
    turns = [
        _TURNS[kind][body[0] % len(_TURNS[kind])]
        for kind, body in properties
        if kind in _TURNS and body
    ]
    return "".join(turns) if turns else None


def parse_xmp(packet: bytes) -> Element:
    """The root element of a packet; ParseError if it is not XML."""
    return ElementTree.fromstring(packet.strip(b"\0"))


def get(node: Element, name: str) -> str | None:
    """A property of this element itself, stored as an attribute or a child element named "{namespace}name"."""
    text = node.get(name)
    text = node.findtext(name) if text is None else text
    return None if text is None else text.strip()


def find(tree: Element, name: str) -> str | None:
    """A property of this element, or of the first element below it that has the property."""
    return next((value for node in tree.iter() if (value := get(node, name)) is not None), None)


def number(tree: Element, name: str) -> float | None:
    """A property, see `find`, as a number; ValueError if it is not a finite number."""
    text = find(tree, name)
    if text is not None and not math.isfinite(float(text)):
        raise ValueError(f"{name.rpartition('}')[2]} is {text}")
    return None if text is None else float(text)
