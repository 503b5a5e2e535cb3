"""Follow epipolar lines through a view, from the cells of a hole to the hole's rim.

When a camera moves, every point of the image moves along its epipolar line. So the epipolar line
through a hole leads to the surface that the move uncovered.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from spackle.core.camera import Camera
from spackle.residual.features import CELL
from spackle.runtime.device import parallel_for_chunks
from spackle.runtime.kernels import kernel

# Two cells belong to one surface if their inverse depths differ by a smaller factor.
SAME_SURFACE_RATIO = 1.1
# A shorter offset between a cell and the epipole, in homogeneous coordinates, has no direction.
MIN_EPIPOLE_OFFSET = 1e-9 * CELL


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
    eye = eye.double()
    # Homogeneous coordinates, because the epipole may lie at infinity.
    epipole = (camera.K.to(eye) @ camera.to_camera(eye)).detach().cpu().numpy()
    cell_uv = uv.contiguous().numpy()
    cell_values = values.contiguous().numpy()
    cell_inverse_depth = inverse_depth.contiguous().numpy()
    hole = mask.contiguous().numpy()

    at_rim = cell_values.copy()
    mirrored = cell_values.copy()
    distance = np.zeros(mask.shape, np.float32)

    def trace_rows(start: int, stop: int) -> None:
        """Write the rows start..stop of the three results."""
        _trace_lines(
            start, stop, cell_uv, cell_values, cell_inverse_depth, hole, epipole,
            SAME_SURFACE_RATIO, at_rim, mirrored, distance,
        )  # fmt: skip

    parallel_for_chunks(trace_rows, len(mask))
    return torch.from_numpy(at_rim), torch.from_numpy(mirrored), torch.from_numpy(distance)


@kernel
def _trace_lines(
    start: int, stop: int, uv: Any, values: Any, inverse_depth: Any, hole: Any, epipole: Any,
    same_surface_ratio: float, at_rim: Any, mirrored: Any, distance: Any,
) -> None:  # fmt: skip
    """For the hole cells of the rows start..stop, write the values where the cell's epipolar line
    meets the hole's rim.

    The line meets the rim on two sides; the side with the greater depth counts.

    Args:
        start, stop: first row, and the row after the last.
        uv: [h, w, 2] pixels (x, y) of the cells' centres.
        values: [h, w, c] values to read at the rim.
        inverse_depth: [h, w] 1/z.
        hole: [h, w] bool.
        epipole: [3] homogeneous pixel (x, y, w).
        same_surface_ratio: two cells whose inverse depths differ by a smaller factor lie on one
            surface.
        at_rim: output [h, w, c], values at the rim; cells without a rim are left as they are.
        mirrored: output [h, w, c], values at the mirror image of the cell beyond the rim, or those
            at the rim if the mirror image lies on another surface.
        distance: output [h, w], steps of one cell to the rim.
    """
    height, width = inverse_depth.shape
    for y in range(start, stop):
        for x in range(width):
            if not hole[y, x]:
                continue
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
                continue

            step_y = rim_sign * line_y
            step_x = rim_sign * line_x
            row, column = _cell_at(y, x, rim_steps * step_y, rim_steps * step_x)
            at_rim[y, x] = values[row, column]
            mirrored[y, x] = values[row, column]
            distance[y, x] = rim_steps

            # The mirror image lies as far beyond the rim as the cell lies before it.
            row, column = _cell_at(y, x, 2 * rim_steps * step_y, 2 * rim_steps * step_x)
            if 0 <= row < height and 0 <= column < width and not hole[row, column]:
                ratio = inverse_depth[row, column] / rim_inverse_depth
                if ratio < same_surface_ratio and ratio > 1.0 / same_surface_ratio:
                    mirrored[y, x] = values[row, column]


@kernel
def _line_direction(epipole: Any, u: float, v: float) -> Any:
    """The unit vector (x, y) along the epipolar line of the pixel (u, v).

    `epipole` [3] is the other camera's position in the image, homogeneous (x, y, w). If both
    cameras stand at one place there is no line, and the result is (1, 0).
    """
    x = epipole[0] - epipole[2] * u
    y = epipole[1] - epipole[2] * v
    length = np.sqrt(x * x + y * y)
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
    # Adding 0.5 rounds to the nearest cell.
    return int(np.floor(y + offset_y + 0.5)), int(np.floor(x + offset_x + 0.5))
