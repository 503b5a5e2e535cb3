"""The sliding pyramid: one vision transformer over windows of three sizes of the picture, merged into feature maps."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate

from spackle.bases.protocol import Progress
from spackle.bases.sharp.config import SharpConfig
from spackle.bases.sharp.precision import lower
from spackle.bases.sharp.vit import VisionTransformer

# Windows a side over the picture at its full size, which overlap by a quarter, and at half of it, by a half.
# A quarter of it is one window.
FULL_WINDOWS, HALF_WINDOWS = 5, 3
WINDOWS = FULL_WINDOWS**2 + HALF_WINDOWS**2 + 1


class SlidingPyramid(nn.Module):
    """Feature maps of five scales, [1, C, side/2, …] to [1, C, side/32, …]."""

    def __init__(self, config: SharpConfig) -> None:
        super().__init__()
        self.taps = config.taps
        self.window = config.window
        self.full_trim, self.half_trim = config.grid // 8, config.grid // 4  # tokens: half an overlap
        self.patch_encoder = VisionTransformer(config)
        self.image_encoder = VisionTransformer(config)
        fine, embed, dims = config.depth_width, config.embed, config.pyramid
        self.upsample_latent0 = _project_and_double(embed, dims[0], fine, 3)
        self.upsample_latent1 = _project_and_double(embed, dims[0], dims[0], 2)
        self.upsample0 = _project_and_double(embed, dims[1], dims[1], 1)
        self.upsample1 = _project_and_double(embed, dims[2], dims[2], 1)
        self.upsample2 = _project_and_double(embed, dims[3], dims[3], 1)
        self.upsample_lowres = nn.ConvTranspose2d(embed, dims[3], 2, stride=2)
        self.fuse_lowres = nn.Conv2d(2 * dims[3], dims[3], 1)

    def forward(self, image: Tensor, batch: int, progress: Progress | None = None) -> list[Tensor]:
        """Feature maps, fine to coarse, of a picture [1, 3, side, side] in -1..1.

        Args:
            image: the picture.
            batch: how many windows go through the transformer at once.
            progress: called after each batch.
        """
        half, quarter = (interpolate(image, scale_factor=f, mode="bilinear") for f in (0.5, 0.25))
        windows = torch.cat([cut(image, self.window, FULL_WINDOWS), cut(half, self.window, HALF_WINDOWS), quarter])
        maps, latents = self._encode(windows, batch, progress)
        full, middle, whole = torch.split(maps, [FULL_WINDOWS**2, HALF_WINDOWS**2, 1])
        whole = self.upsample2(whole)
        lowres = self.upsample_lowres(lower(self.image_encoder(quarter)[0], self.upsample_lowres))
        return [
            self.upsample_latent0(merge(latents[0], self.full_trim)),
            self.upsample_latent1(merge(latents[1], self.full_trim)),
            self.upsample0(merge(full, self.full_trim)),
            self.upsample1(merge(middle, self.half_trim)),
            self.fuse_lowres(torch.cat([whole, lowres], dim=1)),
        ]

    def _encode(self, windows: Tensor, batch: int, progress: Progress | None) -> tuple[Tensor, list[Tensor]]:
        """Features of all windows, and the tapped ones of the full size's, a few windows at a time."""
        found: list[list[Tensor]] = [[] for _ in range(1 + len(self.taps))]
        for start in range(0, len(windows), batch):
            features, tapped = self.patch_encoder(windows[start : start + batch], self.taps)
            kept = max(0, FULL_WINDOWS**2 - start)  # taps are wanted of the full size alone
            for into, part in zip(found, [features, *(tap[:kept] for tap in tapped)], strict=True):
                into.append(lower(part, self.fuse_lowres))
            if progress:
                progress(min(start + batch, len(windows)), len(windows))
        features, *latents = (torch.cat(parts) for parts in found)
        return features, latents


def cut(image: Tensor, window: int, count: int) -> Tensor:
    """count² evenly overlapping windows [count², C, window, window] of [1, C, S, S], in row-major order."""
    stride = (image.shape[-1] - window) // (count - 1)
    rows = image.unfold(2, window, stride).unfold(3, window, stride)  # [1, C, count, count, window, window]
    return rows[0].permute(1, 2, 0, 3, 4).flatten(0, 1)


def merge(maps: Tensor, trim: int) -> Tensor:
    """The inverse of `cut` for feature maps [n², C, G, G]: each gives up `trim` cells where it meets a neighbour."""
    count = int(len(maps) ** 0.5)
    size = maps.shape[-1]
    spans = [slice(trim if i else 0, size - trim if i < count - 1 else size) for i in range(count)]
    rows = []
    for i, vertical in enumerate(spans):
        tiles = [maps[i * count + j, :, vertical, horizontal] for j, horizontal in enumerate(spans)]
        rows.append(torch.cat(tiles, dim=2))
    return torch.cat(rows, dim=1)[None]


def _project_and_double(dim_in: int, dim_middle: int, dim_out: int, doublings: int) -> nn.Sequential:
    """A projection, then transposed convolutions that double the size, all without bias."""
    layers: list[nn.Module] = [nn.Conv2d(dim_in, dim_middle, 1, bias=False)]
    for index in range(doublings):
        layers.append(nn.ConvTranspose2d(dim_out if index else dim_middle, dim_out, 2, stride=2, bias=False))
    return nn.Sequential(*layers)
