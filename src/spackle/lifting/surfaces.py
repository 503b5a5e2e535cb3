"""Surfaces on the photo's grid, and the flat Gaussians ("surfels") that are taken from them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from spackle.core.camera import Camera
from spackle.core.surfels import PIXEL_SIGMA_PX, SURFEL_OPACITY
from spackle.lifting.quadtree import Tiles

# Standard deviation of a tile's Gaussian and of a 2×2 backing Gaussian, in units of their sides.
TILE_SIGMA_SIDES = 0.55


class SurfelSamples(NamedTuple):
    """N flat Gaussians in the photo, with the arguments of `make_surfels` in its order."""

    uv: Tensor  # [N, 2] pixels
    inverse_depth: Tensor  # [N]
    slope: Tensor  # [N, 2] derivative of the inverse depth by pixel x and y
    sigma: Tensor  # [N, 2] standard deviations in pixels
    color: Tensor  # [N, 3] linear RGB
    opacity: Tensor  # [N]

    @staticmethod
    def cat(parts: Sequence[SurfelSamples]) -> SurfelSamples:
        """All samples of several parts, one part after the other."""
        return SurfelSamples(*(torch.cat(tensors) for tensors in zip(*parts, strict=True)))


class Surface(NamedTuple):
    """A surface with a depth and a colour at every pixel."""

    inverse_depth: Tensor  # [H, W]
    slope: Tensor  # [H, W, 2] derivative of the inverse depth by pixel x and y
    color: Tensor  # [H, W, 3] linear RGB
    opacity: Tensor  # [H, W] of a pixel's Gaussian

    def replaced(self, where: Tensor, other: Surface) -> Surface:
        """This surface, replaced by `other` at the pixels `where` [H, W] bool."""
        where_channels = where[..., None]  # [H, W, 1]
        return Surface(
            inverse_depth=torch.where(where, other.inverse_depth, self.inverse_depth),
            slope=torch.where(where_channels, other.slope, self.slope),
            color=torch.where(where_channels, other.color, self.color),
            opacity=torch.where(where, other.opacity, self.opacity),
        )

    def pixel_samples(self, where: Tensor, camera: Camera) -> SurfelSamples:
        """A Gaussian for each of the pixels `where` [H, W] bool, in row-major order."""
        uv = camera.pixel_centers()[where]  # [N, 2]
        sigma = torch.full_like(uv, PIXEL_SIGMA_PX)
        return SurfelSamples(
            uv=uv,
            inverse_depth=self.inverse_depth[where],
            slope=self.slope[where],
            sigma=sigma,
            color=self.color[where],
            opacity=self.opacity[where],
        )

    def tile_samples(self, tiles: Tiles, sigma_sides: float, cell_px: int = 1) -> SurfelSamples:
        """An opaque Gaussian for each tile.

        Args:
            tiles: rectangles of cells of this surface's grid.
            sigma_sides: standard deviations of the Gaussians, in units of a tile's sides.
            cell_px: width of a cell in pixels of the photo.
        """
        inverse_depth = tiles.means(self.inverse_depth)
        slope = tiles.means(self.slope)
        color = tiles.means(self.color)
        opacity = torch.full_like(inverse_depth, float(SURFEL_OPACITY))
        sigma = torch.tensor([tiles.width, tiles.height]) * (sigma_sides * cell_px)
        return SurfelSamples(
            uv=tiles.centers() * cell_px,
            inverse_depth=inverse_depth,
            slope=slope,
            sigma=sigma.expand(len(inverse_depth), 2),
            color=color,
            opacity=opacity,
        )


class PixelSurfaces(NamedTuple):
    """The one or two surfaces that each pixel of a photo shows."""

    main: Surface  # the surface that covers most of a pixel
    other: Surface  # the other surface; valid if `mixed`
    mixed: Tensor  # [H, W] bool: the pixel shows two surfaces
    near_is_main: Tensor  # [H, W] bool: `main` is the near surface
    beside_step: Tensor  # [H, W] bool: a depth step is close


def without_border(mask: Tensor) -> Tensor:
    """A mask [H, W] of pixels, made false on the image's border.

    For masks of pixels that may share a Gaussian: shared at the border, it would reach beyond the
    image.
    """
    inner = torch.zeros_like(mask)
    inner[1:-1, 1:-1] = mask[1:-1, 1:-1]
    return inner
