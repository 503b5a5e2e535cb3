"""What a JPEG carries beside its picture: XMP, further pictures, and bytes behind its end."""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from mmap import mmap

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
    """The XMP that did not fit into the main packet, put together as far as it is there, and whether that is all.

    Each part names the whole's digest (which the main packet names too), its length and the part's offset.
    """
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
