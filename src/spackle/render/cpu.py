"""The CPU renderer: project, sort, deal out to tiles, blend."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from spackle.camera import Camera
from spackle.gaussians import Gaussians
from spackle.render.blend import blend_tiles
from spackle.render.project import Splats, View, project_chunk
from spackle.render.sort import sort_by_depth
from spackle.render.threads import run_chunks
from spackle.render.tiles import TileLists, list_tiles
from spackle.rendering import Rendering

Array = npt.NDArray[Any]

PROJECT_GRAIN = 1 << 16  # Gaussians a thread projects at a time
BLEND_GRAIN = 64  # tiles a thread blends at a time


@dataclasses.dataclass(frozen=True)
class Canvas:
    """The three images as arrays, to be drawn into tile by tile."""

    rgb: Array  # [H, W, 3] float32 sRGB
    depth: Array  # [H, W] float32
    alpha: Array  # [H, W] float32

    @staticmethod
    def prepare(view: View, onto: Rendering | None) -> Canvas:
        """Black and empty, or a copy of `onto`."""
        if onto is None:
            size = (view.height, view.width)
            return Canvas(np.zeros((*size, 3), np.float32), np.zeros(size, np.float32), np.zeros(size, np.float32))
        return Canvas(*(np.array(as_array(t)) for t in (onto.rgb, onto.depth, onto.alpha)))

    def rendering(self) -> Rendering:
        """The same memory as tensors."""
        return Rendering(torch.from_numpy(self.rgb), torch.from_numpy(self.depth), torch.from_numpy(self.alpha))


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
        """Draw Gaussians as a camera sees them; see `Renderer.render`. The result is float32."""
        sets = [gaussians] if isinstance(gaussians, Gaussians) else list(gaussians)
        view = View.of(camera, eps2d)
        wanted = wanted_tiles(view, tiles)
        canvas = Canvas.prepare(view, onto if tiles is not None else None)
        splats, spans = project(sets, view)
        order = sort_by_depth(splats.keys, splats.ids, spans)
        lists = list_tiles(order, splats.boxes, wanted)
        blend(splats, lists, wanted, canvas)
        return canvas.rendering()


def as_array(tensor: Tensor) -> Array:
    """A tensor's values as contiguous float32, without a copy where they are that already."""
    return tensor.detach().to(device="cpu", dtype=torch.float32).contiguous().numpy()


def wanted_tiles(view: View, tiles: Tensor | None) -> Array:
    """The tiles to draw, [rows, columns] bool."""
    if tiles is None:
        return np.ones(view.tiles, np.bool_)
    if tuple(tiles.shape) != view.tiles:
        raise ValueError(f"tiles has shape {tuple(tiles.shape)}, expected {view.tiles}")
    return tiles.detach().to(device="cpu", dtype=torch.bool).contiguous().numpy()


def project(sets: Sequence[Gaussians], view: View) -> tuple[Splats, Array]:
    """Project sets one after the other, without joining them first.

    Returns:
        The splats, and the spans (start, count) [C, 2] of their keys and ids that are in use.
    """
    splats = Splats.allocate(sum(len(part) for part in sets))
    spans: list[tuple[int, int]] = []
    first = 0
    for part in sets:
        arrays = [as_array(tensor) for tensor in part.tensors]

        def chunk(start: int, stop: int, first: int = first, arrays: list[Array] = arrays) -> None:
            found = project_chunk(
                start, stop, first, *arrays, view.lens, view.pose, view.width, view.height, view.eps2d,
                splats.records, splats.boxes, splats.keys, splats.ids,
            )  # fmt: skip
            spans.append((first + start, found))

        run_chunks(chunk, len(part), PROJECT_GRAIN)
        first += len(part)
    return splats, np.array(sorted(spans), np.int64).reshape(-1, 2)


def blend(splats: Splats, lists: TileLists, wanted: Array, canvas: Canvas) -> None:
    """Draw the wanted tiles."""
    tiles = np.flatnonzero(wanted)

    def chunk(start: int, stop: int) -> None:
        blend_tiles(
            start, stop, tiles, wanted.shape[1], lists.ids, lists.starts, splats.records,
            canvas.rgb, canvas.depth, canvas.alpha,
        )  # fmt: skip

    run_chunks(chunk, len(tiles), BLEND_GRAIN)
