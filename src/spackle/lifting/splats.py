"""Turn a photo with a depth at every pixel into Gaussians that blend to the photo.

Each pixel or tile has one Gaussian, pixels at silhouettes have a second one, and a backing lies
behind all of them. Gaussians of half a pixel reproduce the photo sharply, but light passes between
them; wide ones would blur the photo. The coarse backing therefore closes the surface from behind.
At the photo's camera this is 2 dB sharper than one layer of wider Gaussians.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from spackle.core.camera import Camera
from spackle.core.color import linear_to_srgb
from spackle.core.gaussians import Gaussians
from spackle.core.surfels import (
    DEPTH_EDGE_RATIO,
    PIXEL_SIGMA_PX,
    SURFEL_OPACITY,
    inverse_depth_slope,
    make_surfels,
)
from spackle.lifting.backing import backing_surfels
from spackle.lifting.edges import Floats
from spackle.lifting.quadtree import TILE_LEVELS, Quadtree, Tiles
from spackle.lifting.silhouettes import Layers, find_layers
from spackle.lifting.surfaces import (
    TILE_SIGMA_SIDES,
    PixelSurfaces,
    Surface,
    SurfelSamples,
    without_border,
)
from spackle.render.screen_blend import blend_screen_gaussians
from spackle.runtime.kernels import kernel

# Cost of one Gaussian for the quadtree, as a squared sRGB difference: this factor times the
# photo's typical detail, within these bounds.
COST_PER_DETAIL = 0.012
MIN_GAUSSIAN_COST, MAX_GAUSSIAN_COST = 1e-5, 2e-4
# A surface has a Gaussian in a pixel if it covers at least this share of the pixel.
MIN_COVERED_SHARE = 0.05
CORRECTION_SWEEPS = 3  # iterations that correct colours, and of those that correct opacities

# How much a pixel's Gaussian adds to the centres of the 3×3 pixels around, row by row: exp(-½ r²)
# at the squared distances of these pixels.
NEIGHBOR_FALLOFF = np.exp(-0.5 / PIXEL_SIGMA_PX**2 * np.array([2, 1, 2, 1, 0, 1, 2, 1, 2])).astype(
    np.float32
)


def layered_gaussians(
    inverse_depth: Tensor,
    colors: Tensor,
    camera: Camera,
    levels: int = TILE_LEVELS,
    *,
    unmix: bool = True,
) -> Gaussians:
    """Gaussians, about one and at most 2.25 per pixel, that blend to the photo at its camera.

    Args:
        inverse_depth: [H, W] 1/z, positive everywhere.
        colors: [H, W, 3] linear RGB.
        camera: the photo's camera.
        levels: number of tile sizes, from 2×2 pixels on. All pixels of a tile share one Gaussian;
            with 0, every pixel has its own.
        unmix: whether pixels beside a depth step may show two surfaces, whose colours are
            separated; else each shows one.

    Returns:
        In this order: single pixels, row by row, on the surface that covers most of the pixel;
        tiles of up to 8×8 pixels; the other surface of pixels that show two; the backing.
    """
    slope = inverse_depth_slope(inverse_depth)  # [H, W, 2]
    layers = find_layers(
        inverse_depth.contiguous().numpy(),
        slope.contiguous().numpy(),
        colors.contiguous().numpy(),
        unmix=unmix,
    )
    ring = torch.from_numpy(layers.ring)  # [H, W] distance to the nearest depth step, or 0

    # Pixels away from depth steps may share Gaussians where the photo has little detail. The
    # quadtree weighs the lost detail against the number of Gaussians.
    may_share = without_border(ring == 0)
    tree = Quadtree(
        linear_to_srgb(colors), inverse_depth, slope, may_share, levels, DEPTH_EDGE_RATIO
    )
    gaussian_cost = COST_PER_DETAIL * tree.detail()
    gaussian_cost = min(max(gaussian_cost, MIN_GAUSSIAN_COST), MAX_GAUSSIAN_COST)
    single, tiles = tree.cut(gaussian_cost)

    # A pixel beside a step may show two surfaces, and then has two Gaussians. The backing closes
    # the gaps between the Gaussians from behind.
    opaque = torch.full_like(inverse_depth, float(SURFEL_OPACITY))
    surface = Surface(inverse_depth, slope, colors, opaque)
    pixels = _split_mixed_pixels(layers, colors)
    samples = SurfelSamples.cat(
        [
            pixels.main.pixel_samples(single, camera),
            *(surface.tile_samples(of_one_size, TILE_SIGMA_SIDES) for of_one_size in tiles),
            pixels.other.pixel_samples(pixels.mixed, camera),
            *backing_surfels(pixels, gaussian_cost, levels),
        ]
    )

    # Pixels that touch a step (`ring` 1) or the border keep their colours. There, a correction
    # would make up for the light of Gaussians around, and be a visible ghost once the camera moves.
    correctable = without_border(ring != 1)[single]
    samples = _correct_colors(samples, colors, single, correctable, tiles)
    return make_surfels(camera, *samples)


def _split_mixed_pixels(layers: Layers, colors: Tensor) -> PixelSurfaces:
    """The surfaces of each pixel: two if both cover at least 5 % of it, else a single one.

    Args:
        layers: near and far surface (index 0 and 1) of the pixels beside a depth step, and the
            share of each pixel that the near one covers.
        colors: [H, W, 3] the photo in linear RGB.
    """
    ring = torch.from_numpy(layers.ring)
    alpha = torch.from_numpy(layers.alpha)
    near_is_main = alpha >= 0.5
    mixed = torch.minimum(alpha, 1 - alpha) >= MIN_COVERED_SHARE

    # The near Gaussian of a mixed pixel is partly transparent, so that the far one behind it shows
    # through. The far one is solid.
    near_share = torch.where(mixed, alpha, near_is_main.float())
    near_opacity = float(SURFEL_OPACITY) * blended_opacities(near_share.numpy(), layers.ring)
    far_opacity = torch.full_like(alpha, float(SURFEL_OPACITY))

    # A pixel with a single surface keeps the photo's colour.
    near_color = torch.from_numpy(layers.color[0])  # [H, W, 3]
    far_color = torch.from_numpy(layers.color[1])
    near = Surface(
        inverse_depth=torch.from_numpy(layers.depth[0]),
        slope=torch.from_numpy(layers.slope[0]),
        color=torch.where(mixed[..., None], near_color, colors),
        opacity=torch.from_numpy(near_opacity),
    )
    far = Surface(
        inverse_depth=torch.from_numpy(layers.depth[1]),
        slope=torch.from_numpy(layers.slope[1]),
        color=torch.where(mixed[..., None], far_color, colors),
        opacity=far_opacity,
    )
    return PixelSurfaces(
        main=far.replaced(near_is_main, near),
        other=near.replaced(near_is_main, far),
        mixed=mixed,
        near_is_main=near_is_main,
        beside_step=ring > 0,
    )


def _correct_colors(
    samples: SurfelSamples,
    colors: Tensor,
    single: Tensor,
    correctable: Tensor,
    tiles: Sequence[Tiles],
) -> SurfelSamples:
    """Correct the colours of single pixels and tiles until all samples blend to the photo.

    A sample describes one Gaussian by its position and size in the photo, its depth and its colour.
    A tile is a rectangle of pixels that share one sample.

    Args:
        samples: first those of single pixels, then those of tiles, then all others.
        colors: [H, W, 3] the photo in linear RGB.
        single: [H, W] bool: the single pixels.
        correctable: [number of single pixels] bool: those whose colour may change.
        tiles: in the order of their samples, those of one size together.
    """
    height, width = single.shape
    nearest_first = samples.inverse_depth.argsort(descending=True, stable=True)
    # [N, 5]
    screen_gaussians = torch.cat([samples.uv, samples.sigma, samples.opacity[:, None]], dim=-1)
    spots = screen_gaussians[nearest_first].numpy()
    corrected = samples.color.clone()
    # Each sweep adds what the blended picture lacks. Neighbours overlap, so that one is not enough.
    for _ in range(CORRECTION_SWEEPS):
        blended = blend_screen_gaussians(spots, corrected[nearest_first], height, width)
        missing = colors - blended
        missing_in_pixels = missing[single] * correctable[:, None]
        missing_in_tiles = [tiles_of_one_size.means(missing) for tiles_of_one_size in tiles]
        change = torch.cat([missing_in_pixels, *missing_in_tiles])
        corrected[: len(change)] = (corrected[: len(change)] + change).clamp(0, 1)
    return samples._replace(color=corrected)


def blended_opacities(alpha: Floats, ring: NDArray[np.uint8]) -> Floats:
    """Opacities with which near Gaussians and their neighbours together cover given shares.

    Args:
        alpha: [H, W] the share of each pixel that the near surface covers.
        ring: [H, W] distance to the nearest depth step; pixels with 0 keep their share as opacity.

    Returns:
        [H, W] in 0..1: each Gaussian's opacity, divided by the opacity of a solid Gaussian.
    """
    # The opacity of a pixel depends on those of its neighbours, and theirs on it. So they are
    # computed several times in turn.
    opacities = alpha.copy()
    for _ in range(CORRECTION_SWEEPS):
        _subtract_neighbors(alpha, ring, opacities)
    return opacities


@kernel
def _subtract_neighbors(alpha: Any, ring: Any, opacities: Any) -> None:
    """Lower each opacity so that the pixel, with its neighbours' light, is covered as it should be.

    With T the transmittance of the eight neighbours' Gaussians at the pixel's centre, the opacity o
    that covers the share alpha follows from (1 - o)·T = 1 - alpha.

    Args:
        alpha: [H, W] float32: the share to cover; pixels with 0 or 1 keep their opacity.
        ring: [H, W] uint8: distance to the nearest depth step; pixels with 0 are left out.
        opacities: [H, W] float32, changed in place.
    """
    height, width = alpha.shape
    for y in range(height):
        for x in range(width):
            if ring[y, x] == 0 or alpha[y, x] <= 0 or alpha[y, x] >= 1:
                continue
            transmittance = np.float32(1)
            for k in range(9):  # the 3×3 pixels around, row by row; the border repeats
                v = min(max(y + k // 3 - 1, 0), height - 1)
                u = min(max(x + k % 3 - 1, 0), width - 1)
                if k != 4 and ring[v, u] > 0:  # 4 is the pixel itself
                    # The alpha of this neighbour's Gaussian at the pixel's centre is subtracted.
                    transmittance *= 1 - SURFEL_OPACITY * NEIGHBOR_FALLOFF[k] * opacities[v, u]
            opacity = 1 - (1 - alpha[y, x]) / transmittance
            opacities[y, x] = min(max(opacity, np.float32(0)), np.float32(1))
