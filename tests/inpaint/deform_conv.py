"""Deformable convolution in plain PyTorch, called as torchvision's is, which many a torch without CUDA cannot load."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn


class DeformConv2d(nn.Conv2d):
    """A convolution each of whose taps looks somewhere else at each pixel, and counts more or less there."""

    def forward(self, input: Tensor, offset: Tensor, mask: Tensor | None = None) -> Tensor:
        """Convolve where the offsets point.

        Args:
            input: [B, C, H, W]; zero outside, between pixels bilinear.
            offset: [B, 2·G·K, h, w] down and right of where each of the K taps is, for G groups of input channels.
            mask: [B, G·K, h, w] what each tap is multiplied with; 1 where None.

        Returns:
            [B, C', h, w].
        """
        taps = self._taps().to(input)
        batch, groups = len(input), offset.shape[1] // (2 * len(taps))
        height, width = offset.shape[-2:]
        rows = torch.arange(height).to(input) * self.stride[0] - int(self.padding[0])
        columns = torch.arange(width).to(input) * self.stride[1] - int(self.padding[1])
        shift = offset.reshape(batch * groups, len(taps), 2, height, width)
        y = rows[:, None] + taps[:, 0, None, None] + shift[:, :, 0]  # [B·G, K, h, w]
        x = columns + taps[:, 1, None, None] + shift[:, :, 1]
        seen = sample(input.reshape(batch * groups, -1, *input.shape[-2:]), y.flatten(1, 2), x.flatten(1, 2))
        seen = seen.reshape(batch * groups, -1, len(taps), height, width)
        if mask is not None:
            seen = seen * mask.reshape(batch * groups, 1, len(taps), height, width)
        seen = seen.reshape(batch, self.groups, -1, height * width)  # of each group its channels, and their taps
        weight = self.weight.reshape(self.groups, self.out_channels // self.groups, -1)
        out = torch.einsum("goc,bgcp->bgop", weight, seen).reshape(batch, -1, height, width)
        return out if self.bias is None else out + self.bias[:, None, None]

    def _taps(self) -> Tensor:
        """[K, 2] rows and columns of the taps from the first one."""
        sides = [torch.arange(size) * step for size, step in zip(self.kernel_size, self.dilation, strict=True)]
        return torch.cartesian_prod(*sides)


def sample(images: Tensor, y: Tensor, x: Tensor) -> Tensor:
    """[N, C, h, w] of images [N, C, H, W] at rows y and columns x [N, h, w]: bilinear, and zero outside."""
    height, width = images.shape[-2:]
    grid = torch.stack([(2 * x + 1) / width - 1, (2 * y + 1) / height - 1], dim=-1)
    return F.grid_sample(images, grid, mode="bilinear", padding_mode="zeros", align_corners=False)
