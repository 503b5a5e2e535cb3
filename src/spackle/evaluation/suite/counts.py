"""What drawing a scene needs at least: operations and bytes of each stage, counted for the very scene."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from spackle._numba import ONE, ZERO, kernel
from spackle.device import run_chunks
from spackle.evaluation.suite.arithmetic import operations_of
from spackle.evaluation.suite.values import Need
from spackle.gaussians import Gaussians
from spackle.render import project as projection
from spackle.render.blend import (
    CHECK_EVERY,
    LANES,
    PLANE,
    STATE,
    alpha_of,
    blend_patch,
    blend_splat,
    encode_srgb,
    exp2,
    is_full,
    patches_of,
)
from spackle.render.pipeline import BLEND_GRAIN, Drawing, draw, wanted_tiles
from spackle.render.project import HALF_HEIGHT, HALF_WIDTH, KernelCamera, X, Y, natural_log
from spackle.render.protocol import TILE

Array = npt.NDArray[Any]

FLOAT = 4  # bytes
GAUSSIAN = FLOAT * (3 + 4 + 3 + 1 + 3)  # the five tensors
RECORD = FLOAT * projection.RECORD
BOX, KEY, ID, START = 4 * 2, 4, 4, 8
PIXEL = FLOAT * (3 + 1 + 1)  # colour, depth, alpha
PASSES = 3  # of the radix sort

INTEGERS = frozenset({"i", "k", "first", "found", "bits", "exponent"})  # in the kernels' sources
EDGES = frozenset({"left", "right", "top", "bottom"})  # in those of the projection
DEPTH_OPERATIONS = 2  # of a pixel: depth over alpha, where that is more than zero
DEPTH_TEST = 10  # of a Gaussian behind the camera: z in three products and three sums, and the four comparisons


@dataclasses.dataclass(frozen=True)
class Walk:
    """How far blending goes before its tiles are full."""

    splats: int  # Gaussians drawn into tiles, each as often as into tiles
    patches: int  # of sixteen pixels, that they are drawn into


def drawing_needs(sets: Sequence[Gaussians], view: KernelCamera, tiles: Array | None = None) -> dict[str, Need]:
    """Needs of "project", "sort", "bin" and "blend" where sets are drawn, in some tiles or in all."""
    wanted = wanted_tiles(view, None) if tiles is None else tiles
    drawing = draw(sets, view, wanted, None)
    counts = np.diff(drawing.lists.starts)
    visible, entries = len(np.unique(drawing.lists.ids)), int(counts.sum())
    return {
        "project": project_need(sum(len(part) for part in sets), visible),
        "sort": sort_need(visible),
        "bin": bin_need(visible, entries, wanted.size),
        "blend": blend_need(drawing, visible, entries),
    }


def project_need(gaussians: int, visible: int) -> Need:
    """Read five tensors of each; write the record, the box, the key and the id of each visible one.

    A visible one's operations are those written in `measure_block` and what it calls, and in `pack_block`, in float64;
    of any other it takes the depth to know that.
    """
    parts = (
        projection.measure_block,
        projection.covariance,
        natural_log,
        projection.cover,
        projection.cover,
        projection.pack_block,
    )
    each = sum(operations_of(part, INTEGERS | EDGES) for part in parts)
    operations = float(visible * each + (gaussians - visible) * DEPTH_TEST)
    return Need(float(gaussians * GAUSSIAN + visible * (RECORD + BOX + KEY + ID)), {"fp64": operations})


def sort_need(visible: int) -> Need:
    """Three passes that read and write each key and id; no floating-point."""
    return Need(float(PASSES * 2 * (KEY + ID) * visible))


def bin_need(visible: int, entries: int, tiles: int) -> Need:
    """Read the order and each one's box, write each tile's list and where it begins; no floating-point."""
    return Need(float(visible * (ID + BOX) + entries * ID + tiles * START))


def blend_need(drawing: Drawing, visible: int, entries: int) -> Need:
    """Read the lists, and each visible record once (again it comes from the cache); write each pixel once.

    Operations: those of `blend_patch` for each of the sixteen pixels of each patch that is drawn before its tile is
    full, and what finishes each pixel.
    """
    walk, pixels = walked(drawing), int(drawing.wanted.sum()) * PLANE
    operations = walk.patches * LANES * pixel_operations() + pixels * finish_operations()
    traffic = entries * ID + visible * RECORD + pixels * PIXEL
    return Need(float(traffic), {"fp32": float(operations)})


def pixel_operations() -> int:
    """Of one pixel of one patch of one Gaussian."""
    return sum(operations_of(part, INTEGERS) for part in (blend_patch, alpha_of, exp2))


def finish_operations() -> int:
    """Of one pixel, once: three channels to sRGB, depth over alpha."""
    return 3 * operations_of(encode_srgb) + DEPTH_OPERATIONS


def walked(drawing: Drawing) -> Walk:
    """Blend a drawing's tiles once more, and count."""
    tiles, lists, columns = np.flatnonzero(drawing.wanted), drawing.lists, drawing.wanted.shape[1]
    counts = np.zeros((len(tiles), 2), np.int64)
    run_chunks(
        lambda a, b: count_walk(a, b, tiles, columns, lists.ids, lists.starts, drawing.splats.records, counts),
        len(tiles),
        BLEND_GRAIN,
    )
    splats, patches = counts.sum(axis=0)
    return Walk(int(splats), int(patches))


@kernel
def count_walk(
    first: int, last: int, tiles: Array, columns: int, ids: Array, starts: Array, records: Array, counts: Array
) -> None:
    """Go through tiles first..last as `blend_tiles` does; write Gaussians and patches of each to counts [K, 2]."""
    state = np.empty(STATE, np.float32)
    for k in range(first, last):
        tile = tiles[k]
        left, top = (tile % columns) * TILE, (tile // columns) * TILE
        for i in range(STATE):
            state[i] = ONE if i < PLANE else ZERO
        for entry in range(starts[tile], starts[tile + 1]):
            blend_splat(state, records, ids[entry], left, top)
            counts[k, 0] += 1
            counts[k, 1] += count_patches(records[ids[entry]], left, top)
            if (entry - starts[tile]) % CHECK_EVERY == CHECK_EVERY - 1 and is_full(state):
                break


@kernel
def count_patches(record: Array, left: int, top: int) -> int:
    """The patches of a tile that a Gaussian is drawn into."""
    half = np.float32(0.5)
    first_row, last_row = patches_of(record[Y] - np.float32(top) - half, record[HALF_HEIGHT])
    first_column, last_column = patches_of(record[X] - np.float32(left) - half, record[HALF_WIDTH])
    return max(last_row - first_row, 0) * max(last_column - first_column, 0)
