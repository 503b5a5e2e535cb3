"""Read what an untrusted JPEG, HEIF or XMP packet holds beside the picture.

A JPEG is a list of segments, some of which hold XMP (XML about the photo); further pictures may
follow the main one. A HEIF consists of nested boxes; each picture in it is an item with properties.
"""

from __future__ import annotations

import io
import math
import re
import struct
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


# --- Orientation

# An orientation is a text of steps, which are done from left to right: "t" swaps rows and columns,
# "x" swaps left and right, "y" swaps top and bottom.
STEPS_OF_EXIF_ORIENTATION = {2: "x", 3: "xy", 4: "y", 5: "t", 6: "tx", 7: "txy", 8: "ty"}
# HEIF's box `irot` holds the number of quarter turns against the clock; `imir` holds 0 if top and
# bottom are swapped, 1 if left and right are.
_STEPS_OF_HEIF_BOX = {b"irot": ("", "ty", "xy", "tx"), b"imir": ("y", "x")}

# --- HEIF

_DEPTH_ITEM_TYPES = {
    b"urn:mpeg:hevc:2015:auxid:2",
    b"urn:mpeg:avc:2015:auxid:2",
    b"urn:mpeg:mpegB:cicp:systems:auxiliary:depth",
}
Box = tuple[bytes, memoryview]  # the type (four letters), and the content


def steps_of_depth_item(data: bytes) -> str | None:
    """The steps that make a HEIF's depth map upright after it was decoded.

    They are letters, done from left to right: "t" swaps rows and columns, "x" left and right, "y"
    top and bottom. None for broken boxes, and if the file has no depth map or several ones.
    """
    # A HEIF is made of boxes. The box `meta` names the primary item, which is the photo (`pitm`),
    # and lists the properties of all items (`iprp`). In a broken file any of them may be missing.
    try:
        content = next(body for kind, body in _boxes(memoryview(data)) if kind == b"meta")
        meta = dict(_boxes(content[4:]))  # the first 4 bytes are version and flags
        primary_item = _primary_item(meta[b"pitm"])
        properties = _properties_of_items(meta[b"iprp"])
    except (struct.error, KeyError, IndexError, ValueError, StopIteration):
        return None

    depth_items = [boxes for boxes in properties.values() if _item_types(boxes) & _DEPTH_ITEM_TYPES]
    if len(depth_items) != 1:
        return None
    # If the map has turns of its own, the decoder has done them, and no step is left.
    if _orientation_steps(depth_items[0]) is not None:
        return ""
    # Apple gives turns to the photo alone, and leaves the map as the sensor saw it.
    photo_steps = _orientation_steps(properties.get(primary_item, []))
    return "" if photo_steps is None else photo_steps


def _boxes(body: memoryview) -> Iterator[Box]:
    """Consecutive boxes of a HEIF; ValueError if a box ends beyond `body`.

    A box begins with its size (4 bytes) and type (4 bytes). Size 1 means that the size follows in 8
    bytes, size 0 that the box reaches to the end.
    """
    position = 0
    while position + 8 <= len(body):
        size, kind = struct.unpack_from(">I4s", body, position)
        # Sizes include the header.
        header_size = 8
        if size == 1:
            (size,) = struct.unpack_from(">Q", body, position + 8)
            header_size = 16
        elif size == 0:
            size = len(body) - position
        if not header_size <= size <= len(body) - position:
            raise ValueError("a box that ends beyond its parent")
        yield kind, body[position + header_size : position + size]
        position += size


def _primary_item(pitm: memoryview) -> int:
    """The number of the item that is the photo, from the content of the box `pitm`."""
    version = pitm[0]
    (item,) = struct.unpack_from(">I" if version else ">H", pitm, 4)
    return int(item)


def _properties_of_items(iprp: memoryview) -> dict[int, list[Box]]:
    """The property boxes of each item, in the order in which they apply.

    `iprp` is the content of the box of that name: the box `ipco` with all properties, and boxes
    `ipma`, which list for each item the numbers of its properties.
    """
    parts = list(_boxes(iprp))
    all_properties = [box for kind, body in parts if kind == b"ipco" for box in _boxes(body)]
    properties: dict[int, list[Box]] = {}
    for kind, table in parts:
        if kind != b"ipma":
            continue
        # A table begins with its version (1 byte), its flags (3 bytes) and the count of its items
        # (4 bytes). In larger files, version and flags say that numbers are wider.
        version = table[0]
        has_wide_numbers = table[3] & 1  # the last flag
        item_format = struct.Struct(">IB" if version else ">HB")  # item, count of its properties
        number_letter = "H" if has_wide_numbers else "B"
        number_mask = 0x7FFF if has_wide_numbers else 0x7F  # the first bit says "essential"

        (item_count,) = struct.unpack_from(">I", table, 4)
        position = 8
        for _ in range(item_count):
            item, property_count = item_format.unpack_from(table, position)
            position += item_format.size
            numbers_format = struct.Struct(f">{property_count}{number_letter}")
            boxes = properties.setdefault(item, [])
            for stored_number in numbers_format.unpack_from(table, position):
                number = stored_number & number_mask  # from 1; 0 means none
                if 1 <= number <= len(all_properties):
                    boxes.append(all_properties[number - 1])
            position += numbers_format.size
    return properties


def _item_types(properties: list[Box]) -> set[bytes]:
    """What an auxiliary item is, such as depth: the texts in its boxes `auxC`."""
    return {
        bytes(body[4:]).partition(b"\0")[0]  # behind version and flags
        for kind, body in properties
        if kind == b"auxC"
    }


def _orientation_steps(properties: list[Box]) -> str | None:
    """The steps of an item's rotations and mirrorings, in their order; None if there are none.

    They are letters: "t" swaps rows and columns, "x" left and right, "y" top and bottom.
    """
    steps: list[str] = []
    for kind, body in properties:
        # Other properties, such as the size or the colour space, turn nothing.
        if kind not in _STEPS_OF_HEIF_BOX or not body:
            continue
        # The box has one byte. Its lowest bits say which turn it is; the remainder drops the other
        # bits, which are reserved.
        steps_by_value = _STEPS_OF_HEIF_BOX[kind]
        steps.append(steps_by_value[body[0] % len(steps_by_value)])
    return "".join(steps) if steps else None


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
