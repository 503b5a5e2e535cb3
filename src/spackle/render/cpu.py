"""The CPU renderer: project, assign to tiles, sort, blend; `gradients` adds the backward pass."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from importlib import import_module

import numpy as np
import torch
from torch import Tensor

from spackle.core.camera import Camera
from spackle.core.gaussians import Gaussians
from spackle.render.blend import TileLists, blend_tiles
from spackle.render.project import (
    DEPTH,
    RECORD,
    Arrays,
    KernelCamera,
    Splats,
    count_before,
    project_chunk,
)
from spackle.render.protocol import Rendering, check_tiles
from spackle.runtime.device import parallel_for_chunks
from spackle.runtime.kernels import Array, inlined_kernel, kernel

PROJECT_GRAIN = 1 << 16  # Gaussians a thread projects at a time
BLEND_GRAIN = 64  # tiles a thread blends at a time
DIGITS, DIGIT_BITS = 4, 8  # of a sort key, which has 32 bits
BUCKETS = 1 << DIGIT_BITS


class CpuRenderer:
    """Classic 3D Gaussian splatting on the CPU; a `Renderer`."""

    def render(
        self,
        gaussians: Gaussians | Sequence[Gaussians],
        camera: Camera,
        *,
        eps2d: float = 0.0,
        tiles: Tensor | None = None,
        onto: Rendering | None = None,
    ) -> Rendering:
        """See `Renderer.render`; the result is float32."""
        sets = [gaussians] if isinstance(gaussians, Gaussians) else list(gaussians)
        view = KernelCamera.of(camera, eps2d)
        wanted = wanted_tiles(view, tiles)
        onto = onto if tiles is not None else None
        inputs = [t for part in sets for t in part.tensors] + list(onto.tensors if onto else ())
        if torch.is_grad_enabled() and any(t.requires_grad for t in inputs):
            # Without gradients this module, which needs time to compile, is not loaded.
            drawn: Rendering = import_module("spackle.render.gradients").draw(
                sets, view, wanted, onto
            )
            return drawn
        return draw(sets, view, wanted, onto).rendering()


@dataclasses.dataclass(frozen=True)
class Drawing:
    """A rendering, and the intermediate results that the gradient needs."""

    view: KernelCamera
    wanted: Array  # [rows, columns] bool: the drawn tiles
    splats: Splats
    lists: TileLists
    images: Arrays  # float32: rgb [H, W, 3] sRGB, depth [H, W], alpha [H, W], linear colour [H, W, 3] or [0, 0, 3]

    def rendering(self) -> Rendering:
        """The images as tensors that share the arrays' memory."""
        return Rendering(*(torch.from_numpy(image) for image in self.images[:3]))


def draw(
    sets: Sequence[Gaussians],
    view: KernelCamera,
    wanted: Array,
    onto: Rendering | None,
    *,
    keep_linear: bool = False,
) -> Drawing:
    """Draw sets of Gaussians in the wanted tiles [rows, columns] bool, over a copy of `onto` (None: black).

    The gradient needs the linear colour (`keep_linear`).
    """
    splats, lists = deal_out(sets, view, wanted)
    size = (view.height, view.width)
    linear = np.zeros((*(size if keep_linear else (0, 0)), 3), np.float32)
    if onto is None:
        images = tuple(np.zeros((*size, *rest), np.float32) for rest in ((3,), (), ()))
    else:
        images = tuple(np.array(as_array(image)) for image in onto.tensors)
    images = (*images, linear)
    tiles = np.flatnonzero(wanted)

    def chunk(start: int, stop: int) -> None:  # sorting and blending of a few tiles share the cache
        sort_tiles(start, stop, tiles, lists, splats.records)
        blend_tiles(start, stop, tiles, lists, splats.records, images)

    parallel_for_chunks(chunk, len(tiles), BLEND_GRAIN)
    return Drawing(view, wanted, splats, lists, images)


def touched_tiles(gaussians: Gaussians | Sequence[Gaussians], camera: Camera) -> Tensor:
    """[ceil(H/16), ceil(W/16)] bool: tiles with pixels that these Gaussians can change."""
    view = KernelCamera.of(camera, 0.0)
    sets = [gaussians] if isinstance(gaussians, Gaussians) else gaussians
    _, lists = deal_out(sets, view, wanted_tiles(view, None))
    return torch.from_numpy(np.diff(lists.starts) > 0).reshape(view.tiles)


def deal_out(
    sets: Sequence[Gaussians], view: KernelCamera, wanted: Array
) -> tuple[Splats, TileLists]:
    """Project Gaussians, and assign them to tiles."""
    splats = project(sets, view, wanted)
    return splats, list_tiles(splats.boxes, wanted)


def as_array(tensor: Tensor) -> Array:
    """A tensor as a contiguous float32 array, without copy if possible."""
    return tensor.detach().to(device="cpu", dtype=torch.float32).contiguous().numpy()


def wanted_tiles(view: KernelCamera, tiles: Tensor | None) -> Array:
    """The tiles to draw, [rows, columns] bool; if `tiles` is None, all tiles."""
    if tiles is None:
        return np.ones(view.tiles, np.bool_)
    check_tiles(tiles, view.height, view.width)
    return tiles.detach().to(device="cpu", dtype=torch.bool).contiguous().numpy()


def project(sets: Sequence[Gaussians], view: KernelCamera, wanted: Array) -> Splats:
    """Project Gaussians; those that touch wanted tiles get records."""
    n, before, first = sum(len(part) for part in sets), count_before(wanted), 0
    splats = Splats(np.empty((n, RECORD), np.float32), np.empty((n, 4), np.uint16))
    for part in sets:
        scene = tuple(as_array(tensor) for tensor in part.tensors)

        def chunk(start: int, stop: int, first: int = first, scene: Arrays = scene) -> None:
            project_chunk(start, stop, first, scene, view, before, splats)

        parallel_for_chunks(chunk, len(part), PROJECT_GRAIN)
        first += len(part)
    return splats


@kernel
def sort_tiles(first: int, last: int, tiles: Array, lists: TileLists, records: Array) -> None:
    """Sort the lists of the tiles first..last of `tiles` [K] front to back; Gaussians of equal depth keep their order.

    Depths are positive, so their bits have the same order. A radix sort skips digits that a tile's depths share.
    """
    (ids, starts), depth_bits, longest = lists, records.view(np.uint32), 0
    for k in range(first, last):
        longest = max(longest, starts[tiles[k] + 1] - starts[tiles[k]])
    keys, sorted_keys = np.empty(longest, np.uint32), np.empty(longest, np.uint32)
    items, sorted_items = np.empty(longest, np.int32), np.empty(longest, np.int32)
    places = np.empty(
        (DIGITS, BUCKETS), np.uint32
    )  # unsigned, so that no check for negative indices is compiled
    for k in range(first, last):
        own = ids[starts[tiles[k]] : starts[tiles[k] + 1]]
        places[:] = 0
        for n in range(len(own)):
            items[n], keys[n] = own[n], depth_bits[np.uint64(own[n]), DEPTH]
            for digit in range(DIGITS):
                places[digit, digit_of(keys[n], digit)] += np.uint32(1)
        for digit in range(DIGITS):
            starts_of, total = places[digit], np.uint32(0)
            if len(own) == 0 or starts_of[digit_of(keys[0], digit)] == len(own):
                continue
            for bucket in range(BUCKETS):
                count = starts_of[bucket]
                starts_of[bucket] = total
                total += count
            for n in range(len(own)):
                value = digit_of(keys[n], digit)
                place = starts_of[value]
                sorted_keys[place], sorted_items[place] = keys[n], items[n]
                starts_of[value] = place + np.uint32(1)
            keys, sorted_keys, items, sorted_items = sorted_keys, keys, sorted_items, items
        own[:] = items[: len(own)]


@inlined_kernel
def digit_of(key: np.uint32, digit: int) -> np.uint32:
    """Digit number `digit` of a key, the lowest first."""
    return np.uint32((key >> np.uint32(DIGIT_BITS * digit)) & np.uint32(BUCKETS - 1))


def list_tiles(boxes: Array, wanted: Array) -> TileLists:
    """List the Gaussians of each tile, in their own order.

    Args:
        boxes: [N, 4] uint16, the tiles that each Gaussian touches.
        wanted: [rows, columns] bool; lists of other tiles are empty.
    """
    parts = -(-len(boxes) // PROJECT_GRAIN)
    counts = np.zeros((parts, wanted.size), np.int64)
    parallel_for_chunks(lambda a, b: count_entries(a, b, boxes, wanted, counts), parts, 1)
    starts = np.concatenate([[0], np.cumsum(counts.sum(axis=0))])
    positions = starts[:-1] + np.cumsum(counts, axis=0) - counts  # of each part's first entry
    ids = np.empty(starts[-1], np.int32)
    parallel_for_chunks(lambda a, b: write_entries(a, b, boxes, wanted, positions, ids), parts, 1)
    return TileLists(ids, starts)


@kernel
def count_entries(first: int, last: int, boxes: Array, wanted: Array, counts: Array) -> None:
    """Count the entries of each tile from the parts first..last of the Gaussians."""
    columns, flat = wanted.shape[1], wanted.reshape(-1)
    for part in range(first, last):
        row_counts = counts[part]
        for i in range(part * PROJECT_GRAIN, min((part + 1) * PROJECT_GRAIN, len(boxes))):
            k = np.uint64(i)  # unsigned, so that no check for negative indices is compiled
            for row in range(boxes[k, 2], boxes[k, 3]):
                for column in range(boxes[k, 0], boxes[k, 1]):
                    tile = np.uint64(row * columns + column)
                    if flat[tile]:
                        row_counts[tile] += 1


@kernel
def write_entries(
    first: int, last: int, boxes: Array, wanted: Array, positions: Array, ids: Array
) -> None:
    """Write the entries of each tile from the parts first..last of the Gaussians."""
    columns, flat = wanted.shape[1], wanted.reshape(-1)
    for part in range(first, last):
        places = positions[part]
        for i in range(part * PROJECT_GRAIN, min((part + 1) * PROJECT_GRAIN, len(boxes))):
            k = np.uint64(i)
            for row in range(boxes[k, 2], boxes[k, 3]):
                for column in range(boxes[k, 0], boxes[k, 1]):
                    tile = np.uint64(row * columns + column)
                    if flat[tile]:
                        ids[np.uint64(places[tile])] = i
                        places[tile] += 1
