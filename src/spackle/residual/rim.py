"""What f_res sees at a hole's far rim, along the epipolar line on which the hole opened, and in patches of the view."""

from __future__ import annotations

import dataclasses
import math

import torch
from torch import Tensor

from spackle.camera import Camera
from spackle.filters import broadly_blurred
from spackle.patches import TONE_CELLS, Patches, match_patches
from spackle.residual.base_values import Seeds, inside_photo
from spackle.residual.epipolar_walk import CRISP, WIDENING, walk, widened
from spackle.residual.view_features import ViewFeatures

ALIKE = 1.4  # factor by which the inverse depths of a line's far rim and of the seed there may differ


@dataclasses.dataclass(frozen=True)
class Rim:
    """For each masked cell, what its line meets; elsewhere the cell itself."""

    rgb: Tensor  # [h, w, 3] sRGB at the far rim, the farther off the more of it
    mirrored: Tensor  # [h, w, 3] sRGB as far beyond the rim as the cell is before it, if that is the same surface
    distance: Tensor  # [h, w] cells to the rim; 0 elsewhere
    exemplar: Tensor  # [h, w, 3] sRGB of patches elsewhere in the view that match; their tone is the seeds'
    mismatch: Tensor  # [h, w] patch distance: root of their mean squared difference; 0 elsewhere
    beyond: Tensor  # [h, w] bool: masked cells whose points lie outside of the photo's frame


def find_rim(features: ViewFeatures, seeds: Seeds, camera: Camera, photo_camera: Camera) -> tuple[Rim, Patches]:
    """Walk from each masked cell to both sides along its epipolar line, and take the farther surface.

    What moves in front of what, moves along the lines through the epipole, where the view sees the
    photo's eye. So that line leads from a hole to the surface that continues behind, and structure
    at the rim continues along it more often than not, coarse structure farther than fine. Where a line meets
    nothing, or something much nearer than the seed, the seeds stay.

    Also returns patches of the view that match its masked cells: by the seeds' colours behind an object, by what is
    mirrored beyond the photo's border if that is as far away. There the seeds mix all that reaches the border,
    which looks like fog, and fog is what would match it.
    """
    uv, rgb, depths = seeds.uv.detach(), seeds.rgb.detach(), seeds.inverse_depth.detach()
    values = torch.cat([rgb, depths[..., None]], dim=-1)
    far, near, steps = walk(uv, values, depths, features.mask, camera, photo_camera.position)
    unmirrored, apart = (near == far).all(-1, keepdim=True), (near[..., 3] / depths).log().abs()
    in_front = (features.mask & (far[..., 3] > ALIKE * depths))[..., None]  # what stands there does not continue behind
    far, near = (torch.where(in_front, rgb, met[..., :3]) for met in (far, near))
    far = widened(far, features.mask, WIDENING * (steps - CRISP * features.mask.shape[1]).clamp_min(0))
    near = torch.where(unmirrored, far, near)
    beyond = features.mask & ~inside_photo(seeds.inverse_depth, camera, photo_camera)
    tone = torch.where(features.mask[..., None], rgb, features.rgb)
    continues = (beyond & (apart < math.log(ALIKE)))[..., None]
    patches = match_patches(torch.where(continues, near, tone), features.mask, depths)
    toned = (patches.rgb - broadly_blurred(patches.rgb - tone, TONE_CELLS)).clamp(0, 1)
    toned_patches = torch.where(beyond[..., None], toned, patches.rgb)
    return Rim(far, near, steps, toned_patches, patches.mismatch, beyond), patches
