"""The residual network f_res (paper, section 3.3, eq. 5) turns a view's features into deltas for every cell."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import torch
from torch import Tensor, nn

from spackle.core.camera import Camera
from spackle.core.crop import Crop, crops_around_mask
from spackle.core.filters import approximate_gaussian_blur
from spackle.core.patch_matching import TONE_BLUR_CELLS, Patches, match_patches
from spackle.residual.features import ViewFeatures
from spackle.residual.initializer import (
    InitialGaussians,
    inside_photo,
    seen_in_photo,
    trace_epipolar_lines,
)
from spackle.runtime.device import Precision, pick_dtype, without_autocast_or_tf32

ALIKE = 1.4  # a far rim whose inverse depth exceeds the seed's by more than this factor is ignored

# Channels of the features.
VIEW_DEPTH, SEED_DEPTH, SEED_RGB = 3, 6, slice(7, 10)
VIEW_CHANNELS = SEED_RGB.stop  # rendered colour 3, depth, opacity, mask, seed depth, seed colour 3
FAR_RIM = slice(
    VIEW_CHANNELS, VIEW_CHANNELS + 3
)  # logit of the far rim's colour minus logit of the seed's colour
MIRRORED = slice(
    FAR_RIM.stop, FAR_RIM.stop + 3
)  # the same difference for the colour mirrored at the rim
EXEMPLAR = slice(
    MIRRORED.stop + 1, MIRRORED.stop + 4
)  # and for patches; the channel before is the rim's distance
RIM_CHANNELS = (
    EXEMPLAR.stop + 1
)  # number of channels without the photo; the last is the patch distance
PHOTO = slice(RIM_CHANNELS, RIM_CHANNELS + 3)  # optional: the photo's colour at the cell's point
KNOWN_COLORS = (
    FAR_RIM,
    MIRRORED,
    EXEMPLAR,
)  # differences that a network may add to the seed's colour
# Channels of the deltas, as in SHARP: geometry (pixel, inverse depth), texture (scales, quaternion, colour, opacity).
DELTAS = [2, 1, 3, 4, 3, 1]
GEOMETRY_CHANNELS, TEXTURE_CHANNELS, DELTA_CHANNELS = sum(DELTAS[:2]), sum(DELTAS[2:]), sum(DELTAS)
COLOR = slice(10, 13)
COLOR_MARGIN = 1.0 / 512  # keeps the inverse sigmoid finite; less than one step of 8-bit colour

TYPICAL_DISTANCE = 16.0  # from a cell to the rim, in cells
TYPICAL_MISMATCH = 0.1
STRIDE = 16  # cells along the side of one cell of a network's coarsest grid, after four halvings


@dataclasses.dataclass(frozen=True)
class Rim:
    """Values for each masked cell from the far rim of its hole; unmasked cells have their own values."""

    rgb: Tensor  # [h, w, 3] sRGB at the far rim
    mirrored: Tensor  # [h, w, 3] sRGB at the cell's mirror image beyond the rim, if on the same surface; else `rgb`
    distance: Tensor  # [h, w] cells to the rim; 0 elsewhere
    exemplar: (
        Tensor  # [h, w, 3] sRGB of matching patches elsewhere in the view, with the seeds' tone
    )
    mismatch: Tensor  # [h, w] patch distance: root mean squared difference of a match; 0 elsewhere
    beyond: Tensor  # [h, w] bool: masked cells whose points project outside of the photo
    photo: Tensor | None = (
        None  # [h, w, 3] sRGB of the photo, see `seen_in_photo`; outside of it the seed's colour
    )


def find_rim(
    features: ViewFeatures,
    seeds: InitialGaussians,
    camera: Camera,
    photo_camera: Camera,
    photo: Tensor | None = None,
) -> tuple[Rim, Patches]:
    """Values at the far rims of a view's holes (see `trace_epipolar_lines`), and patches of the view that match its masked cells.

    Between photo and view, image points move along epipolar lines. An epipolar line therefore leads from a hole to the
    surface that was uncovered. If the line meets no surface, or a surface much nearer than the seed, the seed is kept.

    Cells inside the photo are matched by the seeds' colours. Cells beyond the photo's border have blurred seeds and are
    matched by mirrored colours. `photo` [H, W, 3] sRGB is needed by a network that `sees_photo`.
    """
    rgb, depths = seeds.rgb.detach(), seeds.inverse_depth.detach()
    values = torch.cat([rgb, depths[..., None]], dim=-1)
    far, near, steps = trace_epipolar_lines(
        seeds.uv.detach(), values, depths, features.mask, camera, photo_camera.position
    )
    in_front = (features.mask & (far[..., 3] > ALIKE * depths))[
        ..., None
    ]  # a nearer surface does not continue here
    far, near = (torch.where(in_front, rgb, met[..., :3]) for met in (far, near))
    beyond = features.mask & ~inside_photo(seeds.inverse_depth, camera, photo_camera)
    tone = torch.where(features.mask[..., None], rgb, features.rgb)
    patches = match_patches(torch.where(beyond[..., None], near, tone), features.mask, depths)
    toned = (patches.rgb - approximate_gaussian_blur(patches.rgb - tone, TONE_BLUR_CELLS)).clamp(
        0, 1
    )
    toned_patches = torch.where(beyond[..., None], toned, patches.rgb)
    seen = None if photo is None else seen_in_photo(photo, rgb, depths, camera, photo_camera)
    return Rim(far, near, steps, toned_patches, patches.mismatch, beyond, seen), patches


def network_input(view: ViewFeatures, seeds: InitialGaussians, rim: Rim) -> Tensor:
    """Features [1, 21, h, w], or [1, 24, h, w] with the photo; depths are log(inverse depth / median)."""
    view_depth = torch.where(
        view.inverse_depth > 0, (view.inverse_depth / seeds.unit).clamp_min(1e-4).log(), 0.0
    )
    seed_depth = (seeds.inverse_depth / seeds.unit).clamp_min(1e-4).log()
    maps = [view_depth, view.alpha, view.mask.to(view.alpha), seed_depth]
    grids = (
        seeds.rgb,
        rim.rgb,
        rim.mirrored,
        rim.exemplar,
        rim.distance[..., None],
        rim.mismatch[..., None],
    )
    *colors, distance, mismatch = (grid[view.mask] for grid in grids)
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
    """f_res: maps features [B, C, h, w] of `network_input` to deltas [B, 14, h, w], for any h and w.

    The last layers start at zero, so the deltas of an untrained network are zero.
    """

    name: ClassVar[str]  # in recipes and weight files
    sees_photo: ClassVar[bool]  # whether the features include the photo
    # Whether a cell's deltas are the same in every crop with enough context around the cell. If so, `forward` takes the
    # crop whose deltas are wanted as a second argument.
    local: ClassVar[bool]


@torch.no_grad()
def predict_deltas(
    network: nn.Module,
    view: ViewFeatures,
    seeds: InitialGaussians,
    rim: Rim,
    precision: Precision = "auto",
    *,
    dense: bool = False,
) -> Tensor:
    """Deltas [h, w, 14] float32 on the CPU; 0 in unmasked cells.

    A `local` network runs only on crops around the masked cells, see `crops_around_mask`.

    Args:
        network: a `ResidualNet`.
        view, seeds, rim: one view's features, seeds and rim.
        precision: of the convolutions; auto is bfloat16 if the hardware multiplies it natively.
        dense: return the deltas of all cells, masked or not.
    """
    device = next(network.parameters()).device
    dtype = pick_dtype(precision, device)
    chosen = torch.ones_like(view.mask) if dense else view.mask
    whole = (Crop(0, 0, *view.mask.shape),) * 2
    field = view.alpha.new_zeros(*view.mask.shape, DELTA_CHANNELS)
    features, local = network_input(view, seeds, rim), getattr(network, "local", True)
    # One autocast block around all crops: the weights are converted once.
    with (
        without_autocast_or_tf32(device),
        torch.autocast(device.type, dtype, enabled=dtype != torch.float32),
    ):
        for inner, outer in crops_around_mask(chosen, STRIDE) if local else [whole]:
            part = (
                features[(..., *outer.slices)]
                .contiguous(memory_format=torch.channels_last)
                .to(device)
            )
            deltas = network(part, inner.moved(-outer.top, -outer.left)) if local else network(part)
            deltas = deltas[0].permute(1, 2, 0).float().cpu()
            field[inner.slices] = torch.where(chosen[inner.slices][..., None], deltas, 0)
    return field
