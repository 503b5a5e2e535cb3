"""The CPU renderer: project, sort, assign to tiles, blend; `gradients` adds the backward pass."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from importlib import import_module

import numpy as np
import torch
from torch import Tensor

from spackle._numba import Array, kernel
from spackle.camera import Camera
from spackle.device import run_chunks, thread_count
from spackle.gaussians import Gaussians
from spackle.render.blend import TileLists, blend_tiles
from spackle.render.project import RECORD, Arrays, KernelCamera, Splats, count_before, project_chunk
from spackle.render.protocol import Rendering, check_tiles

PROJECT_GRAIN = 1 << 16  # Gaussians a thread projects at a time
BLEND_GRAIN = 64  # tiles a thread blends at a time
DIGIT_BITS = 11  # three digits hold the 31 bits of a positive float
BUCKETS = 1 << DIGIT_BITS
MASK = BUCKETS - 1


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
            drawn: Rendering = import_module("spackle.render.gradients").draw(sets, view, wanted, onto)
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
    sets: Sequence[Gaussians], view: KernelCamera, wanted: Array, onto: Rendering | None, *, keep_linear: bool = False
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
    run_chunks(lambda a, b: blend_tiles(a, b, tiles, lists, splats.records, images), len(tiles), BLEND_GRAIN)
    return Drawing(view, wanted, splats, lists, images)


def touched_tiles(gaussians: Gaussians, camera: Camera) -> Tensor:
    """[ceil(H/16), ceil(W/16)] bool: tiles with pixels that these Gaussians can change."""
    view = KernelCamera.of(camera, 0.0)
    _, lists = deal_out([gaussians], view, wanted_tiles(view, None))
    return torch.from_numpy(np.diff(lists.starts) > 0).reshape(view.tiles)


def deal_out(sets: Sequence[Gaussians], view: KernelCamera, wanted: Array) -> tuple[Splats, TileLists]:
    """Project and sort Gaussians, and assign them to tiles."""
    splats, spans = project(sets, view, wanted)
    return splats, list_tiles(sort_by_depth(splats.keys, splats.ids, spans), splats.boxes, wanted)


def as_array(tensor: Tensor) -> Array:
    """A tensor as a contiguous float32 array, without copy if possible."""
    return tensor.detach().to(device="cpu", dtype=torch.float32).contiguous().numpy()


def wanted_tiles(view: KernelCamera, tiles: Tensor | None) -> Array:
    """The tiles to draw, [rows, columns] bool; if `tiles` is None, all tiles."""
    if tiles is None:
        return np.ones(view.tiles, np.bool_)
    check_tiles(tiles, view.height, view.width)
    return tiles.detach().to(device="cpu", dtype=torch.bool).contiguous().numpy()


def project(sets: Sequence[Gaussians], view: KernelCamera, wanted: Array) -> tuple[Splats, Array]:
    """Project Gaussians, and keep those that touch wanted tiles.

    Returns:
        The splats, and the spans (start, count) [C, 2] of used keys and ids.
    """
    n, before, first = sum(len(part) for part in sets), count_before(wanted), 0
    records, boxes = np.empty((n, RECORD), np.float32), np.empty((n, 4), np.uint16)
    splats = Splats(records, boxes, np.empty(n, np.uint32), np.empty(n, np.int32))
    spans: list[tuple[int, int]] = []
    for part in sets:
        scene = tuple(as_array(tensor) for tensor in part.tensors)

        def chunk(start: int, stop: int, first: int = first, scene: Arrays = scene) -> None:
            spans.append((first + start, project_chunk(start, stop, first, scene, view, before, splats)))

        run_chunks(chunk, len(part), PROJECT_GRAIN)
        first += len(part)
    return splats, np.array(sorted(spans), np.int64).reshape(-1, 2)


def sort_by_depth(keys: Array, ids: Array, spans: Array) -> Array:
    """Sort Gaussians front to back; Gaussians of equal depth keep their order.

    Args:
        keys: [N] uint32, the bits of positive floats; overwritten.
        ids: [N] int32; overwritten.
        spans: [C, 2] int64, the used pieces (start, count) of keys and ids.

    Returns:
        [M] int32, the ids in the order of keys; M is the sum of all counts.
    """
    total = int(spans[:, 1].sum())
    items, others = (keys, ids), (np.empty(total, np.uint32), np.empty(total, np.int32))
    for shift in range(0, 32, DIGIT_BITS):
        _sort_digit(items, spans, shift, others)
        items, others = others, items
        spans = even_spans(total, len(spans))
    return items[1][:total]


def _sort_digit(items: Arrays, spans: Array, shift: int, into: Arrays) -> None:
    """Sort (keys, ids) by the digit at bit `shift`; items with equal digits keep their order."""
    counts = np.zeros((len(spans), BUCKETS), np.int64)
    run_chunks(lambda a, b: count_digits(a, b, spans, items[0], shift, counts), len(spans), 1)
    positions = starts_of(counts)
    run_chunks(lambda a, b: scatter(a, b, spans, items, shift, positions, into), len(spans), 1)


def even_spans(total: int, parts: int) -> Array:
    """Divide 0..total into equal pieces (start, count), [parts, 2] int64."""
    edges = np.linspace(0, total, parts + 1).astype(np.int64)
    return np.stack([edges[:-1], np.diff(edges)], axis=1)


def starts_of(counts: Array) -> Array:
    """Start positions [C, B] from the numbers of items [C, B]; items are ordered by bucket, then by piece."""
    flat = counts.T.reshape(-1)
    return np.ascontiguousarray((np.cumsum(flat) - flat).reshape(counts.shape[::-1]).T)


@kernel
def count_digits(first: int, last: int, spans: Array, keys: Array, shift: int, counts: Array) -> None:
    """Count the occurrences of each digit in the keys of pieces first..last."""
    for piece in range(first, last):
        row = counts[piece]
        for i in range(spans[piece, 0], spans[piece, 0] + spans[piece, 1]):
            row[(keys[i] >> np.uint32(shift)) & np.uint32(MASK)] += 1


@kernel
def scatter(first: int, last: int, spans: Array, items: Arrays, shift: int, positions: Array, into: Arrays) -> None:
    """Move the keys and ids of pieces first..last to their sorted positions."""
    (keys, ids), (sorted_keys, sorted_ids) = items, into
    for piece in range(first, last):
        row = positions[piece]
        for i in range(spans[piece, 0], spans[piece, 0] + spans[piece, 1]):
            digit = (keys[i] >> np.uint32(shift)) & np.uint32(MASK)
            place = row[digit]
            row[digit] = place + 1
            sorted_keys[place] = keys[i]
            sorted_ids[place] = ids[i]


def list_tiles(order: Array, boxes: Array, wanted: Array) -> TileLists:
    """Assign the sorted Gaussians to tiles.

    Args:
        order: [M] int32, visible Gaussians front to back.
        boxes: [N, 4] uint16, the tiles that each Gaussian touches.
        wanted: [rows, columns] bool; lists of other tiles are empty.
    """
    parts = thread_count()
    spans = even_spans(len(order), parts)
    counts = np.zeros((parts, wanted.size), np.int64)
    sorted_boxes = np.empty((len(order), 4), np.uint16)
    run_chunks(lambda a, b: count_entries(a, b, spans, order, boxes, wanted, sorted_boxes, counts), parts, 1)
    starts = np.concatenate([[0], np.cumsum(counts.sum(axis=0))])
    positions = starts_of(counts)
    ids = np.empty(starts[-1], np.int32)
    run_chunks(lambda a, b: write_entries(a, b, spans, order, sorted_boxes, wanted, positions, ids), parts, 1)
    return TileLists(ids, starts)


@kernel
def count_entries(
    first: int, last: int, spans: Array, order: Array, boxes: Array, wanted: Array, sorted_boxes: Array, counts: Array
) -> None:
    """Count the entries of each tile in pieces first..last of the order, and copy the boxes in this order."""
    columns, flat = wanted.shape[1], wanted.reshape(-1)
    for piece in range(first, last):
        row_counts = counts[piece]
        for place in range(spans[piece, 0], spans[piece, 0] + spans[piece, 1]):
            k = np.uint64(place)  # unsigned, so that no check for negative indices is compiled
            i = np.uint64(order[k])
            left, right, top, bottom = boxes[i, 0], boxes[i, 1], boxes[i, 2], boxes[i, 3]
            sorted_boxes[k, 0], sorted_boxes[k, 1], sorted_boxes[k, 2], sorted_boxes[k, 3] = left, right, top, bottom
            # With bounds read from memory the compiler emits scalar loops, which are faster for a box of a few tiles.
            for row in range(sorted_boxes[k, 2], sorted_boxes[k, 3]):
                for column in range(sorted_boxes[k, 0], sorted_boxes[k, 1]):
                    tile = np.uint64(row * columns + column)
                    if flat[tile]:
                        row_counts[tile] += 1


@kernel
def write_entries(
    first: int, last: int, spans: Array, order: Array, sorted_boxes: Array, wanted: Array, positions: Array, ids: Array
) -> None:
    """Write the entries of each tile from pieces first..last of the order."""
    columns, flat = wanted.shape[1], wanted.reshape(-1)
    for piece in range(first, last):
        places = positions[piece]
        for place in range(spans[piece, 0], spans[piece, 0] + spans[piece, 1]):
            k = np.uint64(place)
            for row in range(sorted_boxes[k, 2], sorted_boxes[k, 3]):
                for column in range(sorted_boxes[k, 0], sorted_boxes[k, 1]):
                    tile = np.uint64(row * columns + column)
                    if flat[tile]:
                        ids[np.uint64(places[tile])] = order[k]
                        places[tile] += 1
