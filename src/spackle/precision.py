"""What networks compute in: float32, or bfloat16 where the hardware multiplies it natively.

Neither type repeats bit for bit with another number of threads: sums run in another order. With the same
number they do.
"""

from __future__ import annotations

from typing import Literal

import torch

Precision = Literal["auto", "fp32", "bf16"]
PRECISIONS = ("auto", "fp32", "bf16")


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
