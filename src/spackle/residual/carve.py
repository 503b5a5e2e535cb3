"""Keeping aux Gaussians behind what other views already show."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from spackle._numba import kernel
from spackle.camera import Camera
from spackle.gaussians import Gaussians
from spackle.rendering import Rendering
from spackle.residual.cues import MASK_THRESHOLD, hole_mask

SHIELD_PX = 4  # radius of the shield's window: most aux Gaussians reach no farther than this
REACH = 3.0  # a Gaussian is seen this many standard deviations from its centre
MAX_REACH_PX = 40.0  # nor is a huge one's reach looked into farther than this
CLEARANCE = 0.002  # relative distance behind the surface that counts as behind
STEPS = 48  # candidate positions along the line of sight, even in inverse depth


@dataclasses.dataclass(frozen=True)
class Shield:
    """The farthest surface that a view shows near each pixel: nothing new may stand in front of it."""

    camera: Camera
    depth: Tensor  # [H, W]; 0 where the view shows only holes

    @staticmethod
    def of(rendering: Rendering, camera: Camera, threshold: float = MASK_THRESHOLD) -> Shield:
        """The shield of a rendered view."""
        depth = torch.where(hole_mask(rendering.alpha, threshold), 0.0, rendering.depth)[None, None]
        size = 2 * SHIELD_PX + 1
        wide = max_pool2d(depth, (size, 1), stride=1, padding=(SHIELD_PX, 0))
        wide = max_pool2d(wide, (1, size), stride=1, padding=(0, SHIELD_PX))
        return Shield(camera, wide[0, 0])


def push_behind(aux: Gaussians, eye: Tensor, shields: Sequence[Shield]) -> Gaussians:
    """Slide Gaussians away from the eye that wants them until no shield is blocked.

    Scaling about the eye moves and grows a Gaussian without changing how that eye sees it. Far enough
    out everything is behind everything, so a place is found for nearly all; the rest is dropped.

    Args:
        aux: N Gaussians in the world's frame.
        eye: [3] position of the view that they were made for.
        shields: the views to protect.
    """
    if not len(aux) or not shields:
        return aux
    eye = eye.to(aux.means)
    rays = (aux.means - eye).detach().cpu().double().numpy()
    covariances = aux.covariances().detach().cpu().double().numpy()
    lenses = np.stack([_lens(shield.camera) for shield in shields])
    depths = np.concatenate([shield.depth.detach().cpu().float().numpy().ravel() for shield in shields])
    sizes = np.array([[shield.camera.height, shield.camera.width] for shield in shields])
    starts = np.concatenate([[0], np.cumsum(sizes.prod(axis=1))])
    factors = _free_factors(eye.cpu().double().numpy(), rays, covariances, lenses, depths, sizes, starts)
    factor = torch.from_numpy(factors).to(aux.means)[:, None]
    moved = dataclasses.replace(aux, means=eye + factor * (aux.means - eye), scales=aux.scales * factor)
    free = factor[:, 0] > 0
    return moved if bool(free.all()) else moved.select(free)


def _lens(camera: Camera) -> Any:
    """fx, fy, cx, cy and the 3×4 extrinsics, [16] float64."""
    K, matrix = camera.K.detach().cpu().double(), camera.world_to_camera.detach().cpu().double()
    return torch.cat([torch.stack([K[0, 0], K[1, 1], K[0, 2], K[1, 2]]), matrix[:3].reshape(-1)]).numpy()


@kernel
def _free_factors(eye: Any, rays: Any, covariances: Any, lenses: Any, depths: Any, sizes: Any, starts: Any) -> Any:
    """For each Gaussian the smallest of 1 / (1 − k / STEPS) that no shield blocks; 0 where there is none."""
    factors = np.zeros(len(rays))
    for n in range(len(rays)):
        for step in range(STEPS):
            factor = 1.0 / (1.0 - step / STEPS)
            x, y, z = eye[0] + factor * rays[n, 0], eye[1] + factor * rays[n, 1], eye[2] + factor * rays[n, 2]
            blocked = False
            for s in range(len(lenses)):
                if _blocks(lenses[s], depths, starts[s], sizes[s, 0], sizes[s, 1], x, y, z, covariances[n], factor):
                    blocked = True
                    break
            if not blocked:
                factors[n] = factor
                break
    return factors


@kernel
def _blocks(
    lens: Any, shields: Any, start: int, height: int, width: int,
    x: float, y: float, z: float, covariance: Any, factor: float,
) -> bool:  # fmt: skip
    """Whether a Gaussian would stand in front of what a view shows, anywhere in its reach."""
    depth = lens[12] * x + lens[13] * y + lens[14] * z + lens[15]
    if not depth > 0:
        return False
    tan_u = (lens[4] * x + lens[5] * y + lens[6] * z + lens[7]) / depth
    tan_v = (lens[8] * x + lens[9] * y + lens[10] * z + lens[11]) / depth
    u, v = lens[0] * tan_u + lens[2], lens[1] * tan_v + lens[3]
    if u < -MAX_REACH_PX or v < -MAX_REACH_PX or u > width + MAX_REACH_PX or v > height + MAX_REACH_PX:
        return False
    reach_u = _reach(lens, 4, lens[0] * factor / depth, tan_u, covariance)
    reach_v = _reach(lens, 8, lens[1] * factor / depth, tan_v, covariance)
    if u < -reach_u or v < -reach_v or u > width + reach_u or v > height + reach_v:
        return False
    # Windows of the shield, side by side, cover the reach.
    steps_u = int(np.ceil(max(reach_u - SHIELD_PX, 0.0) / (2 * SHIELD_PX)))
    steps_v = int(np.ceil(max(reach_v - SHIELD_PX, 0.0) / (2 * SHIELD_PX)))
    for j in range(-steps_v, steps_v + 1):
        row = min(max(int(np.floor(v + 2 * SHIELD_PX * j)), 0), height - 1)
        for i in range(-steps_u, steps_u + 1):
            column = min(max(int(np.floor(u + 2 * SHIELD_PX * i)), 0), width - 1)
            if depth < shields[start + row * width + column] * (1.0 + CLEARANCE):
                return True
    return False


@kernel
def _reach(lens: Any, row: int, scale: float, tangent: float, covariance: Any) -> float:
    """How far in pixels a Gaussian is seen from its centre, along the axis of a row of the extrinsics."""
    a = scale * (lens[row] - tangent * lens[12])
    b = scale * (lens[row + 1] - tangent * lens[13])
    c = scale * (lens[row + 2] - tangent * lens[14])
    variance = a * a * covariance[0, 0] + b * b * covariance[1, 1] + c * c * covariance[2, 2]
    variance += 2 * (a * b * covariance[0, 1] + a * c * covariance[0, 2] + b * c * covariance[1, 2])
    return float(min(REACH * np.sqrt(max(variance, 0.0)) + 1.0, MAX_REACH_PX))
