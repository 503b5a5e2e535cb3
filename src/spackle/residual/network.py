"""The residual network f_res (paper, eq. 4): cues of a view in, a delta for every cell out."""

from __future__ import annotations

import itertools

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate, pad

from spackle.residual.compose import GEOMETRY_CHANNELS, TEXTURE_CHANNELS
from spackle.residual.cues import Cues
from spackle.residual.seeds import Seeds

IN_CHANNELS = 10  # rendered colour 3, depth, opacity, mask, seed colour 3, seed depth
WIDTHS = (48, 80, 128, 256, 256)  # channels from the finest grid to the coarsest
COARSE_BLOCKS = 3  # residual blocks at the coarsest grid, where context is wide and cheap
STRIDE = 2 ** (len(WIDTHS) - 1)


class ResidualBlock(nn.Module):
    """x + conv(act(conv(act(x)))), starting as the identity.

    There is no normalisation: statistics over an image would make a crop's result depend on the crop.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(channels, channels, 3, padding=1)
        self.second = nn.Conv2d(channels, channels, 3, padding=1)
        nn.init.zeros_(self.second.weight)
        nn.init.zeros_(self.second.bias)  # type: ignore[arg-type]

    def forward(self, x: Tensor) -> Tensor:
        """[B, C, h, w] to the same shape."""
        out: Tensor = x + self.second(torch.relu(self.first(torch.relu(x))))
        return out


class ResidualNet(nn.Module):
    """Encoder of the cues, decoder, and SHARP's two heads: 8.02 M parameters.

    The last layers start at zero, so an untrained network returns the seeds unchanged.
    """

    def __init__(self) -> None:
        super().__init__()
        self.stem = nn.Conv2d(IN_CHANNELS, WIDTHS[0], 3, padding=1)
        pairs = list(itertools.pairwise(WIDTHS))
        self.down = nn.ModuleList(nn.Conv2d(fine, coarse, 3, stride=2, padding=1) for fine, coarse in pairs)
        self.encode = nn.ModuleList(ResidualBlock(width) for width in WIDTHS[:-1])
        self.coarse = nn.Sequential(*(ResidualBlock(WIDTHS[-1]) for _ in range(COARSE_BLOCKS)))
        self.up = nn.ModuleList(nn.Conv2d(coarse, fine, 1) for fine, coarse in pairs)
        self.decode = nn.ModuleList(ResidualBlock(width) for width in WIDTHS[:-1])
        self.geometry = _head(WIDTHS[0], GEOMETRY_CHANNELS)
        self.texture = _head(WIDTHS[0], TEXTURE_CHANNELS)

    def forward(self, features: Tensor) -> Tensor:
        """Features [B, 10, h, w] of `network_input` to deltas [B, 14, h, w]; any h and w."""
        height, width = features.shape[-2:]
        x = self.stem(pad(features, (0, -width % STRIDE, 0, -height % STRIDE), mode="replicate"))
        skips = []
        for encode, down in zip(self.encode, self.down, strict=True):
            x = encode(x)
            skips.append(x)
            x = down(x)
        x = self.coarse(x)
        for up, decode, skip in reversed(list(zip(self.up, self.decode, skips, strict=True))):
            x = decode(skip + interpolate(up(x), scale_factor=2, mode="bilinear", align_corners=False))
        deltas = torch.cat([self.geometry(x), self.texture(x)], dim=1)
        return deltas[..., :height, :width]


def network_input(cues: Cues, seeds: Seeds) -> Tensor:
    """Features [1, 10, h, w], centred around zero; depths as log inverse depth over the view's median."""
    cue_depth = torch.where(cues.inverse_depth > 0, (cues.inverse_depth / seeds.unit).clamp_min(1e-4).log(), 0.0)
    seed_depth = (seeds.inverse_depth / seeds.unit).clamp_min(1e-4).log()
    maps = [cue_depth, cues.alpha, cues.mask.to(cues.alpha), seed_depth]
    channels = [cues.rgb.permute(2, 0, 1) - 0.5, torch.stack(maps), seeds.rgb.permute(2, 0, 1) - 0.5]
    return torch.cat(channels)[None].detach()


def _head(width: int, channels: int) -> nn.Sequential:
    last = nn.Conv2d(width, channels, 1)
    nn.init.zeros_(last.weight)
    nn.init.zeros_(last.bias)  # type: ignore[arg-type]
    return nn.Sequential(ResidualBlock(width), nn.ReLU(), last)
