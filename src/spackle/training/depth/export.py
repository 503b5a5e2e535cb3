"""The lite base's weights into a file: small, and of as many networks as are asked together."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from safetensors.torch import save
from torch import Tensor

from spackle.bases.lite.network import SCALE, LiteNet
from spackle.formats import atomic_path

FEW = 32  # weights for an output: so few, those of depthwise convolutions, take little room in sixteen bits
STEPS = 127  # of eight bits, to either side of zero


def save_networks(networks: Sequence[LiteNet], path: Path) -> None:
    """Write networks into one file, which `spackle.bases.lite.network.load_networks` reads.

    Weights are stored in eight bits, with a scale for each output of a layer; biases and depthwise convolutions in half
    precision. `Look.network` counts them in this order.

    Raises:
        InputError: where the file cannot be written.
    """
    tensors = {
        f"{number}.{name}": tensor
        for number, network in enumerate(networks)
        for layer, value in network.state_dict().items()
        for name, tensor in _stored(layer, value.detach().float().cpu()).items()
    }
    with atomic_path(path) as temporary:
        temporary.write_bytes(save(tensors))


def _stored(name: str, value: Tensor) -> dict[str, Tensor]:
    """A tensor as it is stored, under its name and perhaps one more."""
    if value.dim() < 4 or value[0].numel() < FEW:
        return {name: value.half().contiguous()}
    scale = value.abs().amax((1, 2, 3)) / STEPS
    steps = (value / scale.clamp_min(1e-30)[:, None, None, None]).round()
    return {name: steps.to(torch.int8).contiguous(), name + SCALE: scale}
