"""Which of SHARP's arithmetic runs in bfloat16."""

from __future__ import annotations

import torch
from torch import Tensor, nn

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
    """Convert what costs time to `dtype`, in place; all else stays as it is.

    Kernels go into the channels-last layout, in which the processor's convolutions are up to five
    times as fast.
    """
    for module in network.modules():
        if isinstance(module, _HEAVY) and not isinstance(module, ExactConv):
            module.to(dtype)
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # torch's stubs lack it
