"""Pictures with 10, 12 or 16 bits a channel, of which Pillow keeps 8.

`read_deep_codes` is the entry. HEIF is decoded by pillow-heif, AVIF and PNG by FFmpeg's decoders,
and TIFF by `deep_tiffs.py`. 8 bits are too few for HDR and for linear light, where a step of one is
visible.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any, BinaryIO

import av
import numpy as np
import pillow_heif
import torch
from numpy.typing import NDArray
from PIL import Image

from spackle.core.deep_tiffs import read_deep_tiff
from spackle.core.heif_items import GRID, HeifItems
from spackle.core.image_formats import AVIF, HEIF, PNG, TIFF, FileKind
from spackle.core.tiff_directories import ORIENTATION, SIDEWAYS_ORIENTATIONS

Codes = NDArray[np.uint16]
MAX_CODE = 65535
MAX_PIXELS_FOR_COLORS = 100_000_000  # of a photo that is decoded only for what it states

# FFmpeg's decoder and the box with its settings, for each type of item.
_DECODERS = {b"hvc1": ("hevc", b"hvcC"), b"av01": ("libdav1d", b"av1C")}
FULL_RANGE = 2  # FFmpeg's number for colours in 0..255, not in 16..235
UNSPECIFIED = 2  # in CICP
IDENTITY_MATRIX = 0  # of CICP: the planes are green, blue and red
# What red and blue contribute to the luminance, by the number of the matrix in CICP. A picture
# without a number has BT.601, as decoders of AVIF assume.
_LUMINANCE_OF_MATRIX = {
    1: (0.2126, 0.0722),
    2: (0.299, 0.114),
    4: (0.30, 0.11),
    5: (0.299, 0.114),
    6: (0.299, 0.114),
    7: (0.212, 0.087),
    9: (0.2627, 0.0593),
}


def read_deep_codes(
    image: Image.Image, kind: FileKind, file: BinaryIO, max_pixels: int
) -> Codes | None:
    """The picture as uint16 [H, W, 3 or 4] in 0..65535 with the file's full depth.

    None if Pillow keeps all bits: a picture of 8 bits, or a grey one of 16. Rows and columns are as
    Pillow decodes them, before an orientation in EXIF is applied.

    Args:
        image: the picture, opened by Pillow.
        kind: the format of its file.
        file: the open file.
        max_pixels: how large a picture may be; the header of `image` has been checked already.

    Raises:
        Exception: any of a decoder's, for a damaged file.
    """
    codes = None
    if kind is HEIF and image.info.get("bit_depth", 8) > 8:
        codes = _decode_heif(file)
    elif kind is AVIF:
        codes = _decode_avif(file, max_pixels)
    elif kind is PNG and _is_deep_png(file):
        codes = _decode_png(file, max_pixels)
    elif kind is TIFF:
        codes = read_deep_tiff(file)
    if codes is None:
        return None
    height, width = codes.shape[:2]
    if (width, height) != _stored_size(image):
        raise ValueError(f"the decoder gives {width}×{height}, the file says {image.size}")
    return codes


def _stored_size(image: Image.Image) -> tuple[int, int]:
    """Width and height before the orientation in EXIF is applied.

    Pillow swaps the two in the size of a TIFF that is to be turned.
    """
    is_sideways = image.getexif().get(ORIENTATION) in SIDEWAYS_ORIENTATIONS
    if image.format == "TIFF" and is_sideways:
        return image.height, image.width
    return image.width, image.height


# --- HEIF and AVIF


def _decode_heif(file: BinaryIO) -> Codes:
    """The primary picture of a HEIF with more than 8 bits, upright."""
    file.seek(0)
    # The codes of the file, not multiplied up to 16 bits, whose highest would not be 65535.
    heif = pillow_heif.open_heif(file, convert_hdr_to_8bit=False, hdr_to_16bit=False)
    picture = heif[heif.primary_index]
    codes = np.asarray(picture)
    bits = picture.mode.partition(";")[2]  # of a mode such as "RGB;10"
    return _to_16_bits(codes, int(bits or 8))


def _to_16_bits(codes: NDArray[Any], bits: int) -> Codes:
    """Whole numbers of some bits as uint16, so that the highest becomes 65535."""
    highest = (1 << bits) - 1
    if highest == MAX_CODE:
        return codes.astype(np.uint16)
    # Rounded, without an overflow of 32 bits: both factors are below 2^16.
    scaled = (codes.astype(np.uint32) * MAX_CODE + highest // 2) // highest
    return scaled.astype(np.uint16)


def _decode_avif(file: BinaryIO, max_pixels: int) -> Codes | None:
    """The primary picture of an AVIF; None if it has 8 bits, or is a grid with transparency.

    A picture is one item, or a grid of items; another item may hold its opacity.
    """
    file.seek(0)
    items = HeifItems.of(file.read())
    if items is None:
        return None
    primary = items.primary
    is_grid = items.types.get(primary) == GRID
    tiles = items.referred(b"dimg", primary) if is_grid else [primary]
    settings = items.property(tiles[0], b"av1C") if tiles else None
    # The third byte of the settings begins with profile flags; this bit says "more than 8 bits".
    is_deep = settings is not None and len(settings) > 2 and settings[2] & 0x40
    if not is_deep:
        return None

    alpha_item = items.alpha_of(primary)
    if is_grid:
        # A grid with opacity is rare, and is left to Pillow, which gives 8 bits of it.
        return None if alpha_item is not None else _decode_grid(items, tiles, max_pixels)
    colors = _rgb_of_frame(_decode_item(items, primary, max_pixels), items, primary)
    if alpha_item is None:
        return colors
    opacity = _opacity_of_frame(_decode_item(items, alpha_item, max_pixels))
    return np.concatenate([colors, opacity[..., None]], axis=-1)


def _decode_grid(items: HeifItems, tiles: Sequence[int], max_pixels: int) -> Codes:
    """The primary picture [H, W, 3] of an AVIF in 0..65535, if it is a grid of tiles.

    Args:
        items: of the file.
        tiles: the items that are the tiles, row by row.
        max_pixels: how large the picture may be.

    Raises:
        ValueError: the grid has another number of tiles, or is too large.
    """
    # The item of a grid says how many tiles there are, and how much of them is shown: its version
    # (1 byte), flags (1 byte), rows − 1, columns − 1, and width and height. The first flag says
    # that these have 4 bytes each instead of 2.
    primary = items.primary
    grid = items.content(primary)
    rows = grid[2] + 1
    columns = grid[3] + 1
    width, height = struct.unpack_from(">II" if grid[1] & 1 else ">HH", grid, 4)
    if width * height > max_pixels or rows * columns != len(tiles):
        raise ValueError("a grid that does not fit its tiles")
    result = np.zeros((height, width, 3), np.uint16)
    for index, tile in enumerate(tiles):
        codes = _rgb_of_frame(_decode_item(items, tile, max_pixels), items, primary)
        top = index // columns * codes.shape[0]
        left = index % columns * codes.shape[1]
        # Tiles at the right and at the bottom reach beyond the picture.
        target = result[top : top + codes.shape[0], left : left + codes.shape[1]]
        target[:] = codes[: target.shape[0], : target.shape[1]]
    return result


def bitstream_cicp(items: HeifItems) -> tuple[int, int] | None:
    """CICP's numbers of primaries and transfer function, as the compressed photo states them.

    Those of a grid are those of its first tile. 2 means unspecified. None if the photo cannot be
    decoded.
    """
    item = next(iter(items.referred(b"dimg", items.primary)), items.primary)
    if items.types.get(item) not in _DECODERS:
        return None
    try:
        # A tile is small; a photo that is no grid is decoded twice, which costs a second.
        frame = _decode_item(items, item, max_pixels=MAX_PIXELS_FOR_COLORS)
    except Exception:  # a damaged picture: the decoder of the photo says what is wrong
        return None
    return int(frame.color_primaries), int(frame.color_trc)


def _decode_item(items: HeifItems, item: int, max_pixels: int) -> av.VideoFrame:
    """The frame of an item; KeyError for a codec that is not read."""
    decoder, settings_box = _DECODERS[items.types[item]]
    settings = items.property(item, settings_box)
    extradata = None if settings is None else bytes(settings)
    return _decode(decoder, items.content(item), max_pixels, extradata)


def _decode(
    decoder: str, content: bytes, max_pixels: int, extradata: bytes | None = None
) -> av.VideoFrame:
    """The first frame that a decoder of FFmpeg makes of some bytes; ValueError if it makes none."""
    context = av.CodecContext.create(decoder, "r")
    assert isinstance(context, av.VideoCodecContext)
    context.thread_count = 1  # no threads that outlive the picture
    context.options = {"max_pixels": str(max_pixels)}
    if extradata is not None:
        context.extradata = extradata
    # Some decoders hold a frame back until they are told (by None) that no bytes follow.
    frames = context.decode(av.Packet(content)) or context.decode(None)
    if not frames:
        raise ValueError("the picture cannot be decoded")
    return frames[0]


def _rgb_of_frame(frame: av.VideoFrame, items: HeifItems, item: int) -> Codes:
    """[H, W, 3] in 0..65535 of a frame of luminance and two colour differences, or of RGB.

    Matrix and range are those that the file states for `item`, or else those of the frame.
    """
    matrix = int(frame.colorspace)
    is_full_range = int(frame.color_range) == FULL_RANGE
    # What the file states is in the box `colr`: the name nclx (4 bytes), primaries, transfer
    # function and matrix (2 bytes each), and a byte whose first bit says "full range".
    for kind, body in items.properties.get(item, []):
        if kind == b"colr" and bytes(body[:4]) == b"nclx" and len(body) >= 11:
            (matrix,) = struct.unpack_from(">H", body, 8)
            is_full_range = bool(body[10] & 0x80)
    bits = frame.format.components[0].bits
    planes = [_plane(frame, index) for index in range(len(frame.planes))]
    return ycbcr_to_rgb(planes, bits, matrix, is_full_range=is_full_range)


def _opacity_of_frame(frame: av.VideoFrame) -> Codes:
    """[H, W] in 0..65535 of a frame whose luminance is an opacity; ValueError for 8 bits."""
    bits = frame.format.components[0].bits
    if bits <= 8:
        raise ValueError("an opacity of 8 bits")
    return ycbcr_to_rgb([_plane(frame, 0)], bits, UNSPECIFIED, is_full_range=True)[..., 0]


def _plane(frame: av.VideoFrame, index: int) -> NDArray[np.uint16]:
    """[H, W] codes of a plane of a frame with more than 8 bits."""
    plane = frame.planes[index]
    codes: Codes = np.frombuffer(memoryview(plane), np.uint16)
    return codes.reshape(-1, plane.line_size // 2)[: plane.height, : plane.width]


def ycbcr_to_rgb(
    planes: list[NDArray[np.uint16]], bits: int, matrix: int, *, is_full_range: bool
) -> Codes:
    """[H, W, 3] RGB in 0..65535 of the planes of a compressed picture.

    Args:
        planes: luminance, and the differences of blue and red from it, which may be smaller; or
            luminance alone; or green, blue and red if `matrix` is 0.
        bits: of the codes.
        matrix: CICP's number of the function from RGB to luminance and differences.
        is_full_range: whether codes reach from 0 to 2^bits − 1; otherwise, in 8 bits, luminance is
            in 16..235 and the differences are in 16..240.

    Raises:
        ValueError: a matrix that is not read.
    """
    # Which code is black, and how many codes lie between the least and the greatest value.
    step = 1 << (bits - 8)  # one step of 8 bits
    black = 16 * step
    luma_steps = 219 * step
    chroma_steps = 224 * step
    if is_full_range:
        black = 0
        luma_steps = (1 << bits) - 1
        chroma_steps = luma_steps

    def luma(plane: NDArray[np.uint16]) -> NDArray[np.float32]:
        """A plane in 0..1."""
        values: NDArray[np.float32] = plane.astype(np.float32)
        return (values - np.float32(black)) / np.float32(luma_steps)

    if len(planes) == 1:
        grey = _rounded(luma(planes[0]))
        return np.repeat(grey[..., None], 3, axis=2)
    if matrix == IDENTITY_MATRIX:
        green_blue_red = [_rounded(luma(plane)) for plane in planes[:3]]
        return np.stack([green_blue_red[2], green_blue_red[0], green_blue_red[1]], axis=-1)
    if matrix not in _LUMINANCE_OF_MATRIX:
        raise ValueError(f"the colour matrix {matrix} is not read")

    # Luminance y is a weighted sum of red, green and blue, whose weights the matrix gives.
    red_share, blue_share = _LUMINANCE_OF_MATRIX[matrix]
    green_share = 1 - red_share - blue_share
    height, width = planes[0].shape
    y = luma(planes[0])
    # The differences are in -0.5..0.5.
    middle = np.float32(1 << (bits - 1))
    differences: list[NDArray[np.float32]] = [
        _enlarged((plane.astype(np.float32) - middle) / np.float32(chroma_steps), height, width)
        for plane in planes[1:3]
    ]
    blue_difference = differences[0]
    red_difference = differences[1]
    # The file has (red − y) / (2 · (1 − red_share)), and the same of blue. Green is what then is
    # missing in the sum y.
    red: NDArray[np.float32] = y + np.float32(2 * (1 - red_share)) * red_difference
    blue: NDArray[np.float32] = y + np.float32(2 * (1 - blue_share)) * blue_difference
    green: NDArray[np.float32] = y - np.float32(red_share) * red - np.float32(blue_share) * blue
    green /= np.float32(green_share)
    return np.stack([_rounded(red), _rounded(green), _rounded(blue)], axis=-1)


def _rounded(values: NDArray[np.float32]) -> Codes:
    """Numbers in 0..1 as codes in 0..65535."""
    codes: Codes = np.rint(np.clip(values, 0, 1) * np.float32(MAX_CODE)).astype(np.uint16)
    return codes


def _enlarged(plane: NDArray[np.float32], height: int, width: int) -> NDArray[np.float32]:
    """A plane of colour differences at the size of the luminance, interpolated linearly."""
    if plane.shape == (height, width):
        return plane
    stored = torch.from_numpy(np.ascontiguousarray(plane))[None, None]
    # A difference stands for one or two rows and columns. Those of an odd picture reach beyond it,
    # so the plane is enlarged by whole factors, and then cut to the size.
    steps_y = round(height / plane.shape[0])
    steps_x = round(width / plane.shape[1])
    larger = torch.nn.functional.interpolate(
        stored, scale_factor=(max(steps_y, 1), max(steps_x, 1)), mode="bilinear"
    )
    result: NDArray[np.float32] = larger[0, 0, :height, :width].numpy()
    return result


# --- PNG


def _is_deep_png(file: BinaryIO) -> bool:
    """Whether a PNG has 16 bits a channel and colours, of which Pillow keeps 8."""
    file.seek(24)  # behind the signature, the header's length and name, width and height
    head = file.read(2)
    # Colour types: 2 is RGB, 4 grey with transparency, 6 RGB with transparency.
    return len(head) == 2 and head[0] == 16 and head[1] in (2, 4, 6)


def _decode_png(file: BinaryIO, max_pixels: int) -> Codes:
    """[H, W, 3 or 4] of a PNG with 16 bits a channel; ValueError if it has another layout."""
    file.seek(0)
    frame = _decode("png", file.read(), max_pixels)
    name = frame.format.name
    if name.startswith("ya16"):  # grey and transparency
        grey_and_alpha = _interleaved(frame, 2, name)
        return grey_and_alpha[..., [0, 0, 0, 1]]
    # The name ends in the byte order, "be" or "le".
    channels = {"rgb48": 3, "rgba64": 4}.get(name[:-2])
    if channels is None:
        raise ValueError(f"the layout {name} is not read")
    return _interleaved(frame, channels, name)


def _interleaved(frame: av.VideoFrame, channels: int, name: str) -> Codes:
    """[H, W, channels] of a frame whose pixels lie one after the other; `name` is its format."""
    plane = frame.planes[0]
    order = ">u2" if name.endswith("be") else "<u2"
    rows: NDArray[Any] = np.frombuffer(memoryview(plane), order).reshape(-1, plane.line_size // 2)
    pixels = rows[: frame.height, : frame.width * channels]
    codes: Codes = pixels.reshape(frame.height, frame.width, channels).astype(np.uint16)
    return codes
