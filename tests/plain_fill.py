"""The plain twin of `spackle.fill.far_fill`: whole images, one torch operation at a time."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, pad


def plain_far_fill(
    inverse_depth: Tensor,
    values: Tensor,
    known: Tensor,
    *,
    far_bias: Tensor | float,
    sweeps: int,
) -> tuple[Tensor, Tensor]:
    """See `spackle.fill.far_fill`."""
    if not bool(known.any()):
        raise ValueError("nothing to fill from: no pixel is known")
    field = torch.cat([inverse_depth[None], values])[None]
    field = torch.where(known[None, None], field, field.new_zeros(()))
    bias = torch.as_tensor(far_bias).to(field).expand(inverse_depth.shape)[None, None]
    filled = _fill_level(field, known[None, None], bias, sweeps)[0]
    return filled[0], filled[1:]


def _fill_level(field: Tensor, known: Tensor, bias: Tensor, sweeps: int) -> Tensor:
    """Fill one level [1, 1 + C, H, W] from the next coarser one, then relax it."""
    if bool(known.all()):
        return field
    height, width = field.shape[-2:]
    margins = (0, width % 2, 0, height % 2)
    weight = _far_weight(field[:, :1], known, bias)
    mass = avg_pool2d(pad(weight, margins), 2)
    # A coarse cell is the mean of its known samples, the far ones counting most.
    coarse = avg_pool2d(pad(field * weight, margins), 2) / mass.clamp_min(1e-30)
    coarse_bias = avg_pool2d(pad(bias, margins, mode="replicate"), 2)
    coarse = _fill_level(coarse, mass > 0, coarse_bias, sweeps)
    guess = interpolate(coarse, scale_factor=2, mode="bilinear", align_corners=False)
    field = torch.where(known, field, guess[..., :height, :width])
    return _relax(field, known, bias, sweeps)


def _far_weight(inverse_depth: Tensor, known: Tensor, bias: Tensor) -> Tensor:
    """Weights inverse_depth^−bias, scaled so that they stay within single precision."""
    reference = inverse_depth[known].median()
    ratio = (inverse_depth / reference).clamp_min(1e-6)
    exponent = (-bias * ratio.log()).clamp(-30, 30)
    return torch.where(known, exponent.exp(), torch.zeros_like(ratio))


def _relax(field: Tensor, known: Tensor, bias: Tensor, sweeps: int) -> Tensor:
    """Jacobi sweeps on the unknown pixels; nothing flows across the image's border."""
    height, width = field.shape[-2:]
    solid = _around(known.to(field), height, width)
    for _ in range(sweeps):
        total, mass = torch.zeros_like(field), torch.zeros_like(field[:, :1])
        for near, rim in zip(_around(field, height, width), solid, strict=True):
            trust = (field[:, :1] / near[:, :1].clamp_min(1e-12)).clamp(1e-6, 1.0) ** bias
            conductance = torch.where(rim > 0, trust.clamp_min(1e-6), torch.ones_like(trust))
            total, mass = total + conductance * near, mass + conductance
        field = torch.where(known, field, total / mass)
    return field


def _around(image: Tensor, height: int, width: int) -> list[Tensor]:
    """The four neighbours of each pixel; at the border the pixel itself."""
    wide = pad(image, (1, 1, 1, 1), mode="replicate")
    return [wide[..., dy : dy + height, dx : dx + width] for dy, dx in ((0, 1), (2, 1), (1, 0), (1, 2))]
