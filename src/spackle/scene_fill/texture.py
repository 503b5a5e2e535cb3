"""Colours of filled holes: smooth colours from the network, and texture (fine detail) from patches
or an inpainter.

A network that learns from true views predicts smooth colours if the truth is ambiguous, so texture
is added afterwards.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

from spackle.core.filters import (
    approximate_gaussian_blur,
    distance_to_nearest,
    gaussian_blur,
    nearest_known_pixels,
)
from spackle.core.hole_filling import FAR_SIDE_BIAS, fill_from_far_side
from spackle.core.patch_matching import MIN_MEAN_COST, TONE_BLUR_CELLS, Patches
from spackle.core.patch_search import MIN_VOTE_WEIGHT
from spackle.inpaint import Inpainter, known_inverse_depth
from spackle.residual.features import CELL, MIN_DIVISOR, TINY, hole_mask
from spackle.scene_fill.view_completion import SceneViewCompletion

# Standard deviation of the blur that separates structure (low frequencies) from texture.
TEXTURE_SIGMA_PX = 2.0
FADED_MISMATCH = 0.16  # of a patch, in sRGB, at which its texture has faded to 1/e
# Just beyond the photo's border, the rim's colour continues: it fades to 1/e at this distance, and
# at this relative difference in depth.
BORDER_FADE_CELLS = 4.0
BORDER_FADE_DEPTH_RATIO = 0.05
# Standard deviation of the blur that overlapping Gaussians and votes of patches cause.
OVERLAP_SIGMA_PX = 0.8
SHARPENING_STEPS = 2
MIN_COVERAGE = 1e-6  # least weight of the cells that contribute to an interpolated pixel

# Computes the colours of a view's holes. Takes the view, and the smooth colours [h, w, 3] of all
# its cells (2×2 pixels) that initial Gaussians and network give; returns [2h, 2w, 3] sRGB of all
# pixels, of which those in holes are used.
Texture = Callable[[SceneViewCompletion, Tensor], Tensor]


def exemplar_texture(view: SceneViewCompletion, structure: Tensor) -> Tensor:
    """[2h, 2w, 3] sRGB: the smooth colours `structure` plus texture copied from elsewhere in the
    view.

    Args:
        view: a view with holes, and patches that match them.
        structure: [h, w, 3] sRGB of all cells of 2×2 pixels; in holes, the colours of the predicted
            Gaussians.
    """
    patches = view.patches
    rendered = group_by_cell(view.rendering.rgb)  # [h, w, 2, 2, 3]

    # Only the high frequencies of the patches are used; the low ones are the structure's.
    copied = ungroup_cells(copy_patch_blocks(patches, rendered))
    texture = copied - gaussian_blur(copied, TEXTURE_SIGMA_PX)

    # Texture of a patch that matches badly, or stronger than the texture around the hole, would be
    # conspicuous. Both are weakened.
    match_quality = (-patches.mismatch / FADED_MISMATCH).exp()  # 1 for a perfect match
    gain = match_quality * _gain_to_surroundings(texture, view)  # [h, w]
    # The four pixels of a cell share its gain.
    pixel_gain = ungroup_cells(gain[..., None, None, None].expand(*gain.shape, CELL, CELL, 1))

    # The picture without texture: smooth colours in the hole; elsewhere what was rendered.
    structure_to_border = continue_border(view, structure)
    smooth = group_by_cell(_interpolate_cells(structure_to_border, view.mask))
    in_hole = view.mask[..., None, None, None]
    picture = ungroup_cells(torch.where(in_hole, smooth, rendered))
    return texture.mul_(pixel_gain).add_(picture)


def painted_texture(painter: Inpainter, view: SceneViewCompletion, structure: Tensor) -> Tensor:
    """[2h, 2w, 3] sRGB: the view with its holes painted by an inpainter.

    Args:
        painter: takes a batch of views, here of one.
        view: a view with holes.
        structure: smooth colours of the holes; not used, because the painter makes its own.
    """
    rendering = view.rendering
    hole = hole_mask(rendering.alpha, view.threshold)
    inverse_depth = known_inverse_depth(rendering.depth, hole)
    painted = painter.paint(rendering.rgb[None], hole[None], inverse_depth[None])
    return pad_to_even(painted[0].to(rendering.rgb.device))


def copy_patch_blocks(patches: Patches, blocks: Tensor) -> Tensor:
    """Blocks [h, w, k, k, c] of an image's cells, with those of hole cells copied from elsewhere in
    the image.

    The matching patches of a cell and of its eight neighbours each propose a block. The copied
    block is the weighted mean of these blocks; better matches weigh more.

    Args:
        patches: for each hole cell, where the centre of its best patch lies in the image, and how
            badly the patch matches.
        blocks: [h, w, k, k, c] the k×k pixels of each cell.
    """
    height, width = patches.mismatch.shape
    # Patches come from the image, or from the image mirrored left to right.
    sources = torch.stack([blocks, blocks.flip(1, 3)])  # [2, h, w, k, k, c]

    # `matches` holds source, row and column of each cell's patch; -1 if the cell has no patch.
    is_matched = patches.matches[..., 0] >= 0
    y, x = is_matched.nonzero(as_tuple=True)  # of n cells
    costs = patches.mismatch.square()
    mean_cost = costs[is_matched].mean().clamp_min(MIN_MEAN_COST)

    weighted_sum = torch.zeros_like(blocks[y, x])  # [n, k, k, c]
    total_weight = torch.zeros_like(costs[y, x])  # [n]
    for dy, dx in itertools.product((-1, 0, 1), repeat=2):
        # A neighbour outside of the image, or without a patch, has the weight 0.
        row = (y + dy).clamp(0, height - 1)
        column = (x + dx).clamp(0, width - 1)
        is_inside = (row == y + dy) & (column == x + dx)
        has_patch = is_inside & is_matched[row, column]
        # Otherwise its weight falls with the cost of its patch, but never to 0.
        weight = (-costs[row, column] / mean_cost).exp() + MIN_VOTE_WEIGHT
        weight = torch.where(has_patch, weight, 0)

        # The neighbour lies at (dy, dx) from the cell. So in the neighbour's patch, the block for
        # the cell itself lies at (-dy, -dx) from the patch's centre.
        source, source_row, source_column = patches.matches[row, column].long().unbind(-1)
        block = sources[
            source.clamp_min(0),
            (source_row - dy).clamp(0, height - 1),
            (source_column - dx).clamp(0, width - 1),
        ]
        weighted_sum += weight[:, None, None, None] * block
        total_weight += weight

    filled = blocks.clone()
    filled[y, x] = weighted_sum / total_weight[:, None, None, None]
    return filled


def _gain_to_surroundings(texture: Tensor, view: SceneViewCompletion) -> Tensor:
    """Factors [h, w] ≤ 1 that make a hole's texture no stronger than the texture around the hole.

    The strength of a texture is the root of its energy, the local mean of the squared high
    frequencies.

    Args:
        texture: [2h, 2w, 3] the high frequencies of the view, filled in holes.
        view: the view, whose cells are 2×2 pixels.
    """
    energy = avg_pool2d(texture.square().sum(-1)[None], CELL)[0]  # [h, w]
    hole = view.mask.float()

    # Local means of the energy over hole cells, and over visible cells.
    sums = torch.stack([energy * hole, hole, energy * (1 - hole), 1 - hole], dim=-1)
    sums = approximate_gaussian_blur(sums, TONE_BLUR_CELLS).clamp_min(MIN_DIVISOR)
    hole_energy, hole_weight, visible_energy, visible_weight = sums.unbind(-1)
    log_energy_around = (visible_energy / visible_weight).log()

    # The energy around the hole is continued into it, from the far side of its rim, because the
    # surface there fills the hole. Beyond the photo's border the bias is 0: all sides count
    # alike.
    known = ~view.mask
    if bool(known.any()):
        far_bias = FAR_SIDE_BIAS * ~view.beyond_photo
        _, filled = fill_from_far_side(
            view.initial.inverse_depth, log_energy_around[None], known, far_bias=far_bias
        )
        log_energy_around = filled[0]
    ratio = log_energy_around.exp() / (hole_energy / hole_weight)
    return ratio.sqrt().clamp_max(1)


def _interpolate_cells(colors: Tensor, mask: Tensor) -> Tensor:
    """Colours [2h, 2w, 3] of pixels, interpolated between cells of 2×2 pixels.

    Args:
        colors: [h, w, 3] of the cells.
        mask: [h, w] bool: the cells between which is interpolated; others are left out.
    """
    weight = mask[..., None]
    weighted = torch.cat([colors * weight, weight], dim=-1).permute(2, 0, 1)  # [4, h, w]
    pixels = interpolate(weighted[None], scale_factor=CELL, mode="bilinear")[0].permute(1, 2, 0)

    # Cells outside of the mask have the weight 0, so they do not bleed in.
    return pixels[..., :3] / pixels[..., 3:].clamp_min(MIN_COVERAGE)


def continue_border(view: SceneViewCompletion, structure: Tensor) -> Tensor:
    """Smooth colours [h, w, 3] of all cells, in which the photo's border is no visible edge.

    Just beyond the photo's border, a cell gets the colour of the nearest visible cell. The farther
    away that cell is, or the more its depth differs, the more the cell keeps its own colour.
    Holes behind an object keep their own colours, because their nearest visible cell may belong to
    the object.

    Args:
        view: a view with holes, in cells of 2×2 pixels. Its `initial` has the first guess of each
            hole cell's depth, its `features` what is visible; `beyond_photo` [h, w] bool are the
            hole cells that the photo does not show.
        structure: [h, w, 3] sRGB, the smooth colours of all cells.
    """
    features = view.features
    # Row and column of the nearest visible cell; negative if nothing is visible.
    nearest = nearest_known_pixels(view.mask)  # [2, h, w]
    row, column = nearest.long().clamp_min(0)
    nearest_inverse_depth = features.inverse_depth[row, column].clamp_min(TINY)
    log_depth_ratio = (view.initial.inverse_depth / nearest_inverse_depth).log()

    # The first cell beyond the border, at the distance 1, has the full colour.
    fade = torch.exp(
        (1 - distance_to_nearest(nearest)) / BORDER_FADE_CELLS
        - (log_depth_ratio / BORDER_FADE_DEPTH_RATIO).square()
    )
    return torch.lerp(structure, features.rgb[row, column], (fade * view.beyond_photo)[..., None])


def sharpen_for_overlap(target: Tensor) -> Tensor:
    """Colours [H, W, c] that Gaussians need to show the colours `target` [H, W, c] although they
    overlap.

    Overlapping Gaussians show blur(colours). So the colours with blur(colours) = target are found,
    approximately, by a few Jacobi steps.
    """
    colors = target
    for _ in range(SHARPENING_STEPS):
        colors = colors + target - gaussian_blur(colors, OVERLAP_SIGMA_PX)
    return colors


# Pixels and cells ---------------------------------------------------------------------------------


def pad_to_even(picture: Tensor) -> Tensor:
    """A picture [H, W, c] with even sides: an odd last row or column is repeated."""
    for axis in (0, 1):
        if picture.shape[axis] % CELL:
            last = picture.narrow(axis, -1, 1)
            picture = torch.cat([picture, last], dim=axis)
    return picture


def group_by_cell(picture: Tensor) -> Tensor:
    """Group an image's pixels [H, W, c] by cell: [h, w, 2, 2, c]; an odd last row or column is
    repeated.
    """
    picture = pad_to_even(picture)
    rows = picture.shape[0] // CELL
    columns = picture.shape[1] // CELL
    return picture.reshape(rows, CELL, columns, CELL, -1).transpose(1, 2)


def ungroup_cells(blocks: Tensor) -> Tensor:
    """The image [2h, 2w, c] of pixels grouped by cell, [h, w, 2, 2, c]."""
    return blocks.transpose(1, 2).flatten(2, 3).flatten(0, 1)
