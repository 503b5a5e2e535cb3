"""Photo files as cameras and programs write them, made by hand: PNG chunks, TIFF directories, boxes
of HEIF and AVIF, ICC profiles, EXIF; and colour science written out, to compare with.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Mapping, Sequence
from fractions import Fraction
from typing import Any

import av
import numpy as np
import pillow_heif
from numpy.typing import NDArray
from PIL import Image

# Colours and greys of sRGB, each a square of 64 pixels.
PATCHES = np.array(
    [[200, 60, 40], [60, 180, 70], [40, 60, 200], [128, 128, 128], [230, 230, 230], [20, 20, 20]]
)
# Colours that two HDR clips of tests/data/clips hold.
HDR_CLIP_COLORS = np.array(
    [[150, 60, 40], [60, 140, 70], [40, 60, 150], [128, 128, 128], [230, 230, 230]]
)
SQUARE = 64


def squares(colors: NDArray[Any]) -> NDArray[Any]:
    """[64, 64 n, ...] squares of colours [n, ...]."""
    return np.repeat(np.repeat(colors[None], SQUARE, 0), SQUARE, 1)


def colors_of(picture: NDArray[Any]) -> NDArray[Any]:
    """[n, ...] the colours in the middle of the squares of a picture."""
    return picture[SQUARE // 2, SQUARE // 2 :: SQUARE]


# --- Colour science

PRIMARIES = {  # x and y of red, green, blue and white
    "srgb": (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290),
    "adobe": (0.64, 0.33, 0.21, 0.71, 0.15, 0.06, 0.3127, 0.3290),
    "p3": (0.68, 0.32, 0.265, 0.69, 0.15, 0.06, 0.3127, 0.3290),
    "2020": (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, 0.3127, 0.3290),
}


def rgb_to_xyz(name: str) -> NDArray[np.float64]:
    """[3, 3]: the columns are X, Y, Z of red, green and blue; their sum is white with Y = 1."""
    x, y = np.array(PRIMARIES[name]).reshape(4, 2).T
    columns = np.stack([x / y, np.ones(4), (1 - x - y) / y])
    return columns[:, :3] * np.linalg.solve(columns[:, :3], columns[:, 3])


def srgb_light(code: NDArray[Any]) -> NDArray[np.float64]:
    return np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)


def srgb_code(light: NDArray[Any]) -> NDArray[np.float64]:
    light = np.clip(light, 0, 1)
    return np.where(light <= 0.0031308, light * 12.92, 1.055 * light ** (1 / 2.4) - 0.055)


def pq_code(nits: NDArray[Any]) -> NDArray[np.float64]:
    """SMPTE ST 2084."""
    y = (np.asarray(nits) / 10000) ** 0.1593017578125
    return ((0.8359375 + 18.8515625 * y) / (1 + 18.6875 * y)) ** 78.84375


def hlg_code(scene: NDArray[Any]) -> NDArray[np.float64]:
    """ITU-R BT.2100, of the scene's light in 0..1."""
    scene = np.asarray(scene, np.float64)
    curve = 0.17883277 * np.log(np.maximum(12 * scene - 0.28466892, 1e-9)) + 0.55991073
    return np.where(scene <= 1 / 12, np.sqrt(3 * scene), curve)


def as_light(rgb: NDArray[Any], to: str) -> NDArray[np.float64]:
    """Linear light of sRGB in 0..255, in other primaries with the same white."""
    matrix = np.linalg.inv(rgb_to_xyz(to)) @ rgb_to_xyz("srgb")
    return np.clip(srgb_light(rgb / 255) @ matrix.T, 0, None)


def as_srgb(light: NDArray[Any], primaries: str) -> NDArray[np.float64]:
    """sRGB in 0..1 of linear light in other primaries with the same white; clipped."""
    matrix = np.linalg.inv(rgb_to_xyz("srgb")) @ rgb_to_xyz(primaries)
    return srgb_code(light @ matrix.T)


def as_pq(rgb: NDArray[Any], white_nits: float = 203) -> NDArray[np.float64]:
    """Numbers of PQ with the primaries of BT.2020 of sRGB in 0..255, its white at `white_nits`."""
    return pq_code(as_light(rgb, "2020") * white_nits)


def as_hlg(rgb: NDArray[Any]) -> NDArray[np.float64]:
    """Numbers of HLG with the primaries of BT.2020 of sRGB in 0..255, its white at 203 nits."""
    display = as_light(rgb, "2020") * 203 / 1000
    luminance = display @ np.array([0.2627, 0.6780, 0.0593])
    scene = display * np.maximum(luminance, 1e-9)[..., None] ** ((1 - 1.2) / 1.2)
    return hlg_code(scene)


# --- ICC


def icc_profile(
    primaries: str, gamma: float | None, *, kind: bytes = b"RGB ", cicp: bytes = b""
) -> bytes:
    """A profile of version 2 with three primaries and curves; without gamma, those of sRGB.

    `kind` b"GRAY" makes one with a single curve. `cicp` adds the tag of that name.
    """
    bradford = np.array(
        [[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]]
    )
    d50 = np.array([0.9642, 1.0, 0.8249])
    matrix = rgb_to_xyz(primaries)
    gains = (bradford @ d50) / (bradford @ matrix.sum(axis=1))
    colorants = np.linalg.inv(bradford) @ np.diag(gains) @ bradford @ matrix

    def xyz(values: Any) -> bytes:
        return b"XYZ \0\0\0\0" + struct.pack(">3i", *(round(v * 65536) for v in values))

    if gamma is None:
        table = (srgb_light(np.linspace(0, 1, 1024)) * 65535).round().astype(">u2")
        curve = b"curv\0\0\0\0" + struct.pack(">I", len(table)) + table.tobytes()
    else:
        curve = b"curv\0\0\0\0" + struct.pack(">IH", 1, round(gamma * 256))
    name = b"made by hand\0"
    tags = {
        b"desc": b"desc\0\0\0\0" + struct.pack(">I", len(name)) + name + bytes(78),
        b"cprt": b"text\0\0\0\0none\0",
        b"wtpt": xyz(d50),
    }
    if kind == b"GRAY":
        tags[b"kTRC"] = curve
    else:
        tags |= dict(zip((b"rXYZ", b"gXYZ", b"bXYZ"), map(xyz, colorants.T), strict=True))
        tags |= dict.fromkeys((b"rTRC", b"gTRC", b"bTRC"), curve)
    if cicp:
        tags[b"cicp"] = b"cicp\0\0\0\0" + cicp

    place = 128 + 4 + 12 * len(tags)
    table_of_tags, body = struct.pack(">I", len(tags)), b""
    for tag, content in tags.items():
        padded = content + bytes(-len(content) % 4)
        table_of_tags += tag + struct.pack(">II", place + len(body), len(content))
        body += padded
    size = place + len(body)
    head = struct.pack(">I4sI4s4s4s", size, b"none", 0x02400000, b"mntr", kind, b"XYZ ")
    head += struct.pack(">6H", 2024, 1, 1, 0, 0, 0) + b"acsp" + bytes(28)
    head += struct.pack(">3i", *(round(v * 65536) for v in d50))
    return head.ljust(128, b"\0") + table_of_tags + body


# --- PNG


def png(pixels: NDArray[Any], *chunks: tuple[bytes, bytes]) -> bytes:
    """A PNG of uint8 or uint16 [H, W] or [H, W, 1..4], with chunks (name, content) before IDAT."""
    pixels = pixels[..., None] if pixels.ndim == 2 else pixels
    height, width, channels = pixels.shape
    rows = b"".join(b"\0" + row.astype(pixels.dtype.newbyteorder(">")).tobytes() for row in pixels)
    color_type = {1: 0, 2: 4, 3: 2, 4: 6}[channels]
    bits = 8 * pixels.dtype.itemsize
    header = struct.pack(">IIBBBBB", width, height, bits, color_type, 0, 0, 0)
    parts = [(b"IHDR", header), *chunks, (b"IDAT", zlib.compress(rows)), (b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))
        for name, body in parts
    )


def chrm(name: str) -> bytes:
    """The content of a PNG's chunk cHRM: white, red, green, blue."""
    numbers = PRIMARIES[name]
    in_order = (*numbers[6:], *numbers[:6])
    return struct.pack(">8I", *(round(100_000 * number) for number in in_order))


# --- TIFF and raw files

Tags = Mapping[int, tuple[int, Any]]  # number → type of TIFF, and numbers or bytes


class TiffFile:
    """A TIFF that is put together piece by piece."""

    def __init__(self, order: str = "<", number: int = 42) -> None:
        self.order = order
        self.content = {"<": b"II", ">": b"MM"}[order] + struct.pack(f"{order}HI", number, 0)

    def add(self, content: bytes) -> int:
        """Append bytes; returns where they begin."""
        self.content += bytes(len(self.content) % 2)
        place = len(self.content)
        self.content += content
        return place

    def add_directory(self, tags: Tags, following: int = 0) -> int:
        """Append a directory; returns where it begins."""
        letters = {1: "B", 2: "s", 3: "H", 4: "I", 5: "I", 7: "s"}
        entries = b""
        for tag, (kind, value) in sorted(tags.items()):
            if isinstance(value, bytes):
                count, packed = len(value), value
            else:
                packed = struct.pack(f"{self.order}{len(value)}{letters[kind]}", *value)
                count = len(value) // 2 if kind == 5 else len(value)
            if len(packed) > 4:
                packed = struct.pack(f"{self.order}I", self.add(packed))
            entries += struct.pack(f"{self.order}HHI", tag, kind, count) + packed.ljust(4, b"\0")
        head = struct.pack(f"{self.order}H", len(tags))
        return self.add(head + entries + struct.pack(f"{self.order}I", following))

    def begin_with(self, directory: int) -> bytes:
        """The file, whose first directory is this one."""
        return self.content[:4] + struct.pack(f"{self.order}I", directory) + self.content[8:]


def picture_tags(
    file: TiffFile, pixels: NDArray[Any], photometric: int = 2, reduced: bool = False
) -> dict[int, tuple[int, Any]]:
    """The tags of an uncompressed picture [H, W] or [H, W, C], whose pixels are added to a file."""
    height, width = pixels.shape[:2]
    channels = 1 if pixels.ndim == 2 else pixels.shape[2]
    data = pixels.astype(pixels.dtype.newbyteorder(file.order)).tobytes()
    return {
        254: (4, [int(reduced)]),
        256: (4, [width]),
        257: (4, [height]),
        258: (3, [8 * pixels.dtype.itemsize] * channels),
        259: (3, [1]),
        262: (3, [photometric]),
        273: (4, [file.add(data)]),
        277: (3, [channels]),
        278: (4, [height]),
        279: (4, [len(data)]),
    }


def tiff(pixels: NDArray[Any], extra: Tags | None = None, **options: Any) -> bytes:
    """An uncompressed TIFF of one picture, with further tags."""
    file = TiffFile()
    return file.begin_with(
        file.add_directory({**picture_tags(file, pixels, **options), **(extra or {})})
    )


def packed(content: bytes, row_bytes: int, compression: int) -> bytes:
    """Bytes as a strip of a TIFF: 1 as they are, 5 by LZW, 8 by Deflate, 32773 by PackBits."""
    if compression == 1:
        return content
    if compression == 8:
        return zlib.compress(content)
    name = {5: "tiff_lzw", 32773: "packbits"}[compression]
    file = io.BytesIO()
    grey = Image.frombytes("L", (row_bytes, len(content) // row_bytes), content)
    grey.save(file, "TIFF", compression=name, tiffinfo={278: grey.height})
    with Image.open(file) as image:
        ((begin,), (length,)) = image.tag_v2[273], image.tag_v2[279]  # type: ignore[attr-defined]
    return file.getvalue()[begin : begin + length]


def deep_tiff(
    pixels: NDArray[np.uint16],
    *,
    order: str = "<",
    compression: int = 1,
    predictor: bool = False,
    planar: bool = False,
    tile: tuple[int, int] | None = None,
    rows_per_strip: int = 7,
) -> bytes:
    """A TIFF of RGB of 16 bits [H, W, 3] in one of the layouts that the format has."""
    file = TiffFile(order)
    height, width = pixels.shape[:2]
    block_height, block_width = tile or (rows_per_strip, width)
    places, sizes = [], []
    for plane in np.moveaxis(pixels, 2, 0)[..., None] if planar else [pixels]:
        for top in range(0, height, block_height):
            for left in range(0, width, block_width):
                block = plane[top : top + block_height, left : left + block_width]
                if tile:
                    missing = [(0, n - m) for n, m in zip(tile, block.shape[:2], strict=True)]
                    block = np.pad(block, [*missing, (0, 0)])
                if predictor:
                    block = np.diff(block, axis=1, prepend=np.zeros_like(block[:, :1]))
                row_bytes = 2 * block[0].size
                content = block.astype(f"{order}u2").tobytes()
                strip = packed(content, row_bytes, compression)
                places.append(file.add(strip))
                sizes.append(len(strip))
    if tile:
        blocks = {322: (4, [tile[1]]), 323: (4, [tile[0]]), 324: (4, places), 325: (4, sizes)}
    else:
        blocks = {273: (4, places), 278: (4, [rows_per_strip]), 279: (4, sizes)}
    tags: Tags = {
        256: (4, [width]),
        257: (4, [height]),
        258: (3, [16] * 3),
        259: (3, [compression]),
        262: (3, [2]),
        277: (3, [3]),
        284: (3, [2 if planar else 1]),
        317: (3, [2 if predictor else 1]),
        **blocks,
    }
    return file.begin_with(file.add_directory(tags))


def jpeg(pixels: NDArray[Any], **options: Any) -> bytes:
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "JPEG", **{"quality": 95, "subsampling": 0, **options})
    return file.getvalue()


def jpeg_of_scans(count: int) -> bytes:
    """A flat progressive JPEG of 4 megapixels whose last scan, of a few bytes, is repeated."""
    content = jpeg(np.full((2048, 2048), 90, np.uint8), progressive=True)
    last_scan = content.rindex(b"\xff\xda")
    scan = content[last_scan:-2]  # without the marker of the end
    return content[:last_scan] + count * scan + content[-2:]


def raw_file(
    thumbnail: NDArray[np.uint8],
    preview: bytes | NDArray[np.uint8] | None,
    sensor: tuple[int, int],
    *,
    order: str = "<",
    orientation: int = 1,
    layout: str = "subifd",
    extra: Tags | None = None,
) -> bytes:
    """A raw file: a thumbnail first, the sensor's data, and a preview (a JPEG, or pixels).

    `layout` says where the preview is: in a directory "subifd", as a "strip" of JPEG, or anywhere
    in the notes of the camera's "maker".
    """
    file = TiffFile(order)
    width, height = sensor
    noise = np.random.default_rng(0).integers(0, 4096, (height, width)).astype(np.uint16)
    below = [file.add_directory({**picture_tags(file, noise, photometric=32803)})]
    if isinstance(preview, bytes):
        place = file.add(preview)
        with Image.open(io.BytesIO(preview)) as image:
            size = {256: (4, [image.width]), 257: (4, [image.height])}
        if layout == "subifd":
            below.append(
                file.add_directory(
                    {254: (4, [1]), 259: (3, [6]), 513: (4, [place]), 514: (4, [len(preview)])}
                )
            )
        elif layout == "strip":
            strip = {259: (3, [7]), 262: (3, [6]), 273: (4, [place]), 279: (4, [len(preview)])}
            below.append(file.add_directory({254: (4, [1]), **size, **strip}))
    elif preview is not None:
        below.append(file.add_directory(picture_tags(file, preview, reduced=True)))
    camera = file.add_directory({0x920A: (5, [50, 1])})
    return file.begin_with(
        file.add_directory(
            {
                **picture_tags(file, thumbnail, reduced=True),
                271: (2, b"Maker\0"),
                274: (3, [orientation]),
                330: (4, below),
                0x8769: (4, [camera]),
                **(extra or {}),
            }
        )
    )


# --- EXIF


def exif(tags: Mapping[int, Any], camera: Mapping[int, Any] | None = None) -> bytes:
    """EXIF with tags of the image, and of the camera."""
    result = Image.Exif()
    result.update(tags)
    result.get_ifd(0x8769).update(camera or {})
    return result.tobytes()


ADOBE_RGB_BY_EXIF = {0xA001: 0xFFFF, 0xA005: {1: "R03", 2: b"0100"}}


# --- HEIF and AVIF


def box(kind: bytes, *parts: bytes) -> bytes:
    body = b"".join(parts)
    return struct.pack(">I", len(body) + 8) + kind + body


def full_box(kind: bytes, *parts: bytes, version: int = 0, flags: int = 0) -> bytes:
    return box(kind, struct.pack(">I", version << 24 | flags), *parts)


def nclx(primaries: int, transfer: int, matrix: int, full_range: bool = True) -> bytes:
    """A box `colr` with numbers of CICP."""
    return box(b"colr", b"nclx", struct.pack(">3HB", primaries, transfer, matrix, full_range << 7))


def ispe(width: int, height: int) -> bytes:
    return full_box(b"ispe", struct.pack(">II", width, height))


def item_file(
    items: Sequence[tuple[bytes, bytes, Sequence[bytes]]],
    *,
    brand: bytes = b"avif",
    references: Sequence[tuple[bytes, int, Sequence[int]]] = (),
    primary: int = 1,
    hidden: Sequence[int] = (),
    others: bytes = b"",
) -> bytes:
    """A HEIF or AVIF of items (type, content, properties), which are numbered from 1.

    References are (kind, from, to). `others` are further boxes of the file.
    """
    properties: list[bytes] = []
    associations = b""
    infos = b""
    for number, (kind, _, own) in enumerate(items, start=1):
        indices = []
        for prop in own:
            properties.append(prop)
            # What a reader must not pass over is marked by the first bit.
            is_essential = prop[4:8] in (b"irot", b"imir", b"av1C")
            indices.append(len(properties) | (0x80 if is_essential else 0))
        associations += struct.pack(f">HB{len(indices)}B", number, len(indices), *indices)
        infos += full_box(
            b"infe", struct.pack(">HH", number, 0), kind, b"\0", version=2, flags=number in hidden
        )
    refs = b"".join(
        box(kind, struct.pack(f">HH{len(to)}H", source, len(to), *to))
        for kind, source, to in references
    )

    def meta(begin: int) -> bytes:
        places, at = b"", begin
        for number, (_, content, _) in enumerate(items, start=1):
            places += struct.pack(">HHHII", number, 0, 1, at, len(content))
            at += len(content)
        return full_box(
            b"meta",
            full_box(b"hdlr", bytes(4), b"pict", bytes(13)),
            full_box(b"pitm", struct.pack(">H", primary)),
            full_box(b"iloc", struct.pack(">HH", 0x4400, len(items)), places),
            full_box(b"iinf", struct.pack(">H", len(items)), infos),
            *([full_box(b"iref", refs)] if refs else []),
            box(
                b"iprp",
                box(b"ipco", *properties),
                full_box(b"ipma", struct.pack(">I", len(items)), associations),
            ),
        )

    head = box(b"ftyp", brand, bytes(4), brand, b"mif1", b"miaf")
    begin = len(head) + len(meta(0)) + len(others) + 8
    return head + meta(begin) + others + box(b"mdat", *(content for _, content, _ in items))


def av1_item(
    code: NDArray[np.float64], *, full_range: bool = True, cicp: tuple[int, int] = (2, 2)
) -> tuple[bytes, list[bytes]]:
    """The content of an AV1 item of 10 bits with the matrix of BT.2020, and its properties.

    `code` [H, W, 3] are RGB numbers in 0..1; `cicp` is what the compressed picture states.
    """
    height, width = code.shape[:2]
    luma = code @ np.array([0.2627, 0.6780, 0.0593])
    planes = [
        luma,
        (code[..., 2] - luma) / (2 * (1 - 0.0593)),
        (code[..., 0] - luma) / (2 * (1 - 0.2627)),
    ]
    steps, black, chroma = (1023, 0, 1023) if full_range else (876, 64, 896)
    numbers = [planes[0] * steps + black, *(plane * chroma + 512 for plane in planes[1:])]
    frame = av.VideoFrame(width, height, "yuv420p10le")
    for plane, values in zip(frame.planes, numbers, strict=True):
        rounded = np.clip(values.round(), 0, 1023).astype("<u2")
        rounded = rounded if plane.width == width else rounded[::2, ::2]
        rows = np.zeros((plane.height, plane.line_size // 2), "<u2")
        rows[:, : plane.width] = rounded
        plane.update(rows.tobytes())
    encoder = av.CodecContext.create("libsvtav1", "w")
    encoder.width, encoder.height, encoder.pix_fmt = width, height, "yuv420p10le"
    encoder.time_base = Fraction(1, 1)
    encoder.options = {"crf": "1", "preset": "8"}
    frame.color_range = encoder.color_range = 2 if full_range else 1
    encoder.color_primaries, encoder.color_trc = cicp
    encoder.colorspace = 9
    frame.pts = 0
    content = b"".join(bytes(packet) for packet in [*encoder.encode(frame), *encoder.encode(None)])
    # Version 1 of the settings; the third byte says 10 bits and 4:2:0.
    settings = box(b"av1C", bytes([0x81, 0x00, 0x4C, 0x00]))
    return content, [ispe(width, height), settings]


def avif(code: NDArray[np.float64], *properties: bytes, full_range: bool = True) -> bytes:
    """An AVIF of 10 bits, of RGB numbers [H, W, 3] in 0..1, with further properties."""
    content, own = av1_item(code, full_range=full_range)
    return item_file([(b"av01", content, [*own, *properties])])


def heic(code: NDArray[np.float64], primaries: int, transfer: int, matrix: int = 9) -> bytes:
    """A HEIC of 10 bits, of RGB numbers [H, W, 3] in 0..1, with CICP and no ICC profile."""
    height, width = code.shape[:2]
    pixels = (np.clip(code, 0, 1) * 65535).round().astype(np.uint16)
    picture = pillow_heif.from_bytes("RGB;16", (width, height), pixels.tobytes())
    file = io.BytesIO()
    picture.save(
        file,
        quality=-1,
        chroma=444,
        color_primaries=primaries,
        transfer_characteristics=transfer,
        matrix_coefficients=matrix,
        full_range_flag=1,
    )
    return file.getvalue()


def gpano(**properties: object) -> bytes:
    """A packet of XMP with Google's properties of panoramas."""
    attributes = " ".join(f'GPano:{name}="{value}"' for name, value in properties.items())
    return (
        '<x:xmpmeta xmlns:x="adobe:ns:meta/">'
        '<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        '<rdf:Description xmlns:GPano="http://ns.google.com/photos/1.0/panorama/" '
        f"{attributes}/></rdf:RDF></x:xmpmeta>"
    ).encode()


# The first bytes of files that are no photos, by the name that a message gives them.
CODES_OF_KINDS = {
    "PostScript": b"%!PS-Adobe-3.0 EPSF-3.0\n",
    "PDF": b"%PDF-1.7\n",
    "Photoshop": b"8BPS\0\1",
    "JPEG XL": b"\xff\x0a\x00\x10",
    "JPEG 2000": b"\0\0\0\x0cjP  \r\n\x87\n",
    "OpenEXR": b"\x76\x2f\x31\x01",
    "SVG": b'<svg xmlns="http://www.w3.org/2000/svg">',
    "HTML": b"\n<!DOCTYPE html><html>",
    "video": b"\0\0\0\x18ftypmp42\0\0\0\0mp42isom",
    "RIFF": b"RIFF\0\0\0\0WAVEfmt ",
    "ZIP": b"PK\x03\x04",
    "pointer of Git LFS": b"version https://git-lfs.github.com/spec/v1\n",
    "AppleDouble": b"\0\5\x16\7",
    "not an image of a known format": b"hello, I am a text file\n",
}
