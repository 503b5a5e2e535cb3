"""Gaussians as the page reads them: 20 bytes each, one byte plane after the other.

Centres are float32 without their last 8 bits: an error of 2⁻¹⁶ of the distance to the photo's eye, which is a hundredth
of a pixel, for what is near and for the sky alike. Planes compress well: a single HTML file needs half of them.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from spackle.color import linear_to_srgb
from spackle.gaussians import Gaussians

BYTES = 20  # planes: 9 of centres, 3 of scales, 4 of rotations, 3 of colours, 1 of opacity
SMALLEST_SCALE, LARGEST_SCALE = 1e-7, 1e5  # an outlier beyond must not cost the others their precision
BLOCK = 1 << 16  # so many Gaussians at a time stay in the cache


@dataclasses.dataclass(frozen=True)
class EncodedLayer:
    """Bytes of a layer, and what is needed to read them."""

    data: bytes  # [BYTES, N]
    count: int
    scale_low: float  # logarithm of the scale that the byte 0 stands for
    scale_step: float  # what one step adds to the logarithm


@torch.no_grad()
def encode_layer(gaussians: Gaussians) -> EncodedLayer:
    """Pack Gaussians for the page.

    Planes of N bytes each: x, y, z with three planes each from the lower byte to the upper one, of float32's upper 24
    bits; the logarithms of the three scales; the index of the quaternion's largest part (wxyz), which is made
    positive, and the other three parts, ±127 for ±1/√2; red, green, blue in sRGB; opacity.
    """
    count = len(gaussians)
    means, quats, scales, opacities, colors = (t.detach().to("cpu", torch.float32) for t in gaussians.tensors)
    low, step = _range(scales)
    planes = np.empty((BYTES, count), np.uint8)
    for start in range(0, count, BLOCK):
        part = slice(start, start + BLOCK)
        planes[0:9, part] = _centres(means[part])
        logs = scales[part].clamp(SMALLEST_SCALE, LARGEST_SCALE).log()
        planes[9:12, part] = _bytes((logs - low) / step)
        planes[12:16, part] = _rotations(quats[part])
        planes[16:19, part] = _bytes(linear_to_srgb(colors[part]) * 255)
        planes[19, part] = _bytes(opacities[part, None] * 255)
    return EncodedLayer(planes.tobytes(), count, low, step)


def _range(scales: Tensor) -> tuple[float, float]:
    if not scales.numel():
        return 0.0, 1.0
    ends = (min(max(float(end), SMALLEST_SCALE), LARGEST_SCALE) for end in torch.aminmax(scales))
    low, high = (math.log(end) for end in ends)
    return low, max(high - low, 1e-3) / 255


def _bytes(values: Tensor) -> NDArray[np.uint8]:
    """[rows, C] rounded to [C, rows] in 0..255."""
    return values.round().clamp(0, 255).to(torch.uint8).T.numpy()


def _centres(means: Tensor) -> NDArray[np.uint8]:
    """[9, rows]: rounded to the upper 24 bits of float32."""
    bits = (means.T.contiguous().numpy().view(np.uint32) + np.uint32(0x80)).view(np.uint8)
    rows = bits.reshape(3, -1, 4)[:, :, 1:]  # little-endian
    return rows.transpose(0, 2, 1).reshape(9, -1)


def _rotations(quats: Tensor) -> NDArray[np.uint8]:
    """[4, rows]: which part is the largest, and the other three in their order."""
    quats = torch.nn.functional.normalize(quats, dim=-1)
    largest = quats.abs().argmax(dim=-1, keepdim=True)
    quats = quats * torch.where(quats.gather(-1, largest) < 0, -1.0, 1.0)
    others = torch.tensor([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])[largest[:, 0]]
    small = quats.gather(-1, others) * (127 * math.sqrt(2)) + 128
    return np.concatenate([largest.to(torch.uint8).T.numpy(), _bytes(small)])
