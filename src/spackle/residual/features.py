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
from spackle.runtime.parallel_kernels import kernel_for_pixels

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

    # NumPy counts bools on the processor several times faster than torch does.
    if hole.device.type == "cpu":
        return int(np.count_nonzero(hole.numpy())) / hole.numel()
    return int(hole.count_nonzero()) / hole.numel()


@dataclasses.dataclass(frozen=True)
class ViewFeatures:
    """A rendered view reduced to cells of 2×2 pixels, without gradients.

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

        A pixel with an opacity below `threshold` is a hole. The result is on the rendering's
        device.
        """
        rendering = rendering.detach()
        rgb = rendering.rgb.float().contiguous()
        depth = rendering.depth.float().contiguous()
        alpha = rendering.alpha.float().contiguous()
        # Light is what is averaged, so each colour is decoded once before, and encoded after. Along
        # whole rows [H, 3W] these conversions run in vector registers.
        light = torch.empty_like(rgb)
        rows_of_colors = rgb.flatten(1)
        _decode(rows_of_colors.shape, rows_of_colors, light.flatten(1))

        height, width = alpha.shape
        rows = math.ceil(height / CELL)
        columns = math.ceil(width / CELL)
        features = ViewFeatures(
            rgb=rgb.new_empty(rows, columns, RGB_CHANNELS),
            inverse_depth=depth.new_empty(rows, columns),
            alpha=alpha.new_empty(rows, columns),
            mask=torch.empty(rows, columns, dtype=torch.bool, device=alpha.device),
        )
        _average_cell(
            (rows, columns), light, depth, alpha, np.float32(threshold),
            features.rgb, features.inverse_depth, features.alpha, features.mask,
        )  # fmt: skip
        cell_colors = features.rgb.flatten(1)
        _encode(cell_colors.shape, cell_colors, cell_colors)
        return features


def cell_centers(camera: Camera) -> Tensor:
    """Centres [ceil(H/2), ceil(W/2), 2] of a view's cells of 2×2 pixels, as (x, y) in pixels."""
    return camera.even().pixel_centers(stride=CELL)


@kernel_for_pixels
def _decode(row: int, k: int, encoded: Any, linear: Any) -> None:
    """Convert the k-th number of a row from sRGB to linear light; arrays [H, 3W]."""
    linear[row, k] = decode_srgb(encoded[row, k])


@kernel_for_pixels
def _encode(row: int, k: int, linear: Any, encoded: Any) -> None:
    """Convert the k-th number of a row from linear light to sRGB; arrays [h, 3w]."""
    encoded[row, k] = encode_srgb(linear[row, k])


@kernel_for_pixels
def _average_cell(
    row: int, column: int, light: Any, depth: Any, alpha: Any, threshold: Any,
    cell_light: Any, cell_inverse_depth: Any, cell_alpha: Any, cell_mask: Any,
) -> None:  # fmt: skip
    """Average the pixels of a cell of 2×2 pixels.

    Args:
        row, column: of the cell.
        light: [H, W, 3] linear, already multiplied by the opacity (rendered over black).
        depth: [H, W] z.
        alpha: [H, W] opacity; below `threshold`, the pixel is a hole.
        threshold: τ_α, float32.
        cell_light: output [h, w, 3] linear, without the black background.
        cell_inverse_depth: output [h, w], 1/z of the farthest pixel that is no hole; 0 if there is
            none.
        cell_alpha: output [h, w] mean opacity.
        cell_mask: output [h, w] bool: whether any pixel is a hole.
    """
    height, width = alpha.shape
    top, left = CELL * row, CELL * column
    # An odd last row or column of pixels counts twice.
    bottom, right = min(top + 1, height - 1), min(left + 1, width - 1)

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
        left_light = light[top, left, c] + light[bottom, left, c]
        right_light = light[top, right, c] + light[bottom, right, c]
        cell_light[row, column, c] = (left_light + right_light) / max(
            total_alpha, np.float32(MIN_DIVISOR)
        )
