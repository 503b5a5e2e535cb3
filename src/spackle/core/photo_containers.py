"""Read what an untrusted JPEG or XMP packet holds beside the picture.

A JPEG is a list of segments, some of which hold XMP (XML about the photo); further pictures may
follow the main one. `heif_items.py` and `tiff_directories.py` do the same for HEIF and TIFF.
"""

from __future__ import annotations

import io
import math
import re
from collections.abc import Iterator
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

from PIL.JpegImagePlugin import JpegImageFile

XMP_MAGIC = b"http://ns.adobe.com/xap/1.0/\0"
EXTENDED_XMP_MAGIC = b"http://ns.adobe.com/xmp/extension/\0"
# The main XMP packet names the extended one by a GUID, as an attribute or as an element.
_EXTENDED_XMP_GUID = re.compile(rb"HasExtendedXMP\s*(?:=\s*[\"']|>\s*)([0-9A-Fa-f]{32})")
MAX_PICTURES = 64  # in a file; a photo has a handful
_MPF_TAG_PICTURES = 0xB002  # the list of pictures in the Multi-Picture Format


def open_jpeg(data: bytes) -> JpegImageFile | None:
    """A JPEG, opened with only its header read; None if Pillow cannot open it."""
    try:
        return JpegImageFile(io.BytesIO(data))
    except Exception:  # untrusted bytes can raise any exception in a decoder
        return None


def xmp_of(image: JpegImageFile) -> bytes:
    """The main XMP packet of a JPEG; empty if there is none."""
    for name, body in image.applist:
        if name == "APP1" and body.startswith(XMP_MAGIC):
            return bytes(body[len(XMP_MAGIC) :])
    return b""


def extended_xmp_of(image: JpegImageFile) -> bytes:
    """The extended XMP of a JPEG, which did not fit into the main packet.

    It is empty if there is none, or if a part of it is missing. Each part begins with the GUID that
    the main packet names (32 characters), the length of all parts together and the part's position
    (4 bytes each).
    """
    # Parts of another photo's XMP may lie beside this one's, left by an editor.
    guid = _EXTENDED_XMP_GUID.search(xmp_of(image))
    if guid is None:
        return b""

    parts: list[bytes] = []
    for name, segment in image.applist:
        if name == "APP1" and segment.startswith(EXTENDED_XMP_MAGIC):
            part = segment.removeprefix(EXTENDED_XMP_MAGIC)
            if part[:32].lower() == guid[1].lower():
                parts.append(part)
    if not parts:
        return b""

    # Segments may come in any order.
    parts_in_order = sorted(parts, key=lambda part: part[36:40])
    joined = b"".join(part[40:] for part in parts_in_order)
    stated_length = parts[0][32:36]
    return joined if stated_length == len(joined).to_bytes(4, "big") else b""


def further_pictures(image: JpegImageFile) -> list[tuple[int, int]]:
    """(begin, end) in bytes of the pictures behind the first one in a JPEG file.

    The Multi-Picture Format lists them. A picture may end beyond the file's end, if the file was
    cut off. The list is empty if there is none, or it cannot be read.
    """
    try:
        listing = image._getmp()
        if listing is None:
            return []
        list_begin = image.info["mpoffset"]  # offsets count from the list's byte order mark
        pictures = [
            (list_begin + entry["DataOffset"], entry["Size"])
            for entry in listing[_MPF_TAG_PICTURES]
        ]
    except Exception:  # a broken list can raise any exception
        return []
    return [(begin, begin + size) for begin, size in pictures[1:MAX_PICTURES]]


def xmp_packets(data: bytes) -> Iterator[bytes]:
    """The XMP packets that are stored uncompressed anywhere in a file."""
    for part in data.split(b"<x:xmpmeta", MAX_PICTURES)[1:]:
        body, end, _ = part.partition(b"</x:xmpmeta>")
        yield b"<x:xmpmeta" + body + end


# --- XMP


def parse_xmp(packet: bytes) -> Element:
    """The root element of a packet; ParseError if it is not XML."""
    return ElementTree.fromstring(packet.strip(b"\0"))


def own_property(node: Element, name: str) -> str | None:
    """A property of this element itself, called "{namespace}name"; None if it is missing.

    XMP stores a property as an attribute or as a child element.
    """
    # Writers of XMP choose freely between the two forms.
    text = node.get(name)
    if text is None:
        text = node.findtext(name)
    return None if text is None else text.strip()


def find_property(tree: Element, name: str) -> str | None:
    """A property of this element, or of the first element below it that has the property.

    A property is called "{namespace}name". None if no element has it.
    """
    for node in tree.iter():
        text = own_property(node, name)
        if text is not None:
            return text
    return None


def find_number(tree: Element, name: str) -> float | None:
    """A property of this element, or of one below, as a number; None if it is missing.

    A property is called "{namespace}name". ValueError if it is not a finite number.
    """
    text = find_property(tree, name)
    if text is None:
        return None
    number = float(text)
    if not math.isfinite(number):
        short_name = name.rpartition("}")[2]
        raise ValueError(f"{short_name} is {text}")
    return number
