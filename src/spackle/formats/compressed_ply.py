"""Compressed PLY, PlayCanvas's format: 16 bytes for each Gaussian.

256 consecutive Gaussians, a chunk, share bounds of their positions, scales and colours; the
values of a Gaussian are small integers between these bounds.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from spackle.formats.gaussian_columns import Floats, GaussianColumns
from spackle.formats.ply_tables import NewTable, ply_header
from spackle.formats.quantization import (
    components_to_fractions,
    decode_smallest_three,
    encode_smallest_three,
    fractions_to_components,
    near_distance,
    ordinary_length_factor,
)
from spackle.formats.scene_content import SceneFile

GAUSSIANS_PER_CHUNK = 256

# The largest absolute value of a scale's logarithm that readers expect.
MAX_LOG_SCALE = 20

# Bits of each coordinate along Morton's curve; three coordinates fit a word of 32 bits.
MORTON_BITS = 10

LOG2_DISTANCES_PER_CLASS = 10  # the farthest of a class is a thousand times as far as the nearest

# A range of equal values counts as this wide, so that no fraction divides by zero.
MIN_SPAN = 1e-30

# The properties of a vertex: four words of 32 bits.
PACKED_PROPERTIES = ["packed_position", "packed_rotation", "packed_scale", "packed_color"]

# Bits of each value in a word, the first value in the highest bits. The index of a quaternion's
# largest component takes the two bits above those of the rotation.
POSITION_BITS = (11, 10, 11)
ROTATION_BITS = (10, 10, 10)
SCALE_BITS = (11, 10, 11)
COLOR_BITS = (8, 8, 8, 8)  # red, green, blue, opacity

# The properties of a chunk: three minima and three maxima of each kind.
POSITION_BOUNDS = ["min_x", "min_y", "min_z", "max_x", "max_y", "max_z"]
SCALE_BOUNDS = ["min_scale_x", "min_scale_y", "min_scale_z"]
SCALE_BOUNDS += ["max_scale_x", "max_scale_y", "max_scale_z"]
COLOR_BOUNDS = ["min_r", "min_g", "min_b", "max_r", "max_g", "max_b"]
CHUNK_PROPERTIES = [*POSITION_BOUNDS, *SCALE_BOUNDS, *COLOR_BOUNDS]


# The coefficient of a harmonic is the byte b as (b + ½) / 256 in 0..1, of which 0 stands for -4 and
# 1 for 4; the bytes 0 and 255 are these bounds.
HARMONICS_SPAN = 8
HARMONICS_TABLE = "sh"


def encode_compressed_ply(scene: SceneFile) -> bytes:
    """Encode a scene as a compressed PLY, with y down and z forward.

    Comments in the header keep the photo's camera (if it is at the origin), how many Gaussians come
    from the photo, and how far the camera may go to the side (`disparity`).

    The values of 256 consecutive Gaussians (a chunk) are stored as fractions between their bounds.
    So the Gaussians are sorted, and neighbours in space become neighbours in the file. Gaussians
    that come from the photo stay before those that fill holes. Harmonics, in a table of their own,
    are bytes.

    Raises:
        ValueError: a Gaussian is not finite.
    """
    columns = GaussianColumns.from_gaussians(scene.gaussians).select(file_order(scene))

    harmonics_rows = b""
    harmonics_tables = []
    if columns.harmonics is not None:
        codes = _encode_harmonics(columns.harmonics)
        harmonics_rows = codes.tobytes()
        names = [f"f_rest_{index}" for index in range(codes.shape[1])]
        harmonics_tables = [
            NewTable(name=HARMONICS_TABLE, row_count=len(codes), type="uchar", properties=names)
        ]

    chunks, vertices = _encode_tables(columns)
    header = ply_header(
        NewTable(name="chunk", row_count=len(chunks), type="float", properties=CHUNK_PROPERTIES),
        NewTable(name="vertex", row_count=len(vertices), type="uint", properties=PACKED_PROPERTIES),
        *harmonics_tables,
        camera=scene.camera,
        base_count=scene.base_count,
        disparity=scene.disparity,
        is_metric=scene.is_metric,
    )
    return header + chunks.tobytes() + vertices.tobytes() + harmonics_rows


def _encode_harmonics(harmonics: Floats) -> NDArray[np.uint8]:
    """Return coefficients [N, K, 3] as bytes [N, 3·K]: all of red, then of green, then of blue."""
    by_color = harmonics.transpose(0, 2, 1).reshape(len(harmonics), -1)
    fractions = by_color / np.float32(HARMONICS_SPAN) + np.float32(0.5)
    codes: NDArray[np.uint8] = np.clip(np.floor(fractions * 256), 0, 255).astype(np.uint8)
    return codes


def decode_harmonics(codes: NDArray[np.uint8]) -> Floats:
    """Return the coefficients [N, K, 3] of bytes [N, 3·K]; the inverse of `_encode_harmonics`."""
    fractions = (codes.astype(np.float32) + np.float32(0.5)) / np.float32(256)
    fractions[codes == 0] = 0
    fractions[codes == 255] = 1
    coefficients: Floats = (fractions - np.float32(0.5)) * np.float32(HARMONICS_SPAN)
    by_color = coefficients.reshape(len(codes), 3, -1)
    return by_color.transpose(0, 2, 1)


def file_order(scene: SceneFile) -> NDArray[np.int64]:
    """Return the indices [N] that bring a scene's Gaussians into the order of a compressed PLY."""
    means = scene.gaussians.means.detach().to("cpu", torch.float32).numpy()
    # If it is not known which Gaussians fill holes, all are sorted together.
    base_count = 0 if scene.base_count is None else scene.base_count
    base_order = spatial_order(means[:base_count])
    fill_order = base_count + spatial_order(means[base_count:])
    return np.concatenate([base_order, fill_order])


def spatial_order(means: Floats) -> NDArray[np.int64]:
    """Return the indices [N] that sort points [N, 3] by distance classes, then by Morton's curve.

    A class reaches from one distance to a thousand times as far, so that most scenes are one class.
    A chunk with a near and a very far Gaussian could store neither of both finely.
    """
    if len(means) == 0:
        return np.zeros(0, np.int64)
    distances = np.linalg.norm(means.astype(np.float64), axis=1)
    relative = distances / max(near_distance(means), MIN_SPAN)
    classes = np.floor(np.log2(np.maximum(relative, 1)) / LOG2_DISTANCES_PER_CLASS)
    orders = []
    for distance_class in np.unique(classes):
        members = np.flatnonzero(classes == distance_class)
        orders.append(members[morton_order(means[members])])
    return np.concatenate(orders)


def _encode_tables(columns: GaussianColumns) -> tuple[Floats, NDArray[np.uint32]]:
    """Encode N Gaussians as the two tables of the file.

    Returns:
        The chunks [ceil(N / 256), 18], one row for 256 consecutive Gaussians, with the columns
        CHUNK_PROPERTIES; and the vertices [N, 4], with the columns PACKED_PROPERTIES.
    """
    count = len(columns.means)
    chunk_starts = np.arange(0, count, GAUSSIANS_PER_CHUNK)
    chunks = np.zeros((len(chunk_starts), len(CHUNK_PROPERTIES)), "<f4")
    vertices = np.zeros((count, len(PACKED_PROPERTIES)), "<u4")
    if count == 0:
        return chunks, vertices

    # A row of the chunks has the bounds of the positions, of the scales' logarithms and of the
    # colours: three minima and three maxima of each.
    positions, chunks[:, 0:6] = _to_fractions(columns.means, chunk_starts)
    log_scales = np.clip(columns.log_scales, -MAX_LOG_SCALE, MAX_LOG_SCALE)
    scales, chunks[:, 6:12] = _to_fractions(log_scales, chunk_starts)
    colors, chunks[:, 12:18] = _to_fractions(columns.srgb, chunk_starts)
    rgba = np.concatenate([colors, columns.opacities[:, None]], axis=1)  # [N, 4]

    largest, others = encode_smallest_three(columns.quats)
    rotation_words = _pack_fractions(components_to_fractions(others), ROTATION_BITS)
    # The index of the largest component takes the two bits above the three others.
    largest_bits = largest.astype(np.uint32) << np.uint32(30)

    vertices[:, 0] = _pack_fractions(positions, POSITION_BITS)
    vertices[:, 1] = largest_bits | rotation_words
    vertices[:, 2] = _pack_fractions(scales, SCALE_BITS)
    vertices[:, 3] = _pack_fractions(rgba, COLOR_BITS)
    return chunks, vertices


def morton_order(means: Floats) -> NDArray[np.int64]:
    """Return the indices [N] that sort points [N, 3] along Morton's curve.

    The curve visits the cells of a grid so that neighbours in space mostly stay neighbours. A
    cell's place on it has the bits of its three coordinates in turn.
    """
    if len(means) == 0:
        return np.zeros(0, np.int64)
    # In an ordinary unit, the logarithms below spread near and far points alike.
    ordinary_means = means.astype(np.float64) * ordinary_length_factor(means)
    # Logarithms, because a single distant point would otherwise put all near points in one cell.
    log_positions = np.sign(ordinary_means) * np.log1p(np.abs(ordinary_means))
    low = log_positions.min(axis=0)  # [3]
    span = np.maximum(log_positions.max(axis=0) - low, MIN_SPAN)
    last_cell = 2**MORTON_BITS - 1
    cells = ((log_positions - low) / span * last_cell).astype(np.uint32)  # [N, 3]

    # The bits of x, y and z alternate, so each coordinate's bits are spread to every third place.
    place_on_curve = _spread_bits(cells[:, 0])
    place_on_curve |= _spread_bits(cells[:, 1]) << np.uint32(1)
    place_on_curve |= _spread_bits(cells[:, 2]) << np.uint32(2)
    return np.argsort(place_on_curve, kind="stable")


def _spread_bits(numbers: NDArray[np.uint32]) -> NDArray[np.uint32]:
    """Put two zero bits between neighbouring bits of numbers [N] below 1024 (ten bits)."""
    # Each step moves the upper half of every group of bits up, and halves the groups. The mask
    # clears the copies that the shift left behind.
    for shift, mask in ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249)):
        numbers = (numbers | numbers << np.uint32(shift)) & np.uint32(mask)
    return numbers


def _to_fractions(values: Floats, chunk_starts: NDArray[np.int64]) -> tuple[Floats, Floats]:
    """Express values [N, 3] as fractions between the smallest and largest value of their chunk.

    A chunk is 256 consecutive Gaussians; the last one may be shorter.

    Args:
        values: one row for each Gaussian.
        chunk_starts: [C] the first row of each chunk.

    Returns:
        The fractions [N, 3] in 0..1, and the bounds [C, 6]: three minima, three maxima.
    """
    low = np.minimum.reduceat(values, chunk_starts)  # [C, 3]
    high = np.maximum.reduceat(values, chunk_starts)
    # The difference of the bounds may overflow float32.
    low_64 = low.astype(np.float64)
    span = np.maximum(high - low_64, MIN_SPAN)
    chunk_of_row = np.arange(len(values)) // GAUSSIANS_PER_CHUNK  # [N]
    fractions = (values - low_64[chunk_of_row]) / span[chunk_of_row]
    return fractions.astype(np.float32), np.concatenate([low, high], axis=1)


def _pack_fractions(fractions: Floats, bit_counts: tuple[int, ...]) -> NDArray[np.uint32]:
    """Round the k fractions of each row to codes, and pack these into one word a row.

    A code is a whole number: 0 for the fraction 0, and the largest that its bits can hold for 1.

    Args:
        fractions: [N, k] in 0..1.
        bit_counts: how many bits the code of each of the k columns has.

    Returns:
        [N] words of 32 bits; the code of the first column is in the highest of the bits in use.
    """
    words = np.zeros(len(fractions), np.uint32)
    for column, bit_count in zip(fractions.T, bit_counts, strict=True):
        largest_code = np.float32(2**bit_count - 1)
        codes = np.round(column * largest_code).astype(np.uint32)
        words = words << np.uint32(bit_count) | codes
    return words


def decode_compressed_ply(
    chunks: NDArray[Any], vertices: NDArray[Any], harmonics: NDArray[np.uint8] | None = None
) -> GaussianColumns:
    """Decode the tables of a compressed PLY.

    Args:
        chunks: [C] rows with the fields CHUNK_PROPERTIES; older files have no COLOR_BOUNDS.
        vertices: [N] rows with the fields PACKED_PROPERTIES.
        harmonics: [N, 3·K] bytes of K harmonics, if the file has any.

    Raises:
        ValueError: bounds are missing, or there are too few chunks for the vertices.
    """
    chunk_fields = chunks.dtype.names or ()
    missing = {*POSITION_BOUNDS, *SCALE_BOUNDS}.difference(chunk_fields)
    if missing:
        raise ValueError(f"its chunks have no {min(missing)}")
    if len(chunks) * GAUSSIANS_PER_CHUNK < len(vertices):
        raise ValueError(f"{len(chunks)} chunks for {len(vertices)} vertices")

    positions, rotations, scales, colors = (
        np.array(vertices[name], np.uint32) for name in PACKED_PROPERTIES
    )
    rgba = _unpack_fractions(colors, COLOR_BITS)  # [N, 4]
    srgb = rgba[:, :3]
    # In older files, the fractions are the colours themselves.
    if COLOR_BOUNDS[0] in chunk_fields:
        srgb = _from_fractions(srgb, chunks, COLOR_BOUNDS)

    # The two highest bits hold the index of the largest component.
    largest = rotations >> np.uint32(30)
    others = fractions_to_components(_unpack_fractions(rotations, ROTATION_BITS))

    position_fractions = _unpack_fractions(positions, POSITION_BITS)
    scale_fractions = _unpack_fractions(scales, SCALE_BITS)
    return GaussianColumns(
        means=_from_fractions(position_fractions, chunks, POSITION_BOUNDS),
        quats=decode_smallest_three(largest, others),
        log_scales=_from_fractions(scale_fractions, chunks, SCALE_BOUNDS),
        opacities=rgba[:, 3],
        srgb=srgb if harmonics is not None else np.clip(srgb, 0, 1),
        harmonics=None if harmonics is None else decode_harmonics(harmonics),
    )


def _unpack_fractions(words: NDArray[np.uint32], bit_counts: tuple[int, ...]) -> Floats:
    """Return the k fractions that `_pack_fractions` packed into each word.

    A word holds one code, a whole number, for each fraction; the first one is in the highest
    bits. Code 0 stands for 0, and the largest code that a column's bits can hold stands for 1.

    Args:
        words: [N] of 32 bits. If the codes leave the highest bits free, these are ignored.
        bit_counts: how many bits the code of each of the k columns has.

    Returns:
        [N, k] fractions in 0..1.
    """
    # Column k lies above the bits of all later columns.
    shifts = np.array([sum(bit_counts[k + 1 :]) for k in range(len(bit_counts))], np.uint32)
    largest_codes = np.array([2**bit_count - 1 for bit_count in bit_counts])
    codes = words[:, None] >> shifts & largest_codes.astype(np.uint32)
    fractions: Floats = np.divide(codes, largest_codes, dtype=np.float32)
    return fractions


def _from_fractions(fractions: Floats, chunks: NDArray[Any], bound_names: list[str]) -> Floats:
    """Return the values of fractions between their chunk's bounds; inverts `_to_fractions`.

    A chunk is 256 consecutive Gaussians; the last one may be shorter.

    Args:
        fractions: [N, 3] in 0..1, one row for each Gaussian.
        chunks: [C] rows with the fields `bound_names`.
        bound_names: three minima, then three maxima.

    Returns:
        [N, 3] low + fraction · (high - low).
    """
    bounds = np.stack([chunks[name] for name in bound_names], axis=1).astype(np.float64)  # [C, 6]
    bounds_of_row = bounds[np.arange(len(fractions)) // GAUSSIANS_PER_CHUNK]  # [N, 6]
    low = bounds_of_row[:, 0:3]
    high = bounds_of_row[:, 3:6]
    # Broken bounds may give infinite values, which `GaussianColumns.to_gaussians` refuses.
    with np.errstate(over="ignore", invalid="ignore"):
        return (low + fractions * (high - low)).astype(np.float32)
