"""The CPU renderer, differentiable by all tensors that it is given: project, sort, deal out to tiles, blend."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from spackle._numba import Array
from spackle.camera import Camera
from spackle.device import run_chunks, thread_count
from spackle.gaussians import Gaussians
from spackle.render.binning import TileLists, list_tiles, sort_by_depth
from spackle.render.blend import blend_tiles
from spackle.render.blend_backward import SUMS, backward_tiles, collect_sums
from spackle.render.project import KernelCamera, Splats, count_before, project_chunk
from spackle.render.project_backward import project_backward
from spackle.render.protocol import Rendering, check_tiles, tile_mask

FIELDS = 5  # tensors in a set of Gaussians
PROJECT_GRAIN = 1 << 16  # Gaussians a thread projects at a time
BLEND_GRAIN = 64  # tiles a thread blends at a time


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
        view = KernelCamera.of(camera, eps2d)
        wanted = wanted_tiles(view, tiles)
        onto = onto if tiles is not None else None
        inputs = [t for part in sets for t in part.tensors] + (list(onto.tensors) if onto else [])
        if not (torch.is_grad_enabled() and any(t.requires_grad for t in inputs)):
            return draw(sets, view, wanted, onto).rendering()
        under = [None] * 3 if onto is None else [image.float() for image in onto.tensors]
        fields = [t.to(device="cpu", dtype=torch.float32) for part in sets for t in part.tensors]
        return Rendering(*Draw.apply(view, wanted, *under, *fields))  # type: ignore[no-untyped-call]


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


def touched_tiles(gaussians: Gaussians, camera: Camera) -> Tensor:
    """[ceil(H/16), ceil(W/16)] bool: the tiles whose pixels can change when these Gaussians come or go."""
    view = KernelCamera.of(camera, 0.0)
    everywhere = wanted_tiles(view, None)
    splats, spans = project([gaussians], view, everywhere)
    lists = list_tiles(sort_by_depth(splats.keys, splats.ids, spans), splats.boxes, everywhere)
    return torch.from_numpy(np.diff(lists.starts) > 0).reshape(view.tiles)


def as_array(tensor: Tensor) -> Array:
    """A tensor's values as contiguous float32, without a copy where they are that already."""
    return tensor.detach().to(device="cpu", dtype=torch.float32).contiguous().numpy()


def wanted_tiles(view: KernelCamera, tiles: Tensor | None) -> Array:
    """The tiles to draw, [rows, columns] bool."""
    if tiles is None:
        return np.ones(view.tiles, np.bool_)
    check_tiles(tiles, view.height, view.width)
    return tiles.detach().to(device="cpu", dtype=torch.bool).contiguous().numpy()


def project(sets: Sequence[Gaussians], view: KernelCamera, wanted: Array) -> tuple[Splats, Array]:
    """Project sets one after the other, without joining them first, as far as they touch wanted tiles.

    Returns:
        The splats, and the spans (start, count) [C, 2] of their keys and ids that are in use.
    """
    splats = Splats.allocate(sum(len(part) for part in sets))
    before, first = count_before(wanted), 0
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


class Draw(torch.autograd.Function):
    """Draw sets of Gaussians, given as a flat row of tensors, over the three images of `onto`."""

    @staticmethod
    def forward(ctx: Any, view: KernelCamera, wanted: Array, *tensors: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
        """Draw; `tensors` are rgb, depth and alpha of `onto` (or None), then the five of each set, all float32."""
        under, fields = tensors[:3], [t for t in tensors[3:] if t is not None]
        sets = [Gaussians(*fields[k : k + FIELDS]) for k in range(0, len(fields), FIELDS)]
        onto = None if under[0] is None else Rendering(*under)  # type: ignore[arg-type]
        drawing = draw(sets, view, wanted, onto, keep_linear=True)
        rendering = drawing.rendering()
        ctx.drawing, ctx.sizes = drawing, [len(part) for part in sets]
        ctx.save_for_backward(*rendering.tensors, *fields)
        return rendering.tensors

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        """From the gradients of the three images to those of the tensors that asked for one."""
        outputs, fields = tuple(as_array(t) for t in ctx.saved_tensors[:3]), ctx.saved_tensors[3:]
        needs = ctx.needs_input_grad[2:]
        drawn = tile_mask(torch.from_numpy(ctx.drawing.wanted), *gradients[1].shape)
        under = [  # nothing where tiles were drawn over the image beneath
            torch.where(mask, 0, gradient) if need else None
            for mask, gradient, need in zip((drawn[..., None], drawn, drawn), gradients, needs, strict=False)
        ]
        rows, count, parts = np.full(sum(ctx.sizes), -1, np.int32), 0, []
        for k, size in enumerate(ctx.sizes):
            if any(needs[3 + k * FIELDS : 3 + (k + 1) * FIELDS]):
                first = sum(ctx.sizes[:k])
                rows[first : first + size] = np.arange(count, count + size)
                parts.append((slice(k * FIELDS, (k + 1) * FIELDS), slice(count, count + size)))
                count += size
        table = pixel_sums(ctx.drawing, outputs, tuple(as_array(g) for g in gradients), rows, count)
        results: list[Tensor | None] = [None] * len(fields)
        for own, of in parts:
            results[own] = set_gradients(fields[own], ctx.drawing.view, table[of])
        return None, None, *under, *(r if need else None for r, need in zip(results, needs[3:], strict=True))


def pixel_sums(
    drawing: Drawing, outputs: tuple[Array, ...], gradients: tuple[Array, ...], rows: Array, count: int
) -> Array:
    """What the pixels give to each Gaussian that wants gradients, a table [count, SUMS] float32.

    Each tile writes sums of its own, which are added up in the order of the tiles: the result does not depend on which
    thread was faster. `rows` [N] int32 are the table's rows that belong to the Gaussians, -1 for none.
    """
    lists, columns = drawing.lists, drawing.wanted.shape[1]
    entry_rows = rows[lists.ids]
    wanted = entry_rows >= 0
    slots = np.concatenate([[0], np.cumsum(wanted)])[lists.starts]
    tiles = np.flatnonzero(np.diff(slots))
    sums, table = np.zeros((slots[-1], SUMS), np.float32), np.zeros((count, SUMS), np.float32)

    def blend_chunk(start: int, stop: int) -> None:
        backward_tiles(
            start, stop, tiles, columns, lists.ids, entry_rows, lists.starts, drawing.splats.records,
            outputs, gradients, drawing.linear, slots, sums,
        )  # fmt: skip

    run_chunks(blend_chunk, len(tiles), BLEND_GRAIN)
    shares, slot_rows = thread_count(), entry_rows[wanted]
    share = -(-count // shares)
    run_chunks(lambda a, b: collect_sums(a, b, share, slot_rows, sums, table), shares, 1)
    return table


def set_gradients(fields: Sequence[Tensor], view: KernelCamera, table: Array) -> list[Tensor | None]:
    """The gradients of one set's five tensors."""
    arrays = [as_array(t) for t in fields[:4]]
    gradients = [np.zeros(tuple(t.shape), np.float32) for t in fields]
    run_chunks(
        lambda a, b: project_backward(a, b, *arrays, view.lens, view.pose, view.eps2d, table, *gradients),
        len(table),
        PROJECT_GRAIN,
    )
    return [torch.from_numpy(g) for g in gradients]
