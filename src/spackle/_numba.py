"""A typed door to numba, which ships no types of its own."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar, cast

import numba

R = TypeVar("R")

# Fused multiply-adds are welcome. Reordered sums, and the promise that no NaN or infinity occurs, are
# not: the first would break bits that must repeat, the second the tests that keep bad values out.
_FASTMATH = {"contract", "nsz", "afn"}


def kernel(function: Callable[..., R]) -> Callable[..., R]:
    """Compile a function at its first call, keep the machine code on disk, and run it without the GIL."""
    compiled = numba.njit(cache=True, nogil=True, fastmath=_FASTMATH, error_model="numpy")(function)
    return cast("Callable[..., R]", compiled)


def reordering_kernel(function: Callable[..., R]) -> Callable[..., R]:
    """A `kernel` whose sums may be reordered, which lets them run in vector registers."""
    compiled = numba.njit(cache=True, nogil=True, fastmath={"reassoc", *_FASTMATH}, error_model="numpy")(function)
    return cast("Callable[..., R]", compiled)


def inlined_kernel(function: Callable[..., R]) -> Callable[..., R]:
    """A `kernel` that becomes part of the loops that call it, which only then run in vector registers."""
    compiled = numba.njit(cache=True, nogil=True, fastmath=_FASTMATH, error_model="numpy", forceinline=True)(function)
    return cast("Callable[..., R]", compiled)
