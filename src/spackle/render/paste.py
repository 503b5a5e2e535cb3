"""Some tiles of one image, the others of another."""

from __future__ import annotations

import torch
from torch import Tensor

from spackle.render.protocol import TILE
from spackle.rendering import Rendering


def tile_mask(tiles: Tensor, height: int, width: int) -> Tensor:
    """[H, W] bool: the pixels of the chosen tiles, [rows, columns] bool.

    Raises:
        ValueError: the tiles are not those of an image of this size.
    """
    if tuple(tiles.shape) != (-(-height // TILE), -(-width // TILE)):
        raise ValueError(f"tiles has shape {tuple(tiles.shape)}, expected one of each {TILE}×{TILE} pixels")
    return tiles.repeat_interleave(TILE, 0).repeat_interleave(TILE, 1)[:height, :width]


def paste(rendering: Rendering, tiles: Tensor, onto: Rendering | None) -> Rendering:
    """Keep the chosen tiles of a rendering, [rows, columns] bool, and the rest of `onto`, or black."""
    mask = tile_mask(tiles, *rendering.alpha.shape)
    parts = (rendering.rgb, rendering.depth, rendering.alpha)
    others = (onto.rgb, onto.depth, onto.alpha) if onto is not None else tuple(torch.zeros_like(p) for p in parts)
    rgb = torch.where(mask[..., None], parts[0], others[0])
    return Rendering(rgb, torch.where(mask, parts[1], others[1]), torch.where(mask, parts[2], others[2]))
