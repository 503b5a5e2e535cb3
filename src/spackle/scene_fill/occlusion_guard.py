"""Keep aux Gaussians behind the surfaces that the photo and other views show."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from spackle.core.camera import Camera, to_like
from spackle.core.filters import maximum_filter
from spackle.core.gaussians import Gaussians
from spackle.core.surfels import BEHIND_SURFACE_RATIO
from spackle.render.protocol import ALPHA_MIN, Rendering
from spackle.residual.features import MASK_THRESHOLD
from spackle.runtime.device import parallel_for_chunks
from spackle.runtime.kernels import kernel

WINDOW_PX = 4  # radius of the guard's window: most aux Gaussians reach no farther
REACH = math.sqrt(
    -2 * math.log(ALPHA_MIN)
)  # a Gaussian is visible up to so many standard deviations from its centre
MAX_REACH_PX = 40.0  # a Gaussian is checked only up to this distance from its centre
PIT = 0.027  # of a view's width: a near spot less than twice as wide is removed
STEPS = 48  # candidate positions along the line of sight, evenly spaced in inverse depth


@dataclasses.dataclass(frozen=True)
class OcclusionGuard:
    """The farthest surface near each pixel of a view; no new Gaussian may lie in front of this
    surface.
    """

    camera: Camera
    depth: Tensor  # [H, W]; 0 in holes

    @staticmethod
    def of(
        rendering: Rendering, camera: Camera, threshold: float = MASK_THRESHOLD
    ) -> OcclusionGuard:
        """The guard of a rendered view."""
        view = rendering.to(torch.device("cpu")).detach()
        seen = torch.where(view.alpha < threshold, 0, view.depth).float()
        return OcclusionGuard(camera, maximum_filter(seen, WINDOW_PX))


def move_behind_surfaces(
    aux: Gaussians, eye: Tensor, guards: Sequence[OcclusionGuard]
) -> Gaussians:
    """Move Gaussians away from an eye [3] until they hide no guarded surface, see
    `unoccluding_scales`.
    """
    return move_from_eye(aux, eye, unoccluding_scales(aux, eye, guards))


def move_from_eye(aux: Gaussians, eye: Tensor, factors: Tensor) -> Gaussians:
    """Scale Gaussians about the eye [3] by factors [N]; the eye sees no change. Factor 0 removes a
    Gaussian.
    """
    eye, factor = to_like(eye, aux.means), factors[:, None]
    moved = dataclasses.replace(
        aux, means=eye + factor * (aux.means - eye), scales=aux.scales * factor
    )
    return moved.select(factors > 0)


def unoccluding_scales(aux: Gaussians, eye: Tensor, guards: Sequence[OcclusionGuard]) -> Tensor:
    """Factors [N] ≥ 1 by which Gaussians must move away from an eye to hide no guarded surface; 0
    if impossible.

    Args:
        aux: N Gaussians in the world's frame.
        eye: [3] position of the camera for which the Gaussians were made.
        guards: the views to protect.
    """
    if not len(aux) or not guards:
        return torch.ones_like(aux.opacities)
    rays = (aux.means - to_like(eye, aux.means)).detach().cpu().double().numpy()
    covariances = (
        aux.detach().to(dtype=torch.float64).covariances().cpu().flatten(1).numpy()
    )  # [N, 9]
    lenses = np.empty((len(guards), 16))  # fx, fy, cx, cy and the 3×4 extrinsics of each view
    for lens, camera in zip(lenses, [guard.camera for guard in guards], strict=True):
        lens[:4] = camera.K.detach().cpu().numpy()[[0, 1, 0, 1], [0, 1, 2, 2]]
        lens[4:] = camera.world_to_camera.detach().cpu().numpy()[:3].ravel()
    depths = np.concatenate([guard.depth.numpy().ravel() for guard in guards])
    sizes = np.array([guard.depth.shape for guard in guards])
    starts = np.concatenate([[0], np.cumsum(sizes.prod(axis=1))])
    place, factors = to_like(eye, aux.means).cpu().double().numpy(), np.empty(len(rays))
    views = (lenses, depths, sizes, starts)
    parallel_for_chunks(
        lambda first, last: _free_factors(first, last, place, rays, covariances, *views, factors),
        len(rays),
    )
    return torch.from_numpy(factors).to(aux.means)


def without_pits(depths: Tensor, cells: Tensor) -> Tensor:
    """Depths [n] of the cells `cells` ([h, w] bool), after a morphological closing that removes
    narrow near parts.
    """
    reach = max(1, round(PIT * cells.shape[1]))
    grid = depths.new_zeros(cells.shape)
    grid[cells] = depths
    farthest = maximum_filter(grid, reach)
    return -maximum_filter(torch.where(cells, -farthest, -torch.inf), reach)[cells]


@kernel
def _free_factors(
    first: int, last: int, eye: Any, rays: Any, covariances: Any,
    lenses: Any, depths: Any, sizes: Any, starts: Any, factors: Any,
) -> None:  # fmt: skip
    """Find the least factor 1 / (1 − k / STEPS), or 0, for the Gaussians first..last."""
    for n in range(first, last):
        factors[n] = 0
        for step in range(STEPS):
            factor = 1.0 / (1.0 - step / STEPS)
            x, y, z = (
                eye[0] + factor * rays[n, 0],
                eye[1] + factor * rays[n, 1],
                eye[2] + factor * rays[n, 2],
            )
            blocked = False
            for s in range(len(lenses)):
                if _blocks(
                    lenses[s],
                    depths,
                    starts[s],
                    sizes[s, 0],
                    sizes[s, 1],
                    x,
                    y,
                    z,
                    covariances[n],
                    factor,
                ):
                    blocked = True
                    break
            if not blocked:
                factors[n] = factor
                break


@kernel
def _blocks(
    lens: Any, guards: Any, start: int, height: int, width: int,
    x: float, y: float, z: float, covariance: Any, factor: float,
) -> bool:  # fmt: skip
    """Whether any part of a Gaussian lies in front of a view's surface."""
    depth = lens[12] * x + lens[13] * y + lens[14] * z + lens[15]
    if not depth > 0:
        return False
    tan_u = (lens[4] * x + lens[5] * y + lens[6] * z + lens[7]) / depth
    tan_v = (lens[8] * x + lens[9] * y + lens[10] * z + lens[11]) / depth
    u, v = lens[0] * tan_u + lens[2], lens[1] * tan_v + lens[3]
    if (
        u < -MAX_REACH_PX
        or v < -MAX_REACH_PX
        or u > width + MAX_REACH_PX
        or v > height + MAX_REACH_PX
    ):
        return False
    reach_u = _reach(lens, 4, lens[0] * factor / depth, tan_u, covariance)
    reach_v = _reach(lens, 8, lens[1] * factor / depth, tan_v, covariance)
    if u < -reach_u or v < -reach_v or u > width + reach_u or v > height + reach_v:
        return False
    # Adjacent windows of the guard cover the Gaussian's extent.
    steps_u = int(np.ceil(max(reach_u - WINDOW_PX, 0.0) / (2 * WINDOW_PX)))
    steps_v = int(np.ceil(max(reach_v - WINDOW_PX, 0.0) / (2 * WINDOW_PX)))
    for j in range(-steps_v, steps_v + 1):
        row = min(max(int(np.floor(v + 2 * WINDOW_PX * j)), 0), height - 1)
        for i in range(-steps_u, steps_u + 1):
            column = min(max(int(np.floor(u + 2 * WINDOW_PX * i)), 0), width - 1)
            if depth < guards[start + row * width + column] * (1 + BEHIND_SURFACE_RATIO):
                return True
    return False


@kernel
def _reach(lens: Any, row: int, scale: float, tangent: float, covariance: Any) -> float:
    """A Gaussian's extent in pixels from its centre, along one image axis; `row` is the axis' place
    in `lens`.
    """
    a = scale * (lens[row] - tangent * lens[12])
    b = scale * (lens[row + 1] - tangent * lens[13])
    c = scale * (lens[row + 2] - tangent * lens[14])
    variance = a * a * covariance[0] + b * b * covariance[4] + c * c * covariance[8]
    variance += 2 * (a * b * covariance[1] + a * c * covariance[2] + b * c * covariance[5])
    return float(min(REACH * np.sqrt(max(variance, 0.0)) + 1.0, MAX_REACH_PX))
