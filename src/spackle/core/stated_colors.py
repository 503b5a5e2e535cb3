"""What a photo's file says about its colours, and which of its statements counts.

`read_stated_colors` is the entry. A file may have an ICC profile, numbers of ITU-T H.273 (CICP),
primaries and a gamma of its own, or EXIF; several of them may contradict each other. The order is
that of the formats: in PNG, CICP counts before a profile, and a profile before sRGB, gamma and
primaries; in HEIF and AVIF, a profile counts before CICP, and CICP of the file before that of the
compressed picture. EXIF comes last.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import math
import os
import struct
from collections.abc import Iterator, Mapping, Sequence
from typing import BinaryIO

import numpy as np
from PIL import Image

from spackle.core.color_spaces import (
    ADOBE_RGB,
    ADOBE_RGB_GAMMA,
    ADOBE_RGB_PRIMARIES,
    D65,
    PROPHOTO_RGB,
    SRGB,
    SRGB_PRIMARIES,
    SRGB_TRANSFER,
    Chromaticities,
    ColorSpace,
    Transfer,
    color_space_of_cicp,
    power_transfer,
)
from spackle.core.deep_pictures import bitstream_cicp
from spackle.core.heif_items import BOX_ERRORS, HeifItems
from spackle.core.icc_profiles import hdr_space_of_icc
from spackle.core.image_formats import (
    AVIF,
    BMP,
    HEAD_BYTES,
    HEIF,
    PNG,
    TIFF,
    FileKind,
    kind_of_bytes,
)
from spackle.core.tiff_directories import PREVIEW_COLOR_SPACE

# A gamma of 0.45455 stands in PNGs whose numbers are sRGB; only programs that know nothing about
# sRGB take it for an exact power.
SRGB_FILE_GAMMA = 0.45455
SAME_GAMMA = 0.005
SAME_CHROMATICITY = 0.002
MAX_PNG_CHUNKS = 1000  # before the picture; a PNG has a dozen
MAX_PNG_CHUNK_BYTES = 64  # of those that are read here

# EXIF's tags about colours.
_TAG_INTEROPERABILITY = 1
_TAG_TRANSFER_FUNCTION = 0x012D
_TAG_WHITE_POINT = 0x013E
_TAG_PRIMARIES = 0x013F
_TAG_COLOR_SPACE = 0xA001
_TAG_GAMMA = 0xA500
_EXIF_SRGB = 1
_EXIF_ADOBE_RGB = 2  # not in the standard, but written by some programs
_EXIF_UNCALIBRATED = 65535
# DNG's numbers for the colours of its previews.
_DNG_PREVIEW_SPACES = {2: SRGB, 3: ADOBE_RGB, 4: PROPHOTO_RGB}


@dataclasses.dataclass(frozen=True)
class StatedColors:
    """The statement of a file that counts: an ICC profile, or a colour space."""

    space: ColorSpace = SRGB
    icc: bytes | None = None  # if given, it counts instead of `space`
    note: str = ""  # a line for the user, if something had to be guessed


def read_stated_colors(
    image: Image.Image,
    exif: Mapping[int, object],
    kind: FileKind | None = None,
    file: BinaryIO | None = None,
) -> StatedColors:
    """What a picture's file says about its colours.

    Args:
        image: the picture, opened by Pillow, which finds ICC profiles.
        exif: the EXIF tags of the file, by number.
        kind: the format of the file; None for a picture in memory.
        file: the open file; None for a picture in memory, of which only what Pillow keeps is known.
    """
    stated = _statement_that_counts(image, exif, kind, file)
    # A profile for HDR says what the numbers are, but cannot convert them as other profiles can.
    hdr_space = None if stated.icc is None else hdr_space_of_icc(stated.icc)
    return stated if hdr_space is None else StatedColors(hdr_space)


def _statement_that_counts(
    image: Image.Image,
    exif: Mapping[int, object],
    kind: FileKind | None,
    file: BinaryIO | None,
) -> StatedColors:
    """Which of several statements in a file counts; arguments as for `read_stated_colors`.

    What a format states itself goes before an ICC profile where its specification says so (PNG),
    and EXIF counts last.
    """
    icc = image.info.get("icc_profile") or None
    if file is None:
        return _colors_in_memory(image, exif, icc)
    if kind is PNG:
        return _png_colors(_png_chunks(file), icc) or _exif_colors(exif)
    if icc is not None:
        return StatedColors(icc=icc)
    if kind in (HEIF, AVIF):
        return _heif_colors(file) or _exif_colors(exif)
    if kind is BMP:
        return _bmp_colors(file)
    return _exif_colors(exif, is_tiff=kind is TIFF)


def read_colors_of_open_image(image: Image.Image) -> StatedColors | None:
    """What the file of a picture that Pillow has opened states by CICP, which Pillow does not keep.

    None if it is no PNG or AVIF, its file is not at hand, or states nothing. Call this before you
    read the picture's EXIF: for that, Pillow loads a PNG, and then forgets its file.
    """
    if image.format not in (PNG.pillow, AVIF.pillow):
        return None
    with _file_of(image) as file:
        if file is None:
            return None
        icc = image.info.get("icc_profile") or None
        if image.format == PNG.pillow:
            return _png_colors(_png_chunks(file), icc)
        return None if icc is not None else _heif_colors(file)


@contextlib.contextmanager
def _file_of(image: Image.Image) -> Iterator[BinaryIO | None]:
    """The file from which Pillow has opened an image, during the block; None if it is not at hand.

    While the image is not loaded, it is open, and is left as it was.
    """
    file = getattr(image, "fp", None)
    if file is not None and not getattr(file, "closed", True):
        position = file.tell()
        try:
            yield file
        finally:
            file.seek(position)
        return
    name = getattr(image, "filename", "")
    if not name or not os.path.isfile(name):
        yield None
        return
    with open(name, "rb") as opened:
        # Another file may have got this name since.
        is_same_kind = kind_of_bytes(opened.read(HEAD_BYTES)).pillow == image.format
        yield opened if is_same_kind else None


def _colors_in_memory(
    image: Image.Image, exif: Mapping[int, object], icc: bytes | None
) -> StatedColors:
    """What Pillow and pillow-heif keep about the colours of a picture whose file is not at hand."""
    if icc is not None:
        return StatedColors(icc=icc)
    info = image.info
    nclx = info.get("nclx_profile")  # CICP's numbers of a HEIF; 2 is unspecified
    if isinstance(nclx, Mapping):
        primaries = int(nclx.get("color_primaries", 2))
        transfer = int(nclx.get("transfer_characteristics", 2))
        return StatedColors(color_space_of_cicp(primaries, transfer))
    if "srgb" in info:
        return StatedColors()
    gamma = info.get("gamma")
    numbers = info.get("chromaticity")
    if gamma or numbers:
        return _gamma_colors(float(gamma or 0), numbers)
    return _exif_colors(exif)


# --- PNG


def _png_chunks(file: BinaryIO) -> dict[bytes, bytes]:
    """The short chunks of a PNG that stand before its pixels, the first one of each type."""
    chunks: dict[bytes, bytes] = {}
    file.seek(8)  # behind the signature
    for _ in range(MAX_PNG_CHUNKS):
        head = file.read(8)
        if len(head) < 8:
            break
        length, name = struct.unpack(">I4s", head)
        if name == b"IDAT":
            break
        if length <= MAX_PNG_CHUNK_BYTES:
            chunks.setdefault(name, file.read(length))
            file.seek(4, 1)  # the checksum, which Pillow has checked
        else:
            file.seek(length + 4, 1)
    return chunks


def _png_colors(chunks: Mapping[bytes, bytes], icc: bytes | None) -> StatedColors | None:
    """The statement that counts in a PNG; None if it has none.

    The PNG specification says which chunk goes before which: cICP, iCCP, sRGB, then gAMA and cHRM.
    """
    cicp = chunks.get(b"cICP", b"")
    if len(cicp) == 4:
        primaries, transfer, _, full_range = cicp
        return StatedColors(
            color_space_of_cicp(primaries, transfer, is_full_range=bool(full_range))
        )
    if icc is not None:
        return StatedColors(icc=icc)
    if b"sRGB" in chunks:
        return StatedColors()

    gamma = chunks.get(b"gAMA", b"")
    numbers = chunks.get(b"cHRM", b"")
    if len(gamma) != 4 and len(numbers) != 32:
        return None
    # All are whole numbers of a hundred-thousandth.
    file_gamma = struct.unpack(">I", gamma)[0] / 100_000 if len(gamma) == 4 else 0.0
    chromaticities = None
    if len(numbers) == 32:
        chromaticities = [number / 100_000 for number in struct.unpack(">8I", numbers)]
    return _gamma_colors(file_gamma, chromaticities)


def _gamma_colors(file_gamma: float, chromaticities: Sequence[float] | None) -> StatedColors:
    """The statement of a PNG's gamma and chromaticities.

    Args:
        file_gamma: the exponent with which light was stored; 0 if it is not stated.
        chromaticities: x and y of white, red, green and blue; None if they are not stated.
    """
    transfer = SRGB_TRANSFER
    if file_gamma > 0 and abs(file_gamma - SRGB_FILE_GAMMA) > SAME_GAMMA:
        transfer = power_transfer(1 / file_gamma)
    primaries = SRGB_PRIMARIES
    if chromaticities is not None and len(chromaticities) == 8:
        white, red, green, blue = _pairs(chromaticities)
        primaries = Chromaticities(red, green, blue, white)
    return _colors_of(primaries, transfer, "gamma and primaries of the PNG")


def _pairs(numbers: Sequence[float]) -> list[tuple[float, float]]:
    """Consecutive numbers, two by two."""
    return list(zip(numbers[::2], numbers[1::2], strict=True))


def _colors_of(primaries: Chromaticities, transfer: Transfer, name: str) -> StatedColors:
    """The statement of these primaries and this function; sRGB with a note if they are nonsense."""
    numbers = [coordinate for pair in primaries for coordinate in pair]
    # Numbers that are those of sRGB but for rounding mean sRGB.
    if _is_same(primaries, SRGB_PRIMARIES):
        primaries = SRGB_PRIMARIES
    try:
        if not all(math.isfinite(number) for number in numbers):
            raise ValueError("numbers that are not finite")
        return StatedColors(ColorSpace.of(primaries, transfer, name))
    except (ValueError, np.linalg.LinAlgError) as error:
        note = f"{name} make no colour space ({error}): its colours are taken for sRGB"
        return StatedColors(note=note)


def _is_same(ours: Chromaticities, theirs: Chromaticities) -> bool:
    """Whether two sets of primaries differ by rounding alone."""
    return bool(np.abs(np.array(ours) - np.array(theirs)).max() < SAME_CHROMATICITY)


# --- HEIF and AVIF


_WIDE_CICP_PRIMARIES = (9, 11, 12)  # BT.2020 and P3
_CICP_SRGB_TRANSFER = 13


def _heif_colors(file: BinaryIO) -> StatedColors | None:
    """The statement of a HEIF or AVIF without ICC profile: CICP of the photo or of its tiles.

    None if there is none.
    """
    file.seek(0)
    items = HeifItems.of(file.read())
    if items is None:
        return None
    # A photo that is a grid of tiles may leave the statement to the tiles.
    tiles = items.referred(b"dimg", items.primary)
    for item in (items.primary, *tiles[:1]):
        for kind, body in items.properties.get(item, []):
            if kind == b"colr" and bytes(body[:4]) in (b"nclx", b"nclc"):
                return _nclx_colors(body)

    # Without a statement in the file, the compressed picture may have one. Video encoders write the
    # numbers of ordinary videos into any picture. So a statement is believed only if it says HDR or
    # wide primaries, which no encoder writes by itself.
    cicp = bitstream_cicp(items)
    if cicp is None:
        return None
    primaries, transfer = cicp
    if color_space_of_cicp(primaries, transfer).transfer.is_hdr:
        return StatedColors(color_space_of_cicp(primaries, transfer))
    if primaries in _WIDE_CICP_PRIMARIES:
        return StatedColors(color_space_of_cicp(primaries, _CICP_SRGB_TRANSFER))
    return None


def _nclx_colors(body: memoryview) -> StatedColors | None:
    """The statement of the content of a box `colr`; None if it is too short.

    The matrix and the range are left to the decoder, which needs them.
    """
    try:
        primaries, transfer = struct.unpack_from(">HH", body, 4)
    except BOX_ERRORS:
        return None
    return StatedColors(color_space_of_cicp(primaries, transfer))


# --- BMP

_BMP_HEADER_BEGIN = 14  # behind the file's header
_BMP_V4_BYTES = 108
_BMP_V5_BYTES = 124
_BMP_EMBEDDED_PROFILE = b"MBED"[::-1]  # little-endian


def _bmp_colors(file: BinaryIO) -> StatedColors:
    """The statement of a BMP: primaries and gammas, or an embedded ICC profile; sRGB without."""
    file.seek(_BMP_HEADER_BEGIN)
    header = file.read(_BMP_V5_BYTES)
    if len(header) < _BMP_V4_BYTES:
        return StatedColors()
    (size,) = struct.unpack_from("<I", header, 0)
    kind = header[56:60]
    if size >= _BMP_V5_BYTES and len(header) >= _BMP_V5_BYTES and kind == _BMP_EMBEDDED_PROFILE:
        place, length = struct.unpack_from("<II", header, 112)
        file.seek(_BMP_HEADER_BEGIN + place)
        return StatedColors(icc=file.read(length) or None)
    if size < _BMP_V4_BYTES or kind != b"\0\0\0\0":  # "calibrated RGB"; others are names of sRGB
        return StatedColors()

    # X, Y, Z of red, green and blue as fractions of 2^30, and gammas as fractions of 2^16.
    endpoints = np.array(struct.unpack_from("<9i", header, 60), np.float64).reshape(3, 3) / 2**30
    gammas = np.array(struct.unpack_from("<3I", header, 96), np.float64) / 2**16
    if not endpoints.any() or not (gammas > 0).all():  # most writers leave them empty
        return StatedColors()
    # Chromaticities are x = X / (X + Y + Z) and y = Y / (X + Y + Z). White is the sum of the three.
    colors = np.vstack([endpoints, endpoints.sum(axis=0)])  # [4, 3]
    with np.errstate(all="ignore"):  # `_colors_of` refuses what is not finite
        chromaticities = (colors / colors.sum(axis=1, keepdims=True))[:, :2].tolist()
    red, green, blue, white = (tuple(pair) for pair in chromaticities)
    transfer = Transfer("gamma", lambda code: code ** gammas[:, None])
    return _colors_of(Chromaticities(red, green, blue, white), transfer, "endpoints of the BMP")


# --- EXIF and TIFF


def _exif_colors(exif: Mapping[int, object], *, is_tiff: bool = False) -> StatedColors:
    """The statement of EXIF, or of the same tags in a TIFF; sRGB without any.

    Args:
        exif: the tags, by number; DNG's colour space of a preview among them.
        is_tiff: whether primaries and transfer function are a TIFF's own tags, which need no
            further tag that says that they count.
    """
    preview = _number(exif.get(PREVIEW_COLOR_SPACE))
    if preview is not None and int(preview) in _DNG_PREVIEW_SPACES:
        return StatedColors(_DNG_PREVIEW_SPACES[int(preview)])

    stated = _number(exif.get(_TAG_COLOR_SPACE))
    interoperability = _text(exif.get(_TAG_INTEROPERABILITY))
    if stated == _EXIF_SRGB or interoperability.startswith("R98"):
        return StatedColors()
    # "R03" is Adobe RGB in DCF, the standard of cameras.
    if stated == _EXIF_ADOBE_RGB or interoperability.startswith("R03"):
        return StatedColors(ADOBE_RGB)
    if stated != _EXIF_UNCALIBRATED and not is_tiff:
        return StatedColors()

    primaries = _exif_primaries(exif)
    transfer = _exif_transfer(exif)
    if primaries is None and transfer is None:
        if stated != _EXIF_UNCALIBRATED:
            return StatedColors()
        return StatedColors(
            note='EXIF calls its colours "uncalibrated", and there is no ICC profile: '
            "they are taken for sRGB"
        )
    if primaries is not None and transfer is None and _is_same(primaries, ADOBE_RGB_PRIMARIES):
        transfer = power_transfer(ADOBE_RGB_GAMMA)
    return _colors_of(
        primaries or SRGB_PRIMARIES, transfer or SRGB_TRANSFER, "primaries and gamma of EXIF"
    )


def _exif_primaries(exif: Mapping[int, object]) -> Chromaticities | None:
    """The primaries that EXIF states, with D65 if it states no white; None without primaries."""
    numbers = _numbers(exif.get(_TAG_PRIMARIES))
    if len(numbers) != 6:  # x and y of red, green and blue
        return None
    red, green, blue = _pairs(numbers)
    white_numbers = _numbers(exif.get(_TAG_WHITE_POINT))
    white = D65
    if len(white_numbers) == 2:
        white = (white_numbers[0], white_numbers[1])
    return Chromaticities(red, green, blue, white)


def _exif_transfer(exif: Mapping[int, object]) -> Transfer | None:
    """The transfer function that EXIF states, by a table or a gamma; None without."""
    table = _numbers(exif.get(_TAG_TRANSFER_FUNCTION))
    # One column for all channels, or one for each, of 2^bits light values in 0..65535.
    for channels in (1, 3):
        entries, rest = divmod(len(table), channels)
        if rest == 0 and entries in (256, 65536):
            light = np.reshape(table, (channels, entries)) / 65535
            return Transfer("table", functools.partial(_interpolate, light))
    gamma = _number(exif.get(_TAG_GAMMA))
    if gamma is None or not gamma > 0:
        return None
    # EXIF rounds Adobe RGB's 2.19921875.
    is_adobe = abs(gamma - ADOBE_RGB_GAMMA) < 0.01
    return power_transfer(ADOBE_RGB_GAMMA if is_adobe else gamma)


def _interpolate(light: np.ndarray, code: np.ndarray) -> np.ndarray:
    """Values [channels, n] of tables [channels, entries] at positions [n] in 0..1."""
    nodes = np.linspace(0, 1, light.shape[1])
    return np.stack([np.interp(code, nodes, table) for table in light])


def _numbers(value: object) -> list[float]:
    """The numbers of a tag with several; empty if it has none."""
    if not isinstance(value, Sequence) or isinstance(value, str | bytes):
        return []
    numbers = [_number(element) for element in value]
    return [number for number in numbers if number is not None]


def _number(value: object) -> float | None:
    """The finite number of a tag; None if it is none."""
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    return number if math.isfinite(number) else None


def _text(value: object) -> str:
    """The text of a tag; empty if it is none."""
    if isinstance(value, bytes):
        return value.decode("latin-1")
    return value if isinstance(value, str) else ""
