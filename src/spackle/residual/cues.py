"""What the residual looks at: a rendered view on a grid with one cell for each 2×2 pixels."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d, pad

from spackle.color import linear_to_srgb, srgb_to_linear
from spackle.rendering import Rendering

CELL = 2  # pixels along a cell's side
MASK_THRESHOLD = 0.95  # τ_α: a pixel with less opacity is a hole (paper, eq. 3)


def hole_mask(alpha: Tensor, threshold: float = MASK_THRESHOLD) -> Tensor:
    """M_v(p) = 1[A_v(p) < τ_α] (paper, eq. 3): [H, W] bool, true where nothing was seen."""
    return alpha < threshold


def hole_area_ratio(alpha: Tensor, threshold: float = MASK_THRESHOLD) -> float:
    """HAR = 1 − coverage (paper, section 4.2): the share of hole pixels."""
    return float(hole_mask(alpha, threshold).double().mean())


@dataclasses.dataclass(frozen=True)
class Cues:
    """A view's cells, detached from whatever made them. Grid: ceil(H/2) × ceil(W/2)."""

    rgb: Tensor  # [h, w, 3] sRGB of the covered part of the cell, without the black behind it
    inverse_depth: Tensor  # [h, w] farthest covered pixel's 1/z; 0 in a cell without any
    alpha: Tensor  # [h, w] mean opacity
    mask: Tensor  # [h, w] bool: some pixel of the cell is a hole

    @staticmethod
    def of(rendering: Rendering, threshold: float = MASK_THRESHOLD) -> Cues:
        """Gather the cells of a rendering; an odd last row or column stands for its twin too."""
        view = rendering.detach()
        alpha = _cells(view.alpha)
        hole = _cells(hole_mask(view.alpha, threshold).to(view.alpha))
        covered = 1.0 - hole
        light = _cells(srgb_to_linear(view.rgb.permute(2, 0, 1)))  # premultiplied by alpha
        rgb = linear_to_srgb(light.sum(-1) / alpha.sum(-1).clamp_min(1e-6))
        inverse = torch.where(covered > 0, 1.0 / _cells(view.depth).clamp_min(1e-6), torch.inf)
        farthest = inverse.amin(dim=-1)
        return Cues(
            rgb=rgb.permute(1, 2, 0),
            inverse_depth=torch.where(farthest.isinf(), 0.0, farthest),
            alpha=alpha.mean(-1),
            mask=hole.amax(dim=-1) > 0,
        )

    @property
    def covered(self) -> Tensor:
        """[h, w] bool: the cells without a hole, which the fill may start from."""
        return ~self.mask

    def farthest_around(self, radius: int) -> Tensor:
        """[h, w] smallest inverse depth of what is covered within `radius` cells; inf where nothing is."""
        known = torch.where(self.inverse_depth > 0, self.inverse_depth, torch.inf)
        return -max_pool2d(-known[None, None], 2 * radius + 1, stride=1, padding=radius)[0, 0]


def _cells(image: Tensor) -> Tensor:
    """[..., H, W] to [..., ceil(H/2), ceil(W/2), 4]."""
    height, width = image.shape[-2:]
    flat = image.reshape(1, -1, height, width)
    even = pad(flat, (0, width % CELL, 0, height % CELL), mode="replicate")
    rows, columns = even.shape[-2] // CELL, even.shape[-1] // CELL
    grid = even.reshape(*image.shape[:-2], rows, CELL, columns, CELL)
    return grid.transpose(-3, -2).flatten(-2)
