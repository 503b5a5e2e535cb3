"""Photos that bring their depth along, by the letter of each layout: HEIC as files, and JPEG written in four ways.

The photo's stored pixels are `picture()`, whatever its orientation. Maps are given as codes [H, W], whole
numbers in the orientation of those pixels.
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


def xmp(body: str, names: str) -> bytes:
    """An XMP packet of one description; `body` begins with its further attributes and the end of its tag."""
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
    matrix: tuple[object, ...] | None = None,
    size: tuple[object, object] = (WIDTH, HEIGHT),
    more: str = "",
) -> bytes:
    """What an iPhone writes beside an auxiliary image; `matrix` column by column, for a photo of `size`."""
    said: dict[str, object] = {"apdi:IntMinValue": 0, "apdi:IntMaxValue": 255}
    said |= {"apdi:FloatMinValue": ends[0], "apdi:FloatMaxValue": ends[1], "depthData:Accuracy": accuracy}
    if native is not None:
        said["apdi:NativeFormat"] = int.from_bytes(native.encode(), "big")
    if matrix is not None:
        entries = "".join(f"<rdf:li>{entry}</rdf:li>" for entry in matrix)
        said["depthData:IntrinsicMatrix"] = f"<rdf:Seq>{entries}</rdf:Seq>"
        said["depthData:IntrinsicMatrixReferenceWidth"], said["depthData:IntrinsicMatrixReferenceHeight"] = size
    return xmp(f">{elements(said)}{more}", APPLE)


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
    place, at = 10, len(photo) + 8 + 50 + 16 * count  # of the byte order mark, and of the second picture
    entries = struct.pack(f"{order}IIIHH", 0x20030000, at, 0, 0, 0)
    for other in others:
        entries += struct.pack(f"{order}IIIHH", 0, len(other), at - place + shift, 0, 0)
        at += len(other)
    head = {"<": b"II*\0", ">": b"MM\0*"}[order] + struct.pack(f"{order}IH", 8, 3)
    head += struct.pack(f"{order}HHI4s", 0xB000, 7, 4, b"0100") + struct.pack(f"{order}HHII", 0xB001, 4, 1, count)
    head += struct.pack(f"{order}HHIII", 0xB002, 7, 16 * count, 50, 0)
    return with_segments(photo, segment(0xE2, b"MPF\0" + head + entries)) + b"".join(others)


def apple_jpeg(map_: NDArray[np.uint8], packet: bytes | None = None, orientation: int = 1, order: str = "<") -> bytes:
    """A portrait with a gain map and a matte before its depth map, as iPhones have them."""
    other = jpeg(np.flipud(map_))
    gain_map = with_segments(other, xmp_segment(xmp("><apdi:StoredFormat>1278226488</apdi:StoredFormat>", APPLE)))
    said = apple_xmp("L008", more="<apdi:AuxiliaryImageType>depth</apdi:AuxiliaryImageType>")
    matte = with_segments(other, xmp_segment(said))
    depth = with_segments(jpeg(map_), xmp_segment(apple_xmp() if packet is None else packet))
    return multi_picture(jpeg(picture(), orientation), gain_map, matte, depth, order=order)


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


def gdepth_jpeg(
    image: bytes, said: Range = Range(), orientation: int = 1, part: int | None = 1000, text: str | None = None
) -> bytes:
    """The map as base64 in the XMP: in its extension in parts of so many bytes, or in the main packet."""
    properties = said.properties("GDepth") | {"GDepth:Mime": "image/png"}
    data = {"GDepth:Data": base64.b64encode(image).decode() if text is None else text}
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
    padding: int = 0,
    model: dict[str, object] | None = None,
    extended: bool = False,
    length: int | None = None,
    trailer: bytes = b"",
    primary: int = 0,
) -> bytes:
    """The map behind the photo, after another item, where a directory in the (extended) XMP has it."""
    other, uri = jpeg(codes()[::-1]), "android/depthmap"
    depth = {"DepthMap:ItemSemantic": "Depth", **said.properties("DepthMap"), "DepthMap:DepthURI": uri}
    entries: list[dict[str, object]] = [
        {"Item:Mime": mime, "Item:Length": size, "Item:DataURI": name, "Item:Padding": gap}
        for mime, size, name, gap in (
            ("image/jpeg", primary, "primary_image", padding),
            ("image/jpeg", len(other), "android/gainmap", 0),
            ("image/png", len(image) if length is None else length, uri, 0),
        )
    ]
    resource = 'rdf:parseType="Resource"'
    if extended:  # as Pixels have it
        inner = (f"<rdf:value {resource}>{elements(entry)}</rdf:value>" for entry in entries)
        items = "".join(f"<rdf:li {resource}>{value}</rdf:li>" for value in inner)
        of_map = f"<Camera:DepthMap {resource}>{elements(depth)}</Camera:DepthMap>"
    else:
        items = "".join(f"<rdf:li><Container:Item{attributes(entry)}/></rdf:li>" for entry in entries)
        of_map = f"<Camera:DepthMap{attributes(depth)}/>"
    said_of_lens = attributes({f"ImagingModel:{name}": value for name, value in (model or {}).items()})
    lens = f"<Camera:ImagingModel><rdf:Description{said_of_lens}/></Camera:ImagingModel>" if model else ""
    directory = f"<Container:Directory><rdf:Seq>{items}</rdf:Seq></Container:Directory>"
    body = f"><Device:Cameras><rdf:Seq><rdf:li>{of_map}{lens}</rdf:li></rdf:Seq></Device:Cameras>"
    packet = xmp(f"{body}<Device:Container>{directory}</Device:Container>", DYNAMIC)
    segments = [xmp_segment(packet)]
    if extended:
        digest, parts = extended_segments(packet)
        segments = [xmp_segment(xmp(f' xmpNote:HasExtendedXMP="{digest}">', GDEPTH.split()[1])), *parts]
    photo = with_segments(jpeg(picture(), orientation), *segments)
    return photo + b"\0" * padding + other + image + trailer


HEVC = b"urn:mpeg:hevc:2015:auxid:2"


@functools.cache
def heic_files() -> dict[str, bytes]:
    """By name, what libheif encoded losslessly, and boxes of the letter of the standards were put around."""
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
    """A photo, an auxiliary image of some kind, and XMP behind them, as far as `heic_files` has them.

    The orientation is HEIF's rotation and mirroring of the photo, with `own_turn` of the map too; `information` is
    HEVC's depth representation information.
    """
    shown = "no map" if map_ is None else f"map {zlib.crc32(map_.tobytes()):08x}"
    turned, known = " with its map" if own_turn else "", information or "no range"
    file = heic_files()[f"{shown}, turned {orientation}{turned}, {kind.decode().rpartition(':')[2]}, {known}.heic"]
    return file + (b"" if packet is None else struct.pack(">I4s", 8 + len(packet), b"free") + packet)


def write(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path
