"""New Gaussians for the holes of one view, behind all surfaces that other views show."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from spackle.core.camera import Camera, to_like
from spackle.core.color import linear_to_srgb, srgb_to_linear
from spackle.core.gaussians import Gaussians
from spackle.core.surfels import BEHIND_SURFACE_RATIO, PIXEL_SIGMA_PX
from spackle.residual.composer import compose
from spackle.residual.features import CELL, CELL_PIXELS, hole_mask
from spackle.residual.initializer import InitialGaussians
from spackle.scene_fill.context import FillContext
from spackle.scene_fill.occlusion_guard import (
    OcclusionGuard,
    move_from_eye,
    unoccluding_scales,
    without_pits,
)
from spackle.scene_fill.texture import group_by_cell, sharpen_for_overlap
from spackle.scene_fill.view_completion import SceneViewCompletion

# sRGB: a cell whose pixels differ less from their mean gets one Gaussian, any other also one for
# each pixel.
UNIFORM_CELL_RANGE = 0.01
# Pixel centres of a cell of 2×2 pixels, as (x, y) from the cell's centre in pixels, row by row.
PIXEL_OFFSETS = torch.tensor([[-0.5, -0.5], [0.5, -0.5], [-0.5, 0.5], [0.5, 0.5]])


@dataclasses.dataclass(frozen=True)
class HoleFilling:
    """The new Gaussians in the holes of a view, and the surfaces that they continue."""

    gaussians: Gaussians
    # A surface point with its colour for each cell of the view, in holes and elsewhere. These
    # surfaces are continued beneath the rims of the holes.
    surfaces: InitialGaussians


def cells_to_fill(view: SceneViewCompletion, fillable: Tensor | None) -> Tensor:
    """[h, w] bool: the cells (2×2 pixels) of a view that touch a hole which may be filled.

    Args:
        view: the view, with its holes.
        fillable: [H, W] bool, the pixels that may be filled; None: all of them.
    """
    if fillable is None:
        return view.mask
    alpha = view.rendering.alpha
    hole = hole_mask(alpha, view.threshold) & fillable.to(alpha.device)
    # An odd last row or column of pixels is a cell, too.
    return max_pool2d(hole[None].float(), CELL, ceil_mode=True)[0] > 0


def fill_holes(
    context: FillContext,
    view: SceneViewCompletion,
    guards: Sequence[OcclusionGuard],
    mask: Tensor | None = None,
) -> HoleFilling:
    """Gaussians for all cells (2×2 pixels) of a view that touch a hole.

    Each cell has one Gaussian; with a texture, a cell whose pixels differ has a Gaussian for each
    pixel, too.

    Args:
        context: network and texture, if any, and the precision of the network.
        view: the view, with its holes.
        guards: surfaces of other views, in front of which no new Gaussian may lie.
        mask: [h, w] bool from `cells_to_fill`: the cells that get Gaussians; None: all with holes.
    """
    if mask is None:
        mask = view.mask
    eye = view.camera.position
    deltas = view.deltas(context.network, context.precision, cells=mask)
    cells = view.gaussians(mask, deltas)

    # Gaussians that would hide a surface that another view shows (a guard) move away along their
    # line of sight. A single cell that stayed near, between others that moved, would look like a
    # speck (a "pit" of the depths), so it moves like them. A scale of 0 removes a Gaussian.
    depths = view.camera.to_camera(cells.means)[:, 2]
    scales = unoccluding_scales(cells, eye, guards)
    moved_depths = depths * scales
    smooth_scales = without_pits(moved_depths, mask) / depths
    scales = torch.where(scales > 0, smooth_scales, 0)

    pixels = Gaussians.empty(cells.means.device)
    if context.texture is not None:
        # The texture adds detail to smooth colours of all cells: those of the new Gaussians in
        # holes, the rendered ones elsewhere. Other holes, which are not to be filled, were rendered
        # black, and the texture would spread that. So they get the colours of the initial
        # Gaussians, the first guess from what surrounds them.
        structure = view.features.rgb.clone()
        structure[view.mask] = view.initial.rgb[view.mask]
        structure[mask] = linear_to_srgb(cells.colors)
        picture = context.texture(view, structure)
        pixels = _textured_pixels(view, mask, deltas, picture, scales)

        # A cell's own Gaussian lies a little behind the Gaussians of its pixels (so far that it
        # does not show through them), and has their mean colour. So it shows only in gaps.
        scales = scales / (1 - BEHIND_SURFACE_RATIO)
        cell_pixels = group_by_cell(picture)[mask]
        linear_means = srgb_to_linear(cell_pixels.clamp(0, 1)).mean((1, 2))
        cells = dataclasses.replace(cells, colors=linear_means)

    # The caller will continue `surfaces` beneath the rims of the holes. Without network and
    # texture, they are the first guess, unchanged.
    surfaces = view.initial
    if context.network is not None or context.texture is not None:
        surfaces = _follow_beyond_photo(view, mask, depths * scales, scales > 0)
    cells = move_from_eye(cells, eye, scales)
    return HoleFilling(Gaussians.cat([pixels, cells]), surfaces)


def _textured_pixels(
    view: SceneViewCompletion,
    mask: Tensor,
    deltas: Tensor | None,
    picture: Tensor,
    scales: Tensor,
) -> Gaussians:
    """One Gaussian for each pixel of those hole cells whose four pixels differ in colour.

    Args:
        view: the view.
        mask: [h, w] bool: the n hole cells that are filled.
        deltas: [h, w, 14] the network's changes of the initial Gaussians; None: no changes.
        picture: [2h, 2w, 3] sRGB of all pixels of the view.
        scales: [n] factors by which the Gaussians of the n hole cells move away from the eye; 0
            removes them.
    """
    cell_pixels = group_by_cell(picture)[mask]  # [n, 2, 2, 3] sRGB
    cell_means = cell_pixels.mean((1, 2), keepdim=True)
    differs = (cell_pixels - cell_means).abs().amax((1, 2, 3)) > UNIFORM_CELL_RANGE
    textured = differs.nonzero()[:, 0]

    # Overlapping Gaussians blur the picture, so it is sharpened in advance.
    sharp_cell_pixels = group_by_cell(sharpen_for_overlap(picture))[mask]  # [n, 2, 2, 3]
    pixels = pixel_gaussians(
        initial=view.initial.select(mask).select(textured),
        deltas=None if deltas is None else deltas[mask][textured],
        camera=view.camera,
        colors=sharp_cell_pixels[textured],
    )
    return move_from_eye(
        pixels, view.camera.position, scales[textured].repeat_interleave(CELL_PIXELS)
    )


def _follow_beyond_photo(
    view: SceneViewCompletion, mask: Tensor, depths: Tensor, is_kept: Tensor
) -> InitialGaussians:
    """The view's initial Gaussians, but beyond the photo's border at the depths of the new
    Gaussians.

    An initial Gaussian is the first guess of a surface point for a cell of 2×2 pixels. The surfaces
    of the result are later continued beneath the rims of holes. There they must meet the new
    Gaussians, which started at the first guess but may have moved away from the camera since.
    Inside the photo, the first guess is kept.

    Args:
        view: the view.
        mask: [h, w] bool: the n hole cells that are filled.
        depths: [n] z of the new Gaussians of these cells.
        is_kept: [n] bool, false for Gaussians that were removed.
    """
    hole_inverse_depth = view.initial.inverse_depth[mask]  # [n]
    follows = view.beyond_photo[mask] & is_kept
    inverse_depth = view.initial.inverse_depth.clone()
    inverse_depth[mask] = torch.where(follows, 1 / depths, hole_inverse_depth)
    return dataclasses.replace(view.initial, inverse_depth=inverse_depth)


def pixel_gaussians(
    initial: InitialGaussians, deltas: Tensor | None, camera: Camera, colors: Tensor
) -> Gaussians:
    """Gaussians [4n] for the single pixels of n cells of 2×2 pixels.

    Args:
        initial: the first guess for the n cells, flat fields [n, ...].
        deltas: [n, 14] the network's changes of the guess; None: no changes.
        camera: of the view.
        colors: [n, 2, 2, 3] sRGB of the pixels.
    """
    pixels_a_cell = len(PIXEL_OFFSETS)

    def repeat(field: Tensor) -> Tensor:
        """The values of each cell, once for each of its pixels."""
        return field.repeat_interleave(pixels_a_cell, 0)

    # The pixels lie on the cell's plane. Their inverse depth is at least half that of the cell's
    # centre, so that a steep plane does not carry them to infinity.
    cell_inverse_depth = repeat(initial.inverse_depth)
    offsets = to_like(PIXEL_OFFSETS, initial.uv)
    rise = (initial.slope[:, None] * offsets).sum(-1).flatten()
    inverse_depth = (cell_inverse_depth + rise).clamp_min(0.5 * cell_inverse_depth)
    pixels = InitialGaussians(
        uv=(initial.uv[:, None] + offsets).flatten(0, 1),
        inverse_depth=inverse_depth,
        slope=repeat(initial.slope),
        rgb=repeat(initial.rgb),
        unit=initial.unit,
    )
    pixel_deltas = None if deltas is None else repeat(deltas)
    # Guesses and changes together make Gaussians of half a pixel.
    composed = compose(pixels, pixel_deltas, camera, spread_px=PIXEL_SIGMA_PX)

    # The pixels' own colours replace those that the network predicts for the cell.
    linear_colors = srgb_to_linear(colors.flatten(0, 2).clamp(0, 1))
    return dataclasses.replace(composed, colors=linear_colors)
