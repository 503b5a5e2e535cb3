"""Compressed PLY, PlayCanvas's format: 16 bytes for each Gaussian, quantised within bounds that 256 Gaussians share."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from spackle.formats.ply import PACKED, ply_header
from spackle.formats.scene_files import (
    Floats,
    GaussianColumns,
    SceneFile,
    components_to_fractions,
    decode_smallest_three,
    encode_smallest_three,
    fractions_to_components,
)

CHUNK = 256  # Gaussians that share bounds
LARGEST_LOG_SCALE = 20  # largest absolute value that readers expect
GRID_BITS = 10  # bits of each coordinate in Morton order

_CHUNK_NAMES = [
    *(
        f"{end}_{prefix}{axis}"
        for prefix in ("", "scale_")
        for end in ("min", "max")
        for axis in "xyz"
    ),
    *(f"{end}_{channel}" for end in ("min", "max") for channel in "rgb"),
]
PLACE_BITS, TURN_BITS, COLOR_BITS = (11, 10, 11), (10, 10, 10), (8, 8, 8, 8)


def encode_compressed_ply(scene: SceneFile) -> bytes:
    """Encode a scene as a compressed PLY; the axes stay the same, and the comments are those of `save_ply`.

    The base's Gaussians come first; within base and aux, neighbours in space become neighbours in the file. ValueError
    if a Gaussian is not finite.
    """
    columns, count, border = (
        GaussianColumns.of(scene.gaussians),
        len(scene.gaussians),
        scene.base_count or 0,
    )
    order = np.concatenate(
        [morton_order(columns.means[:border]), border + morton_order(columns.means[border:])]
    )
    columns = columns.select(order)
    scales = np.clip(columns.log_scales, -LARGEST_LOG_SCALE, LARGEST_LOG_SCALE)
    starts = np.arange(0, count, CHUNK)
    tables = ("chunk", len(starts), "float", _CHUNK_NAMES), ("vertex", count, "uint", PACKED)
    chunks = np.zeros((len(starts), len(_CHUNK_NAMES)), "<f4")
    rows = np.zeros((count, len(PACKED)), "<u4")
    if count:
        places, chunks[:, 0:6] = _normalised(columns.means, starts)
        sizes, chunks[:, 6:12] = _normalised(scales, starts)
        colors, chunks[:, 12:18] = _normalised(columns.srgb, starts)
        rows[:, 0] = _packed(places, PLACE_BITS)
        largest, others = encode_smallest_three(columns.quats)
        rows[:, 1] = largest.astype(np.uint32) << np.uint32(30) | _packed(
            components_to_fractions(others), TURN_BITS
        )
        rows[:, 2] = _packed(sizes, PLACE_BITS)
        rows[:, 3] = _packed(
            np.concatenate([colors, columns.opacities[:, None]], axis=1), COLOR_BITS
        )
    header = ply_header(
        *tables,
        camera=scene.untilted_camera,
        base_count=scene.base_count,
        disparity=scene.disparity,
    )
    return header + chunks.tobytes() + rows.tobytes()


def morton_order(means: Floats) -> NDArray[np.int64]:
    """Indices [N] that sort points [N, 3] along Morton's curve, so that neighbours stay together."""
    if not len(means):
        return np.zeros(0, np.int64)
    # Logarithms, because a single distant point would otherwise put all near points into one cell.
    places = np.sign(means) * np.log1p(np.abs(means.astype(np.float64)))
    low = places.min(axis=0)
    span = np.maximum(places.max(axis=0) - low, 1e-30)
    cells = ((places - low) / span * (2**GRID_BITS - 1)).astype(np.uint32)
    return np.argsort(sum(_spread(cells[:, axis]) << axis for axis in range(3)), kind="stable")


def _spread(bits: NDArray[np.uint32]) -> NDArray[np.uint32]:
    """Spread the ten lowest bits, with two zeros between neighbouring ones."""
    for shift, mask in ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249)):
        bits = (bits | bits << np.uint32(shift)) & np.uint32(mask)
    return bits


def _normalised(values: Floats, starts: NDArray[np.int64]) -> tuple[Floats, Floats]:
    """Values [N, 3] as fractions 0..1 between their chunk's bounds, and the bounds [chunks, 6]: minima, maxima."""
    low, high = np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)
    rows = np.arange(len(values)) // CHUNK
    wide = low.astype(np.float64)  # the bounds' difference may overflow float32
    span = np.maximum(high - wide, 1e-30)
    shares = (values - wide[rows]) / span[rows]
    return shares.astype(np.float32), np.concatenate([low, high], axis=1)


def _packed(shares: Floats, widths: tuple[int, ...]) -> NDArray[np.uint32]:
    """Pack fractions 0..1 [N, k] into words [N]; each is rounded to its width, the first takes the highest bits."""
    word = np.zeros(len(shares), np.uint32)
    for column, width in zip(shares.T, widths, strict=True):
        word = word << np.uint32(width) | np.round(column * np.float32(2**width - 1)).astype(
            np.uint32
        )
    return word


def decode_compressed_ply(chunks: NDArray[Any], rows: NDArray[Any]) -> GaussianColumns:
    """Decode Gaussians from a file's two tables; ValueError if the tables do not fit together."""
    if missing := set(_CHUNK_NAMES[:12]) - set(chunks.dtype.names or ()):
        raise ValueError(f"its chunks have no {min(missing)}")
    if len(chunks) * CHUNK < len(rows):
        raise ValueError(f"{len(chunks)} chunks for {len(rows)} vertices")
    places, turns, sizes, colors = (np.array(rows[name], np.uint32) for name in PACKED)
    rgba = _unpacked(colors, COLOR_BITS)
    srgb = (
        _between(rgba[:, :3], chunks, _CHUNK_NAMES[12:])
        if "min_r" in (chunks.dtype.names or ())
        else rgba[:, :3]
    )
    return GaussianColumns(
        _between(_unpacked(places, PLACE_BITS), chunks, _CHUNK_NAMES[0:6]),
        decode_smallest_three(
            turns >> np.uint32(30), fractions_to_components(_unpacked(turns, TURN_BITS))
        ),
        _between(_unpacked(sizes, PLACE_BITS), chunks, _CHUNK_NAMES[6:12]),
        rgba[:, 3],
        np.clip(srgb, 0, 1),
    )


def _unpacked(words: NDArray[np.uint32], widths: tuple[int, ...]) -> Floats:
    """The inverse of `_packed`: unpack words [N] into fractions 0..1 [N, k]; higher bits are ignored."""
    shifts = np.array([sum(widths[k + 1 :]) for k in range(len(widths))], np.uint32)
    masks = np.array([2**width - 1 for width in widths])
    codes = words[:, None] >> shifts & masks.astype(np.uint32)
    shares: Floats = np.divide(codes, masks, dtype=np.float32)
    return shares


def _between(shares: Floats, chunks: NDArray[Any], names: list[str]) -> Floats:
    """The inverse of `_normalised`; `names` are the properties with the chunks' bounds: three minima, three maxima."""
    bounds = np.stack([chunks[name] for name in names], axis=1).astype(np.float64)
    low, high = np.split(bounds[np.arange(len(shares)) // CHUNK], 2, axis=1)
    with np.errstate(
        over="ignore", invalid="ignore"
    ):  # `GaussianColumns.gaussians` refuses infinite values
        return (low + shares * (high - low)).astype(np.float32)
