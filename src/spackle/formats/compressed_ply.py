"""Compressed PLY, PlayCanvas's format: 16 bytes a Gaussian, each within the bounds of its 256 neighbours."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from spackle.formats.ply import ply_header
from spackle.formats.scene_files import Columns, Floats, SceneFile, as_shares, smallest_three

CHUNK = 256  # Gaussians that share bounds
LARGEST_LOG_SCALE = 20  # what readers expect at most, in either direction
GRID_BITS = 10  # of each coordinate when neighbours are looked for

_CHUNK_NAMES = [
    *(f"{end}_{prefix}{axis}" for prefix in ("", "scale_") for end in ("min", "max") for axis in "xyz"),
    *(f"{end}_{channel}" for end in ("min", "max") for channel in "rgb"),
]
_VERTEX_NAMES = ["packed_position", "packed_rotation", "packed_scale", "packed_color"]


def encode_compressed_ply(scene: SceneFile) -> bytes:
    """Gaussians, in their axes, as a compressed PLY; the camera and the base's number are comments, as `save_ply`'s.

    The base's stay before the others; within both, neighbours in space become neighbours in the file.

    Raises:
        ValueError: where a Gaussian is not finite.
    """
    columns, count, border = Columns.of(scene.gaussians), len(scene.gaussians), scene.base_count or 0
    order = np.concatenate([morton_order(columns.means[:border]), border + morton_order(columns.means[border:])])
    columns = columns.select(order)
    scales = np.clip(columns.log_scales, -LARGEST_LOG_SCALE, LARGEST_LOG_SCALE)
    starts = np.arange(0, count, CHUNK)
    tables = ("chunk", len(starts), "float", _CHUNK_NAMES), ("vertex", count, "uint", _VERTEX_NAMES)
    chunks = np.zeros((len(starts), len(_CHUNK_NAMES)), "<f4")
    rows = np.zeros((count, len(_VERTEX_NAMES)), "<u4")
    if count:
        places, chunks[:, 0:6] = _normalised(columns.means, starts)
        sizes, chunks[:, 6:12] = _normalised(scales, starts)
        colors, chunks[:, 12:18] = _normalised(columns.srgb, starts)
        rows[:, 0] = _packed(places, (11, 10, 11))
        largest, others = smallest_three(columns.quats)
        rows[:, 1] = largest.astype(np.uint32) << np.uint32(30) | _packed(as_shares(others), (10, 10, 10))
        rows[:, 2] = _packed(sizes, (11, 10, 11))
        rows[:, 3] = _packed(np.concatenate([colors, columns.opacities[:, None]], axis=1), (8, 8, 8, 8))
    header = ply_header(*tables, camera=scene.untilted_camera, base_count=scene.base_count)
    return header + chunks.tobytes() + rows.tobytes()


def morton_order(means: Floats) -> NDArray[np.int64]:
    """[N] an order of points [N, 3] along Morton's curve, which keeps neighbours together."""
    if not len(means):
        return np.zeros(0, np.int64)
    # By logarithms: else one that is far away would put all the near ones into one cell.
    places = np.sign(means) * np.log1p(np.abs(means.astype(np.float64)))
    low = places.min(axis=0)
    span = np.maximum(places.max(axis=0) - low, 1e-30)
    cells = ((places - low) / span * (2**GRID_BITS - 1)).astype(np.uint32)
    return np.argsort(sum(_spread(cells[:, axis]) << axis for axis in range(3)), kind="stable")


def _spread(bits: NDArray[np.uint32]) -> NDArray[np.uint32]:
    """The ten lowest bits with two zeros before each."""
    for shift, mask in ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249)):
        bits = (bits | bits << np.uint32(shift)) & np.uint32(mask)
    return bits


def _normalised(values: Floats, starts: NDArray[np.int64]) -> tuple[Floats, Floats]:
    """Values [N, 3] as shares 0..1 of their chunk's bounds, and the bounds [chunks, 6]: least, greatest."""
    low, high = np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)
    rows = np.arange(len(values)) // CHUNK
    wide = low.astype(np.float64)  # the ends may be farther apart than a float32 can say
    span = np.maximum(high - wide, 1e-30)
    shares = (values - wide[rows]) / span[rows]
    return shares.astype(np.float32), np.concatenate([low, high], axis=1)


def _packed(shares: Floats, widths: tuple[int, ...]) -> NDArray[np.uint32]:
    """[N] words of shares 0..1 [N, k], each rounded to its number of bits, the first one highest."""
    word = np.zeros(len(shares), np.uint32)
    for column, width in zip(shares.T, widths, strict=True):
        word = word << np.uint32(width) | np.round(column * np.float32(2**width - 1)).astype(np.uint32)
    return word
