"""SPZ, Niantic's compressed format: writes version 3 (20 bytes for each Gaussian, then deflated), reads 2 and 3."""

from __future__ import annotations

import bisect
import dataclasses
import struct
import zlib
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from spackle.core.gaussians import Gaussians
from spackle.formats.scene_files import (
    SH_C0,
    Floats,
    GaussianColumns,
    SceneFile,
    codes_to_fractions,
    decode_smallest_three,
    encode_smallest_three,
)
from spackle.runtime.errors import InputError

MAGIC, VERSION = 0x5053474E, 3
HEADER = struct.Struct(
    "<IIIBBBB"
)  # magic, version, count, degree of harmonics, fractional bits, flags, reserved
ROW = 20  # bytes for each Gaussian
MAX_GRID_COORDINATE = 2**23 - 1  # largest coordinate, which has 24 bits
FEWEST_BITS, MOST_BITS = 1, 23  # fractional bits of a coordinate
NEAR_STEPS = 2048  # least number of grid steps in the near distance
NEAR_SHARE = 0.01  # quantile of the Gaussians' distances that is the near distance
COLOR_SCALE = 0.15  # colours are stored with room below 0 and above 1
MAX_DEGREE = 3  # of spherical harmonics
GZIP, WINDOW = 16, 15
EFFORT = 5  # level 6 takes twice the time for files 1 % smaller
MAX_COUNT = 10_000_000  # most Gaussians that the format's own library reads

# Rounded values deflate better. A file uses the finest of the levels in _DETAILS that keeps its size within 1/8 of the
# PLY's size.
MAX_BYTES_PER_GAUSSIAN = 8.5  # bytes for each Gaussian; the PLY has 68
SMALL = 1 << 14  # bytes; smaller files need no further rounding
SAMPLE, SAMPLES = (
    1 << 13,
    8,
)  # consecutive Gaussians in a sample, and number of samples, with which levels are tried
SAMPLED_LIMIT = (
    8.7  # bytes for each Gaussian of a sample; samples deflate a little worse than the file
)


class _Detail(NamedTuple):
    position: float  # step in standard deviations of the Gaussian's middle axis
    quat_bits: int  # bits, of 9, that are kept of each of the three smaller components
    scale_step: int  # step of a scale's logarithm, in sixteenths
    opacity_step: int  # step in 255ths


_DETAILS = [
    _Detail(1 / 16, 9, 1, 1),
    _Detail(1 / 8, 7, 1, 1),
    _Detail(1 / 4, 6, 1, 2),
    _Detail(1 / 4, 5, 2, 2),
]
_DETAILS += [_Detail(1 / 2, 5, 2, 4), _Detail(1 / 2, 4, 2, 4), _Detail(1 / 2, 4, 4, 8)]


def encode_spz(scene: SceneFile) -> bytes:
    """Encode a scene as an SPZ file of version 3, in the scene's order; y up and z backward as the format requires.

    Positions are rounded to a grid (see `spz_grid`). Gaussians outside the grid's range are moved towards the origin
    and shrunk, which does not change the view from the origin.

    Raises:
        InputError: there are more Gaussians than readers accept.
        ValueError: a Gaussian is not finite.
    """
    count = len(scene.gaussians)
    if count > MAX_COUNT:
        raise InputError(
            f"{count:,} Gaussians are too many for SPZ (at most {MAX_COUNT:,}): use another format"
        )
    columns = GaussianColumns.of(scene.gaussians).flipped()
    bits, _ = spz_grid(scene.gaussians)
    columns = _within(columns, bits)
    header = HEADER.pack(MAGIC, VERSION, count, 0, bits, 0, 0)
    data = b""
    for detail in _DETAILS[_finest(columns, bits) :]:
        data = _deflated(header + b"".join(_sections(columns, bits, detail)))
        if len(data) <= max(MAX_BYTES_PER_GAUSSIAN * count, SMALL):
            break
    return data


def spz_grid(gaussians: Gaussians) -> tuple[int, int]:
    """The number of fractional bits of positions, and the number of Gaussians outside the grid's range."""
    means = gaussians.means.detach().to("cpu").double().numpy()
    if not len(means):
        return 12, 0
    reach, distance = np.abs(means).max(axis=1), np.sqrt((means * means).sum(axis=1))
    near = float(
        np.partition(distance, int(NEAR_SHARE * len(distance)))[int(NEAR_SHARE * len(distance))]
    )
    holds_all = np.floor(np.log2(MAX_GRID_COORDINATE / max(float(reach.max()), 1e-30)))
    shows_near = np.ceil(np.log2(NEAR_STEPS / max(near, 1e-30)))
    bits = int(np.clip(max(holds_all, shows_near), FEWEST_BITS, MOST_BITS))
    return bits, int((reach * 2.0**bits > MAX_GRID_COORDINATE).sum())


def _within(columns: GaussianColumns, bits: int) -> GaussianColumns:
    """Shrink positions and sizes of Gaussians outside the grid's range towards the origin, until they fit."""
    reach = np.abs(columns.means).max(axis=1, initial=0).astype(np.float64)
    factor = np.minimum(1, MAX_GRID_COORDINATE / 2.0**bits / np.maximum(reach, 1e-30))[:, None]
    means, log_scales = columns.means * factor, columns.log_scales + np.log(factor)
    return dataclasses.replace(
        columns, means=means.astype(np.float32), log_scales=log_scales.astype(np.float32)
    )


def _finest(columns: GaussianColumns, bits: int) -> int:
    """Index of the finest rounding that keeps deflated samples within SAMPLED_LIMIT; the coarsest if none does."""
    count = len(columns.means)
    starts = np.unique(np.linspace(0, max(0, count - SAMPLE), SAMPLES).astype(np.int64))
    rows = np.concatenate([np.arange(start, min(start + SAMPLE, count)) for start in starts])
    sample = columns.select(rows)

    def fits(detail: _Detail) -> bool:
        return len(_deflated(b"".join(_sections(sample, bits, detail)))) <= max(
            SAMPLED_LIMIT * len(rows), SMALL
        )

    return bisect.bisect_left(_DETAILS[:-1], True, key=fits)


def _sections(columns: GaussianColumns, bits: int, detail: _Detail) -> list[bytes]:
    """The bytes of positions, opacities, colours, scales and rotations, in the file's order."""
    scales = (
        np.round((columns.log_scales + 10) * np.float32(16 / detail.scale_step)) * detail.scale_step
    )
    scales = np.clip(scales, 0, 255).astype(np.uint8)
    colors = (columns.srgb - np.float32(0.5)) * np.float32(COLOR_SCALE * 255 / SH_C0) + np.float32(
        127.5
    )
    step = detail.opacity_step
    ball = (scales == scales[:, :1]).all(
        axis=1, keepdims=True
    )  # the rotation of a sphere is invisible
    quats = np.where(ball, np.array([1, 0, 0, 0], np.float32), columns.quats)
    return [
        _positions(columns, bits, detail.position).tobytes(),
        np.minimum(255, np.round(columns.opacities * (255 / step)) * step)
        .astype(np.uint8)
        .tobytes(),
        np.clip(np.round(colors), 0, 255).astype(np.uint8).tobytes(),
        scales.tobytes(),
        _rotations(quats, detail.quat_bits).tobytes(),
    ]


def _positions(columns: GaussianColumns, bits: int, share: float) -> NDArray[np.uint8]:
    """Positions as bytes [N, 9]: 24-bit fixed point, in steps of up to `share` times the Gaussian's middle axis."""
    a, b, c = columns.log_scales.T
    middle = np.maximum(np.minimum(a, b), np.minimum(np.maximum(a, b), c))
    exponent = np.floor(middle / np.float32(np.log(2)) + np.float32(np.log2(share) + bits))
    step = np.exp2(np.clip(exponent, 0, 20))[:, None]
    fixed = np.round(columns.means * np.float64(2.0**bits) / step) * step
    whole = np.clip(fixed, -MAX_GRID_COORDINATE, MAX_GRID_COORDINATE).astype("<i4")
    return np.ascontiguousarray(whole.view(np.uint8).reshape(-1, 3, 4)[:, :, :3])


def _rotations(quats: Floats, bits: int) -> NDArray[np.uint32]:
    """Pack unit quaternions wxyz into words [N].

    A word has the index of the largest of xyzw, then a sign and 9 bits, rounded to `bits`, for each other component.
    """
    largest, others = encode_smallest_three(quats[:, [1, 2, 3, 0]])
    step = 2 ** (9 - bits)
    sizes = np.minimum(
        511, np.round(np.abs(others) * np.float32(511 * 2**0.5 / step)) * step
    ).astype("<u4")
    words: NDArray[np.uint32] = largest.astype("<u4")
    for size, other in zip(sizes.T, others.T, strict=True):
        words = words << 10 | ((other < 0) & (size > 0)).astype("<u4") << 9 | size
    return words


def _deflated(data: bytes) -> bytes:
    deflater = zlib.compressobj(EFFORT, zlib.DEFLATED, GZIP + WINDOW, 9)
    return deflater.compress(data) + deflater.flush()


def decode_spz(data: bytes) -> GaussianColumns:
    """Decode the Gaussians of an SPZ file, with y down and z forward, and colours of degree 0.

    ValueError or zlib.error for another version or a damaged file. Never inflates more than the header announces.
    """
    inflater = zlib.decompressobj(GZIP + WINDOW)
    head = inflater.decompress(data, HEADER.size)
    magic, version, count, degree, bits, _, _ = HEADER.unpack(head)
    if magic != MAGIC or version not in (2, 3) or degree > MAX_DEGREE or count > MAX_COUNT:
        raise ValueError(
            f"version {version} with {count:,} Gaussians and harmonics of degree {degree}"
        )
    widths = (9, 1, 3, 3, 4 if version == 3 else 3)  # bytes of `_sections`
    body = inflater.decompress(inflater.unconsumed_tail, max(1, count * sum(widths)))
    if len(body) != count * sum(widths):
        raise ValueError(f"it ends after {len(body):,} bytes of {count:,} Gaussians")
    cut = np.split(np.frombuffer(body, np.uint8), np.cumsum(widths)[:-1] * count)
    places, alphas, colors, scales, turns = (part.reshape(count, -1) for part in cut)
    fixed = np.pad(places.reshape(-1, 3), ((0, 0), (1, 0))).view("<i4").reshape(count, 3) >> 8
    srgb = (codes_to_fractions(colors, 255) - np.float32(0.5)) * np.float32(
        SH_C0 / COLOR_SCALE
    ) + np.float32(0.5)
    if version == 3:
        words = turns.copy().view("<u4")
        fields = words >> np.array([20, 10, 0], np.uint32)
        sizes = (fields & 511).astype(np.float32) / np.float32(511 * 2**0.5)
        xyzw = decode_smallest_three(words[:, 0] >> 30, np.where(fields & 512, -sizes, sizes))
    else:  # version 2 omits w
        xyzw = decode_smallest_three(np.full(count, 3), codes_to_fractions(turns, 255) * 2 - 1)
    means, log_scales = (fixed / 2.0**bits).astype(np.float32), codes_to_fractions(scales, 16) - 10
    opacities = codes_to_fractions(alphas[:, 0], 255)
    return GaussianColumns(
        means, xyzw[:, [3, 0, 1, 2]], log_scales, opacities, np.clip(srgb, 0, 1)
    ).flipped()
