"""The CPU renderer, differentiable by all tensors that it is given."""

from __future__ import annotations

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
from spackle.render.blend_backward import SUMS, backward_tiles, collect_sums, count_wanted
from spackle.render.pipeline import BLEND_GRAIN, PROJECT_GRAIN, Drawing, as_array, draw, wanted_tiles
from spackle.render.project import KernelCamera
from spackle.render.project_backward import project_backward
from spackle.render.projection_cache import ProjectionCache
from spackle.render.protocol import Rendering, tile_mask

FIELDS = 5  # tensors in a set of Gaussians


class CpuRenderer:
    """Classic 3D Gaussian splatting on the CPU; a `Renderer`.

    The last whole drawing is remembered: more sets on top of it, in some tiles, cost those tiles only. Changes that
    PyTorch makes in place are noticed; writes to the same memory through NumPy or `.data` are not.
    """

    def __init__(self) -> None:
        self._memory = ProjectionCache()

    def __reduce__(self) -> tuple[type[CpuRenderer], tuple[()]]:
        """Copies, as other processes get them, remember nothing."""
        return CpuRenderer, ()

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
        if torch.is_grad_enabled() and any(t.requires_grad for t in inputs):
            under = [None] * 3 if onto is None else [image.float() for image in onto.tensors]
            fields = [t.to(device="cpu", dtype=torch.float32) for part in sets for t in part.tensors]
            return Rendering(*Draw.apply(view, wanted, *under, *fields))  # type: ignore[no-untyped-call]
        if tiles is not None:
            redrawn = self._memory.redraw(sets, view, wanted, onto)
            return (redrawn or draw(sets, view, wanted, onto)).rendering()
        drawing = draw(sets, view, wanted, None)
        self._memory.keep(sets, drawing)
        return drawing.rendering()


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
        under = [
            keep_undrawn(gradient, ctx.drawing.wanted) if need else None
            for gradient, need in zip(gradients, needs[:3], strict=True)
        ]
        wants = [k for k in range(len(ctx.sizes)) if any(needs[3 + k * FIELDS : 3 + (k + 1) * FIELDS])]
        ranges = gradient_rows(ctx.sizes, wants)
        table = pixel_sums(ctx.drawing, outputs, tuple(as_array(g) for g in gradients), ranges)
        results: list[Tensor | None] = [None] * len(fields)
        for k, (_, _, row) in zip(wants, ranges, strict=True):
            own = slice(k * FIELDS, (k + 1) * FIELDS)
            results[own] = set_gradients(fields[own], ctx.drawing.view, table[row : row + ctx.sizes[k]])
        return None, None, *under, *(r if need else None for r, need in zip(results, needs[3:], strict=True))


def gradient_rows(sizes: Sequence[int], wants: list[int]) -> Array:
    """[S, 3] int64 of the sets that want gradients: first and last Gaussian (exclusive), first row of the table."""
    all_sizes = np.array(sizes, np.int64)
    own, last = all_sizes[wants], np.cumsum(all_sizes)[wants]
    return np.stack([last - own, last, np.cumsum(own) - own], axis=1)


def keep_undrawn(gradient: Tensor, wanted: Array) -> Tensor:
    """The gradient of the image that was drawn onto: nothing where tiles were drawn over it."""
    height, width = gradient.shape[:2]
    drawn = tile_mask(torch.from_numpy(wanted), height, width)
    return torch.where(drawn if gradient.ndim == 2 else drawn[..., None], 0, gradient)


def pixel_sums(drawing: Drawing, outputs: tuple[Array, ...], gradients: tuple[Array, ...], ranges: Array) -> Array:
    """What the pixels give to each Gaussian that wants gradients, [G, SUMS] float32, see `gradient_rows`.

    Each tile writes sums of its own, which are added up in the order of the tiles: the result does not
    depend on which thread was faster.
    """
    lists, columns = drawing.lists, drawing.wanted.shape[1]
    counts = np.zeros(drawing.wanted.size, np.int64)
    run_chunks(lambda a, b: count_wanted(a, b, lists.ids, lists.starts, ranges, counts), len(counts), BLEND_GRAIN)
    slots = np.concatenate([[0], np.cumsum(counts)])
    tiles = np.flatnonzero(counts)
    sums = np.zeros((slots[-1], SUMS), np.float32)
    table = np.zeros((int((ranges[:, 1] - ranges[:, 0]).sum()), SUMS), np.float32)

    def blend_chunk(start: int, stop: int) -> None:
        backward_tiles(
            start, stop, tiles, columns, lists.ids, lists.starts, drawing.splats.records,
            outputs, gradients, drawing.linear, ranges, slots, sums,
        )  # fmt: skip

    run_chunks(blend_chunk, len(tiles), BLEND_GRAIN)
    shares = thread_count()
    rows = -(-len(table) // shares)
    run_chunks(lambda a, b: collect_sums(a, b, rows, tiles, lists.ids, lists.starts, ranges, sums, table), shares, 1)
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
