"""Turn a photo with a depth at every pixel into Gaussians that blend to the photo.

Each pixel or tile has one Gaussian, pixels at silhouettes have a second one, and a backing lies behind all of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from spackle.core.camera import Camera
from spackle.core.color import linear_to_srgb
from spackle.core.gaussians import Gaussians
from spackle.core.surfels import (
    BEHIND_SURFACE_RATIO,
    CREASE_RATIO,
    DEPTH_EDGE_RATIO,
    PIXEL_SIGMA_PX,
    SURFEL_OPACITY,
    inverse_depth_slope,
    make_surfels,
)
from spackle.lifting.edges import Floats
from spackle.lifting.quadtree import LEVELS, Quadtree, Tiles
from spackle.lifting.silhouettes import Layers, find_layers
from spackle.render.screen_blend import blend_screen_gaussians
from spackle.runtime.kernels import kernel

# Gaussians of half a pixel reproduce the photo sharply, but light passes between them; wide ones would blur the photo.
# A coarse backing, one Gaussian for 2×2 pixels or more, therefore closes the surface from behind. At the photo's
# camera this is 2 dB sharper than one layer of wider Gaussians.
TILE_SPREAD = 0.55  # standard deviation of a tile's Gaussian and of a 2×2 backing Gaussian, in units of their sides
LARGE_BACKING_SPREAD = (
    0.65  # the same for larger backing Gaussians, which lie away from depth steps
)
RIM_BACKING_SPREAD = 0.42  # the same for the backing at a near surface's rim: a wider backing would show past the rim
BACKING_SIDES = (
    2  # the backing recedes by the depth change over this number of its sides, to stay hidden
)
WORTH = 0.012  # squared sRGB difference that justifies one Gaussian, in units of the photo's detail
LEAST_WORTH, MOST_WORTH = 1e-5, 2e-4
BACKING_SHARE = 0.02  # share of the backing's colour that is visible through the front
LEAST_MIXED = (
    0.05  # a surface has a Gaussian in a pixel if it covers at least this share of the pixel
)
SWEEPS = 3  # number of iterations that correct colours, and of those that correct opacities


def layered_gaussians(
    inverse_depth: Tensor, colors: Tensor, camera: Camera, levels: int = LEVELS
) -> Gaussians:
    """Gaussians, about one and at most 2.25 per pixel, that blend to the photo at the photo's camera.

    `inverse_depth` [H, W] is positive everywhere, `colors` [H, W, 3] are linear RGB, and `levels` is the number of tile
    sizes. The Gaussians come in this order: single pixels, row by row, on the surface that covers most of the pixel;
    tiles of up to 8×8 pixels; the other surface of mixed pixels; the backing.
    """
    slope = inverse_depth_slope(inverse_depth)
    layers = find_layers(*(image.contiguous().numpy() for image in (inverse_depth, slope, colors)))
    ring = torch.from_numpy(layers.ring)
    tree = Quadtree(
        linear_to_srgb(colors), inverse_depth, slope, _inner(ring == 0), levels, DEPTH_EDGE_RATIO
    )
    worth = min(max(WORTH * tree.detail(), LEAST_WORTH), MOST_WORTH)
    single, tiles = tree.cut(worth)
    surface = _Surface(
        inverse_depth, slope, colors, torch.full_like(inverse_depth, float(SURFEL_OPACITY))
    )
    front = [surface.samples(part, TILE_SPREAD) for part in tiles]
    pixels = _split(layers, colors)
    rest = pixels.rest.pixels(pixels.mixed, camera)
    parts = [pixels.most.pixels(single, camera), *front, rest, *_backing(pixels, worth, levels)]
    samples = _Samples(*(torch.cat(tensors) for tensors in zip(*parts, strict=True)))
    corrected = _inner(ring != 1)[
        single
    ]  # corrected colours beside a step or at the border would be visible ghosts
    return make_surfels(camera, *_fitted(samples, colors, single, corrected, tiles))


class _Samples(NamedTuple):
    """N Gaussians, in the order of `make_surfels`."""

    uv: Tensor  # [N, 2] pixels
    depth: Tensor  # [N] inverse
    slope: Tensor  # [N, 2]
    spread: Tensor  # [N, 2] pixels
    color: Tensor  # [N, 3] linear RGB
    opacity: Tensor  # [N]


def _fitted(
    samples: _Samples, colors: Tensor, single: Tensor, corrected: Tensor, tiles: Sequence[Tiles]
) -> _Samples:
    """Correct the colours of tiles and single pixels until all samples blend to `colors` at the photo's camera.

    `corrected` [number of single pixels] bool chooses the single pixels.
    """
    fitted = samples.color.clone()
    order = samples.depth.argsort(descending=True, stable=True)
    spots = torch.cat([samples.uv, samples.spread, samples.opacity[:, None]], dim=-1)[order].numpy()
    for _ in range(SWEEPS):
        missing = colors - blend_screen_gaussians(spots, fitted[order], *single.shape)
        pixels = missing[single] * corrected[:, None]
        change = torch.cat([pixels, *(part.means(missing) for part in tiles)])
        fitted[: len(change)] = (fitted[: len(change)] + change).clamp(0, 1)
    return samples._replace(color=fitted)


class _Surface(NamedTuple):
    depth: Tensor  # [H, W] inverse
    slope: Tensor  # [H, W, 2]
    color: Tensor  # [H, W, 3] linear RGB
    opacity: Tensor  # [H, W]

    def instead(self, where: Tensor, other: _Surface) -> _Surface:
        """This surface, replaced by `other` at the pixels `where` [H, W] bool."""
        images = zip(other, self, strict=True)
        return _Surface(
            *(torch.where(where if a.ndim == 2 else where[..., None], a, b) for a, b in images)
        )

    def pixels(self, where: Tensor, camera: Camera) -> _Samples:
        """A Gaussian for each of the pixels `where` [H, W] bool, in row-major order."""
        uv = camera.pixel_centers()[where]
        depth, slope, color, opacity = (image[where] for image in self)
        return _Samples(uv, depth, slope, torch.full_like(uv, PIXEL_SIGMA_PX), color, opacity)

    def samples(self, tiles: Tiles, spread: float, pixels: int = 1) -> _Samples:
        """An opaque Gaussian for each tile; its standard deviations are `spread` times the tile's sides.

        The unit of tiles is a cell of the surface, which is `pixels` pixels wide.
        """
        depth, slope, color = (tiles.means(image) for image in (self.depth, self.slope, self.color))
        opacity = torch.full_like(depth, float(SURFEL_OPACITY))
        sides = torch.tensor([tiles.width, tiles.height]) * (spread * pixels)
        return _Samples(
            tiles.centers() * pixels, depth, slope, sides.expand(len(depth), 2), color, opacity
        )


class _Pixels(NamedTuple):
    most: _Surface  # the surface that covers most of a pixel
    rest: _Surface  # the other surface; valid if `mixed`
    mixed: Tensor  # [H, W] bool
    near: Tensor  # [H, W] bool: `most` is the near surface
    edge: Tensor  # [H, W] bool: a depth step is close


def _split(layers: Layers, colors: Tensor) -> _Pixels:
    """The surfaces of each pixel: two if both cover at least `LEAST_MIXED` of it (mixed), else a single one."""
    ring, alpha = torch.from_numpy(layers.ring), torch.from_numpy(layers.alpha)
    near = alpha >= 0.5
    mixed = torch.minimum(alpha, 1 - alpha) >= LEAST_MIXED
    opacity = float(SURFEL_OPACITY) * blended_opacities(
        torch.where(mixed, alpha, near.float()).numpy(), layers.ring
    )
    surfaces = []
    for side, opaque in enumerate(
        (torch.from_numpy(opacity), torch.full_like(alpha, float(SURFEL_OPACITY)))
    ):
        depth, slope, own = (
            torch.from_numpy(a[side]) for a in (layers.depth, layers.slope, layers.color)
        )
        surfaces.append(_Surface(depth, slope, torch.where(mixed[..., None], own, colors), opaque))
    most, rest = surfaces[1].instead(near, surfaces[0]), surfaces[0].instead(near, surfaces[1])
    return _Pixels(most, rest, mixed, near, ring > 0)


def _backing(pixels: _Pixels, worth: float, levels: int) -> list[_Samples]:
    """A wide Gaussian behind each cell of 2×2 pixels, on its farthest pixel's surface; larger ones in flat areas.

    A cell has no backing if it holds pixels of both surfaces, or if its far surface is visible only in mixed pixels.
    """
    behind = pixels.mixed & pixels.near
    deepest = pixels.most.instead(behind, pixels.rest)
    cells = _cells(deepest.depth)
    if not cells.numel():  # one pixel high or wide
        return []
    far, pick = cells.min(dim=-1)
    slope = (
        _cells(deepest.slope).gather(2, pick[..., None, None].expand(*pick.shape, 1, 2)).squeeze(2)
    )
    # The cell's centre lies half a pixel from the farthest pixel's centre.
    offset = torch.stack([0.5 - pick % 2, 0.5 - pick // 2], dim=-1)
    at_center = (far + (slope * offset).sum(-1)).clamp_min(0.5 * far.min())
    # The colour is the mean of the cell's pixels on the same surface.
    same = (cells - far[..., None] < 0.02 * far[..., None]).to(far)
    color = (_cells(deepest.color) * same[..., None]).sum(2) / same.sum(2)[..., None]
    has_near, has_far = (_cells(pixels.edge & side).any(-1) for side in (pixels.near, ~pixels.near))
    wanted = torch.where(has_far, ~has_near, ~_cells(behind).any(-1))
    flat = _inner(wanted & ~_cells(pixels.edge).any(-1))
    tree = Quadtree(linear_to_srgb(color), at_center, 2 * slope, flat, levels, CREASE_RATIO)
    single, tiles = tree.cut(worth / BACKING_SHARE)
    surface = _Surface(at_center, slope, color, torch.full_like(far, float(SURFEL_OPACITY)))
    parts = [(part, LARGE_BACKING_SPREAD) for part in tiles]
    for where, spread in ((~has_near, TILE_SPREAD), (has_near, RIM_BACKING_SPREAD)):
        parts.append((Tiles(1, 1, *(single & wanted & where).nonzero(as_tuple=True)), spread))
    return [_receded(surface.samples(part, spread, pixels=2), part) for part, spread in parts]


def _receded(samples: _Samples, tiles: Tiles) -> _Samples:
    """Move the backing behind the front Gaussians; the unit of `tiles` is a cell of 2×2 pixels."""
    reach = 2 * BACKING_SIDES * torch.tensor([tiles.width, tiles.height])
    recede = 1 - BEHIND_SURFACE_RATIO - (reach * samples.slope.abs()).sum(-1) / samples.depth
    return samples._replace(depth=samples.depth * recede, slope=samples.slope * recede[:, None])


def _inner(free: Tensor) -> Tensor:
    """The mask [H, W], false on the image's border, because a tile's Gaussian would reach beyond the image."""
    inner = torch.zeros_like(free)
    inner[1:-1, 1:-1] = free[1:-1, 1:-1]
    return inner


def _cells(image: Tensor) -> Tensor:
    """[H, W, ...] to [H/2, W/2, 4, ...]: the pixels of each 2×2 cell in row-major order."""
    height, width = (n // 2 for n in image.shape[:2])
    grid = image[: 2 * height, : 2 * width].reshape(height, 2, width, 2, *image.shape[2:])
    return grid.transpose(1, 2).flatten(2, 3)


WEIGHTS = np.exp(-0.5 / PIXEL_SIGMA_PX**2 * np.array([2, 1, 2, 1, 0, 1, 2, 1, 2])).astype(
    np.float32
)  # 3×3 neighbours


def blended_opacities(alpha: Floats, ring: NDArray[np.uint8]) -> Floats:
    """Opacities [H, W] with which Gaussians and their neighbours together cover the share alpha [H, W] of pixels."""
    result = alpha.copy()
    for _ in range(SWEEPS):
        _thin(alpha, ring, result)
    return result


@kernel
def _thin(alpha: Any, ring: Any, result: Any) -> None:
    height, width = alpha.shape
    for y in range(height):
        for x in range(width):
            if ring[y, x] == 0 or alpha[y, x] <= 0 or alpha[y, x] >= 1:
                continue
            passes = np.float32(1)
            for k in range(9):
                v, u = (
                    min(max(y + k // 3 - 1, 0), height - 1),
                    min(max(x + k % 3 - 1, 0), width - 1),
                )
                if k != 4 and ring[v, u] > 0:
                    passes *= 1 - SURFEL_OPACITY * WEIGHTS[k] * result[v, u]
            result[y, x] = min(max(1 - (1 - alpha[y, x]) / passes, np.float32(0)), np.float32(1))
