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

REACH_PX = 4  # how far from its centre an aux Gaussian may still be seen: three standard deviations
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
        size = 2 * REACH_PX + 1
        wide = max_pool2d(depth, (size, 1), stride=1, padding=(REACH_PX, 0))
        wide = max_pool2d(wide, (1, size), stride=1, padding=(0, REACH_PX))
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
    lenses = np.stack([_lens(shield.camera) for shield in shields])
    depths = np.concatenate([shield.depth.detach().cpu().float().numpy().ravel() for shield in shields])
    sizes = np.array([[shield.camera.height, shield.camera.width] for shield in shields])
    starts = np.concatenate([[0], np.cumsum(sizes.prod(axis=1))])
    factors = _free_factors(eye.cpu().double().numpy(), rays, lenses, depths, sizes, starts)
    factor = torch.from_numpy(factors).to(aux.means)[:, None]
    moved = dataclasses.replace(aux, means=eye + factor * (aux.means - eye), scales=aux.scales * factor)
    free = factor[:, 0] > 0
    return moved if bool(free.all()) else moved.select(free)


def _lens(camera: Camera) -> Any:
    """fx, fy, cx, cy and the 3×4 extrinsics, [16] float64."""
    K, matrix = camera.K.detach().cpu().double(), camera.world_to_camera.detach().cpu().double()
    return torch.cat([torch.stack([K[0, 0], K[1, 1], K[0, 2], K[1, 2]]), matrix[:3].reshape(-1)]).numpy()


@kernel
def _free_factors(eye: Any, rays: Any, lenses: Any, depths: Any, sizes: Any, starts: Any) -> Any:
    """For each ray [N, 3] the smallest of 1 / (1 − k / STEPS) that no shield blocks; 0 where there is none."""
    factors = np.zeros(len(rays))
    for n in range(len(rays)):
        for step in range(STEPS):
            factor = 1.0 / (1.0 - step / STEPS)
            x, y, z = eye[0] + factor * rays[n, 0], eye[1] + factor * rays[n, 1], eye[2] + factor * rays[n, 2]
            blocked = False
            for s in range(len(lenses)):
                if _blocks(lenses[s], depths, starts[s], sizes[s, 0], sizes[s, 1], x, y, z):
                    blocked = True
                    break
            if not blocked:
                factors[n] = factor
                break
    return factors


@kernel
def _blocks(lens: Any, depths: Any, start: int, height: int, width: int, x: float, y: float, z: float) -> bool:
    """Whether a point would stand in front of what a view shows."""
    depth = lens[12] * x + lens[13] * y + lens[14] * z + lens[15]
    if not depth > 0:
        return False
    u = lens[0] * (lens[4] * x + lens[5] * y + lens[6] * z + lens[7]) / depth + lens[2]
    v = lens[1] * (lens[8] * x + lens[9] * y + lens[10] * z + lens[11]) / depth + lens[3]
    # A point just outside the frame reaches into it; the shield's border pixels speak for it.
    if not (-REACH_PX < u < width + REACH_PX and -REACH_PX < v < height + REACH_PX):
        return False
    column, row = min(max(int(np.floor(u)), 0), width - 1), min(max(int(np.floor(v)), 0), height - 1)
    return bool(depth < depths[start + row * width + column] * (1.0 + CLEARANCE))
