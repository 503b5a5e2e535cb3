"""Photos that bring their depth along, written by the letter of each layout: HEIC, and JPEG in four ways.

The photo's stored pixels are `picture()`, whatever its orientation. Maps are given as codes [H, W], whole
numbers in the orientation of those pixels.
"""

from __future__ import annotations

import base64
import dataclasses
import hashlib
import io
import math
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pillow_heif
from numpy.typing import NDArray
from photos import picture
from PIL import Image, ImageOps

Codes = NDArray[np.uint8] | NDArray[np.uint16]

WIDTH, HEIGHT = 64, 48  # of the photo; maps are half as wide and high
ORIENTATION = 0x0112
RDF = 'xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"'
APPLE = 'xmlns:apdi="http://ns.apple.com/pixeldatainfo/1.0/" xmlns:depthData="http://ns.apple.com/depthData/1.0/"'
GDEPTH = 'xmlns:GDepth="http://ns.google.com/photos/1.0/depthmap/" xmlns:xmpNote="http://ns.adobe.com/xmp/note/"'
DYNAMIC = " ".join(
    f'xmlns:{name}="http://ns.google.com/photos/dd/1.0/{name.lower()}/"'
    for name in ("Device", "Container", "Item", "Camera", "DepthMap", "ImagingModel")
)


def codes(width: int = WIDTH // 2, height: int = HEIGHT // 2) -> NDArray[np.uint8]:
    """A bright box before a dark slope, [H, W], alike in no two corners; all of 0 and 255 occur."""
    y, x = np.mgrid[:height, :width]
    slope = 20 + 2 * x + 3 * y
    slope[height // 4 : height // 2, width // 3 : width // 2] = 200
    slope[0, 0], slope[-1, -1] = 0, 255
    return slope.astype(np.uint8)


def upright(stored: NDArray[Any], orientation: int) -> NDArray[Any]:
    """Pixels as the EXIF orientation turns them."""
    image = Image.fromarray(stored)
    image.getexif()[ORIENTATION] = orientation
    return np.asarray(ImageOps.exif_transpose(image))


def png(values: Codes) -> bytes:
    return _encoded(values, "PNG")


def jpeg(values: NDArray[np.uint8], orientation: int = 1) -> bytes:
    exif = Image.Exif()
    exif[ORIENTATION] = orientation
    return _encoded(values, "JPEG", quality=95, subsampling=0, exif=exif)


def _encoded(values: Codes, kind: str, **options: object) -> bytes:
    file = io.BytesIO()
    Image.fromarray(values).save(file, kind, **options)
    return file.getvalue()


def decoded(image: bytes) -> NDArray[np.uint8]:
    """What Pillow makes of an encoded map."""
    return np.asarray(Image.open(io.BytesIO(image)))


# XMP


def xmp(body: str, names: str) -> bytes:
    packet = f'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF {RDF}><rdf:Description rdf:about="" {names}'
    return (
        f'<?xpacket begin="\ufeff"?>{packet}{body}</rdf:Description></rdf:RDF></x:xmpmeta><?xpacket end="w"?>'.encode()
    )


def apple_xmp(
    native: str | None = "hdis",
    ends: tuple[object, object] = (0.5, 3.0),
    accuracy: str = "relative",
    matrix: tuple[float, ...] | None = None,
    size: tuple[int, int] = (WIDTH, HEIGHT),
    more: str = "",
) -> bytes:
    """What an iPhone writes beside an auxiliary image; `matrix` column by column, for a photo of `size`."""
    body = "><apdi:IntMinValue>0</apdi:IntMinValue><apdi:IntMaxValue>255</apdi:IntMaxValue>"
    body += f"<apdi:FloatMinValue>{ends[0]}</apdi:FloatMinValue><apdi:FloatMaxValue>{ends[1]}</apdi:FloatMaxValue>"
    if native is not None:
        body += f"<apdi:NativeFormat>{int.from_bytes(native.encode(), 'big')}</apdi:NativeFormat>"
    body += f"<depthData:Accuracy>{accuracy}</depthData:Accuracy>"
    if matrix is not None:
        entries = "".join(f"<rdf:li>{entry}</rdf:li>" for entry in matrix)
        body += f"<depthData:IntrinsicMatrix><rdf:Seq>{entries}</rdf:Seq></depthData:IntrinsicMatrix>"
        for side, length in zip(("Width", "Height"), size, strict=True):
            name = f"depthData:IntrinsicMatrixReference{side}"
            body += f"<{name}>{length}</{name}>"
    return xmp(body + more, APPLE)


# JPEG


def segment(marker: int, body: bytes) -> bytes:
    return struct.pack(">BBH", 0xFF, marker, len(body) + 2) + body


def with_segments(image: bytes, *segments: bytes) -> bytes:
    """Further segments at the head of a JPEG."""
    return image[:2] + b"".join(segments) + image[2:]


def xmp_segment(packet: bytes) -> bytes:
    return segment(0xE1, b"http://ns.adobe.com/xap/1.0/\0" + packet)


def extended_segments(packet: bytes, part: int = 1000) -> tuple[str, list[bytes]]:
    """The digest that the main packet has to name, and the parts."""
    digest = hashlib.md5(packet, usedforsecurity=False).hexdigest().upper()
    head = b"http://ns.adobe.com/xmp/extension/\0" + digest.encode()
    return digest, [
        segment(0xE1, head + struct.pack(">II", len(packet), at) + packet[at : at + part])
        for at in range(0, len(packet), part)
    ]


def multi_picture(photo: bytes, *others: bytes, order: str = "<", shift: int = 0) -> bytes:
    """A JPEG with further ones behind it, listed in the Multi-Picture Format; `shift` makes the list lie."""
    count = 1 + len(others)
    length = 8 + 2 + 3 * 12 + 4 + 16 * count
    place = 2 + 4 + 4  # SOI, the segment's head, its signature
    at = len(photo) + 4 + 4 + length
    entries = [struct.pack(f"{order}IIIHH", 0x20030000, at, 0, 0, 0)]
    for other in others:
        entries.append(struct.pack(f"{order}IIIHH", 0, len(other), at - place + shift, 0, 0))
        at += len(other)
    head = {"<": b"II*\0", ">": b"MM\0*"}[order] + struct.pack(f"{order}IH", 8, 3)
    head += struct.pack(f"{order}HHI4s", 0xB000, 7, 4, b"0100") + struct.pack(f"{order}HHII", 0xB001, 4, 1, count)
    head += struct.pack(f"{order}HHIII", 0xB002, 7, 16 * count, 50, 0)
    return with_segments(photo, segment(0xE2, b"MPF\0" + head + b"".join(entries))) + b"".join(others)


def apple_jpeg(map_: NDArray[np.uint8], packet: bytes | None = None, orientation: int = 1, order: str = "<") -> bytes:
    """A portrait with a gain map and a matte before its depth map, as iPhones have them."""
    photo = jpeg(picture(), orientation)
    other = jpeg(np.flipud(map_))
    gain_map = with_segments(other, xmp_segment(xmp("><apdi:StoredFormat>1278226488</apdi:StoredFormat>", APPLE)))
    kind = "<apdi:AuxiliaryImageType>depth</apdi:AuxiliaryImageType>"
    matte = with_segments(other, xmp_segment(apple_xmp("L008", more=kind)))
    depth = with_segments(jpeg(map_), xmp_segment(apple_xmp() if packet is None else packet))
    return multi_picture(photo, gain_map, matte, depth, order=order)


@dataclasses.dataclass(frozen=True)
class Range:
    """What Android's layouts say of a map."""

    near: object = 0.5
    far: object = 8.0
    style: str = "RangeInverse"
    unit: str | None = "m"
    measure: str = "OpticalAxis"

    def properties(self, prefix: str) -> dict[str, object]:
        named = {"Format": self.style, "Near": self.near, "Far": self.far, "MeasureType": self.measure}
        named |= {} if self.unit is None else {"Units": self.unit}
        return {f"{prefix}:{name}": value for name, value in named.items()}


def attributes(properties: dict[str, object]) -> str:
    return "".join(f' {name}="{value}"' for name, value in properties.items())


def elements(properties: dict[str, object]) -> str:
    return "".join(f"<{name}>{value}</{name}>" for name, value in properties.items())


def gdepth_jpeg(
    image: bytes, said: Range | None = None, orientation: int = 1, part: int | None = 1000, text: str | None = None
) -> bytes:
    """The map as base64 in the XMP: in its extension in parts of so many bytes, or in the main packet."""
    properties = (said or Range()).properties("GDepth") | {"GDepth:Mime": "image/png"}
    data = {"GDepth:Data": base64.b64encode(image).decode() if text is None else text}
    photo = jpeg(picture(), orientation)
    if part is None:
        return with_segments(photo, xmp_segment(xmp(attributes(properties | data) + ">", GDEPTH)))
    digest, parts = extended_segments(xmp(attributes(data) + ">", GDEPTH), part)
    main = xmp(attributes(properties | {"xmpNote:HasExtendedXMP": digest}) + ">", GDEPTH)
    return with_segments(photo, xmp_segment(main), *parts)


def dynamic_jpeg(
    image: bytes,
    said: Range | None = None,
    orientation: int = 1,
    padding: int = 0,
    model: dict[str, object] | None = None,
    extended: bool = False,
    length: int | None = None,
    trailer: bytes = b"",
    primary: int = 0,
) -> bytes:
    """The map behind the photo, after another item, where a directory in the (extended) XMP has it."""
    other = jpeg(codes()[::-1])
    depth = {"DepthMap:ItemSemantic": "Depth", **(said or Range(unit="Meters")).properties("DepthMap")}
    depth["DepthMap:DepthURI"] = "android/depthmap"
    entries: list[dict[str, object]] = [
        {"Item:Mime": "image/jpeg", "Item:Length": primary, "Item:DataURI": "primary_image", "Item:Padding": padding},
        {"Item:Mime": "image/jpeg", "Item:Length": len(other), "Item:DataURI": "android/gainmap"},
        {"Item:Mime": "image/png", "Item:Length": len(image) if length is None else length},
    ]
    entries[2]["Item:DataURI"] = "android/depthmap"
    resource = 'rdf:parseType="Resource"'
    if extended:  # as Pixels have it
        inner = (f"<rdf:value {resource}>{elements(entry)}</rdf:value>" for entry in entries)
        items = "".join(f"<rdf:li {resource}>{value}</rdf:li>" for value in inner)
        of_map = f"<Camera:DepthMap {resource}>{elements(depth)}</Camera:DepthMap>"
    else:
        items = "".join(f"<rdf:li><Container:Item{attributes(entry)}/></rdf:li>" for entry in entries)
        of_map = f"<Camera:DepthMap{attributes(depth)}/>"
    lens = "" if model is None else f"<Camera:ImagingModel><rdf:Description{attributes(model)}/></Camera:ImagingModel>"
    body = f"><Device:Cameras><rdf:Seq><rdf:li>{of_map}{lens}</rdf:li></rdf:Seq></Device:Cameras>"
    body += (
        f"<Device:Container><Container:Directory><rdf:Seq>{items}</rdf:Seq></Container:Directory></Device:Container>"
    )
    packet = xmp(body, DYNAMIC)
    segments = [xmp_segment(packet)]
    if extended:
        digest, parts = extended_segments(packet)
        segments = [xmp_segment(xmp(f' xmpNote:HasExtendedXMP="{digest}">', GDEPTH.split()[1])), *parts]
    photo = with_segments(jpeg(picture(), orientation), *segments)
    return photo + b"\0" * padding + other + image + trailer


# HEIC


def heic(
    map_: Codes | None,
    packet: bytes | None = None,
    orientation: int = 1,
    *,
    kind: bytes = b"urn:mpeg:hevc:2015:auxid:2",
    information: bytes = b"",
    own_turn: bool = False,
) -> bytes:
    """A photo with an auxiliary image, encoded by libheif and put together here.

    Args:
        map_: the auxiliary image; None for none.
        packet: its XMP.
        orientation: of the photo, written as HEIF's rotation and mirroring.
        kind: what the auxiliary image is.
        information: HEVC's depth representation information, see `depth_information`.
        own_turn: the auxiliary image gets the photo's rotation and mirroring too.
    """
    photo = _Item.encoded(picture(), orientation)
    items = [photo]
    if map_ is not None:
        turns = [box for box in photo.properties if box[4:8] in (b"irot", b"imir")]
        map_item = _Item.encoded(map_, 1)
        auxiliary = full(b"auxC", 0, kind + b"\0" + information)
        items.append(_Item(b"hvc1", map_item.data, [*map_item.properties, auxiliary, *(turns if own_turn else [])]))
    if packet is not None:
        items.append(_Item(b"mime", packet, []))
    return _file(items)


@dataclasses.dataclass(frozen=True)
class _Item:
    kind: bytes
    data: bytes
    properties: list[bytes]  # whole boxes, in the order in which they apply

    @staticmethod
    def encoded(values: Codes, orientation: int) -> _Item:
        """The one item of what pillow-heif writes, losslessly."""
        file, exif = io.BytesIO(), Image.Exif()
        exif[ORIENTATION] = orientation
        image = pillow_heif.from_pillow(Image.fromarray(values))
        image.info["exif"] = exif.tobytes()
        image.save(file, quality=-1, chroma=444)
        whole = file.getvalue()
        meta = dict(boxes(dict(boxes(whole))[b"meta"][4:]))
        properties = dict(boxes(meta[b"iprp"]))
        wanted = [box(kind, body) for kind, body in boxes(properties[b"ipco"]) if kind != b"colr"]
        at, length = _place(meta[b"iloc"])
        return _Item(b"hvc1", whole[at : at + length], wanted)


def _place(iloc: bytes) -> tuple[int, int]:
    """Where the first item lies, in a box that counts from the file's begin."""
    version, sizes = iloc[0], int.from_bytes(iloc[4:6], "big")
    of_offset, of_length, of_base, of_index = (sizes >> shift & 15 for shift in (12, 8, 4, 0))
    at = 8 + (6 if version else 4) + of_base  # behind number and, since version 1, the method; the file; the base
    base = int.from_bytes(iloc[at - of_base : at], "big")
    at += 2 + (of_index if version else 0)
    offset, length = iloc[at : at + of_offset], iloc[at + of_offset : at + of_offset + of_length]
    return base + int.from_bytes(offset, "big"), int.from_bytes(length, "big")


def _file(items: list[_Item]) -> bytes:
    """A HEIC of these items: the photo, and its auxiliary image and that one's XMP where they are given."""
    entries, associations, stored_properties = b"", b"", b""
    count = 0
    for number, item in enumerate(items, 1):
        mime = b"application/rdf+xml\0" if item.kind == b"mime" else b""
        entries += full(b"infe", 0, struct.pack(">HH4s", number, 0, item.kind) + b"\0" + mime, version=2)
        indices = bytes(range(count + 1, count + 1 + len(item.properties)))
        associations += struct.pack(">HB", number, len(indices)) + indices
        stored_properties += b"".join(item.properties)
        count += len(item.properties)
    association = full(b"ipma", 0, struct.pack(">I", len(items)) + associations)
    links = {2: b"auxl", 3: b"cdsc"}
    references = [box(links[n], struct.pack(">HHH", n, 1, n - 1)) for n in range(2, len(items) + 1)]
    parts = [
        full(b"hdlr", 0, b"\0\0\0\0pict" + bytes(13)),
        full(b"pitm", 0, struct.pack(">H", 1)),
        full(b"iinf", 0, struct.pack(">H", len(items)) + entries),
        *([full(b"iref", 0, b"".join(references))] if references else []),
        box(b"iprp", box(b"ipco", stored_properties) + association),
    ]
    head = box(b"ftyp", b"heic\0\0\0\0mif1heic")
    before = len(head) + 12 + sum(map(len, parts)) + 16 + 14 * len(items) + 8  # meta, iloc and mdat have heads
    where = b""
    for number, item in enumerate(items, 1):
        where += struct.pack(">HHHII", number, 0, 1, before, len(item.data))
        before += len(item.data)
    locations = full(b"iloc", 0, struct.pack(">HH", 0x4400, len(items)) + where)
    return head + full(b"meta", 0, b"".join(parts) + locations) + box(b"mdat", b"".join(i.data for i in items))


def box(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", 8 + len(body)) + kind + body


def full(kind: bytes, flags: int, body: bytes, version: int = 0) -> bytes:
    return box(kind, struct.pack(">I", version << 24 | flags) + body)


def boxes(data: bytes) -> list[tuple[bytes, bytes]]:
    """(type, content) of each."""
    found, at = [], 0
    while at < len(data):
        size, kind = struct.unpack_from(">I4s", data, at)
        found.append((kind, data[at + 8 : at + size]))
        at += size
    return found


def depth_information(kind: int, **values: float) -> bytes:
    """HEVC's depth representation information, of values by name: z_near, z_far, d_min, d_max."""
    names = ("z_near", "z_far", "d_min", "d_max")
    bits = "".join("01"[name in values] for name in names) + _golomb(kind)
    if "d_min" in values or "d_max" in values:
        bits += _golomb(0)
    for name in names:
        if name in values:
            mantissa, exponent = math.frexp(abs(values[name]))
            fraction = round((2 * mantissa - 1) * (1 << 20))
            bits += f"{int(values[name] < 0)}{exponent - 1 + 31:07b}{20 - 1:05b}{fraction:020b}"
    if kind == 3:
        bits += _golomb(0) + _golomb(1) * 2
    bits += "1"
    bits += "0" * (-len(bits) % 8)
    payload = int(bits, 2).to_bytes(len(bits) // 8, "big")
    unit = b"\x4e\x01\xb1" + bytes([len(payload)]) + payload + b"\x20"
    return struct.pack(">II", 4 + len(unit), len(unit)) + unit


def _golomb(value: int) -> str:
    binary = f"{value + 1:b}"
    return "0" * (len(binary) - 1) + binary


def write(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path
