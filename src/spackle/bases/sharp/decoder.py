"""Convolutional decoders over the feature pyramid, after "Vision Transformers for Dense Prediction" (Ranftl 2021)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

GROUPS = 8  # of the group norms


class Residual(nn.Module):
    """x plus what a few layers make of it."""

    def __init__(self, *layers: nn.Module) -> None:
        super().__init__()
        self.residual = nn.Sequential(*layers)

    def forward(self, x: Tensor) -> Tensor:
        delta: Tensor = self.residual(x)
        return delta.add_(x)


class GroupNorm(nn.GroupNorm):
    """torch's, made exact where it is not.

    In float32 on a processor, torch adds up a channels-last map pixel by pixel; over half a million
    pixels that loses three digits, which the Gaussians show. Sums of rows, then of those, lose none.
    """

    def forward(self, x: Tensor) -> Tensor:
        """[1, C, H, W] to the same."""
        if x.device.type != "cpu" or x.dtype != torch.float32 or len(x) != 1:
            return super().forward(x)
        rows = x[0].permute(1, 2, 0)  # [H, W, C]
        count = rows.numel() // self.num_groups
        mean, square = (
            moment.double().sum(0).view(self.num_groups, -1).sum(1) / count
            for moment in (rows.sum(1), rows.square().sum(1))
        )
        scale = torch.rsqrt(square - mean.square() + self.eps)
        each = self.num_channels // self.num_groups
        scale, mean = (n.repeat_interleave(each) for n in (scale, mean))
        factor = (self.weight * scale).float()
        shift = (self.bias - self.weight * scale * mean).float()
        return torch.addcmul(shift, rows, factor).permute(2, 0, 1)[None]


def plain_residual(dim: int) -> Residual:
    """Two 3×3 convolutions behind rectifiers. The first must leave x alone; the second may work in place."""
    first, second = (nn.Conv2d(dim, dim, 3, padding=1) for _ in range(2))
    return Residual(nn.ReLU(), first, nn.ReLU(inplace=True), second)


def normed_residual(dim: int) -> Residual:
    """The same with group norms, and half the width between them."""
    return Residual(
        GroupNorm(GROUPS, dim),
        nn.ReLU(inplace=True),
        nn.Conv2d(dim, dim // 2, 3, padding=1),
        GroupNorm(GROUPS, dim // 2),
        nn.ReLU(inplace=True),
        nn.Conv2d(dim // 2, dim, 3, padding=1),
    )


class Fusion(nn.Module):
    """Adds finer features to coarser ones, and doubles the size where asked."""

    def __init__(self, dim: int, doubles: bool) -> None:
        super().__init__()
        self.resnet1 = plain_residual(dim)
        self.resnet2 = plain_residual(dim)
        self.deconv = nn.ConvTranspose2d(dim, dim, 2, stride=2, bias=False) if doubles else nn.Identity()
        self.out_conv = nn.Conv2d(dim, dim, 1)

    def forward(self, coarse: Tensor, fine: Tensor | None = None) -> Tensor:
        """[1, C, H, W] each, to the same or twice the size."""
        x = coarse if fine is None else coarse + self.resnet1(fine)
        out: Tensor = self.out_conv(self.deconv(self.resnet2(x)))
        return out


class Decoder(nn.Module):
    """Fuses feature maps from coarse to fine into one of the finest size."""

    def __init__(self, dims: Sequence[int], width: int) -> None:
        super().__init__()
        finest = nn.Identity() if dims[0] == width else nn.Conv2d(dims[0], width, 1, bias=False)
        coarser = (nn.Conv2d(dim, width, 3, padding=1, bias=False) for dim in dims[1:])
        self.convs = nn.ModuleList([finest, *coarser])
        self.fusions = nn.ModuleList(Fusion(width, doubles=level > 0) for level in range(len(dims)))

    def forward(self, maps: Sequence[Tensor]) -> Tensor:
        """Maps from fine to coarse, [1, dims[i], H/2^i, W/2^i], to [1, width, H, W]."""
        features: Tensor | None = None
        for level in reversed(range(len(maps))):
            projected = self.convs[level](maps[level])
            fuse = self.fusions[level]
            features = fuse(projected) if features is None else fuse(features, projected)
        assert features is not None
        return features
