"""Decorators that compile numeric functions by numba.

`kernel` is the usual one; parallel_kernels.py has others, for what is computed for each item of a
list or each pixel. The decorators have types, which numba lacks, and recompile a kernel when a
constant or another kernel that it uses has changed, which numba does not notice.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numba.core.dispatcher import Dispatcher
from numpy.typing import NDArray

R = TypeVar("R")
Array = NDArray[Any]  # an argument of a kernel

# Constants of float32 kernels: a Python float would widen a whole expression to float64.
ZERO = np.float32(0.0)
HALF = np.float32(0.5)
ONE = np.float32(1.0)
MANTISSA_BITS = np.int32(23)  # of a float32

# Liberties that the compiler may take with floating point numbers: fuse a multiplication and an
# addition, ignore the sign of zero, approximate functions. It may not reorder sums ("reassoc"),
# because results must be the same bit for bit, and may not assume finite numbers ("nnan", "ninf"),
# because kernels test for NaN and infinity.
FASTMATH = {"contract", "nsz", "afn"}


def kernel(function: Callable[..., R]) -> Callable[..., R]:
    """Compile a function at its first call, cache the machine code on disk, and free the GIL."""
    return compile_kernel(function, FASTMATH)


def reordering_kernel(function: Callable[..., R]) -> Callable[..., R]:
    """A `kernel` whose sums may be reordered, which allows vector instructions."""
    return compile_kernel(function, {"reassoc", *FASTMATH})


def inlined_kernel(function: Callable[..., R]) -> Callable[..., R]:
    """A `kernel` that is inlined into the calling loops, which allows vector instructions."""
    return compile_kernel(function, FASTMATH, forceinline=True)


def compiled_function(value: Any) -> Callable[..., Any] | None:
    """The Python function that was compiled as a kernel; None for anything else."""
    if isinstance(value, Dispatcher):
        return cast("Callable[..., Any]", value.py_func)
    return None


def is_compiled(function: Callable[..., Any]) -> bool:
    """Whether a kernel's machine code is on disk, or cannot be kept there."""
    disk_cache = _disk_cache_of(function)
    if disk_cache is None:
        return True
    return bool(disk_cache._load_index())  # numba's table of the versions on disk


def compile_kernel(
    function: Callable[..., R], fastmath: set[str], **options: Any
) -> Callable[..., R]:
    """Compile a function by numba, with a disk cache that notices changes of what it uses.

    Numba keeps compiled functions on disk, and compiles again only if the function's own source
    file has changed. If a kernel or constant of another file, or an option, has changed, it would
    run the old machine code. So the stamp, by which numba knows the state of the source file, is
    extended by all that the function may use (`watch_globals`).

    Args:
        function: the function in Python.
        fastmath: names of LLVM's liberties with floating point numbers.
        options: further options of `numba.njit`.
    """
    compiled = numba.njit(
        cache=True, nogil=True, fastmath=fastmath, error_model="numpy", **options
    )(function)
    watch_globals(compiled, function, (sorted(fastmath), sorted(options.items())))
    return cast("Callable[..., R]", compiled)


def watch_globals(compiled: Any, function: Callable[..., Any], options: object = None) -> None:
    """Make numba compile again, in a new process, if what a function uses has changed.

    Args:
        compiled: what numba made of the function; it may lack a disk cache.
        function: the function in Python.
        options: a change of these compiles again, too.
    """
    # The stamp is a private attribute. Numba's public way, a cache locator, would not do: an
    # environment variable sets it for all packages, and it knows neither function nor options.
    disk_cache = _disk_cache_of(compiled)
    if disk_cache is not None:
        disk_cache._source_stamp = (
            disk_cache._source_stamp,
            _digest_of_globals(function),
            repr(options),
        )


def _digest_of_globals(function: Callable[..., Any]) -> str:
    """A hash of the numbers and kernels that a function's module defines or imports.

    The function may use any of them, so it must be compiled again if the hash changes. A kernel
    enters the hash by its own source stamp, which changes with its source and all that it uses.
    """
    stamps = []
    for name, value in sorted(function.__globals__.items()):
        if isinstance(value, Dispatcher):  # another kernel, compiled by numba
            source_stamp = getattr(_disk_cache_of(value), "_source_stamp", None)
            stamps.append((name, repr(source_stamp)))
        elif isinstance(value, (int, float, np.generic)):
            stamps.append((name, repr(value)))
    return hashlib.sha256(repr(stamps).encode()).hexdigest()


def _disk_cache_of(compiled: Any) -> Any:
    """Numba's internal disk cache of a kernel's machine code; None if the cache is off."""
    cache_file = getattr(getattr(compiled, "_cache", None), "_cache_file", None)
    return cache_file if hasattr(cache_file, "_source_stamp") else None
