"""LaMa's generator, plainly: one function of the published names, batch norms by themselves, and an input."""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

Weights = dict[str, Tensor]


def plain_logits(weights: Weights, x: Tensor) -> Tensor:
    """[B, 4, H, W] to [B, 3, H, W], before the last sigmoid; sides are multiples of 8."""

    def conv(name: str, x: Tensor, pad: int = 0, stride: int = 1) -> Tensor:
        padded = F.pad(x, (pad,) * 4, mode="reflect") if pad else x
        return F.conv2d(padded, weights[f"{name}.weight"], weights.get(f"{name}.bias"), stride)

    def norm_relu(name: str, x: Tensor) -> Tensor:
        mean, var, gain, bias = (weights[f"{name}.{key}"] for key in ("running_mean", "running_var", "weight", "bias"))
        return F.batch_norm(x, mean, var, gain, bias, eps=1e-5).relu()

    def spectral(name: str, x: Tensor) -> Tensor:
        x = norm_relu(f"{name}.conv1.1", conv(f"{name}.conv1.0", x))
        spectrum = torch.fft.rfftn(x, dim=(-2, -1), norm="ortho")
        parts = torch.stack((spectrum.real, spectrum.imag), 2).flatten(1, 2)  # real and imaginary parts alternate
        parts = norm_relu(f"{name}.fu.bn", conv(f"{name}.fu.conv_layer", parts)).unflatten(1, (-1, 2))
        filtered = torch.complex(parts[:, :, 0], parts[:, :, 1])
        x = x + torch.fft.irfftn(filtered, s=x.shape[-2:], dim=(-2, -1), norm="ortho")
        return conv(f"{name}.conv2", x)

    def block(name: str, local: Tensor, distant: Tensor) -> tuple[Tensor, Tensor]:
        near = conv(f"{name}.ffc.convl2l", local, 1) + conv(f"{name}.ffc.convg2l", distant, 1)
        far = conv(f"{name}.ffc.convl2g", local, 1) + spectral(f"{name}.ffc.convg2g", distant)
        return norm_relu(f"{name}.bn_l", near), norm_relu(f"{name}.bn_g", far)

    x = norm_relu("model.1.bn_l", conv("model.1.ffc.convl2l", x, 3))
    for stage in (2, 3):
        x = norm_relu(f"model.{stage}.bn_l", conv(f"model.{stage}.ffc.convl2l", x, 1, 2))
    local = norm_relu("model.4.bn_l", conv("model.4.ffc.convl2l", x, 1, 2))
    distant = norm_relu("model.4.bn_g", conv("model.4.ffc.convl2g", x, 1, 2))
    stage = 5
    while f"model.{stage}.conv1.bn_l.weight" in weights:
        near, far = block(f"model.{stage}.conv2", *block(f"model.{stage}.conv1", local, distant))
        local, distant, stage = local + near, distant + far, stage + 1
    x = torch.cat((local, distant), 1)
    for up in range(stage + 1, stage + 10, 3):
        weight, bias = weights[f"model.{up}.weight"], weights[f"model.{up}.bias"]
        x = norm_relu(f"model.{up + 1}", F.conv_transpose2d(x, weight, bias, 2, 1, output_padding=1))
    return conv(f"model.{stage + 11}", x, 3)


def made_input(height: int, width: int) -> Tensor:
    """[1, 4, H, W]: waves with two holes, and the holes."""
    yy, xx = np.meshgrid(np.arange(height) / height, np.arange(width) / width, indexing="ij")
    waves = (
        0.5 + 0.5 * np.sin(2 * np.pi * (3 * xx + 2 * yy)),
        0.5 + 0.5 * np.cos(2 * np.pi * (5 * xx * yy + yy)),
        0.5 + 0.25 * np.sin(40 * xx) * np.cos(30 * yy) + 0.25 * xx,
    )
    hole = (xx > 0.6) | ((np.abs(xx - 0.3) < 0.1) & (np.abs(yy - 0.5) < 0.25))
    return torch.from_numpy(np.stack([*(wave * ~hole for wave in waves), hole])[None].astype(np.float32))
