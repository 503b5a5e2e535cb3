"""The gradient of a rendering on the CPU, as a function of PyTorch's autograd.

`backward_blend` turns gradients of the image into sums over pixels for each Gaussian, and
`backward_project` turns these sums into gradients of the Gaussians' tensors.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from spackle.core.gaussians import Gaussians
from spackle.render.backward_blend import SUMS, backward_tiles, collect_sums
from spackle.render.backward_project import project_backward
from spackle.render.drawing import (
    GAUSSIANS_PER_CHUNK,
    TILES_PER_CHUNK,
    Drawing,
    as_array,
    draw_for_gradients,
)
from spackle.render.project import Arrays, KernelCamera
from spackle.render.protocol import Rendering, tile_mask
from spackle.runtime.device import parallel_for_chunks, thread_count
from spackle.runtime.kernels import Array

FIELDS_PER_SET = 5  # tensors of a set: means, quats, scales, opacities, colors
IMAGES = 3  # number of a rendering's images: rgb, depth, alpha
ARGUMENTS_BEFORE_TENSORS = 2  # of `DrawFunction.forward`: the camera and the tiles


def draw_with_gradients(
    sets: Sequence[Gaussians],
    view: KernelCamera,
    drawn_tiles: Array,
    background: Rendering | None,
) -> Rendering:
    """Draw sets of Gaussians, so that gradients reach their tensors and the background.

    Args:
        sets: drawn together as if they were one set; without harmonics.
        view: the camera.
        drawn_tiles: [rows, columns] bool: the tiles of 16×16 pixels to draw.
        background: a rendering whose copy fills all other tiles; None: they are black and empty.
    """
    # Autograd takes all tensors as one flat sequence: three images, or None for each, and then the
    # five fields of each set.
    background_images: list[Tensor | None] = [None] * IMAGES
    if background is not None:
        background_images = [image.float() for image in background.tensors]
    fields = [
        tensor.to(device="cpu", dtype=torch.float32) for part in sets for tensor in part.tensors
    ]
    images = DrawFunction.apply(  # type: ignore[no-untyped-call]
        view, drawn_tiles, *background_images, *fields
    )
    return Rendering(*images)


class DrawFunction(torch.autograd.Function):
    """Draws sets of Gaussians over three images.

    Autograd wants tensors as one flat sequence of arguments, so the five fields of each set are
    passed one by one, set after set.
    """

    @staticmethod
    def forward(
        ctx: Any, view: KernelCamera, drawn_tiles: Array, *tensors: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Draw, and keep what the backward pass needs.

        Args:
            ctx: autograd's store for the backward pass.
            view: the camera.
            drawn_tiles: [rows, columns] bool: the tiles to draw.
            tensors: rgb, depth and alpha that fill the other tiles, or three None; then means,
                quats, scales, opacities and colors of each set, all float32.

        Returns:
            The images rgb [H, W, 3] sRGB, depth [H, W] and alpha [H, W].
        """
        background_images = [image for image in tensors[:IMAGES] if image is not None]
        background = Rendering(*background_images) if background_images else None
        fields = [tensor for tensor in tensors[IMAGES:] if tensor is not None]
        sets = [
            Gaussians(*fields[first : first + FIELDS_PER_SET])
            for first in range(0, len(fields), FIELDS_PER_SET)
        ]
        drawing = draw_for_gradients(sets, view, drawn_tiles, background)
        rendering = drawing.rendering()

        ctx.drawing = drawing
        ctx.set_sizes = [len(part) for part in sets]
        # Saved this way, PyTorch raises an error if a tensor is changed before the backward pass.
        ctx.save_for_backward(*rendering.tensors, *fields)
        return rendering.tensors

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *image_gradients: Tensor) -> tuple[Tensor | None, ...]:
        """Turn gradients of the three images into gradients of all arguments of `forward`.

        Args:
            ctx: holds what `forward` kept.
            image_gradients: those of rgb [H, W, 3], depth [H, W] and alpha [H, W].

        Returns:
            For the camera and the tiles None, because they are no tensors; then the gradients of
            the three images that lie under the drawing; then, for each set of Gaussians, those of
            its means, quats, scales, opacities and colors. A gradient that nobody asked for is
            None.
        """
        drawing: Drawing = ctx.drawing
        fields = ctx.saved_tensors[IMAGES:]  # the first ones are the images of the result
        tensor_needs = ctx.needs_input_grad[ARGUMENTS_BEFORE_TENSORS:]
        background_needs = tensor_needs[:IMAGES]
        field_needs = tensor_needs[IMAGES:]
        background_gradients = gradients_of_background(drawing, image_gradients, background_needs)

        # Sums are computed only for Gaussians of sets with at least one tensor that needs them.
        set_slices = [
            slice(first, first + FIELDS_PER_SET) for first in range(0, len(fields), FIELDS_PER_SET)
        ]
        set_needs = np.array([any(field_needs[set_slice]) for set_slice in set_slices], np.bool_)
        needs = np.repeat(set_needs, ctx.set_sizes)  # [N], of each Gaussian
        # The rows of those that need sums are numbered from 0; all others have -1.
        table_rows = np.where(needs, np.cumsum(needs) - 1, -1).astype(np.int32)
        gradient_arrays = tuple(as_array(gradient) for gradient in image_gradients)
        table = pixel_sums(drawing, gradient_arrays, table_rows, int(needs.sum()))

        field_gradients: list[Tensor | None] = []
        first_row = 0  # of the set in the table
        for set_slice, size, set_need in zip(set_slices, ctx.set_sizes, set_needs, strict=True):
            if not set_need:
                field_gradients += [None] * FIELDS_PER_SET
                continue
            set_table = table[first_row : first_row + size]
            first_row += size
            gradients = gradients_of_set(fields[set_slice], drawing.view, set_table)
            field_gradients += [
                gradient if need else None
                for gradient, need in zip(gradients, field_needs[set_slice], strict=True)
            ]
        # The camera and the tiles have no gradients.
        return None, None, *background_gradients, *field_gradients


def gradients_of_background(
    drawing: Drawing, image_gradients: Sequence[Tensor], needs: Sequence[bool]
) -> list[Tensor | None]:
    """The gradients of the three images over which the tiles were drawn; None where not needed.

    A pixel that a drawn tile covers does not show in the result, so its gradient is 0.

    Args:
        drawing: knows which tiles were drawn.
        image_gradients: those of the result: rgb [H, W, 3], depth [H, W], alpha [H, W].
        needs: [3] whether the gradient of each image is needed.
    """
    height, width = image_gradients[1].shape
    mask = tile_mask(torch.from_numpy(drawing.drawn_tiles), height, width)  # [H, W]
    gradients: list[Tensor | None] = []
    for gradient, need in zip(image_gradients, needs, strict=True):
        image_mask = mask[..., None] if gradient.ndim == 3 else mask
        gradients.append(torch.where(image_mask, 0, gradient) if need else None)
    return gradients


def pixel_sums(drawing: Drawing, gradients: Arrays, table_rows: Array, count: int) -> Array:
    """Sums over pixels for each Gaussian that needs gradients: a table [count, 10] float32.

    With a pixel's offset (dx, dy) from the centre, u = dx - slope·dy (the distance from the place
    in its row where alpha is largest) and v = ∂L/∂ln(alpha), the columns are the sums of v, v·u,
    v·u², v·dy, v·dy², v·u·dy; then the gradients of red, green, blue and depth. Each tile sums on
    its own, and the sums of tiles are added in the order of tiles, so that the result does not
    depend on the number of threads.

    Args:
        drawing: the result of the forward pass.
        gradients: of rgb [H, W, 3], depth [H, W] and alpha [H, W].
        table_rows: [N] int32: each Gaussian's row in the table, or -1 if it needs no gradients.
        count: rows of the table.
    """
    lists = drawing.lists
    # An entry is a Gaussian in a tile's list. Each that needs gradients has a row in `sums`.
    entry_rows = table_rows[lists.ids]  # [E] int32
    entry_needs = entry_rows >= 0  # [E] bool
    needs_before_entry = np.concatenate([[0], np.cumsum(entry_needs)])  # [E + 1]
    rows_before = needs_before_entry[lists.starts]  # [T + 1]: where a tile's rows start in `sums`
    tiles = np.flatnonzero(np.diff(rows_before))  # those with entries that need gradients
    sums = np.zeros((rows_before[-1], SUMS), np.float32)

    parallel_for_chunks(
        lambda start, stop: backward_tiles(
            start, stop, tiles, lists, entry_needs, drawing.splats.records, drawing.images,
            gradients, rows_before, sums,
        ),
        len(tiles),
        TILES_PER_CHUNK,
    )  # fmt: skip

    # Then the sums of all tiles are added up by Gaussian. Each thread does a share of the table's
    # rows, so that no two threads write to one row.
    table = np.zeros((count, SUMS), np.float32)
    sum_rows = entry_rows[entry_needs]  # [M]: the row of the table for each row of `sums`
    shares = thread_count()
    share_size = math.ceil(count / shares)

    parallel_for_chunks(
        lambda start, stop: collect_sums(
            start * share_size, stop * share_size, sum_rows, sums, table
        ),
        shares,
        chunk_length=1,
    )
    return table


def gradients_of_set(fields: Sequence[Tensor], view: KernelCamera, table: Array) -> list[Tensor]:
    """The gradients of a set's means, quats, scales, opacities and colors, from sums over pixels.

    Args:
        fields: these five tensors, of n Gaussians.
        view: the camera.
        table: [n, 10] sums over the pixels that each Gaussian covers. With a pixel's offset
            (dx, dy) from the Gaussian's centre, u = dx - slope·dy (the distance from the place in
            its row where alpha is largest) and v = ∂L/∂ln(alpha), they are the sums of v, v·u,
            v·u², v·dy, v·dy², v·u·dy; then the gradients of red, green, blue and depth.
    """
    scene = tuple(as_array(field) for field in fields)
    # Zero at first; `project_backward` writes those of the Gaussians `start` to `stop` - 1.
    gradients = tuple(np.zeros(field.shape, np.float32) for field in fields)

    parallel_for_chunks(
        lambda start, stop: project_backward(start, stop, scene, view, table, gradients),
        len(table),
        GAUSSIANS_PER_CHUNK,
    )
    return [torch.from_numpy(gradient) for gradient in gradients]
