"""The protocol of renderers, and their result."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Protocol

import torch
from torch import Tensor

from spackle.core.camera import Camera
from spackle.core.gaussians import Gaussians


@dataclasses.dataclass(frozen=True)
class Rendering:
    """One view: three images of the same size."""

    rgb: Tensor  # [H, W, 3] sRGB in 0..1, over black
    depth: Tensor  # [H, W] expected z, normalised by alpha; 0 where alpha is 0
    alpha: Tensor  # [H, W] accumulated opacity in 0..1

    @property
    def tensors(self) -> tuple[Tensor, Tensor, Tensor]:
        """The three images in field order."""
        return self.rgb, self.depth, self.alpha

    def to(self, device: torch.device) -> Rendering:
        """The images on another device."""
        return (
            self
            if self.rgb.device == device
            else Rendering(*(image.to(device) for image in self.tensors))
        )

    def detach(self) -> Rendering:
        """The same values, detached from autograd."""
        return Rendering(*(image.detach() for image in self.tensors))


ALPHA_MAX = 0.999  # largest alpha of a Gaussian, as in gsplat 1.5
ALPHA_MIN = 1.0 / 255.0  # fainter contributions are skipped
TRANSMITTANCE_STOP = 1e-4  # a pixel is full if its transmittance falls to this
NEAR_PLANE = 0.01  # nearer Gaussians are not drawn
TILE = 16  # pixels along a tile's side


class Renderer(Protocol):
    """Classic 3D Gaussian splatting: one pass gives colour, expected depth and opacity."""

    def render(
        self,
        gaussians: Gaussians | Sequence[Gaussians],
        camera: Camera,
        *,
        eps2d: float = 0.0,
        tiles: Tensor | None = None,
        onto: Rendering | None = None,
    ) -> Rendering:
        """Draw Gaussians as a camera sees them.

        Args:
            gaussians: one set, or several sets that are drawn together. Gradients reach tensors that require them.
            camera: the view.
            eps2d: added to the diagonal of each projected covariance, in pixels² (SHARP: 0, gsplat's default: 0.3).
            tiles: [ceil(H/16), ceil(W/16)] bool: the tiles to draw; None: all tiles.
            onto: a rendering from which all other tiles are copied; None: other tiles are black and empty.
        """


def tile_grid(height: int, width: int) -> tuple[int, int]:
    """Rows and columns of tiles in an image."""
    return -(-height // TILE), -(-width // TILE)


def check_tiles(tiles: Tensor, height: int, width: int) -> None:
    """ValueError if the shape of `tiles` does not fit an image of this size."""
    if tuple(tiles.shape) != (grid := tile_grid(height, width)):
        raise ValueError(
            f"tiles has shape {tuple(tiles.shape)}, expected {grid}: one for each {TILE}×{TILE} pixels"
        )


def tile_mask(tiles: Tensor, height: int, width: int) -> Tensor:
    """[H, W] bool: the pixels of the tiles [rows, columns] bool; ValueError if the shape does not fit the image."""
    check_tiles(tiles, height, width)
    return tiles.repeat_interleave(TILE, 0).repeat_interleave(TILE, 1)[:height, :width]


def paste(rendering: Rendering, tiles: Tensor, onto: Rendering | None) -> Rendering:
    """Take the pixels of `tiles` ([rows, columns] bool) from a rendering, all others from `onto` (None: black)."""
    mask = tile_mask(tiles, *rendering.alpha.shape)
    others = (
        onto.tensors
        if onto is not None
        else tuple(torch.zeros_like(image) for image in rendering.tensors)
    )
    masks = (mask[..., None], mask, mask)
    return Rendering(
        *(torch.where(*images) for images in zip(masks, rendering.tensors, others, strict=True))
    )
