"""Keeping aux Gaussians behind what other views already show."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

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
        depth = torch.where(hole_mask(rendering.alpha, threshold), 0.0, rendering.depth)
        wide = max_pool2d(depth[None, None], 2 * REACH_PX + 1, stride=1, padding=REACH_PX)[0, 0]
        return Shield(camera, wide)

    def blocks(self, points: Tensor) -> Tensor:
        """[N] bool: points [N, 3] that would stand in front of what this view shows."""
        uv, z = self.camera.project(points)
        # A point just outside the frame reaches into it; the shield's border pixels speak for it.
        x, y = uv.unbind(-1)
        seen = (z > 0) & (x > -REACH_PX) & (y > -REACH_PX)
        seen &= (x < self.camera.width + REACH_PX) & (y < self.camera.height + REACH_PX)
        column = x.nan_to_num(0.0).clamp(0, self.camera.width - 1).long()
        row = y.nan_to_num(0.0).clamp(0, self.camera.height - 1).long()
        return seen & (z < self.depth[row, column] * (1.0 + CLEARANCE))


def push_behind(aux: Gaussians, eye: Tensor, shields: list[Shield]) -> Gaussians:
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
    factor = torch.ones(len(aux)).to(aux.means)
    pending = torch.arange(len(aux), device=factor.device)
    for step in range(STEPS):
        factor[pending] = 1.0 / (1.0 - step / STEPS)
        points = eye + factor[pending, None] * (aux.means[pending] - eye)
        blocked = torch.stack([shield.blocks(points) for shield in shields]).any(0)
        pending = pending[blocked]
        if not len(pending):
            break
    moved = dataclasses.replace(
        aux, means=eye + factor[:, None] * (aux.means - eye), scales=aux.scales * factor[:, None]
    )
    keep = torch.ones(len(aux), dtype=torch.bool)
    keep[pending] = False
    return moved.select(keep)
