"""The container of an SPZ file: its header, and the compressed bytes of each attribute.

Versions 1 to 3 are one gzip stream. Version 4 has a readable header, and a Zstandard frame for each
attribute. What the bytes mean is known by `spz.py`.
"""

from __future__ import annotations

import dataclasses
import struct
import zlib
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from spackle.formats import zstandard
from spackle.formats.quantization import check_length_factor
from spackle.formats.scene_content import UnsupportedSceneError
from spackle.formats.scene_limits import check_gaussian_count

MAGIC = 0x5053474E  # "NGSP", lowest byte first
FRAMES_VERSION = 4  # the first version with Zstandard frames
KNOWN_VERSIONS = range(1, 5)

# Magic, version, number of Gaussians, degree of the spherical harmonics, fractional bits of a
# coordinate, flags, and a byte that version 4 uses for the number of its frames.
HEADER = struct.Struct("<IIIBBBB")

# What version 4 has after these: where its table of frames begins, and 12 reserved bytes.
HEADER_END = struct.Struct("<I12x")
TABLE_ROW = struct.Struct("<QQ")  # compressed and uncompressed bytes of a frame
EXTENSION_RECORD = struct.Struct("<II")  # kind and bytes of an extension, which then follows

MAX_COUNT = 10_000_000  # most Gaussians that older readers of the format accept
MAX_HARMONICS_DEGREE = 4

HAS_EXTENSIONS = 2  # this bit of the flags says that there are extensions
COORDINATE_SYSTEM = 0xADBE0003  # kind of the extension that names the axes of the file
# Kind of the extension in which Spackle states by what all lengths were multiplied: a float64.
LENGTH_FACTOR = 0x53504B01  # "SPK", and a number of ours
LENGTH_FACTOR_FORMAT = struct.Struct("<d")
# Kind of the extension that says between which bounds the bytes of harmonics lie: bits of degree 1
# and of the others, lower and upper bound.
HARMONICS_BOUNDS = 0xADBE0001
HARMONICS_BOUNDS_FORMAT = struct.Struct("<BBff")
MAX_EXTENSION_BYTES = 1 << 16  # of all extensions of a file, more than those that are known need

# Arguments of zlib: the container of gzip, the largest window, the most memory.
GZIP_WINDOW_BITS = 16 + 15
DEFLATE_MEMORY = 9
DEFLATE_LEVEL = 5  # level 6 takes twice the time for files 1 % smaller


class SpzHeader(NamedTuple):
    """What the header of a file says, in the order of HEADER."""

    magic: int
    version: int
    gaussian_count: int
    harmonics_degree: int
    fraction_bits: int
    flags: int
    frame_count: int


@dataclasses.dataclass(frozen=True)
class SpzParts:
    """The decompressed content of an SPZ file with N Gaussians."""

    header: SpzHeader
    positions: NDArray[np.uint8]  # [N, 9], in version 1 [N, 6]
    opacities: NDArray[np.uint8]  # [N, 1]
    colors: NDArray[np.uint8]  # [N, 3]
    scales: NDArray[np.uint8]  # [N, 3]
    rotations: NDArray[np.uint8]  # [N, 4], in versions 1 and 2 [N, 3]
    harmonics: NDArray[np.uint8]  # [N, 3·K] for K harmonics: red, green, blue of each
    # The numbers for which the bytes 0 and 255 of harmonics stand, if an extension says so.
    harmonics_bounds: tuple[float, float] | None = None
    axes: int = 0  # the number of the file's axes, if an extension names them; 0 for the usual ones
    length_factor: float = 1.0  # by which the scene was multiplied, if an extension says it


def pack_parts(header: SpzHeader, parts: Sequence[bytes], length_factor: float = 1.0) -> bytes:
    """Return a whole SPZ file: gzip for the versions up to 3, Zstandard for version 4.

    Args:
        header: of the file; its number of frames is filled in here.
        parts: positions, opacities, colours, scales, rotations, and harmonics if there are any.
        length_factor: by which all lengths were multiplied; an extension states it unless it is 1.
    """
    extensions = b""
    if length_factor != 1:
        factor_bytes = LENGTH_FACTOR_FORMAT.pack(length_factor)
        extensions = EXTENSION_RECORD.pack(LENGTH_FACTOR, len(factor_bytes)) + factor_bytes
        header = header._replace(flags=header.flags | HAS_EXTENSIONS)
    if header.version < FRAMES_VERSION:
        return deflate(HEADER.pack(*header) + b"".join(parts) + extensions)

    frames = [zstandard.compress(part) for part in parts]
    # The table follows the header and the extensions.
    table_start = HEADER.size + HEADER_END.size + len(extensions)
    sizes = zip(frames, parts, strict=True)
    return b"".join(
        [
            HEADER.pack(*header._replace(frame_count=len(frames))),
            HEADER_END.pack(table_start),
            extensions,
            *(TABLE_ROW.pack(len(frame), len(part)) for frame, part in sizes),
            *frames,
        ]
    )


def deflate(data: bytes) -> bytes:
    """Compress bytes as gzip does, without a time, so that equal data gives equal files."""
    compressor = zlib.compressobj(DEFLATE_LEVEL, zlib.DEFLATED, GZIP_WINDOW_BITS, DEFLATE_MEMORY)
    return compressor.compress(data) + compressor.flush()


def unpack_parts(data: bytes) -> SpzParts:
    """Decompress an SPZ file of any known version.

    No more bytes are decompressed than the header announces, because a small damaged or hostile
    file could otherwise fill the memory.

    Raises:
        UnsupportedSceneError: the file is compressed but no SPZ, or is of an unknown kind.
        ValueError: the file is too short, or contradicts itself.
        Exception: zlib or Zstandard find damage.
    """
    is_plain = data.startswith(MAGIC.to_bytes(4, "little"))
    return _unpack_frames(data) if is_plain else _unpack_gzip(data)


def _unpack_gzip(data: bytes) -> SpzParts:
    """Decompress a file of the versions 1 to 3, in which all is one gzip stream."""
    # zlib takes the container's kind, which is gzip's, as a part of this number.
    inflater = zlib.decompressobj(GZIP_WINDOW_BITS)
    head = inflater.decompress(data, HEADER.size)
    if not head.startswith(MAGIC.to_bytes(4, "little")):
        raise UnsupportedSceneError(
            "a gzip file with something else than an SPZ scene: unpack it, and give what is inside"
        )
    header = SpzHeader(*HEADER.unpack(head))
    if header.version in KNOWN_VERSIONS and header.version >= FRAMES_VERSION:
        raise ValueError(f"version {header.version} within gzip")
    _check_header(header, len(data))

    widths = part_widths(header)
    body_bytes = header.gaussian_count * sum(widths)
    # For zlib, the limit 0 would mean no limit.
    body = inflater.decompress(inflater.unconsumed_tail, max(1, body_bytes))
    if len(body) != body_bytes:
        raise ValueError(
            f"it ends after {len(body):,} bytes of {header.gaussian_count:,} Gaussians"
        )
    part_ends = np.cumsum(widths)[:-1] * header.gaussian_count
    parts = _named_parts(header, np.split(np.frombuffer(body, np.uint8), part_ends))
    if not header.flags & HAS_EXTENSIONS:
        return parts

    extensions = inflater.decompress(inflater.unconsumed_tail, MAX_EXTENSION_BYTES)
    return _with_extensions(parts, extensions)


def _unpack_frames(data: bytes) -> SpzParts:
    """Decompress a file of version 4, with a Zstandard frame for each attribute."""
    header = SpzHeader(*HEADER.unpack_from(data))
    _check_header(header, len(data))
    (table_start,) = HEADER_END.unpack_from(data, HEADER.size)

    widths = part_widths(header)
    # A scene without harmonics may leave their empty frame out.
    needed_count = sum(width > 0 for width in widths)
    if header.frame_count < needed_count:
        raise ValueError(f"{header.frame_count} of {needed_count} attributes are there")
    frame_start = table_start + header.frame_count * TABLE_ROW.size
    parts = []
    for index, width in enumerate(widths[:needed_count]):
        row_start = table_start + index * TABLE_ROW.size
        frame_bytes, part_bytes = TABLE_ROW.unpack_from(data, row_start)
        if part_bytes != header.gaussian_count * width:
            raise ValueError(f"{part_bytes:,} bytes for {header.gaussian_count:,} Gaussians")
        frame = data[frame_start : frame_start + frame_bytes]
        part = zstandard.decompress(frame, part_bytes) if part_bytes else b""
        if len(part) != part_bytes:
            raise ValueError(f"a part ends after {len(part):,} of {part_bytes:,} bytes")
        parts.append(np.frombuffer(part, np.uint8))
        frame_start += frame_bytes
    if needed_count < len(widths):
        parts.append(np.empty(0, np.uint8))

    extensions = b""
    if header.flags & HAS_EXTENSIONS:
        extensions = data[HEADER.size + HEADER_END.size : table_start]
    return _with_extensions(_named_parts(header, parts), extensions)


def _with_extensions(parts: SpzParts, records: bytes) -> SpzParts:
    """Return the content with what extensions say of axes, unit and harmonics; others are skipped.

    Args:
        parts: the content, with the usual axes, unit and bounds of harmonics.
        records: the extensions; each begins with its kind and its number of bytes.

    Raises:
        ValueError: the unit is impossible.
    """
    start = 0
    while start + EXTENSION_RECORD.size <= len(records):
        kind, byte_count = EXTENSION_RECORD.unpack_from(records, start)
        start += EXTENSION_RECORD.size
        content = records[start : start + byte_count]
        if kind == COORDINATE_SYSTEM:
            parts = dataclasses.replace(parts, axes=int.from_bytes(content[:4], "little"))
        elif kind == LENGTH_FACTOR:
            (factor,) = LENGTH_FACTOR_FORMAT.unpack(content)
            check_length_factor(factor)
            parts = dataclasses.replace(parts, length_factor=factor)
        elif kind == HARMONICS_BOUNDS and len(content) == HARMONICS_BOUNDS_FORMAT.size:
            _, _, low, high = HARMONICS_BOUNDS_FORMAT.unpack(content)
            parts = dataclasses.replace(parts, harmonics_bounds=(low, high))
        start += byte_count
    return parts


def harmonics_count(degree: int) -> int:
    """Return the number of spherical harmonics of the degrees 1 to `degree`: 3, 8, 15, 24."""
    return (degree + 1) ** 2 - 1


def part_widths(header: SpzHeader) -> tuple[int, ...]:
    """Return the bytes of a Gaussian's position, opacity, colour, scales, rotation, harmonics."""
    position_bytes = 6 if header.version == 1 else 9  # version 1 has half-precision numbers
    rotation_bytes = 3 if header.version < 3 else 4
    return position_bytes, 1, 3, 3, rotation_bytes, 3 * harmonics_count(header.harmonics_degree)


def _check_header(header: SpzHeader, file_bytes: int) -> None:
    """Refuse a version, degree or size that is not read.

    Raises:
        UnsupportedSceneError: another program may read the file.
        ValueError: the file of `file_bytes` bytes cannot hold so many Gaussians.
    """
    if header.version not in KNOWN_VERSIONS:
        problem = f"SPZ version {header.version} (versions 1 to {KNOWN_VERSIONS[-1]} are read)"
        raise UnsupportedSceneError(f"{problem}: save it as version 4 or 3, or as PLY")
    if header.harmonics_degree > MAX_HARMONICS_DEGREE:
        problem = f"spherical harmonics of degree {header.harmonics_degree}"
        limit = f"at most {MAX_HARMONICS_DEGREE}"
        raise UnsupportedSceneError(f"{problem} ({limit}): save it with a lower degree, or as PLY")
    if header.gaussian_count > MAX_COUNT:
        problem = f"{header.gaussian_count:,} Gaussians ({MAX_COUNT:,} at most)"
        raise UnsupportedSceneError(f"{problem}: split the scene, or save it as PLY")
    check_gaussian_count(header.gaussian_count, header.harmonics_degree, file_bytes)


def _named_parts(header: SpzHeader, parts: Sequence[NDArray[np.uint8]]) -> SpzParts:
    """Return flat parts as rows, one for each Gaussian, in the order of the file."""
    widths = part_widths(header)
    rows = [
        part.reshape(header.gaussian_count, width)
        for part, width in zip(parts, widths, strict=True)
    ]
    positions, opacities, colors, scales, rotations, harmonics = rows
    return SpzParts(header, positions, opacities, colors, scales, rotations, harmonics)
