"""The pictures of a HEIF or AVIF, as the file lists them.

Such a file consists of nested boxes. Each picture is an item with properties, such as its size; one
item is the photo (the primary one), others are its tiles, thumbnail, depth map or gain map. Nothing
is decoded here.
"""

from __future__ import annotations

import dataclasses
import struct
from collections.abc import Iterator

# An orientation is a text of steps, which are done from left to right: "t" swaps rows and columns,
# "x" swaps left and right, "y" swaps top and bottom.
STEPS_OF_EXIF_ORIENTATION = {2: "x", 3: "xy", 4: "y", 5: "t", 6: "tx", 7: "txy", 8: "ty"}
# HEIF's box `irot` holds the number of quarter turns against the clock; `imir` holds 0 if top and
# bottom are swapped, 1 if left and right are.
_STEPS_OF_HEIF_BOX = {b"irot": ("", "ty", "xy", "tx"), b"imir": ("y", "x")}

_DEPTH_ITEM_TYPES = {
    b"urn:mpeg:hevc:2015:auxid:2",
    b"urn:mpeg:avc:2015:auxid:2",
    b"urn:mpeg:mpegB:cicp:systems:auxiliary:depth",
}
_ALPHA_ITEM_TYPES = {
    b"urn:mpeg:hevc:2015:auxid:1",
    b"urn:mpeg:avc:2015:auxid:1",
    b"urn:mpeg:mpegB:cicp:systems:auxiliary:alpha",
}
# Items that are pictures; others hold EXIF or XMP.
_PICTURE_TYPES = {b"hvc1", b"av01", b"avc1", b"jpeg", b"grid", b"iden", b"iovl", b"unci", b"vvc1"}
GRID = b"grid"  # the type of an item that is composed of tiles
MAX_ITEMS = 65_536  # a photo of 100 megapixels has some hundred tiles
Box = tuple[bytes, memoryview]  # the type (four letters), and the content
Piece = tuple[memoryview, int, int]  # the file or a box of it; begin and end of bytes in it

# What a broken list of boxes raises.
BOX_ERRORS = (struct.error, KeyError, IndexError, ValueError, StopIteration, OverflowError)


@dataclasses.dataclass(frozen=True)
class HeifItems:
    """The items of a HEIF or AVIF; what is broken or missing is empty."""

    primary: int  # the number of the item that is the photo
    types: dict[int, bytes]  # such as b"hvc1"
    hidden: frozenset[int]  # items that are not for display, such as tiles
    properties: dict[int, list[Box]]  # in the order in which they apply
    references: list[tuple[bytes, int, list[int]]]  # kind, from this item, to these
    _pieces: dict[int, list[Piece]]  # of the bytes of each item
    has_movie: bool  # the file is a sequence, too

    @staticmethod
    def of(data: bytes) -> HeifItems | None:
        """The items of a file; None if it lists none or its list is broken."""
        try:
            # A dict keeps the last box of each type; reversed, that is the first in the file.
            top = dict(reversed(list(_top_boxes(memoryview(data)))))
            # The first 4 bytes of most boxes are version and flags.
            meta = dict(_boxes(top[b"meta"][4:]))
            primary = _primary_item(meta[b"pitm"])
            properties = _properties_of_items(meta[b"iprp"])
        except BOX_ERRORS:
            return None
        types, hidden = _item_infos(meta.get(b"iinf"))
        return HeifItems(
            primary=primary,
            types=types,
            hidden=hidden,
            properties=properties,
            references=_item_references(meta.get(b"iref")),
            _pieces=_item_pieces(memoryview(data), meta.get(b"iloc"), meta.get(b"idat")),
            has_movie=b"moov" in top,
        )

    def property(self, item: int, kind: bytes) -> memoryview | None:
        """The content of an item's first property of a type; None if it has none."""
        for name, content in self.properties.get(item, []):
            if name == kind:
                return content
        return None

    def referred(self, kind: bytes, item: int) -> list[int]:
        """The items to which `item` refers in this way, such as a grid to its tiles (b"dimg")."""
        return [
            target
            for name, source, targets in self.references
            if name == kind and source == item
            for target in targets
        ]

    def content(self, item: int) -> bytes:
        """The bytes of an item; KeyError if it has none, ValueError if they are not in the file."""
        pieces = self._pieces[item]
        if any(end > len(source) for source, _, end in pieces):
            raise ValueError("the file ends before the picture does")
        return b"".join(bytes(source[begin:end]) for source, begin, end in pieces)

    def size(self, item: int) -> tuple[int, int] | None:
        """Width and height of an item as stored, in pixels; None if they are not stated."""
        extents = self.property(item, b"ispe")
        if extents is None or len(extents) < 12:
            return None
        width, height = struct.unpack_from(">II", extents, 4)
        return int(width), int(height)

    def is_turned_sideways(self, item: int) -> bool:
        """Whether the item's rotation swaps its width and height."""
        steps = _orientation_steps(self.properties.get(item, [])) or ""
        return steps.count("t") % 2 == 1

    def alpha_of(self, item: int) -> int | None:
        """The item that holds the opacity of a picture; None without."""
        for kind, source, targets in self.references:
            types = _item_types(self.properties.get(source, []))
            if kind == b"auxl" and item in targets and types & _ALPHA_ITEM_TYPES:
                return source
        return None

    def shown_pictures(self) -> list[int]:
        """The items that are pictures of their own: no tile, thumbnail, mask or gain map."""
        # Tiles, of which other items are derived ("dimg").
        parts = {
            target for kind, _, targets in self.references if kind == b"dimg" for target in targets
        }
        # Thumbnails ("thmb") of other items, and their masks, depth or gain maps ("auxl").
        helpers = {source for kind, source, _ in self.references if kind in (b"thmb", b"auxl")}
        return [
            item
            for item, kind in self.types.items()
            if kind in _PICTURE_TYPES and item not in self.hidden | parts | helpers
        ]


def steps_of_depth_item(data: bytes) -> str | None:
    """The steps that make a HEIF's depth map upright after it was decoded.

    They are letters, done from left to right: "t" swaps rows and columns, "x" left and right, "y"
    top and bottom. None for broken boxes, and if the file has no depth map or several ones.
    """
    items = HeifItems.of(data)
    if items is None:
        return None
    depth_items = [
        boxes for boxes in items.properties.values() if _item_types(boxes) & _DEPTH_ITEM_TYPES
    ]
    if len(depth_items) != 1:
        return None
    # If the map has turns of its own, the decoder has done them, and no step is left.
    if _orientation_steps(depth_items[0]) is not None:
        return ""
    # Apple gives turns to the photo alone, and leaves the map as the sensor saw it.
    photo_steps = _orientation_steps(items.properties.get(items.primary, []))
    return "" if photo_steps is None else photo_steps


def _top_boxes(data: memoryview) -> Iterator[Box]:
    """The boxes of a file, as far as they are whole: the last one may be cut off."""
    try:
        yield from _boxes(data)
    except ValueError:
        return


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


def _item_infos(iinf: memoryview | None) -> tuple[dict[int, bytes], frozenset[int]]:
    """The types of the items, and which of them are hidden, from the content of the box `iinf`."""
    types: dict[int, bytes] = {}
    hidden: set[int] = set()
    if iinf is None:
        return types, frozenset()
    try:
        # Version 0 counts the entries with 2 bytes, later ones with 4.
        entries = iinf[8:] if iinf[0] else iinf[6:]
        for kind, entry in _boxes(entries):
            # Older versions than 2, of the same box in other kinds of files, state no type.
            if kind != b"infe" or entry[0] < 2 or len(types) >= MAX_ITEMS:
                continue
            number = struct.Struct(">H" if entry[0] == 2 else ">I")
            (item,) = number.unpack_from(entry, 4)
            type_begin = 4 + number.size + 2  # behind the number and 2 bytes about protection
            types[item] = bytes(entry[type_begin : type_begin + 4])
            if entry[3] & 1:  # the last flag
                hidden.add(item)
    except BOX_ERRORS:
        pass  # the entries that were read before count
    return types, frozenset(hidden)


def _item_references(iref: memoryview | None) -> list[tuple[bytes, int, list[int]]]:
    """(kind, from, to) of the references between items, from the content of the box `iref`."""
    references: list[tuple[bytes, int, list[int]]] = []
    if iref is None:
        return references
    try:
        letter = "I" if iref[0] else "H"  # the width of an item's number
        for kind, body in _boxes(iref[4:]):
            head = struct.Struct(f">{letter}H")
            source, count = head.unpack_from(body, 0)
            targets = struct.unpack_from(f">{count}{letter}", body, head.size)
            references.append((kind, source, list(targets)))
    except BOX_ERRORS:
        pass  # the references that were read before count
    return references


def _item_pieces(
    data: memoryview, iloc: memoryview | None, idat: memoryview | None
) -> dict[int, list[Piece]]:
    """Where each item's content lies, from the content of the box `iloc`: one or several pieces.

    A piece is (the bytes in which it lies, its begin, its end).

    Args:
        data: the file, in which most items lie.
        iloc: the content of that box; None without one.
        idat: the content of that box, in which small items may lie; None without one.
    """
    pieces_of_items: dict[int, list[Piece]] = {}
    if iloc is None:
        return pieces_of_items
    try:
        fields = _Fields(iloc)
        version = fields.take(1)
        fields.take(3)  # flags
        sizes = fields.take(2)
        # Four sizes of four bits each; the last one exists from version 1 on.
        offset_size = sizes >> 12
        length_size = sizes >> 8 & 15
        base_size = sizes >> 4 & 15
        index_size = sizes & 15 if version else 0
        number_size = 2 if version < 2 else 4
        for _ in range(min(fields.take(number_size), MAX_ITEMS)):
            item = fields.take(number_size)
            # Where the item lies: 0 in the file, 1 in `idat`, 2 in other items, which is not read.
            method = fields.take(2) & 15 if version else 0
            source = idat if method == 1 else data
            fields.take(2)  # the number of another file; 0 is this one
            base = fields.take(base_size)
            pieces: list[Piece] = []
            for _ in range(fields.take(2)):
                fields.take(index_size)  # a number for items that lie in other items
                begin = base + fields.take(offset_size)
                length = fields.take(length_size)
                if source is not None:
                    end = begin + length if length else len(source)  # 0: up to the end
                    pieces.append((source, begin, end))
            if method in (0, 1):
                pieces_of_items[item] = pieces
    except BOX_ERRORS:
        pass  # the items that were read before count
    return pieces_of_items


class _Fields:
    """Reads consecutive numbers, most significant byte first."""

    def __init__(self, body: memoryview) -> None:
        """Begin at the beginning of `body`."""
        self._body = body
        self._position = 0

    def take(self, size: int) -> int:
        """The next number, of `size` bytes; 0 if it has no bytes. ValueError at the end."""
        end = self._position + size
        if end > len(self._body):
            raise ValueError("a box that ends too early")
        number = int.from_bytes(self._body[self._position : end], "big")
        self._position = end
        return number


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
