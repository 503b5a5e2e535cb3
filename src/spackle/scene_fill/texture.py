"""Colours of filled holes: low frequencies from the residual, high frequencies (texture) from
patches or an inpainter.

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
from spackle.core.patch_matching import MIN_MEAN_COST, MIN_VOTE_WEIGHT, TONE_BLUR_CELLS, Patches
from spackle.inpaint import Inpainter, known_inverse_depth
from spackle.residual.features import CELL, MIN_DIVISOR, hole_mask
from spackle.scene_fill.view_completion import SceneViewCompletion

TEXTURE_PX = (
    2.0  # standard deviation of the blur that separates structure (low frequencies) from texture
)
TEXTURE_FADING = 0.16  # mismatch at which the texture has faded to 1/e
EXTENDED_CELLS, SAME_DEPTH = (
    4.0,
    0.05,
)  # reach of the rim's colours beyond the photo's border; relative depth
OVERLAP_PX = (
    0.8  # standard deviation of the blur that overlapping Gaussians and votes of patches cause
)
STEPS = 2  # Jacobi steps of `sharpened`


# Computes the colours of a view's holes. Takes the view, and the smooth colours [h, w, 3] of all
# its cells (2×2 pixels) that initial Gaussians and network give; returns [2h, 2w, 3] sRGB of all
# pixels, of which those in holes are used.
Texture = Callable[[SceneViewCompletion, Tensor], Tensor]


def exemplar_texture(view: SceneViewCompletion, structure: Tensor) -> Tensor:
    """Colours [2h, 2w, 3] sRGB: the residual's structure plus texture copied from elsewhere in the
    view.
    """
    features, patches = view.features, view.patches
    pixels = group_by_cell(view.rendering.rgb)
    painted = ungroup_cells(patch_blocks(patches, pixels))
    fine = painted - gaussian_blur(painted, TEXTURE_PX)
    gain = (-patches.mismatch / TEXTURE_FADING).exp() * _in_proportion(fine, view)
    smooth = group_by_cell(_magnified(extended(view, structure), features.mask))
    picture = ungroup_cells(torch.where(features.mask[..., None, None, None], smooth, pixels))
    return fine.mul_(
        ungroup_cells(gain[..., None, None, None].expand(*gain.shape, CELL, CELL, 1))
    ).add_(picture)


def painted_texture(painter: Inpainter, view: SceneViewCompletion, structure: Tensor) -> Tensor:
    """Colours [2h, 2w, 3] sRGB of the view with its holes painted by an inpainter, without the
    residual's structure.
    """
    hole = hole_mask(view.rendering.alpha, view.threshold)
    views = (
        view.rendering.rgb[None],
        hole[None],
        known_inverse_depth(view.rendering.depth, hole)[None],
    )
    return ungroup_cells(group_by_cell(painter.paint(*views)[0]))


def patch_blocks(patches: Patches, blocks: Tensor) -> Tensor:
    """Fill the blocks [H, W, k, k, c] of an image's masked cells with blocks from elsewhere in the
    image.

    The matches of a cell and of its eight neighbours each propose a block. The filled block is the
    weighted mean of these blocks; better matches weigh more. `Patches.rgb`, a vote of whole
    patches, loses fine detail.
    """
    height, width = patches.mismatch.shape
    sources = torch.stack([blocks, blocks.flip(1, 3)])
    matched = patches.matches[..., 0] >= 0
    y, x = matched.nonzero(as_tuple=True)
    costs = patches.mismatch.square()
    limit = costs[matched].mean().clamp_min(MIN_MEAN_COST)
    total, mass = torch.zeros_like(blocks[y, x]), torch.zeros_like(costs[y, x])
    for dy, dx in itertools.product((-1, 0, 1), repeat=2):
        v, u = (y + dy).clamp(0, height - 1), (x + dx).clamp(0, width - 1)
        source, row, column = patches.matches[v, u].long().unbind(-1)
        votes = (
            (v == y + dy) & (u == x + dx) & matched[v, u]
        )  # a matched cell's patch lies within its source
        weight = votes * ((-costs[v, u] / limit).exp() + MIN_VOTE_WEIGHT)
        block = sources[
            source.clamp_min(0), (row - dy).clamp(0, height - 1), (column - dx).clamp(0, width - 1)
        ]
        total += weight[:, None, None, None] * block
        mass += weight
    filled = blocks.clone()
    filled[y, x] = total / mass[:, None, None, None]
    return filled


def _in_proportion(fine: Tensor, view: SceneViewCompletion) -> Tensor:
    """Factors [h, w] ≤ 1 that make the texture `fine` [2h, 2w, 3] no stronger than the texture
    around a hole.
    """
    energy, hole = avg_pool2d(fine.square().sum(-1)[None], CELL)[0], view.features.mask.float()
    parts = torch.stack([energy * hole, hole, energy * (1 - hole), 1 - hole], dim=-1)
    own, masked, others, seen = (
        approximate_gaussian_blur(parts, TONE_BLUR_CELLS).clamp_min(MIN_DIVISOR).unbind(-1)
    )
    around, known = (others / seen).log(), ~view.features.mask
    if bool(known.any()):
        bias = FAR_SIDE_BIAS * ~view.beyond_photo
        around = fill_from_far_side(view.initial.inverse_depth, around[None], known, far_bias=bias)[
            1
        ][0]
    return (around.exp() / (own / masked)).sqrt().clamp_max(1)


def _magnified(cells: Tensor, mask: Tensor) -> Tensor:
    """Interpolate colours [h, w, 3] to pixels [2h, 2w, 3]; only cells in `mask` ([h, w] bool)
    contribute.
    """
    both = torch.cat([cells * mask[..., None], mask[..., None]], dim=-1).permute(2, 0, 1)
    pixels = interpolate(both[None], scale_factor=CELL, mode="bilinear")[0].permute(1, 2, 0)
    return pixels[..., :3] / pixels[..., 3:].clamp_min(1e-6)


def extended(view: SceneViewCompletion, structure: Tensor) -> Tensor:
    """Structure [h, w, 3]; just beyond the photo's border it has the colour of the nearest visible
    cell.

    The colour fades to `structure` with the distance to that cell, and with the difference in
    depth. Holes behind an object keep `structure`, because their nearest visible cell may belong to
    the object.
    """
    features = view.features
    near = nearest_known_pixels(features.mask.numpy())
    row, column = torch.from_numpy(near).long().clamp_min(0)
    apart = (view.initial.inverse_depth / features.inverse_depth[row, column].clamp_min(1e-9)).log()
    fading = torch.exp(
        (1 - distance_to_nearest(near)) / EXTENDED_CELLS - (apart / SAME_DEPTH).square()
    )
    return torch.lerp(structure, features.rgb[row, column], (fading * view.beyond_photo)[..., None])


def sharpened(wanted: Tensor) -> Tensor:
    """Colours [H, W, c] that Gaussians need to show the `wanted` colours although they overlap; by
    Jacobi steps.
    """
    colors = wanted
    for _ in range(STEPS):
        colors = colors + wanted - gaussian_blur(colors, OVERLAP_PX)
    return colors


def group_by_cell(picture: Tensor) -> Tensor:
    """Group an image's pixels [H, W, c] by cell: [h, w, 2, 2, c]; an odd last row or column is
    repeated.
    """
    for dim in (0, 1):
        if picture.shape[dim] % CELL:
            picture = torch.cat([picture, picture.narrow(dim, -1, 1)], dim=dim)
    rows, columns = (size // CELL for size in picture.shape[:2])
    return picture.reshape(rows, CELL, columns, CELL, -1).transpose(1, 2)


def ungroup_cells(blocks: Tensor) -> Tensor:
    """The image [2h, 2w, c] of pixels grouped by cell, [h, w, 2, 2, c]."""
    return blocks.transpose(1, 2).flatten(2, 3).flatten(0, 1)
