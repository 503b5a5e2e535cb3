"""Texture for holes from the picture itself: PatchMatch over colours that come from the far rim."""

from __future__ import annotations

import torch
from torch import Tensor

from spackle.fill import far_fill
from spackle.inpaint.protocol import InpainterOptions, PlainInpainter
from spackle.patches import match_patches


class ExemplarInpainter(PlainInpainter):
    """Each view by itself."""

    name = "exemplar"
    version = "1"

    def __init__(self, options: InpainterOptions) -> None:
        """Take no option."""

    def paint(self, rgb: Tensor, hole: Tensor, inverse_depth: Tensor) -> Tensor:
        """The views [V, H, W, 3] with their holes [V, H, W] painted; see `Inpainter.paint`."""
        return torch.stack([_painted(*view) for view in zip(rgb, hole, inverse_depth, strict=True)])


def _painted(rgb: Tensor, hole: Tensor, inverse_depth: Tensor) -> Tensor:
    if bool(hole.all()):
        return rgb
    if not bool(((inverse_depth > 0) & ~hole).any()):
        inverse_depth = torch.ones_like(inverse_depth)
    depth, colors = far_fill(inverse_depth, rgb.permute(2, 0, 1), (inverse_depth > 0) & ~hole)
    guess = torch.where(hole[..., None], colors.permute(1, 2, 0), rgb)
    return torch.where(hole[..., None], match_patches(guess, hole, depth).rgb.clamp(0, 1), rgb)
