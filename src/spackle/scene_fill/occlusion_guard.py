"""Keep new Gaussians behind the surfaces that the photo and other views show.

Gaussians that fill the holes of one view must not appear in front of a surface in another view. So
they move away from the eye for which they were made, until they hide nothing. That eye sees no
difference, because the Gaussians grow as they move.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from spackle.core.camera import Camera, to_like
from spackle.core.filters import maximum_filter
from spackle.core.gaussians import Gaussians
from spackle.core.surfels import BEHIND_SURFACE_RATIO
from spackle.render.protocol import ALPHA_MIN, Rendering
from spackle.residual.features import MASK_THRESHOLD
from spackle.runtime.kernels import kernel
from spackle.runtime.parallel_kernels import device_for_kernels, kernel_for_items

WINDOW_RADIUS_PX = 4  # of the guard's windows: most new Gaussians reach no farther
# A Gaussian is visible up to so many standard deviations from its centre: exp(-x² / 2) = ALPHA_MIN.
VISIBLE_SIGMAS = math.sqrt(-2 * math.log(ALPHA_MIN))
MAX_REACH_PX = 40.0  # a Gaussian is checked only up to this distance from its centre
# A near spot in the depths of a hole is removed if it is less than twice this wide. The radius is a
# fraction of the view's width.
PIT_RADIUS_WIDTHS = 0.027
# Where the rows of the extrinsics for x and y begin in a camera's 16 numbers: fx, fy, cx, cy, and
# the 3×4 extrinsics row by row.
X_ROW = 4
Y_ROW = 8
DEPTH_STEPS = 48  # candidate positions along the line of sight, evenly spaced in inverse depth


@dataclasses.dataclass(frozen=True)
class OcclusionGuard:
    """The farthest surface near each pixel of a view; no new Gaussian may lie in front of it."""

    camera: Camera
    # [H, W] z of the farthest surface within WINDOW_RADIUS_PX; 0 in holes, infinite where the view
    # is to stay empty
    depth: Tensor

    @staticmethod
    def of(
        rendering: Rendering,
        camera: Camera,
        threshold: float = MASK_THRESHOLD,
        keep_empty: Tensor | None = None,
    ) -> OcclusionGuard:
        """The farthest surface around each pixel of a rendered view, which new Gaussians must not
        hide.

        Args:
            rendering: the view [H, W]; the guard is on its device, if kernels run there.
            camera: of the view.
            threshold: pixels with a lower opacity are holes, and show no surface.
            keep_empty: [H, W] bool: pixels in which nothing may appear, such as sky; None: none.
        """
        view = rendering.to(device_for_kernels(rendering.alpha.device)).detach()
        is_hole = view.alpha < threshold
        surface_depth = torch.where(is_hole, 0, view.depth).float()
        if keep_empty is not None:
            # Empty space is like a surface at infinity: everything would hide it. Its border is
            # left out, a strip of twice the filter's radius, because the filter below would carry
            # the infinite depth onto the surfaces beside it.
            is_shown = ~keep_empty.to(view.alpha.device)
            is_beside_space = maximum_filter(is_shown, 2 * WINDOW_RADIUS_PX)
            surface_depth = torch.where(is_beside_space, surface_depth, torch.inf)

        # A Gaussian reaches some pixels around its centre, and may hide a surface at any of them.
        # So each pixel keeps the greatest depth within a window around it.
        return OcclusionGuard(camera, maximum_filter(surface_depth, WINDOW_RADIUS_PX))


def move_behind_surfaces(
    gaussians: Gaussians, eye: Tensor, guards: Sequence[OcclusionGuard]
) -> Gaussians:
    """Move Gaussians away from an eye until they hide no guarded surface.

    They grow as they move, so the eye sees no change. A Gaussian that hides a surface wherever it
    moves is removed.

    Args:
        gaussians: N Gaussians in the world's frame.
        eye: [3] position of the camera for which the Gaussians were made.
        guards: the surfaces of other views.
    """
    return move_from_eye(gaussians, eye, unoccluding_scales(gaussians, eye, guards))


def move_from_eye(gaussians: Gaussians, eye: Tensor, scales: Tensor) -> Gaussians:
    """Scale Gaussians about an eye [3] by factors `scales` [N], so that the eye sees no change.

    A factor of 0 removes a Gaussian.
    """
    eye = to_like(eye, gaussians.means)
    factor = scales[:, None]
    moved = dataclasses.replace(
        gaussians,
        means=eye + factor * (gaussians.means - eye),
        scales=gaussians.scales * factor,
    )
    return moved.select(scales > 0)


def unoccluding_scales(
    gaussians: Gaussians, eye: Tensor, guards: Sequence[OcclusionGuard]
) -> Tensor:
    """[N] factors by which Gaussians must move away from an eye to hide no guarded surface.

    The factor multiplies a Gaussian's distance from the eye. It is at least 1 (1: it need not
    move), or else 0, for a Gaussian that hides a surface wherever it moves.

    Args:
        gaussians: N Gaussians in the world's frame.
        eye: [3] position of the camera for which the Gaussians were made.
        guards: the surfaces to protect.
    """
    if not len(gaussians) or not guards:
        return torch.ones_like(gaussians.opacities)
    device = gaussians.means.device
    rays = (gaussians.means - to_like(eye, gaussians.means)).detach().double()  # [N, 3]
    covariances = gaussians.detach().to(dtype=torch.float64).covariances().flatten(1)  # [N, 9]

    # The guards' depth images differ in size, so their pixels are stored one image behind the
    # other.
    sizes = torch.tensor([guard.depth.shape for guard in guards])  # [guards, 2]
    ends = sizes.prod(dim=1).cumsum(0)
    surfaces = GuardedSurfaces(
        cameras=torch.stack([_camera_numbers(guard.camera) for guard in guards]).to(device),
        depths=torch.cat([guard.depth.flatten() for guard in guards]).to(device),
        sizes=sizes.to(device),
        starts=(ends - sizes.prod(dim=1)).to(device),
    )
    eye_position = Point(*eye.detach().double().tolist())
    # The kernel runs for each of the N Gaussians, and writes its factor into `scales`.
    scales = torch.empty(len(rays), dtype=torch.float64, device=device)
    _write_scale(
        len(rays), eye_position, rays.contiguous(), covariances.contiguous(), surfaces, scales
    )
    return scales.to(gaussians.means.dtype)


class Point(NamedTuple):
    """A point in the world."""

    x: float
    y: float
    z: float


class GuardedSurfaces(NamedTuple):
    """The farthest surfaces near each pixel of several views, as a kernel reads them."""

    # [guards, 16] float64: fx, fy, cx, cy, and the 3×4 extrinsics row by row
    cameras: Tensor
    depths: Tensor  # the pixels of all guards' depth images, one behind the other; 0 is no surface
    sizes: Tensor  # [guards, 2] height and width of the images
    starts: Tensor  # [guards] the place of each image's first pixel in `depths`


def _camera_numbers(camera: Camera) -> Tensor:
    """A camera as 16 numbers, float64: fx, fy, cx, cy, and the 3×4 extrinsics row by row."""
    K = camera.K.detach().cpu().double()
    extrinsics = camera.world_to_camera.detach().cpu().double()[:3]
    return torch.cat([K[[0, 1, 0, 1], [0, 1, 2, 2]], extrinsics.flatten()])


def without_pits(depths: Tensor, cells: Tensor) -> Tensor:
    """[n] depths of cells, without narrow parts that are nearer than what surrounds them.

    Such parts get the depth around them (a morphological closing).

    Args:
        depths: [n] z of the cells.
        cells: [h, w] bool, where the n cells lie in the view's grid.
    """
    # The radius is a fraction of the view's width; parts less than twice as wide are removed.
    radius = max(1, round(PIT_RADIUS_WIDTHS * cells.shape[1]))
    grid = depths.new_zeros(cells.shape)
    grid[cells] = depths

    # A closing is a maximum followed by a minimum. The minimum is computed as minus the maximum of
    # the negative.
    farthest = maximum_filter(grid, radius)
    closed = -maximum_filter(torch.where(cells, -farthest, -torch.inf), radius)
    return closed[cells]


@kernel_for_items
def _write_scale(n: int, eye: Any, rays: Any, covariances: Any, surfaces: Any, scales: Any) -> None:
    """Write the least of 48 factors with which one Gaussian hides no guarded surface, or 0.

    A factor multiplies the Gaussian's distance from the eye. The factors are 1 / (1 − step / 48),
    for step = 0 … 47. 0 means that the Gaussian hides a surface with all of them.

    Args:
        n: index of the Gaussian; the kernel runs for each index.
        eye: the point from which the Gaussians move away.
        rays: [N, 3] from the eye to the Gaussians' centres.
        covariances: [N, 9] in the world's frame.
        surfaces: `GuardedSurfaces`.
        scales: output [N]; scales[n] is written.
    """
    scales[n] = 0
    for step in range(DEPTH_STEPS):
        # The steps are even in inverse depth: 1 / scale = 1 - step / DEPTH_STEPS.
        scale = 1.0 / (1.0 - step / DEPTH_STEPS)
        x = eye.x + scale * rays[n, 0]
        y = eye.y + scale * rays[n, 1]
        z = eye.z + scale * rays[n, 2]
        hides_surface = False
        for guard in range(len(surfaces.starts)):
            if _hides_surface(surfaces, guard, x, y, z, covariances[n], scale):
                hides_surface = True
                break
        if not hides_surface:
            scales[n] = scale
            break


@kernel
def _hides_surface(
    surfaces: Any, guard: int, x: float, y: float, z: float, covariance: Any, scale: float
) -> bool:
    """Whether any part of a Gaussian lies in front of a surface of one guarded view.

    Args:
        surfaces: `GuardedSurfaces` of all views.
        guard: number of the view.
        x, y, z: the Gaussian's centre in the world.
        covariance: [9] of the Gaussian before it was scaled.
        scale: factor on the Gaussian's standard deviations.
    """
    camera = surfaces.cameras[guard]
    height, width = surfaces.sizes[guard, 0], surfaces.sizes[guard, 1]
    # Row by row of the extrinsics, (camera[4:8], camera[8:12], camera[12:16]) · (x, y, z, 1).
    depth = camera[12] * x + camera[13] * y + camera[14] * z + camera[15]
    if not depth > 0:
        return False
    tan_u = (camera[4] * x + camera[5] * y + camera[6] * z + camera[7]) / depth
    tan_v = (camera[8] * x + camera[9] * y + camera[10] * z + camera[11]) / depth
    u = camera[0] * tan_u + camera[2]
    v = camera[1] * tan_v + camera[3]

    # Is the Gaussian in the picture at all? A cheap test takes the largest reach that any Gaussian
    # is given, a second one the reach of this Gaussian.
    if u < -MAX_REACH_PX or v < -MAX_REACH_PX:
        return False
    if u > width + MAX_REACH_PX or v > height + MAX_REACH_PX:
        return False
    reach_u = _reach_px(camera, X_ROW, camera[0] * scale / depth, tan_u, covariance)
    reach_v = _reach_px(camera, Y_ROW, camera[1] * scale / depth, tan_v, covariance)
    if u < -reach_u or v < -reach_v or u > width + reach_u or v > height + reach_v:
        return False

    # Each depth of the guard is the greatest within a window around its pixel. So not every pixel
    # that the Gaussian covers has to be looked at: pixels one window apart see all of it. On a GPU,
    # `ceil` and `floor` give floats, hence np.int64.
    spacing_px = 2 * WINDOW_RADIUS_PX
    steps_u = np.int64(math.ceil(max(reach_u - WINDOW_RADIUS_PX, 0.0) / spacing_px))
    steps_v = np.int64(math.ceil(max(reach_v - WINDOW_RADIUS_PX, 0.0) / spacing_px))
    start = surfaces.starts[guard]
    for j in range(-steps_v, steps_v + 1):
        row = min(max(np.int64(math.floor(v + spacing_px * j)), 0), height - 1)
        for i in range(-steps_u, steps_u + 1):
            column = min(max(np.int64(math.floor(u + spacing_px * i)), 0), width - 1)
            surface_depth = surfaces.depths[start + row * width + column]
            # A Gaussian that lies just behind a surface would show through it.
            if depth < surface_depth * (1 + BEHIND_SURFACE_RATIO):
                return True
    return False


@kernel
def _reach_px(
    camera: Any, axis_row: int, px_per_unit: float, tangent: float, covariance: Any
) -> float:
    """How many pixels from its centre a Gaussian is visible along one image axis, at most 40.

    Args:
        camera: [16] fx, fy, cx, cy, 3×4 extrinsics.
        axis_row: where the axis' row of the extrinsics begins in `camera`: 4 for x, 8 for y.
        px_per_unit: pixels for a unit of length at the Gaussian's depth.
        tangent: x / z or y / z of the Gaussian's centre in the camera's frame.
        covariance: [9] of the Gaussian in the world's frame.
    """
    # The derivative (a, b, c) of the pixel by the world's x, y, z. From number 12 on, `camera`
    # holds the row of the extrinsics for z.
    a = px_per_unit * (camera[axis_row] - tangent * camera[12])
    b = px_per_unit * (camera[axis_row + 1] - tangent * camera[13])
    c = px_per_unit * (camera[axis_row + 2] - tangent * camera[14])

    # The variance along the axis is (a, b, c) Σ (a, b, c)ᵀ; Σ is symmetric.
    variance = a * a * covariance[0] + b * b * covariance[4] + c * c * covariance[8]
    variance += 2 * (a * b * covariance[1] + a * c * covariance[2] + b * c * covariance[5])
    reach = VISIBLE_SIGMAS * math.sqrt(max(variance, 0.0)) + 1.0  # one more, for a pixel's width
    return float(min(reach, MAX_REACH_PX))
