"""Which of SHARP's arithmetic runs in bfloat16, and where the hardware multiplies it natively.

Neither type repeats bit for bit with another number of threads: sums run in another order. With the same
number they do.
"""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor, nn

Precision = Literal["auto", "fp32", "bf16"]
PRECISIONS = ("auto", "fp32", "bf16")

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


def pick_dtype(precision: Precision, device: torch.device) -> torch.dtype:
    """The type that --precision means on a device: `auto` is bfloat16 where the hardware multiplies it natively.

    Raises:
        ValueError: an unknown precision.
    """
    if precision not in PRECISIONS:
        raise ValueError(f"precision {precision!r} is none of {', '.join(PRECISIONS)}")
    if precision == "auto":
        return torch.bfloat16 if multiplies_bf16(device) else torch.float32
    return torch.float32 if precision == "fp32" else torch.bfloat16


def multiplies_bf16(device: torch.device) -> bool:
    """Whether products of bfloat16 are native: AMX or AVX512-BF16 on a processor, Ampere or later on a GPU."""
    if device.type == "cuda":
        return torch.cuda.get_device_capability(device) >= (8, 0)
    if device.type != "cpu":
        return False
    has: dict[str, bool] = getattr(torch.cpu, "get_capabilities", dict)()  # older torch cannot tell
    return bool(has.get("amx_bf16") or has.get("avx512_bf16"))
