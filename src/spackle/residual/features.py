"""Features of a rendered view: mask (paper, eq. 4), hole-area ratio (eqs. 10, 11), and cells of 2×2 pixels (3.3)."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import torch
from torch import Tensor

from spackle.core.camera import Camera
from spackle.render.fast_math import decode_srgb, encode_srgb
from spackle.render.protocol import Rendering
from spackle.runtime.device import parallel_for_chunks
from spackle.runtime.kernels import kernel

MASK_THRESHOLD = 0.95  # τ_α: a pixel with lower opacity is a hole (eq. 4)
CELL = 2  # pixels along a cell's side
CHANNELS = 3
LEAST = 1e-6  # lower bound of depths and summed opacities, for safe division
CPU = torch.device("cpu")


def hole_mask(alpha: Tensor, threshold: float = MASK_THRESHOLD) -> Tensor:
    """M_v(p) = 1[A_v(p) < τ_α] (eq. 4): [H, W] bool, true in holes."""
    return alpha < threshold


def hole_area_ratio(alpha: Tensor, threshold: float = MASK_THRESHOLD) -> float:
    """HAR = 1 − coverage (eqs. 10 and 11): the fraction of hole pixels."""
    hole = hole_mask(alpha, threshold)
    return (
        int(np.count_nonzero(hole.cpu().numpy())) / hole.numel()
    )  # numpy counts bools fastest by far


@dataclasses.dataclass(frozen=True)
class ViewFeatures:
    """The cells of a view, on the CPU and without gradients; h = ceil(H/2), w = ceil(W/2)."""

    rgb: Tensor  # [h, w, 3] sRGB: mean in linear light, divided by the opacity to remove the black background
    inverse_depth: (
        Tensor  # [h, w] 1/z of the farthest pixel that is no hole; 0 if all pixels are holes
    )
    alpha: Tensor  # [h, w] mean opacity
    mask: Tensor  # [h, w] bool: at least one pixel of the cell is a hole

    @staticmethod
    def of(rendering: Rendering, threshold: float = MASK_THRESHOLD) -> ViewFeatures:
        """Reduce a rendering to cells; an odd last row or column counts twice."""
        rendering = rendering.to(CPU).detach()
        images = (rendering.rgb.flatten(1), rendering.depth, rendering.alpha)
        view = [image.float().contiguous().numpy() for image in images]
        rows, columns = (-(-size // CELL) for size in rendering.alpha.shape)
        rgb, mask = (
            np.empty((rows, CHANNELS * columns), np.float32),
            np.empty((rows, columns), np.bool_),
        )
        inverse_depth, alpha = (np.empty((rows, columns), np.float32) for _ in range(2))
        cells, low = (rgb, inverse_depth, alpha, mask), np.float32(threshold)
        parallel_for_chunks(lambda start, stop: _gather(start, stop, *view, low, *cells), rows)
        colors = rgb.reshape(rows, columns, CHANNELS)
        return ViewFeatures(
            *(torch.from_numpy(image) for image in (colors, inverse_depth, alpha, mask))
        )


def cell_centers(camera: Camera) -> Tensor:
    """Centres [ceil(H/2), ceil(W/2), 2] of a view's cells, in pixels."""
    return camera.even().pixel_centers(stride=CELL)


@kernel
def _gather(
    start: int, stop: int, rgb: Any, depth: Any, alpha: Any, threshold: Any,
    colors: Any, inverse_depth: Any, opacity: Any, mask: Any,
) -> None:  # fmt: skip
    """Compute the rows start..stop of the cells; loops over whole rows of colours run in vector registers."""
    height, width = alpha.shape
    columns = inverse_depth.shape[1]
    light = np.empty(CHANNELS * width, np.float32)
    mean = np.empty(CHANNELS * columns, np.float32)
    for row in range(start, stop):
        top, bottom = CELL * row, min(CELL * row + 1, height - 1)
        for k in range(CHANNELS * width):
            light[k] = decode_srgb(rgb[top, k]) + decode_srgb(rgb[bottom, k])
        for column in range(columns):
            left, right = CELL * column, min(CELL * column + 1, width - 1)
            total, far, holes = np.float32(0), np.float32(0), 0
            for y, x in ((top, left), (top, right), (bottom, left), (bottom, right)):
                total += alpha[y, x]
                if alpha[y, x] < threshold:
                    holes += 1
                else:
                    far = max(far, depth[y, x], np.float32(LEAST))
            inverse_depth[row, column] = (
                np.float32(1) / far if holes < CELL * CELL else np.float32(0)
            )
            opacity[row, column] = total / np.float32(CELL * CELL)
            mask[row, column] = holes > 0
            for c in range(CHANNELS):  # rendered light is already multiplied by alpha
                both = light[CHANNELS * left + c] + light[CHANNELS * right + c]
                mean[CHANNELS * column + c] = both / max(total, np.float32(LEAST))
        for k in range(CHANNELS * columns):
            colors[row, k] = encode_srgb(mean[k])
