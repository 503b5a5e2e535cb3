"""What the residual network sees of a rendered view: its holes, and its pixels averaged in cells.

The mask is eq. 4 of the paper, the hole-area ratio eqs. 10 and 11, the cells of 2×2 pixels stand in
section 3.3.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from spackle.core.camera import Camera
from spackle.render.fast_math import decode_srgb, encode_srgb
from spackle.render.protocol import Rendering
from spackle.runtime.device import parallel_for_chunks
from spackle.runtime.kernels import kernel

MASK_THRESHOLD = 0.95  # τ_α of eq. 4: a pixel with a lower opacity is a hole
CELL = 2  # pixels along a cell's side
CELL_PIXELS = CELL * CELL
RGB_CHANNELS = 3
# Ratios and summed opacities are raised to this before something is divided by them.
MIN_DIVISOR = 1e-6
TINY = 1e-30  # a length, or an inverse length, that is shorter than any in a scene of any unit


def hole_mask(alpha: Tensor, threshold: float = MASK_THRESHOLD) -> Tensor:
    """M_v(p) = 1[A_v(p) < τ_α] (eq. 4): [H, W] bool, true in holes, from the opacity `alpha` [H,
    W].
    """
    return alpha < threshold


def hole_area_ratio(alpha: Tensor, threshold: float = MASK_THRESHOLD) -> float:
    """The hole-area ratio (HAR = 1 − coverage, eqs. 10 and 11): the fraction of hole pixels.

    `alpha` [H, W] is the opacity of the pixels; a hole pixel's is below the threshold.
    """
    hole = hole_mask(alpha, threshold)

    # NumPy counts bools several times faster than torch does.
    hole_pixels = int(np.count_nonzero(hole.cpu().numpy()))
    return hole_pixels / hole.numel()


@dataclasses.dataclass(frozen=True)
class ViewFeatures:
    """A rendered view reduced to cells of 2×2 pixels, on the CPU and without gradients.

    h = ceil(H/2) and w = ceil(W/2): an odd last row or column of pixels counts twice.
    """

    # [h, w, 3] sRGB: mean in linear light, divided by the opacity to remove the black background
    rgb: Tensor
    # [h, w] 1/z of the farthest pixel that is no hole; 0 if all pixels are holes
    inverse_depth: Tensor
    alpha: Tensor  # [h, w] mean opacity
    mask: Tensor  # [h, w] bool: at least one pixel of the cell is a hole

    @staticmethod
    def of(rendering: Rendering, threshold: float = MASK_THRESHOLD) -> ViewFeatures:
        """Average the pixels [H, W] of a rendering in cells [h, w] of 2×2 pixels.

        A pixel with an opacity below `threshold` is a hole.
        """
        rendering = rendering.to(torch.device("cpu")).detach()
        # The kernel runs along whole rows, so colours become [H, 3W].
        rgb = rendering.rgb.flatten(1).float().contiguous().numpy()
        depth = rendering.depth.float().contiguous().numpy()
        alpha = rendering.alpha.float().contiguous().numpy()

        height, width = rendering.alpha.shape
        rows = math.ceil(height / CELL)
        columns = math.ceil(width / CELL)
        cell_rgb = np.empty((rows, RGB_CHANNELS * columns), np.float32)
        cell_inverse_depth = np.empty((rows, columns), np.float32)
        cell_alpha = np.empty((rows, columns), np.float32)
        cell_mask = np.empty((rows, columns), np.bool_)

        def average_rows(start: int, stop: int) -> None:
            """Write the rows start..stop of all four grids of cells."""
            _average_cells(
                start, stop, rgb, depth, alpha, np.float32(threshold),
                cell_rgb, cell_inverse_depth, cell_alpha, cell_mask,
            )  # fmt: skip

        parallel_for_chunks(average_rows, rows)
        return ViewFeatures(
            rgb=torch.from_numpy(cell_rgb.reshape(rows, columns, RGB_CHANNELS)),
            inverse_depth=torch.from_numpy(cell_inverse_depth),
            alpha=torch.from_numpy(cell_alpha),
            mask=torch.from_numpy(cell_mask),
        )


def cell_centers(camera: Camera) -> Tensor:
    """Centres [ceil(H/2), ceil(W/2), 2] of a view's cells of 2×2 pixels, as (x, y) in pixels."""
    return camera.even().pixel_centers(stride=CELL)


@kernel
def _average_cells(
    start: int, stop: int, rgb: Any, depth: Any, alpha: Any, threshold: Any,
    cell_rgb: Any, cell_inverse_depth: Any, cell_alpha: Any, cell_mask: Any,
) -> None:  # fmt: skip
    """Average the pixels of each cell of 2×2 pixels, for the rows start..stop of cells.

    Args:
        start, stop: first row of cells, and the row after the last.
        rgb: [H, 3W] sRGB, already multiplied by the opacity (rendered over black).
        depth: [H, W] z.
        alpha: [H, W] opacity; below `threshold`, the pixel is a hole.
        threshold: τ_α, float32.
        cell_rgb: output [h, 3w] sRGB without the black background.
        cell_inverse_depth: output [h, w], 1/z of the farthest pixel that is no hole; 0 if there is
            none.
        cell_alpha: output [h, w] mean opacity.
        cell_mask: output [h, w] bool: whether any pixel is a hole.
    """
    height, width = alpha.shape
    columns = cell_inverse_depth.shape[1]
    two_rows_light = np.empty(RGB_CHANNELS * width, np.float32)
    mean_light = np.empty(RGB_CHANNELS * columns, np.float32)
    for row in range(start, stop):
        top = CELL * row
        bottom = min(CELL * row + 1, height - 1)

        # The conversions from and to sRGB are loops over whole rows, which run in vector registers.
        for k in range(RGB_CHANNELS * width):
            two_rows_light[k] = decode_srgb(rgb[top, k]) + decode_srgb(rgb[bottom, k])

        for column in range(columns):
            left = CELL * column
            right = min(CELL * column + 1, width - 1)
            total_alpha = np.float32(0)
            farthest = np.float32(0)
            holes = 0
            for y, x in ((top, left), (top, right), (bottom, left), (bottom, right)):
                total_alpha += alpha[y, x]
                if alpha[y, x] < threshold:
                    holes += 1
                else:
                    farthest = max(farthest, depth[y, x], np.float32(TINY))

            cell_mask[row, column] = holes > 0
            cell_alpha[row, column] = total_alpha / np.float32(CELL_PIXELS)
            cell_inverse_depth[row, column] = (
                np.float32(1) / farthest if holes < CELL_PIXELS else np.float32(0)
            )

            # Rendered light is already multiplied by alpha: divide by the sum of alpha, not by 4.
            for c in range(RGB_CHANNELS):
                light = (
                    two_rows_light[RGB_CHANNELS * left + c]
                    + two_rows_light[RGB_CHANNELS * right + c]
                )
                mean_light[RGB_CHANNELS * column + c] = light / max(
                    total_alpha, np.float32(MIN_DIVISOR)
                )

        for k in range(RGB_CHANNELS * columns):
            cell_rgb[row, k] = encode_srgb(mean_light[k])
