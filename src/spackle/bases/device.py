"""Where a network runs: on which device, with how much memory, untouched by settings that a caller has for others."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch

from spackle.errors import InputError

# How torch says that memory is short, beside the exceptions that it has for it.
_SHORTAGES = (
    "DefaultCPUAllocator",
    "not enough memory",
    "allocate memory",  # the system, when a file is to be mapped; and torch
    "out of memory",  # CUDA outside torch's allocator
    "_ALLOC_FAILED",  # cuBLAS and cuDNN
)


class MemoryShort(InputError):
    """There was too little memory; the next time there may be enough."""


def pick_device(device: torch.device | str | None) -> torch.device:
    """The device that a caller means: for None a CUDA device where there is one, else the processor.

    Raises:
        InputError: a device that is not there, or one of a kind that networks do not run on here.
    """
    present = torch.cuda.is_available()
    if device is None:
        return torch.device("cuda" if present else "cpu")
    shown = f"device {str(device)[:40]!a}"
    try:
        target = torch.device(device)
    except (RuntimeError, TypeError) as error:
        raise InputError(f"{shown}: there is no such device: give cpu or cuda") from error
    if target.type not in ("cpu", "cuda"):
        raise InputError(f"{shown}: networks do not run there: give cpu or cuda")
    if target.type == "cuda" and not present:
        raise InputError(f"{shown}: torch finds no CUDA device: give cpu, or install a torch and a driver for CUDA")
    if target.type == "cuda" and (target.index or 0) >= torch.cuda.device_count():
        raise InputError(f"{shown}: the last CUDA device is cuda:{torch.cuda.device_count() - 1}: give that or another")
    return target


def memory_is_short(error: BaseException) -> bool:
    """Whether that is what an exception says, in one of torch's many ways."""
    named = isinstance(error, (MemoryError, torch.OutOfMemoryError))
    return named or any(words in str(error) for words in _SHORTAGES)


@contextmanager
def enough_memory(*advice: str) -> Iterator[None]:
    """Turn a shortage of memory, which torch reports in many ways, into one line.

    Args:
        advice: what to do about it; closing other programs is always named.

    Raises:
        MemoryShort: memory was short.
    """
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        if not memory_is_short(error):
            raise
        remedies = ", or ".join([*advice, "close other programs"])
        raise MemoryShort(f"not enough memory for the network: {remedies}") from error


@contextmanager
def own_arithmetic(device: torch.device) -> Iterator[None]:
    """Compute in the types that the tensors have, whatever the caller has set for networks of their own.

    Autocast would round to sixteen bits what is to stay exact. TF32, which torch uses for a GPU's convolutions
    unless told otherwise, drops thirteen bits of each float32. Its switches hold for the whole process, so
    other threads see them too until they are set back.
    """
    with torch.autocast("cpu", enabled=False), torch.autocast("cuda", enabled=False):
        if device.type != "cuda":
            yield
            return
        # The older allow_tf32 cannot be read where the caller has used these newer switches.
        switches = torch.backends.cuda.matmul, torch.backends.cudnn.conv  # type: ignore[attr-defined]  # its stubs
        before = [switch.fp32_precision for switch in switches]
        try:
            for switch in switches:
                switch.fp32_precision = "ieee"
            yield
        finally:
            for switch, value in zip(switches, before, strict=True):
                switch.fp32_precision = value
