"""The residual network f_res (paper, section 3.3, eq. 5) turns a view's features into a delta for every cell.

Its input is the rendered view, the base values, the colours at a hole's far rim along the epipolar line, and the
colours of matching patches of the view.
"""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import torch
from torch import Tensor, nn

from spackle.camera import Camera
from spackle.crop import Crop, crops_around
from spackle.device import Precision, own_arithmetic, pick_dtype
from spackle.filters import broadly_blurred
from spackle.patches import TONE_CELLS, Patches, match_patches
from spackle.residual.base_values import Seeds, inside_photo, seen_in_photo
from spackle.residual.epipolar_walk import walk
from spackle.residual.view_features import ViewFeatures

ALIKE = 1.4  # a far rim whose inverse depth exceeds the seed's by more than this factor is ignored

# Channels of the features.
VIEW_DEPTH, SEED_DEPTH, SEED_RGB = 3, 6, slice(7, 10)
VIEW_CHANNELS = SEED_RGB.stop  # rendered colour 3, depth, opacity, mask, seed depth, seed colour 3
FAR_RIM = slice(VIEW_CHANNELS, VIEW_CHANNELS + 3)  # the far rim's colour minus the seed's, both as logits
MIRRORED = slice(FAR_RIM.stop, FAR_RIM.stop + 3)  # likewise, for the colour mirrored at the rim
EXEMPLAR = slice(MIRRORED.stop + 1, MIRRORED.stop + 4)  # likewise, for patches; after the rim's distance
RIM_CHANNELS = EXEMPLAR.stop + 1  # number of channels with the patch distance, which is the last
PHOTO = slice(RIM_CHANNELS, RIM_CHANNELS + 3)  # if given: the photo's colour at the cell's point
KNOWN_COLORS = (FAR_RIM, MIRRORED, EXEMPLAR)  # colours that a network may copy
# Channels of the deltas, as in SHARP: geometry (pixel, inverse depth), texture (scales, quaternion, colour, opacity).
DELTAS = [2, 1, 3, 4, 3, 1]
GEOMETRY_CHANNELS, TEXTURE_CHANNELS, DELTA_CHANNELS = sum(DELTAS[:2]), sum(DELTAS[2:]), sum(DELTAS)
COLOR = slice(10, 13)
COLOR_MARGIN = 1.0 / 512  # keeps the inverse sigmoid finite, below 8-bit resolution

TYPICAL_DISTANCE = 16.0  # from a cell to the rim, in cells
TYPICAL_MISMATCH = 0.1
STRIDE = 16  # cells along the side of one cell of an architecture's coarsest grid: four halvings


@dataclasses.dataclass(frozen=True)
class Rim:
    """Values at the far rim for each masked cell; elsewhere the cell's own values."""

    rgb: Tensor  # [h, w, 3] sRGB at the far rim
    mirrored: Tensor  # [h, w, 3] sRGB at the cell's mirror image beyond the rim, if on the same surface; else `rgb`
    distance: Tensor  # [h, w] cells to the rim; 0 elsewhere
    exemplar: Tensor  # [h, w, 3] sRGB of matching patches elsewhere in the view, with the seeds' tone
    mismatch: Tensor  # [h, w] patch distance: root mean squared difference of a match; 0 elsewhere
    beyond: Tensor  # [h, w] bool: masked cells whose points project outside of the photo
    photo: Tensor | None = None  # [h, w, 3] sRGB of the photo, if requested (see `seen_in_photo`); outside, the seed's


def find_rim(
    features: ViewFeatures, seeds: Seeds, camera: Camera, photo_camera: Camera, photo: Tensor | None = None
) -> tuple[Rim, Patches]:
    """Walk from each masked cell in both directions along its epipolar line, and take the farther surface.

    Between the photo and the view, points move along lines through the epipole, the projection of the photo's eye. So
    such a line leads from a hole to the surface that was uncovered, and structure at the rim often continues along it.
    If a line meets no surface, or one much nearer than the seed, the seed is kept.

    Also returns patches of the view that match its masked cells. Behind an object they are matched by the seeds'
    colours; beyond the photo's border, where seeds are blurred, by the mirrored colours. The `photo` [H, W, 3] sRGB is
    for a network that `sees_photo`.
    """
    rgb, depths = seeds.rgb.detach(), seeds.inverse_depth.detach()
    values = torch.cat([rgb, depths[..., None]], dim=-1)
    far, near, steps = walk(seeds.uv.detach(), values, depths, features.mask, camera, photo_camera.position)
    in_front = (features.mask & (far[..., 3] > ALIKE * depths))[..., None]  # a nearer surface does not continue here
    far, near = (torch.where(in_front, rgb, met[..., :3]) for met in (far, near))
    beyond = features.mask & ~inside_photo(seeds.inverse_depth, camera, photo_camera)
    tone = torch.where(features.mask[..., None], rgb, features.rgb)
    patches = match_patches(torch.where(beyond[..., None], near, tone), features.mask, depths)
    toned = (patches.rgb - broadly_blurred(patches.rgb - tone, TONE_CELLS)).clamp(0, 1)
    toned_patches = torch.where(beyond[..., None], toned, patches.rgb)
    seen = None if photo is None else seen_in_photo(photo, rgb, depths, camera, photo_camera)
    return Rim(far, near, steps, toned_patches, patches.mismatch, beyond, seen), patches


def network_input(view: ViewFeatures, seeds: Seeds, rim: Rim) -> Tensor:
    """Features [1, 21, h, w] (24 with the photo), centred around zero; depths as log (inverse depth / its median)."""
    view_depth = torch.where(view.inverse_depth > 0, (view.inverse_depth / seeds.unit).clamp_min(1e-4).log(), 0.0)
    seed_depth = (seeds.inverse_depth / seeds.unit).clamp_min(1e-4).log()
    maps = [view_depth, view.alpha, view.mask.to(view.alpha), seed_depth]
    grids = (seeds.rgb, rim.rgb, rim.mirrored, rim.exemplar, rim.distance[..., None], rim.mismatch[..., None])
    *colors, distance, mismatch = (grid[view.mask] for grid in grids)  # elsewhere all differences are 0
    seed, near, mirrored, patches = map(color_logit, colors)
    distance, mismatch = (distance / TYPICAL_DISTANCE).log1p(), mismatch / TYPICAL_MISMATCH
    at_rim = torch.cat([near - seed, mirrored - seed, distance, patches - seed, mismatch], dim=-1)
    far = at_rim.new_zeros(*view.mask.shape, RIM_CHANNELS - VIEW_CHANNELS)
    far[view.mask] = at_rim
    channels = [view.rgb - 0.5, torch.stack(maps, dim=-1), seeds.rgb - 0.5, far]
    channels += [] if rim.photo is None else [rim.photo - 0.5]
    return torch.cat(channels, dim=-1).permute(2, 0, 1)[None].detach()


def color_logit(value: Tensor) -> Tensor:
    """sigmoid⁻¹ of colours or opacities, clamped away from 0 and 1."""
    return torch.logit(value.clamp(COLOR_MARGIN, 1 - COLOR_MARGIN / 2))


class ResidualNet(nn.Module):
    """f_res, in one of the `architectures`: maps features of `network_input` to deltas [B, 14, h, w], for any h and w.

    Its last layers start at zero, so an untrained network returns the seeds unchanged.
    """

    name: ClassVar[str]  # its name in recipes and weight files
    sees_photo: ClassVar[bool]  # whether its features include the photo
    local: ClassVar[bool]  # whether a cell's deltas are the same in every crop with enough context around it


@torch.no_grad()
def predict_deltas(
    network: nn.Module,
    view: ViewFeatures,
    seeds: Seeds,
    rim: Rim,
    precision: Precision = "auto",
    *,
    dense: bool = False,
) -> Tensor:
    """Deltas [h, w, 14] float32 of a view's masked cells, on the CPU; 0 elsewhere.

    A `local` network runs only on crops around the masked cells, see `crops_around`.

    Args:
        network: a `ResidualNet`, perhaps wrapped; its input is moved to its device.
        view, seeds, rim: one view's features, seeds and rim.
        precision: precision of the convolutions; auto is bfloat16 if the hardware multiplies it natively.
        dense: return the deltas of all cells.
    """
    device = next(network.parameters()).device
    dtype = pick_dtype(precision, device)
    chosen = torch.ones_like(view.mask) if dense else view.mask
    whole = (Crop(0, 0, *view.mask.shape),) * 2
    field = view.alpha.new_zeros(*view.mask.shape, DELTA_CHANNELS)
    features = network_input(view, seeds, rim)
    # One autocast block around all crops, so that the weights are converted once.
    with own_arithmetic(device), torch.autocast(device.type, dtype, enabled=dtype != torch.float32):
        for inner, outer in crops_around(chosen, STRIDE) if getattr(network, "local", True) else [whole]:
            part = features[(..., *outer.slices)].contiguous(memory_format=torch.channels_last).to(device)
            deltas = network(part)[0].permute(1, 2, 0)[inner.moved(-outer.top, -outer.left).slices]
            field[inner.slices] = torch.where(chosen[inner.slices][..., None], deltas.float().cpu(), 0)
    return field
