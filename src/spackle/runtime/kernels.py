"""Typed decorators around numba, which has no type annotations."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numba.core.dispatcher import Dispatcher
from numpy.typing import NDArray

R = TypeVar("R")
Array = NDArray[Any]  # what kernels take

# Constants of float32 kernels: a Python float would widen a whole expression to float64.
ZERO, HALF, ONE = np.float32(0.0), np.float32(0.5), np.float32(1.0)
MANTISSA_BITS = np.int32(23)  # bits of a float32's mantissa

# Reordered sums are not allowed, because results must be the same bit for bit; "nnan" and "ninf" are not, because
# kernels test for NaN and infinity.
_FASTMATH = {"contract", "nsz", "afn"}


def kernel(function: Callable[..., R]) -> Callable[..., R]:
    """Compile a function at its first call, cache the machine code on disk, and run without the GIL."""
    return _compiled(function, _FASTMATH)


def reordering_kernel(function: Callable[..., R]) -> Callable[..., R]:
    """A `kernel` whose sums may be reordered, which allows vector instructions."""
    return _compiled(function, {"reassoc", *_FASTMATH})


def inlined_kernel(function: Callable[..., R]) -> Callable[..., R]:
    """A `kernel` that is inlined into the calling loops, which allows vector instructions."""
    return _compiled(function, _FASTMATH, forceinline=True)


def is_compiled(function: Callable[..., Any]) -> bool:
    """Whether a kernel's machine code is on disk, or cannot be kept there."""
    kept = _kept(function)
    return kept is None or bool(kept._load_index())


def _compiled(function: Callable[..., R], fastmath: set[str], **more: Any) -> Callable[..., R]:
    compiled = numba.njit(cache=True, nogil=True, fastmath=fastmath, error_model="numpy", **more)(
        function
    )
    kept = _kept(compiled)
    if kept is not None:
        options = (sorted(fastmath), sorted(more.items()))
        kept._source_stamp = (kept._source_stamp, _surroundings(function), repr(options))
    return cast("Callable[..., R]", compiled)


def _surroundings(function: Callable[..., Any]) -> str:
    """A hash of the numbers and kernels that a module has; numba notices only changes of the module's own text."""
    seen = []
    for name, value in sorted(function.__globals__.items()):
        if isinstance(value, Dispatcher):
            seen.append((name, repr(getattr(_kept(value), "_source_stamp", None))))
        elif isinstance(value, (int, float, np.generic)):
            seen.append((name, repr(value)))
    return hashlib.sha256(repr(seen).encode()).hexdigest()


def _kept(compiled: Any) -> Any:
    """Numba's internal disk cache of a kernel's machine code; None if the cache is off."""
    file = getattr(getattr(compiled, "_cache", None), "_cache_file", None)
    return file if hasattr(file, "_source_stamp") else None
