"""The stages of the CPU renderer, one after the other: project, sort, deal out to tiles, blend."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from spackle._numba import Array
from spackle.camera import Camera
from spackle.device import run_chunks
from spackle.gaussians import Gaussians
from spackle.render.binning import TileLists, list_tiles, sort_by_depth
from spackle.render.blend import blend_tiles
from spackle.render.project import KernelCamera, Splats, count_before, project_chunk
from spackle.render.protocol import Rendering

PROJECT_GRAIN = 1 << 16  # Gaussians a thread projects at a time
BLEND_GRAIN = 64  # tiles a thread blends at a time


@dataclasses.dataclass(frozen=True)
class Drawing:
    """A finished drawing, and what its gradient needs to know."""

    view: KernelCamera
    wanted: Array  # [rows, columns] bool, the tiles that were drawn
    splats: Splats
    lists: TileLists
    rgb: Array  # [H, W, 3] float32 sRGB
    depth: Array  # [H, W] float32
    alpha: Array  # [H, W] float32
    linear: Array  # [H, W, 3] float32, the colour before sRGB, or [0, 0, 3] where nobody asks for it

    def rendering(self) -> Rendering:
        """The images as tensors of the same memory."""
        return Rendering(*(torch.from_numpy(image) for image in (self.rgb, self.depth, self.alpha)))


def draw(
    sets: Sequence[Gaussians], view: KernelCamera, wanted: Array, onto: Rendering | None, *, keep_linear: bool = False
) -> Drawing:
    """Draw sets of Gaussians as one, in the wanted tiles [rows, columns] bool, over a copy of `onto`.

    The other tiles are black and empty where `onto` is None. The gradient needs the colour before sRGB (`keep_linear`).
    """
    splats, spans = project(sets, view, wanted)
    lists = list_tiles(sort_by_depth(splats.keys, splats.ids, spans), splats.boxes, wanted)
    return blend(splats, lists, view, wanted, onto, keep_linear)


def as_array(tensor: Tensor) -> Array:
    """A tensor's values as contiguous float32, without a copy where they are that already."""
    return tensor.detach().to(device="cpu", dtype=torch.float32).contiguous().numpy()


def wanted_tiles(view: KernelCamera, tiles: Tensor | None) -> Array:
    """The tiles to draw, [rows, columns] bool."""
    if tiles is None:
        return np.ones(view.tiles, np.bool_)
    if tuple(tiles.shape) != view.tiles:
        raise ValueError(f"tiles has shape {tuple(tiles.shape)}, expected {view.tiles}")
    return tiles.detach().to(device="cpu", dtype=torch.bool).contiguous().numpy()


def touched_tiles(gaussians: Gaussians, camera: Camera, eps2d: float = 0.0) -> Tensor:
    """[ceil(H/16), ceil(W/16)] bool: the tiles whose pixels can change when these Gaussians come or go."""
    view = KernelCamera.of(camera, eps2d)
    everywhere = wanted_tiles(view, None)
    splats, spans = project([gaussians], view, everywhere)
    lists = list_tiles(sort_by_depth(splats.keys, splats.ids, spans), splats.boxes, everywhere)
    return torch.from_numpy(np.diff(lists.starts) > 0).reshape(view.tiles)


def project(
    sets: Sequence[Gaussians], view: KernelCamera, wanted: Array, splats: Splats | None = None, first: int = 0
) -> tuple[Splats, Array]:
    """Project sets one after the other, without joining them first, as far as they touch wanted tiles.

    Args:
        splats: where they go, from number `first` on; new ones where None.
        first: how many are there already.

    Returns:
        The splats, and the spans (start, count) [C, 2] of their keys and ids that are in use.
    """
    splats = splats or Splats.allocate(sum(len(part) for part in sets))
    before = count_before(wanted)
    spans: list[tuple[int, int]] = []
    for part in sets:
        arrays = [as_array(tensor) for tensor in part.tensors]

        def chunk(start: int, stop: int, first: int = first, arrays: list[Array] = arrays) -> None:
            found = project_chunk(
                start, stop, first, *arrays, view.lens, view.pose, view.width, view.height, view.eps2d, before,
                splats.records, splats.boxes, splats.keys, splats.ids,
            )  # fmt: skip
            spans.append((first + start, found))

        run_chunks(chunk, len(part), PROJECT_GRAIN)
        first += len(part)
    return splats, np.array(sorted(spans), np.int64).reshape(-1, 2)


def blend(
    splats: Splats,
    lists: TileLists,
    view: KernelCamera,
    wanted: Array,
    onto: Rendering | None,
    keep_linear: bool = False,
) -> Drawing:
    """Draw the wanted tiles; see `draw`."""
    size = (view.height, view.width)
    linear = np.zeros((*(size if keep_linear else (0, 0)), 3), np.float32)
    if onto is None:
        rgb, depth, alpha = (np.zeros((*size, *rest), np.float32) for rest in ((3,), (), ()))
    else:
        rgb, depth, alpha = (np.array(as_array(image)) for image in onto.tensors)
    tiles = np.flatnonzero(wanted)

    def chunk(start: int, stop: int) -> None:
        blend_tiles(
            start, stop, tiles, wanted.shape[1], lists.ids, lists.starts, splats.records, rgb, depth, alpha, linear
        )

    run_chunks(chunk, len(tiles), BLEND_GRAIN)
    return Drawing(view, wanted, splats, lists, rgb, depth, alpha, linear)
