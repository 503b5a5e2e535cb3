"""Make photos with a depth map inside: HEIC from files, JPEG in Apple's, GDepth's and Dynamic Depth's layouts.

The photo's stored pixels are `picture()` in each EXIF orientation. A map is given as codes [H, W] for these pixels.
"""

from __future__ import annotations

import base64
import dataclasses
import functools
import hashlib
import io
import struct
import tarfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from photos import picture
from PIL import Image, ImageOps

Codes = NDArray[np.uint8] | NDArray[np.uint16]

WIDTH, HEIGHT = 64, 48  # of the photo; maps are half as wide and high
ORIENTATION = 0x0112
APPLE = 'xmlns:apdi="http://ns.apple.com/pixeldatainfo/1.0/" xmlns:depthData="http://ns.apple.com/depthData/1.0/"'
GDEPTH = 'xmlns:GDepth="http://ns.google.com/photos/1.0/depthmap/" xmlns:xmpNote="http://ns.adobe.com/xmp/note/"'
DYNAMIC = " ".join(
    f'xmlns:{name}="http://ns.google.com/photos/dd/1.0/{name.lower()}/"'
    for name in ("Device", "Container", "Item", "Camera", "DepthMap")
)


def codes(width: int = WIDTH // 2, height: int = HEIGHT // 2) -> NDArray[np.uint8]:
    """[H, W]: a bright box in front of a dark slope; the corners differ, and 0 and 255 occur."""
    y, x = np.mgrid[:height, :width]
    slope = 20 + 2 * x + 3 * y
    slope[height // 4 : height // 2, width // 3 : width // 2] = 200
    slope[0, 0], slope[-1, -1] = 0, 255
    return slope.astype(np.uint8)


def upright(stored: NDArray[Any], orientation: int) -> NDArray[Any]:
    """Stored pixels, turned by an EXIF orientation."""
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


def xmp(body: str, names: str) -> bytes:
    """An XMP packet with one description; `body` begins with the rest of the description's tag."""
    rdf = f'<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description rdf:about="" {names}'
    whole = f'<x:xmpmeta xmlns:x="adobe:ns:meta/">{rdf}{body}</rdf:Description></rdf:RDF></x:xmpmeta>'
    return f'<?xpacket begin="\ufeff"?>{whole}<?xpacket end="w"?>'.encode()


def attributes(properties: dict[str, object]) -> str:
    return "".join(f' {name}="{value}"' for name, value in properties.items())


def elements(properties: dict[str, object]) -> str:
    return "".join(f"<{name}>{value}</{name}>" for name, value in properties.items())


def apple_xmp(
    native: str | None = "hdis",
    ends: tuple[object, object] = (0.5, 3.0),
    accuracy: str = "relative",
    more: str = "",
) -> bytes:
    """What an iPhone writes beside an auxiliary image."""
    said: dict[str, object] = {"apdi:IntMinValue": 0, "apdi:IntMaxValue": 255}
    said |= {"apdi:FloatMinValue": ends[0], "apdi:FloatMaxValue": ends[1], "depthData:Accuracy": accuracy}
    if native is not None:
        said["apdi:NativeFormat"] = int.from_bytes(native.encode(), "big")
    return xmp(f">{elements(said)}{more}", APPLE)


def segment(marker: int, body: bytes) -> bytes:
    return struct.pack(">BBH", 0xFF, marker, len(body) + 2) + body


def with_segments(image: bytes, *segments: bytes) -> bytes:
    """Insert segments at the head of a JPEG."""
    return image[:2] + b"".join(segments) + image[2:]


def xmp_segment(packet: bytes) -> bytes:
    return segment(0xE1, b"http://ns.adobe.com/xap/1.0/\0" + packet)


def extended_segments(packet: bytes, part: int = 1000) -> tuple[str, list[bytes]]:
    """The digest that the main packet must name, and the segments of an extended XMP."""
    digest = hashlib.md5(packet, usedforsecurity=False).hexdigest().upper()
    head = b"http://ns.adobe.com/xmp/extension/\0" + digest.encode()
    return digest, [
        segment(0xE1, head + struct.pack(">II", len(packet), at) + packet[at : at + part])
        for at in range(0, len(packet), part)
    ]


def multi_picture(photo: bytes, *others: bytes, shift: int = 0) -> bytes:
    """A JPEG with further JPEGs after it, listed in the Multi-Picture Format with offsets that are wrong by `shift`."""
    count = 1 + len(others)
    place, at = 10, len(photo) + 8 + 50 + 16 * count  # of the byte order mark, and of the second picture
    entries = struct.pack(">IIIHH", 0x20030000, at, 0, 0, 0)
    for other in others:
        entries += struct.pack(">IIIHH", 0, len(other), at - place + shift, 0, 0)
        at += len(other)
    head = b"MM\0*" + struct.pack(">IH", 8, 3)
    head += struct.pack(">HHI4s", 0xB000, 7, 4, b"0100") + struct.pack(">HHII", 0xB001, 4, 1, count)
    head += struct.pack(">HHIII", 0xB002, 7, 16 * count, 50, 0)
    return with_segments(photo, segment(0xE2, b"MPF\0" + head + entries)) + b"".join(others)


def apple_jpeg(map_: NDArray[np.uint8], packet: bytes | None = None, orientation: int = 1) -> bytes:
    """A portrait as iPhones write it: the depth map comes after a gain map and a matte."""
    other = jpeg(np.flipud(map_))
    gain_map = with_segments(other, xmp_segment(xmp("><apdi:StoredFormat>1278226488</apdi:StoredFormat>", APPLE)))
    said = apple_xmp("L008", more="<apdi:AuxiliaryImageType>depth</apdi:AuxiliaryImageType>")
    matte = with_segments(other, xmp_segment(said))
    depth = with_segments(jpeg(map_), xmp_segment(apple_xmp() if packet is None else packet))
    return multi_picture(jpeg(picture(), orientation), gain_map, matte, depth)


@dataclasses.dataclass(frozen=True)
class Range:
    """What Android's layouts state about a map."""

    near: object = 0.5
    far: object = 8.0
    style: str = "RangeInverse"
    unit: str | None = "m"
    measure: str = "OpticalAxis"

    def properties(self, prefix: str) -> dict[str, object]:
        named = {"Format": self.style, "Near": self.near, "Far": self.far, "MeasureType": self.measure}
        named |= {} if self.unit is None else {"Units": self.unit}
        return {f"{prefix}:{name}": value for name, value in named.items()}


def gdepth_jpeg(image: bytes, said: Range = Range(), orientation: int = 1, part: int | None = 1000) -> bytes:
    """The map as base64 in an extended XMP with parts of `part` bytes, or in the main packet if `part` is None."""
    properties = said.properties("GDepth") | {"GDepth:Mime": "image/png"}
    data = {"GDepth:Data": base64.b64encode(image).decode()}
    photo = jpeg(picture(), orientation)
    if part is None:
        return with_segments(photo, xmp_segment(xmp(attributes(properties | data) + ">", GDEPTH)))
    digest, parts = extended_segments(xmp(attributes(data) + ">", GDEPTH), part)
    main = xmp(attributes(properties | {"xmpNote:HasExtendedXMP": digest}) + ">", GDEPTH)
    return with_segments(photo, xmp_segment(main), *parts)


def dynamic_jpeg(
    image: bytes,
    said: Range = Range(unit="Meters"),
    orientation: int = 1,
    extended: bool = False,
    *,
    padding: int = 0,
    length: int | None = None,
    trailer: bytes = b"",
    primary: int = 0,
) -> bytes:
    """The map behind the photo and another item; a directory in the (extended) XMP lists all three."""
    other, uri = jpeg(codes()[::-1]), "android/depthmap"
    depth = {"DepthMap:ItemSemantic": "Depth", **said.properties("DepthMap"), "DepthMap:DepthURI": uri}
    entries: list[dict[str, object]] = [
        {"Item:Mime": "image/jpeg", "Item:Length": primary, "Item:DataURI": "primary_image", "Item:Padding": padding},
        {"Item:Mime": "image/jpeg", "Item:Length": len(other), "Item:DataURI": "android/gainmap"},
        {"Item:Mime": "image/png", "Item:Length": len(image) if length is None else length, "Item:DataURI": uri},
    ]
    resource = 'rdf:parseType="Resource"'
    if extended:  # as Pixels have it
        inner = (f"<rdf:value {resource}>{elements(entry)}</rdf:value>" for entry in entries)
        items = "".join(f"<rdf:li {resource}>{value}</rdf:li>" for value in inner)
        of_map = f"<Camera:DepthMap {resource}>{elements(depth)}</Camera:DepthMap>"
    else:
        items = "".join(f"<rdf:li><Container:Item{attributes(entry)}/></rdf:li>" for entry in entries)
        of_map = f"<Camera:DepthMap{attributes(depth)}/>"
    directory = f"<Container:Directory><rdf:Seq>{items}</rdf:Seq></Container:Directory>"
    body = f"><Device:Cameras><rdf:Seq><rdf:li>{of_map}</rdf:li></rdf:Seq></Device:Cameras>"
    packet = xmp(f"{body}<Device:Container>{directory}</Device:Container>", DYNAMIC)
    segments = [xmp_segment(packet)]
    if extended:
        digest, parts = extended_segments(packet)
        segments = [xmp_segment(xmp(f' xmpNote:HasExtendedXMP="{digest}">', GDEPTH.split()[1])), *parts]
    return with_segments(jpeg(picture(), orientation), *segments) + b"\0" * padding + other + image + trailer


HEVC = b"urn:mpeg:hevc:2015:auxid:2"


@functools.cache
def heic_files() -> dict[str, bytes]:
    """HEIC files by name: their pictures were encoded without loss by libheif, their boxes written by the standards."""
    with tarfile.open(Path(__file__).parent / "data" / "heic_portraits.tar.xz") as archive:
        return {entry.name: archive.extractfile(entry).read() for entry in archive}  # type: ignore[union-attr]


def heic(
    map_: Codes | None,
    packet: bytes | None = None,
    orientation: int = 1,
    *,
    kind: bytes = HEVC,
    information: str = "",
    own_turn: bool = False,
) -> bytes:
    """One of `heic_files`: a photo with an auxiliary image of type `kind`, followed by an XMP packet.

    HEIF properties turn the photo by `orientation`, and with `own_turn` also the map. `information` names the map's
    range in HEVC's depth representation information.
    """
    shown = "no map" if map_ is None else f"map {zlib.crc32(map_.tobytes()):08x}"
    turned, known = " with its map" if own_turn else "", information or "no range"
    file = heic_files()[f"{shown}, turned {orientation}{turned}, {kind.decode().rpartition(':')[2]}, {known}.heic"]
    return file + (b"" if packet is None else struct.pack(">I4s", 8 + len(packet), b"free") + packet)


def write(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path
