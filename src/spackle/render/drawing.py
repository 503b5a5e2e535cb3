"""The forward pass of the CPU renderer: project Gaussians, list them by tile, sort, blend."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from spackle.core.camera import Camera
from spackle.core.gaussians import Gaussians
from spackle.render.blend import blend_tiles
from spackle.render.project import (
    DEPTH,
    RECORD_FLOATS,
    Arrays,
    KernelCamera,
    Splats,
    count_drawn_tiles,
    project_gaussians,
)
from spackle.render.protocol import MIN_NEAR_PLANE, Rendering, as_sets, check_tiles
from spackle.render.tile_lists import (
    TileLists,
    count_by_part,
    list_tiles,
    sort_tiles,
    tile_blocks,
)
from spackle.runtime.device import parallel_for_chunks
from spackle.runtime.kernels import Array

GAUSSIANS_PER_CHUNK = 1 << 16  # Gaussians that a thread projects at a time
TILES_PER_CHUNK = 64  # tiles that a thread sorts and blends at a time

# Lists of all tiles together that are made at one time: half a gigabyte. A scene of SHARP has some
# millions of entries; but each of a few Gaussians may be as large as the whole picture.
MAX_ENTRIES_AT_ONCE = 1 << 27


@dataclasses.dataclass(frozen=True)
class Drawing:
    """A rendering, and the intermediate results that the backward pass needs."""

    view: KernelCamera
    drawn_tiles: Array  # [rows, columns] bool
    splats: Splats
    lists: TileLists  # sorted front to back in the drawn tiles
    # Float32: rgb [H, W, 3] sRGB, depth [H, W], alpha [H, W], and linear colour [H, W, 3].
    images: Arrays

    def rendering(self) -> Rendering:
        """The images as tensors that share the arrays' memory."""
        rgb, depth, alpha, _ = self.images
        return Rendering(torch.from_numpy(rgb), torch.from_numpy(depth), torch.from_numpy(alpha))


def draw(
    sets: Sequence[Gaussians],
    view: KernelCamera,
    drawn_tiles: Array,
    background: Rendering | None,
) -> Rendering:
    """Draw sets of Gaussians into some tiles of an image.

    If the lists of all tiles together would be very long, they are made for some tiles at a time.

    Args:
        sets: drawn together as if they were one set; without harmonics.
        view: the camera.
        drawn_tiles: [rows, columns] bool: the tiles of 16×16 pixels to draw.
        background: a rendering whose copy fills all other tiles; None: they are black and empty.
    """
    splats = project(sets, view, drawn_tiles)
    images = blank_images(view, background, keep_linear=False)
    counts = count_by_part(splats.boxes, drawn_tiles, GAUSSIANS_PER_CHUNK)
    list_lengths = counts.sum(axis=0)
    if list_lengths.sum() <= MAX_ENTRIES_AT_ONCE:
        lists = list_tiles(splats.boxes, drawn_tiles, GAUSSIANS_PER_CHUNK, counts)
        blend_lists(splats, lists, drawn_tiles, images)
    else:
        del counts  # large, and only of use for all tiles together
        _draw_in_blocks(splats, list_lengths.reshape(view.tiles), drawn_tiles, images)
    rgb, depth, alpha, _ = images
    return Rendering(torch.from_numpy(rgb), torch.from_numpy(depth), torch.from_numpy(alpha))


def draw_for_gradients(
    sets: Sequence[Gaussians],
    view: KernelCamera,
    drawn_tiles: Array,
    background: Rendering | None,
) -> Drawing:
    """Draw as `draw` does, and keep the lists of all tiles and the linear colour.

    The backward pass needs both. The arguments are those of `draw`.
    """
    splats = project(sets, view, drawn_tiles)
    lists = list_tiles(splats.boxes, drawn_tiles, GAUSSIANS_PER_CHUNK)
    images = blank_images(view, background, keep_linear=True)
    blend_lists(splats, lists, drawn_tiles, images)
    return Drawing(view, drawn_tiles, splats, lists, images)


def _draw_in_blocks(
    splats: Splats, list_lengths: Array, drawn_tiles: Array, images: Arrays
) -> None:
    """Draw some tiles after the others, so that only the lists of some are in memory.

    Args:
        splats: the projected Gaussians.
        list_lengths: [rows, columns] entries of each tile's list.
        drawn_tiles: [rows, columns] bool: the tiles of 16×16 pixels to draw.
        images: as `blank_images` makes them; they are drawn over.
    """
    # Gaussians that are sorted now need not be sorted again in the list of every tile. As there,
    # equal depths keep their order. Depths are positive, so their bits have the same order.
    depth_bits = splats.records[:, DEPTH].view(np.uint32)
    front_to_back = np.argsort(depth_bits, kind="stable")
    boxes = splats.boxes[front_to_back]
    sorted_splats = Splats(splats.records[front_to_back], boxes)
    for block in tile_blocks(list_lengths, MAX_ENTRIES_AT_ONCE):
        block_tiles = block.drawn(drawn_tiles)
        lists = list_tiles(block.clip(boxes), block_tiles, GAUSSIANS_PER_CHUNK)
        blend_lists(sorted_splats, lists, block_tiles, images, are_sorted=True)


def blend_lists(
    splats: Splats,
    lists: TileLists,
    drawn_tiles: Array,
    images: Arrays,
    *,
    are_sorted: bool = False,
) -> None:
    """Sort the lists of some tiles front to back, and draw these tiles.

    Args:
        splats: the projected Gaussians.
        lists: of all tiles; sorted in place.
        drawn_tiles: [rows, columns] bool: the tiles to draw.
        images: as `blank_images` makes them; they are drawn over.
        are_sorted: whether the lists are sorted already.
    """
    tiles = np.flatnonzero(drawn_tiles)

    # Each chunk sorts its tiles just before it blends them, while they are in the cache.
    def sort_and_blend(start: int, stop: int) -> None:
        if not are_sorted:
            sort_tiles(start, stop, tiles, lists, splats.records)
        blend_tiles(start, stop, tiles, lists, splats.records, images)

    parallel_for_chunks(sort_and_blend, len(tiles), TILES_PER_CHUNK)


def blank_images(view: KernelCamera, background: Rendering | None, keep_linear: bool) -> Arrays:
    """The images of a `Drawing` before anything is drawn: a copy of `background`, or zeros.

    Returns rgb [H, W, 3], depth [H, W], alpha [H, W] and linear colour [H, W, 3] in float32. The
    linear colour is zero, and has the shape [0, 0, 3] unless `keep_linear`.
    """
    height, width = view.height, view.width
    linear = np.zeros((height, width, 3) if keep_linear else (0, 0, 3), np.float32)
    if background is not None:
        # `np.array` copies, because the images will be drawn over.
        rgb = np.array(as_array(background.rgb))
        depth = np.array(as_array(background.depth))
        alpha = np.array(as_array(background.alpha))
        return rgb, depth, alpha, linear
    rgb = np.zeros((height, width, 3), np.float32)
    depth = np.zeros((height, width), np.float32)
    alpha = np.zeros((height, width), np.float32)
    return rgb, depth, alpha, linear


def touched_tiles(gaussians: Gaussians | Sequence[Gaussians], camera: Camera) -> Tensor:
    """[ceil(H/16), ceil(W/16)] bool: tiles with pixels that these Gaussians can change."""
    # Colours, which may change with the view, do not matter.
    sets = [part.with_harmonics_count(0) for part in as_sets(gaussians)]
    # Drawn together with others, they may have a nearer near plane than alone.
    view = KernelCamera.of(camera, eps2d=0.0, near=MIN_NEAR_PLANE)
    drawn_tiles = tiles_to_draw(view, None)
    splats = project(sets, view, drawn_tiles)
    counts = count_by_part(splats.boxes, drawn_tiles, GAUSSIANS_PER_CHUNK)
    return torch.from_numpy(counts.any(axis=0)).reshape(view.tiles)


def project(sets: Sequence[Gaussians], view: KernelCamera, drawn_tiles: Array) -> Splats:
    """Project the Gaussians of all sets; those that touch a drawn tile get a record for blending.

    `drawn_tiles` is [rows, columns] bool. The sets have no harmonics: their colours are those that
    the camera sees.
    """
    count = sum(len(part) for part in sets)
    drawn_before = count_drawn_tiles(drawn_tiles)
    splats = Splats(
        records=np.empty((count, RECORD_FLOATS), np.float32), boxes=np.empty((count, 4), np.uint16)
    )
    first_index = 0  # of the set's first Gaussian among those of all sets
    for part in sets:
        scene = tuple(as_array(tensor) for tensor in part.tensors)
        offset = first_index

        # As default values, this set's numbers are fixed; the loop changes the variables later.
        def project_some(
            start: int, stop: int, offset: int = offset, scene: Arrays = scene
        ) -> None:
            project_gaussians(start, stop, offset, scene, view, drawn_before, splats)

        parallel_for_chunks(project_some, len(part), GAUSSIANS_PER_CHUNK)
        first_index += len(part)
    return splats


def tiles_to_draw(view: KernelCamera, tiles: Tensor | None) -> Array:
    """A caller's choice of tiles as an array [rows, columns] bool; None chooses all tiles.

    ValueError if the shape of `tiles` does not fit the view.
    """
    if tiles is None:
        return np.ones(view.tiles, np.bool_)
    check_tiles(tiles, view.height, view.width)
    return tiles.detach().to(device="cpu", dtype=torch.bool).contiguous().numpy()


def as_array(tensor: Tensor) -> Array:
    """A tensor as a contiguous float32 array, without copy if possible."""
    return tensor.detach().to(device="cpu", dtype=torch.float32).contiguous().numpy()
