"""Follow epipolar lines through a view, from the cells of a hole to the hole's rim.

When a camera moves, every point of the image moves along its epipolar line. So the epipolar line
through a hole leads to the surface that the move uncovered.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from spackle.core.camera import Camera
from spackle.residual.features import CELL
from spackle.runtime.kernels import kernel
from spackle.runtime.parallel_kernels import kernel_for_pixels

# Two cells belong to one surface if their inverse depths differ by a smaller factor.
SAME_SURFACE_RATIO = 1.1
# A shorter offset between a cell and the epipole, in homogeneous coordinates, has no direction.
MIN_EPIPOLE_OFFSET = 1e-9 * CELL


class Epipole(NamedTuple):
    """Another camera's position in the image, as a homogeneous pixel: (x / w, y / w)."""

    x: float
    y: float
    w: float


def trace_epipolar_lines(
    uv: Tensor, values: Tensor, inverse_depth: Tensor, mask: Tensor, camera: Camera, eye: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """For each cell of a hole, the values where the cell's epipolar line meets the hole's rim.

    From each hole cell, the line is followed in both directions to the first visible cells. These
    two cells lie at the rim of the hole. The one with the greater depth counts, because a hole
    uncovers what lies behind.

    Args:
        uv: [h, w, 2] pixels (x, y) of the cells' centres.
        values: [h, w, c] float32, for example colours; they are read at the rim.
        inverse_depth: [h, w] 1/z, positive.
        mask: [h, w] bool, true in holes.
        camera: of the view.
        eye: [3] position of the other camera, in the world; its projection into the view is the
            epipole.

    Returns:
        Three grids: values [h, w, c] at the rim; values [h, w, c] at the cell's mirror image beyond
        the rim, or those at the rim if the mirror image lies on another surface; distance [h, w] to
        the rim in cells. Visible cells, and cells whose line leaves the view before it meets a
        visible one, have their own values and the distance 0.
    """
    eye = eye.double().cpu()
    # Homogeneous coordinates, because the epipole may lie at infinity.
    epipole = Epipole(*(camera.K.to(eye) @ camera.to_camera(eye)).detach().tolist())

    at_rim = values.clone(memory_format=torch.contiguous_format)
    mirrored = at_rim.clone()
    distance = at_rim.new_zeros(mask.shape)
    _trace_line(
        mask.shape, uv.contiguous(), values.contiguous(), inverse_depth.contiguous(),
        mask.contiguous(), epipole, at_rim, mirrored, distance,
    )  # fmt: skip
    return at_rim, mirrored, distance


@kernel_for_pixels
def _trace_line(
    y: int, x: int, uv: Any, values: Any, inverse_depth: Any, hole: Any, epipole: Any,
    at_rim: Any, mirrored: Any, distance: Any,
) -> None:  # fmt: skip
    """For a hole cell, write the values where the cell's epipolar line meets the hole's rim.

    The line meets the rim on two sides; the side with the greater depth counts.

    Args:
        y, x: row and column of the cell.
        uv: [h, w, 2] pixels (x, y) of the cells' centres.
        values: [h, w, c] values to read at the rim.
        inverse_depth: [h, w] 1/z.
        hole: [h, w] bool.
        epipole: the other camera's position in the image.
        at_rim: output [h, w, c], values at the rim; cells without a rim are left as they are.
        mirrored: output [h, w, c], values at the mirror image of the cell beyond the rim, or those
            at the rim if the mirror image lies on another surface.
        distance: output [h, w], steps of one cell to the rim.
    """
    if not hole[y, x]:
        return
    height, width = inverse_depth.shape
    line_x, line_y = _line_direction(epipole, uv[y, x, 0], uv[y, x, 1])

    # Search in both directions; the side with the smaller inverse depth is the farther one.
    rim_inverse_depth = np.float32(np.inf)
    rim_steps = 0
    rim_sign = 0.0
    for sign in (1.0, -1.0):
        steps = _steps_to_rim(hole, y, x, sign * line_y, sign * line_x)
        if steps == 0:
            continue
        row, column = _cell_at(y, x, steps * sign * line_y, steps * sign * line_x)
        if inverse_depth[row, column] < rim_inverse_depth:
            rim_inverse_depth = inverse_depth[row, column]
            rim_steps = steps
            rim_sign = sign
    if rim_steps == 0:
        return

    step_y = rim_sign * line_y
    step_x = rim_sign * line_x
    row, column = _cell_at(y, x, rim_steps * step_y, rim_steps * step_x)
    distance[y, x] = rim_steps

    # The mirror image lies as far beyond the rim as the cell lies before it.
    mirror_row, mirror_column = _cell_at(y, x, 2 * rim_steps * step_y, 2 * rim_steps * step_x)
    is_on_surface = False
    if 0 <= mirror_row < height and 0 <= mirror_column < width:
        ratio = inverse_depth[mirror_row, mirror_column] / rim_inverse_depth
        is_near = ratio < SAME_SURFACE_RATIO and ratio > 1.0 / SAME_SURFACE_RATIO
        is_on_surface = is_near and not hole[mirror_row, mirror_column]
    if not is_on_surface:
        mirror_row, mirror_column = row, column

    for channel in range(values.shape[2]):
        at_rim[y, x, channel] = values[row, column, channel]
        mirrored[y, x, channel] = values[mirror_row, mirror_column, channel]


@kernel
def _line_direction(epipole: Any, u: float, v: float) -> Any:
    """The unit vector (x, y) along the epipolar line of the pixel (u, v).

    If the other camera stands at the view's place there is no line, and the result is (1, 0).
    """
    x = epipole.x - epipole.w * u
    y = epipole.y - epipole.w * v
    length = math.sqrt(x * x + y * y)
    if length > MIN_EPIPOLE_OFFSET:
        return x / length, y / length
    return 1.0, 0.0


@kernel
def _steps_to_rim(hole: Any, y: int, x: int, step_y: float, step_x: float) -> int:
    """The number of steps of one cell from the cell (y, x) to the first cell outside of the hole
    ([h, w] bool).

    0 if the steps leave the image before they leave the hole.
    """
    height, width = hole.shape
    steps = 1
    while True:
        row, column = _cell_at(y, x, steps * step_y, steps * step_x)
        if row < 0 or column < 0 or row >= height or column >= width:
            return 0
        if not hole[row, column]:
            return steps
        steps += 1


@kernel
def _cell_at(y: int, x: int, offset_y: float, offset_x: float) -> Any:
    """Row and column of the cell at an offset, in cells, from the centre of the cell (y, x)."""
    # Adding 0.5 rounds to the nearest cell. On a GPU, `floor` gives a float.
    row = np.int64(math.floor(y + offset_y + 0.5))
    column = np.int64(math.floor(x + offset_x + 0.5))
    return row, column
