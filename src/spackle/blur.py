"""Gaussian blur of pictures."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import conv2d


def blurred(image: Tensor, sigma: float) -> Tensor:
    """A picture [..., H, W, C] under a Gaussian of `sigma` pixels; what lies beyond the border has no weight."""
    reach = math.ceil(3 * sigma)
    offsets = torch.arange(-reach, reach + 1, dtype=torch.float32, device=image.device)
    line = torch.exp(-0.5 * (offsets / sigma) ** 2).to(image).view(1, 1, 1, -1)
    lead, (height, width, channels) = image.shape[:-3], image.shape[-3:]
    planes = image.reshape(-1, height, width, channels).movedim(-1, 1).reshape(-1, 1, height, width)
    ones = planes.new_ones(1, 1, height, width)

    def smeared(maps: Tensor) -> Tensor:
        return conv2d(conv2d(maps, line, padding=(0, reach)), line.mT, padding=(reach, 0))

    mean = (smeared(planes) / smeared(ones)).reshape(-1, channels, height, width)
    return mean.movedim(1, -1).reshape(*lead, height, width, channels)
