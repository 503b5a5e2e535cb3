"""SHARP's sizes, its precision, and the blocks that its decoders share (after Ranftl 2021, dense prediction)."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import torch
from torch import Tensor, nn

LAYERS = 2  # of Gaussians: the visible surface, and what may be behind it
STRIDE = 2  # pixels of the network's picture for each cell of Gaussians


@dataclasses.dataclass(frozen=True)
class SharpConfig:
    """Widths and depths; whatever else there is about SHARP is the same in all sizes."""

    embed: int = 1024  # width of both vision transformers
    depth: int = 24  # their blocks
    heads: int = 16
    classes: int = 21841  # of the transformers' classifiers, which are in the checkpoint and never used
    taps: tuple[int, int] = (5, 11)  # blocks whose tokens become the two finest feature maps
    pyramid: tuple[int, int, int, int] = (256, 512, 1024, 1024)  # channels of the coarser feature maps, fine to coarse
    depth_width: int = 256  # channels of the depth decoder, and of the finest feature map
    gaussian_width: int = 128  # channels of the Gaussian decoder
    feature_width: int = 32  # channels that the Gaussians are predicted from
    patch: int = 16  # pixels of a token's side; the decoders count on 16
    window: int = 384  # pixels of a transformer's picture, a multiple of 8 tokens

    @property
    def side(self) -> int:
        """Pixels of the side of the square picture that the network looks at."""
        return 4 * self.window

    @property
    def grid(self) -> int:
        """Tokens of a window's side."""
        return self.window // self.patch


FULL = SharpConfig()
TINY = SharpConfig(
    embed=48,
    depth=4,
    heads=3,
    classes=8,
    taps=(0, 1),
    pyramid=(16, 24, 32, 32),
    depth_width=16,
    gaussian_width=16,
    feature_width=16,
)
CONFIGS = {"full": FULL, "tiny": TINY}


_HEAVY = (nn.Linear, nn.Conv2d, nn.ConvTranspose2d, nn.GroupNorm)


class ExactConv(nn.Conv2d):
    """A convolution that stays in float32: cheap, and next to the pixels that come in or the Gaussians that go out."""

    def forward(self, x: Tensor) -> Tensor:
        with torch.autocast(x.device.type, enabled=False):  # the decoder learns under it
            return super().forward(x.float())


def lower(x: Tensor, module: nn.Linear | nn.Conv2d | nn.ConvTranspose2d) -> Tensor:
    """`x` in the precision that a module computes in."""
    return x.to(module.weight.dtype)


def set_precision(network: nn.Module, dtype: torch.dtype) -> None:
    """Convert what costs time to `dtype`, in place, and kernels to channels-last, which is fast on a processor."""
    for module in network.modules():
        if isinstance(module, _HEAVY) and not isinstance(module, ExactConv):
            module.to(dtype)
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # torch's stubs lack it


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
    """torch's, exact in float32 on a processor, where torch loses three digits over half a million pixels.

    Sums of rows, then of those in float64, lose none.
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
