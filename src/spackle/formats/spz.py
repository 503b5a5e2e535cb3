"""SPZ, Niantic's compressed format: 20 bytes for each Gaussian, then compressed.

Harmonics take 9, 24 or 45 bytes more.

`encode_spz` writes version 3, `encode_spz_4` version 4; `decode_spz` reads the versions 1 to 4.
"""

from __future__ import annotations

import bisect
import dataclasses
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from spackle.core.gaussians import Gaussians
from spackle.core.spherical_harmonics import HARMONICS_COUNTS
from spackle.formats.gaussian_columns import (
    SH_C0,
    Floats,
    GaussianColumns,
    colors_of_harmonics,
)
from spackle.formats.quantization import (
    MIN_LENGTH,
    codes_to_fractions,
    decode_smallest_three,
    encode_smallest_three,
    near_distance,
    ordinary_length_factor,
    shrink_distant,
)
from spackle.formats.scene_content import DecodedScene, SceneFile, UnsupportedSceneError
from spackle.formats.spz_container import (
    MAGIC,
    MAX_COUNT,
    SpzHeader,
    SpzParts,
    deflate,
    pack_parts,
    unpack_parts,
)
from spackle.runtime.errors import InputError

WRITTEN_VERSION = 3  # most programs read it; PlayCanvas only reads version 4

# A coordinate is a fixed-point number of 24 bits with a sign, of which some are fractional.
MAX_GRID_COORDINATE = 2**23 - 1
MIN_FRACTION_BITS = 1
MAX_FRACTION_BITS = 23
FRACTION_BITS_OF_EMPTY_SCENE = 12

# The grid has at least this many steps in the distance of the nearest 1 % of the Gaussians.
MIN_NEAR_STEPS = 2048

# A byte of a colour stands for 0.5 + 0.15 · f_dc, where f_dc is the coefficient of the constant
# spherical harmonic. This leaves room for colours below 0 and above 1.
COLOR_SCALE = 0.15

# A byte of a scale stands for the logarithm -10 + byte / 16.
MIN_LOG_SCALE = -10
SCALE_STEPS = 16

# The three smaller components of a quaternion, times √2, have a sign and 9 bits each.
MAX_COMPONENT_CODE = 511
COMPONENT_SIGN_BIT = 512

# A byte of a harmonic's coefficient c is 128 + 128 c. It is rounded to multiples of HARMONIC_STEP;
# Niantic's library takes steps of 8 (degree 1) and 16, which are visible.
HARMONIC_ONE = 128
HARMONIC_STEP = 2

# Where the axes of a file point, by their number in an extension. The usual ones are RUB: x right,
# y up, z back.
AXES = ["RUB", "LDB", "RDB", "LUB", "RUB", "LDF", "RDF", "LUF", "RUF"]
AXES += ["LFD", "RFD", "LFU", "RFU", "LBD", "RBD", "LBU", "RBU"]

# A file may take an eighth of the PLY's 68 bytes for each Gaussian. Rounded values deflate
# better, so values are rounded more and more coarsely until the file is small enough.
MAX_BYTES_PER_GAUSSIAN = 8.5
SMALL_FILE_BYTES = 1 << 14  # smaller files need no further rounding

# Roundings are first tried on samples of consecutive Gaussians, which deflate a little worse
# than the whole file does.
SAMPLE_GAUSSIANS = 1 << 13
SAMPLE_COUNT = 8
MAX_BYTES_PER_SAMPLED_GAUSSIAN = 8.7


class Rounding(NamedTuple):
    """How coarsely the values of a file are rounded."""

    position_step: float  # in standard deviations along the Gaussian's middle axis
    component_bits: int  # how many of the 9 bits of a quaternion's component are kept
    scale_step: int  # in sixteenths of a scale's logarithm
    opacity_step: int  # in 255ths


# From the finest to the coarsest; found by trials, so that each next one looks as good as it can.
ROUNDINGS = [
    Rounding(1 / 16, 9, 1, 1),
    Rounding(1 / 8, 7, 1, 1),
    Rounding(1 / 4, 6, 1, 2),
    Rounding(1 / 4, 5, 2, 2),
    Rounding(1 / 2, 5, 2, 4),
    Rounding(1 / 2, 4, 2, 4),
    Rounding(1 / 2, 4, 4, 8),
]


class SpzGrid(NamedTuple):
    """The grid to which positions are rounded."""

    fraction_bits: int  # the grid's step is 2 to the power of -fraction_bits
    outside_count: int  # how many Gaussians lie beyond the largest coordinate
    length_factor: float = 1.0  # by which the scene is multiplied before it is rounded

    @property
    def end(self) -> float:
        """The largest coordinate of the grid, in the scene's own unit."""
        return MAX_GRID_COORDINATE / 2.0**self.fraction_bits / self.length_factor


def encode_spz(scene: SceneFile) -> bytes:
    """Encode a scene as an SPZ file of version 3, which most programs read; see `_encode`."""
    return _encode(scene, WRITTEN_VERSION)


def encode_spz_4(scene: SceneFile) -> bytes:
    """Encode a scene as an SPZ file of version 4, compressed with Zstandard; see `_encode`.

    The Gaussians are those of version 3, bit for bit.
    """
    return _encode(scene, 4)


def _encode(scene: SceneFile, version: int) -> bytes:
    """Encode a scene as an SPZ file of a version, in the scene's order.

    The axes become y up and z backward, as the format requires. Positions are rounded to the
    grid of `spz_grid`. A Gaussian outside of the grid is moved towards the origin and shrunk
    in proportion, which does not change the view from the origin. The format has no sizes below
    0.00005 or above 380: a scene that is not in metres is stored in another unit, and an
    extension, which other readers skip, says which. Harmonics between -1 and 1 are kept.

    Raises:
        InputError: there are more Gaussians than readers accept.
        ValueError: a Gaussian is not finite.
    """
    count = len(scene.gaussians)
    if count > MAX_COUNT:
        problem = f"{count:,} Gaussians are too many for SPZ (at most {MAX_COUNT:,})"
        raise InputError(f"{problem}: use another format")

    columns = GaussianColumns.from_gaussians(scene.gaussians).flip_y_and_z()
    grid = spz_grid(scene.gaussians)
    fraction_bits = grid.fraction_bits
    columns = columns.scaled(grid.length_factor)
    columns = shrink_distant(columns, MAX_GRID_COORDINATE / 2.0**fraction_bits)
    header = SpzHeader(
        magic=MAGIC,
        version=version,
        gaussian_count=count,
        harmonics_degree=columns.harmonics_degree,
        fraction_bits=fraction_bits,
        flags=0,
        frame_count=0,
    )

    # Harmonics have a size of their own, which coarser other values would not change much.
    harmonics = b""
    if columns.harmonics is not None:
        harmonics = _encode_harmonics(columns.harmonics).tobytes()
        columns = dataclasses.replace(columns, harmonics=None)

    # ROUNDINGS go from fine to coarse. The first one with which samples of the Gaussians get small
    # enough may be too fine for the whole file; then coarser ones follow.
    data = b""
    max_bytes = max(MAX_BYTES_PER_GAUSSIAN * count, SMALL_FILE_BYTES)
    first_index = _finest_rounding_of_samples(columns, fraction_bits)
    for rounding in ROUNDINGS[first_index:]:
        sections = _encode_sections(columns, fraction_bits, rounding)
        if harmonics:
            return pack_parts(header, [*sections, harmonics], grid.length_factor)
        data = pack_parts(header, sections, grid.length_factor)
        if len(data) <= max_bytes:
            break
    return data


def _encode_harmonics(harmonics: Floats) -> NDArray[np.uint8]:
    """Return coefficients [N, K, 3] as bytes: 128 + 128 c, rounded to even numbers."""
    steps = np.round(harmonics * np.float32(HARMONIC_ONE / HARMONIC_STEP))
    rounded = np.clip(steps * HARMONIC_STEP + HARMONIC_ONE, 0, 255)
    codes: NDArray[np.uint8] = rounded.astype(np.uint8)
    return codes


def _decode_harmonics(parts: SpzParts) -> Floats | None:
    """Return the coefficients [N, K, 3] of degree 1 to 3, in the file's axes; None without any."""
    if parts.header.harmonics_degree == 0:
        return None
    codes = parts.harmonics.reshape(len(parts.harmonics), -1, 3)
    kept_codes: Floats = codes[:, : HARMONICS_COUNTS[-1]].astype(np.float32)
    if parts.harmonics_bounds is None:
        return kept_codes / np.float32(HARMONIC_ONE) - np.float32(1)
    low, high = parts.harmonics_bounds
    return np.float32(low) + kept_codes * np.float32((high - low) / 255)


def spz_grid(gaussians: Gaussians) -> SpzGrid:
    """Choose the grid to which the positions of a scene are rounded.

    SPZ stores a coordinate as a fixed-point number of 24 bits. The more of these bits are
    fractional, the finer is the grid, but the smaller is its largest coordinate. The grid is as
    fine as the farthest Gaussian allows. If that is too coarse for the nearest Gaussians, the grid
    is finer, and distant Gaussians lie outside of it.
    """
    means = gaussians.means.detach().to("cpu").double().numpy()  # [N, 3]
    if len(means) == 0:
        return SpzGrid(fraction_bits=FRACTION_BITS_OF_EMPTY_SCENE, outside_count=0)
    length_factor = ordinary_length_factor(means)
    means = means * length_factor
    largest_coordinate = np.abs(means).max(axis=1)  # [N]

    # The nearest 1 % of the Gaussians begin here; the grid must be fine there.
    nearest = near_distance(means)
    farthest_coordinate = float(largest_coordinate.max())
    # The most bits with which all coordinates fit: farthest · 2^bits ≤ MAX_GRID_COORDINATE.
    bits_for_all = np.floor(np.log2(MAX_GRID_COORDINATE / max(farthest_coordinate, MIN_LENGTH)))
    # The fewest bits with which the grid is fine enough: near · 2^bits ≥ MIN_NEAR_STEPS.
    bits_for_near = np.ceil(np.log2(MIN_NEAR_STEPS / max(nearest, MIN_LENGTH)))
    fraction_bits = int(
        np.clip(max(bits_for_all, bits_for_near), MIN_FRACTION_BITS, MAX_FRACTION_BITS)
    )

    is_outside = largest_coordinate * 2.0**fraction_bits > MAX_GRID_COORDINATE
    return SpzGrid(
        fraction_bits=fraction_bits,
        outside_count=int(is_outside.sum()),
        length_factor=length_factor,
    )


def _finest_rounding_of_samples(columns: GaussianColumns, fraction_bits: int) -> int:
    """Return the index of the finest of ROUNDINGS that will probably make the file small enough.

    ROUNDINGS go from fine to coarse. They are tried on samples of the Gaussians, because it would
    take long to encode the whole file with each of them.

    Args:
        columns: all Gaussians, with y up and z backward.
        fraction_bits: the positions' grid has steps of 2 to the power of -fraction_bits.

    Returns:
        The index in ROUNDINGS; that of the coarsest one if none makes the samples small enough.
    """
    count = len(columns.means)
    # The samples are runs of consecutive Gaussians, evenly spread. Those of a small scene start at
    # the same places, of which one is kept.
    last_start = max(0, count - SAMPLE_GAUSSIANS)
    starts = np.unique(np.linspace(0, last_start, SAMPLE_COUNT).astype(np.int64))
    samples = [np.arange(start, min(start + SAMPLE_GAUSSIANS, count)) for start in starts]
    rows = np.concatenate(samples)
    sampled_columns = columns.select(rows)
    max_bytes = max(MAX_BYTES_PER_SAMPLED_GAUSSIAN * len(rows), SMALL_FILE_BYTES)

    def is_small_enough(rounding: Rounding) -> bool:
        sections = _encode_sections(sampled_columns, fraction_bits, rounding)
        return len(deflate(b"".join(sections))) <= max_bytes

    # Coarser roundings give smaller files, so bisection finds the first one that is enough. The
    # last one need not be tried, because it is taken if no other is enough.
    return bisect.bisect_left(ROUNDINGS[:-1], True, key=is_small_enough)


def _encode_sections(
    columns: GaussianColumns, fraction_bits: int, rounding: Rounding
) -> list[bytes]:
    """Return the bytes of positions, opacities, colours, scales and rotations, as a file has them.

    Args:
        columns: N Gaussians with y up and z backward.
        fraction_bits: the positions' grid has steps of 2 to the power of -fraction_bits.
        rounding: how coarsely values are rounded, because coarser values compress better.
    """
    positions = _encode_positions(columns, fraction_bits, rounding.position_step)

    opacity_steps = np.round(columns.opacities * (255 / rounding.opacity_step))
    opacities = np.minimum(255, opacity_steps * rounding.opacity_step).astype(np.uint8)

    # A colour is srgb = 0.5 + SH_C0 · f_dc, where f_dc is the coefficient of the constant spherical
    # harmonic. A byte, as a fraction of 255, is 0.5 + COLOR_SCALE · f_dc.
    byte_per_srgb = np.float32(COLOR_SCALE * 255 / SH_C0)
    color_bytes = (columns.srgb - np.float32(0.5)) * byte_per_srgb + np.float32(0.5 * 255)
    colors = np.clip(np.round(color_bytes), 0, 255).astype(np.uint8)

    step_per_log = np.float32(SCALE_STEPS / rounding.scale_step)
    scale_steps = np.round((columns.log_scales - MIN_LOG_SCALE) * step_per_log)
    scales = np.clip(scale_steps * rounding.scale_step, 0, 255).astype(np.uint8)

    # The rotation of a sphere is invisible; so spheres get equal rotations, which compress best.
    is_sphere = (scales == scales[:, :1]).all(axis=1, keepdims=True)  # [N, 1]
    quats = np.where(is_sphere, np.array([1, 0, 0, 0], np.float32), columns.quats)
    rotations = _encode_rotations(quats, rounding.component_bits)
    return [part.tobytes() for part in (positions, opacities, colors, scales, rotations)]


def _encode_positions(
    columns: GaussianColumns, fraction_bits: int, relative_step: float
) -> NDArray[np.uint8]:
    """Return positions as bytes [N, 9]: three fixed-point numbers of 24 bits, lowest byte first.

    Args:
        columns: N Gaussians.
        fraction_bits: how many of a number's bits are fractional.
        relative_step: positions are rounded to a power of two of at most this many standard
            deviations along the Gaussian's middle axis, because finer detail is invisible.
    """
    middle_log_scale = _middle_of_three(columns.log_scales)  # [N]
    # The rounding step in steps of the grid: the largest power of two that is not above
    # relative_step · scale · 2^fraction_bits.
    log2_scale = middle_log_scale / np.float32(np.log(2))
    exponent = np.floor(log2_scale + np.float32(np.log2(relative_step) + fraction_bits))
    # A step below 1 would be finer than the grid. A step above 2^20 would leave fewer than 3 of a
    # coordinate's 23 bits.
    step = np.exp2(np.clip(exponent, 0, 20))[:, None]  # [N, 1]

    grid_positions = columns.means * np.float64(2.0**fraction_bits)
    rounded = np.round(grid_positions / step) * step
    numbers = np.clip(rounded, -MAX_GRID_COORDINATE, MAX_GRID_COORDINATE).astype("<i4")
    four_bytes = numbers.view(np.uint8).reshape(-1, 3, 4)
    # The highest byte only repeats the sign, because 24 bits hold the number.
    return np.ascontiguousarray(four_bytes[:, :, :3])


def _middle_of_three(values: Floats) -> Floats:
    """Return the middle one of the three values in each row [N, 3], as [N]."""
    a, b, c = values.T
    middle: Floats = np.maximum(np.minimum(a, b), np.minimum(np.maximum(a, b), c))
    return middle


def _encode_rotations(quats: Floats, component_bits: int) -> NDArray[np.uint32]:
    """Pack unit quaternions [N, 4] (w, x, y, z) into words of 32 bits [N].

    From the highest bit on, a word has two bits for the index of the largest component of
    (x, y, z, w), and for each other component its sign and nine bits of its size. Only the
    `component_bits` upper ones of the nine are used.
    """
    xyzw = quats[:, [1, 2, 3, 0]]
    largest, others = encode_smallest_three(xyzw)  # [N], [N, 3]
    # Sizes are multiples of this step, so that the lower of the nine bits are 0.
    step = 2 ** (9 - component_bits)
    # The components that are not the largest are at most 1/√2, which gets the largest code.
    code_per_component = np.float32(MAX_COMPONENT_CODE * 2**0.5 / step)
    rounded = np.round(np.abs(others) * code_per_component) * step
    sizes = np.minimum(MAX_COMPONENT_CODE, rounded).astype("<u4")
    is_negative = (others < 0) & (sizes > 0)  # zero has no sign, so that equal values stay equal
    codes = sizes | (is_negative.astype("<u4") << 9)  # [N, 3]; the sign is above the nine bits

    # The index of the largest component ends up in the two highest of the 32 bits.
    words: NDArray[np.uint32] = largest.astype("<u4")
    for component in range(3):
        words = words << 10 | codes[:, component]
    return words


def decode_spz(data: bytes) -> DecodedScene:
    """Decode an SPZ file, with y down and z forward, and harmonics up to degree 3.

    Raises:
        UnsupportedSceneError: the file is of an unknown version.
        ValueError: the file is too short.
        Exception: the compressed data are damaged.
    """
    parts = unpack_parts(data)
    version = parts.header.version
    # A byte, as a fraction of 255, is 0.5 + COLOR_SCALE · f_dc, where f_dc is the coefficient of
    # the constant spherical harmonic. The colour is srgb = 0.5 + SH_C0 · f_dc.
    srgb_per_color = np.float32(SH_C0 / COLOR_SCALE)
    centered_colors = codes_to_fractions(parts.colors, 255) - np.float32(0.5)
    srgb = centered_colors * srgb_per_color + np.float32(0.5)

    if version == 1:
        means = parts.positions.view("<f2").astype(np.float32)
    else:
        means = _decode_positions(parts.positions, parts.header.fraction_bits)
    if version >= 3:
        quats = _decode_rotations(parts.rotations)
    else:
        quats = _decode_rotations_of_version_2(parts.rotations)
    columns = GaussianColumns(
        means=means,
        quats=quats,
        log_scales=codes_to_fractions(parts.scales, SCALE_STEPS) + MIN_LOG_SCALE,
        opacities=codes_to_fractions(parts.opacities[:, 0], 255),
        srgb=colors_of_harmonics(srgb, parts.header.harmonics_degree),
        harmonics=_decode_harmonics(parts),
    )
    return DecodedScene(
        columns=_in_opencv_axes(columns, parts.axes).scaled(1 / parts.length_factor),
        format=f"SPZ {version}",
        harmonics_degree=parts.header.harmonics_degree,
    )


def _in_opencv_axes(columns: GaussianColumns, axes: int) -> GaussianColumns:
    """Return Gaussians with y down and z forward; `axes` is the number of the file's axes."""
    if axes >= len(AXES):
        problem = f"axes of the unknown kind {axes}"
        raise UnsupportedSceneError(f"SPZ with {problem}: save it with y up and z back, or as PLY")
    return columns.to_opencv_axes(AXES[axes])


def _decode_positions(positions: NDArray[np.uint8], fraction_bits: int) -> Floats:
    """Return positions [N, 3] from bytes [N, 9]: three numbers of 24 bits, lowest byte first."""
    three_bytes = positions.reshape(-1, 3)
    # With an empty lowest byte, the sign stands in the highest bit of an int32; the shift by 8
    # bits then extends the sign.
    four_bytes = np.pad(three_bytes, ((0, 0), (1, 0)))
    numbers = four_bytes.view("<i4").reshape(len(positions), 3) >> 8
    return (numbers / 2.0**fraction_bits).astype(np.float32)


def _decode_rotations(rotations: NDArray[np.uint8]) -> Floats:
    """Return unit quaternions [N, 4] (w, x, y, z) from words of version 3, as bytes [N, 4].

    From the highest bit on, a word has two bits for the index of the largest component of
    (x, y, z, w), and for each other component its sign and nine bits of its size.
    """
    words = rotations.copy().view("<u4")  # [N, 1]
    # After these shifts, the lowest ten bits belong to one component. The bits above belong to
    # others; the masks below leave them out.
    codes = words >> np.array([20, 10, 0], np.uint32)  # [N, 3]
    sizes = (codes & MAX_COMPONENT_CODE).astype(np.float32)
    sizes = sizes / np.float32(MAX_COMPONENT_CODE * 2**0.5)
    others = np.where(codes & COMPONENT_SIGN_BIT, -sizes, sizes)
    xyzw = decode_smallest_three(words[:, 0] >> 30, others)
    return xyzw[:, [3, 0, 1, 2]]


def _decode_rotations_of_version_2(rotations: NDArray[np.uint8]) -> Floats:
    """Return unit quaternions [N, 4] (w, x, y, z) from bytes [N, 3] for x, y, z in -1..1."""
    xyz = codes_to_fractions(rotations, 255) * 2 - 1
    # The file omits w (index 3 of x, y, z, w), whichever component is the largest.
    omitted = np.full(len(rotations), 3)
    xyzw = decode_smallest_three(omitted, xyz)
    return xyzw[:, [3, 0, 1, 2]]
