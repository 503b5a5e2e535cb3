"""Run kernels for items and pixels on an NVIDIA GPU, by numba's CUDA.

The same Python function that numba compiles for the processor (kernels.py) is compiled for CUDA
here, together with the kernels that it calls. Tensors are passed without a copy.

Without a GPU, numba's simulator runs the same code: NUMBA_ENABLE_CUDASIM=1.
"""

from __future__ import annotations

import functools
import inspect
import math
import os
import types
from collections.abc import Callable
from typing import Any

import numba
import numba.cuda
import torch
from torch import Tensor

from spackle.runtime.kernels import compiled_function, watch_globals

cuda: Any = numba.cuda  # without types
IS_SIMULATED = os.environ.get("NUMBA_ENABLE_CUDASIM") == "1"

THREADS_PER_BLOCK = 128  # four warps, which suits kernels with many registers
# A thread takes further items until none is left, so more blocks than this would not be faster: the
# largest GPUs run about 2,000 such blocks at a time.
MAX_BLOCKS = 1 << 14

# What one thread of the GPU does. It is compiled from text, as the processor's loops are, because
# numba keeps compiled code on disk only for functions that belong to a source file. The arguments
# come as one tuple.
_THREAD_FOR_ITEMS = """
def {thread}(count, columns, arguments):
    for item in range(cuda.grid(1), count, cuda.gridsize(1)):
        {body}(item, *arguments)
"""
_THREAD_FOR_PIXELS = """
def {thread}(count, columns, arguments):
    for pixel in range(cuda.grid(1), count, cuda.gridsize(1)):
        {body}(pixel // columns, pixel % columns, *arguments)
"""


def run(
    body: Callable[..., None],
    shape: tuple[int, ...],
    arguments: tuple[Any, ...],
    device: torch.device,
) -> None:
    """Run a kernel's body for all items or pixels, after all earlier work of torch on the device.

    The call returns at once; torch's later work on the device waits for the result.

    Args:
        body: the function of one item's number, or of one pixel's row and column.
        shape: (items,), or (rows, columns).
        arguments: of the body, after the index: tensors on the device, contiguous in memory; named
            tuples of tensors and numbers; numbers.
        device: a GPU.
    """
    count = math.prod(shape)
    if count == 0:
        return
    thread = gpu_thread(body, index_count=len(shape))
    block_count = min(math.ceil(count / THREADS_PER_BLOCK), MAX_BLOCKS)
    with torch.cuda.device(device):
        launch = thread[block_count, THREADS_PER_BLOCK, _current_stream()]
        launch(count, shape[-1], tuple(_as_device_array(argument) for argument in arguments))


def reason_against(device: torch.device) -> str | None:
    """Why kernels cannot run on a GPU; None if they can.

    A small kernel is compiled and run, because a driver may be too old for the compiler, which
    nothing but a trial shows.
    """
    try:
        numbers = torch.arange(4, device=device)
        doubled = torch.empty_like(numbers)
        run(_double, (len(numbers),), (numbers, doubled), device)
        is_right = bool((doubled == 2 * numbers).all())
    # Whatever fails within numba, its bindings or the driver is a reason.
    except Exception as error:
        return f"{type(error).__name__}: {error}".splitlines()[0]
    return None if is_right else "a kernel computed wrong numbers"


def _double(item: int, numbers: Any, doubled: Any) -> None:
    """Write twice the number of an item."""
    doubled[item] = 2 * numbers[item]


@functools.cache
def gpu_thread(body: Callable[..., None], index_count: int) -> Any:
    """A kernel's body compiled for CUDA, with a loop by which a thread takes several items.

    `index_count` is 1 for a body that takes an item's number, 2 for a pixel's row and column. The
    compiler runs at the first call, and keeps the machine code on disk.
    """
    text = _THREAD_FOR_ITEMS if index_count == 1 else _THREAD_FOR_PIXELS
    name = f"{body.__name__}_on_gpu"
    module = {"__name__": body.__module__, "cuda": cuda, body.__name__: gpu_function(body)}
    source = text.format(thread=name, body=body.__name__)
    exec(compile(source, inspect.getfile(body), "exec"), module)
    compiled = cuda.jit(cache=True)(module[name])
    watch_globals(compiled, body)
    return compiled


@functools.cache
def gpu_function(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function for kernels on a GPU to call, from one that numba compiles for the processor.

    The kernels of the processor that it calls are replaced by those of the GPU.
    """
    names = {}
    for name, value in function.__globals__.items():
        called = compiled_function(value)
        is_used = name in function.__code__.co_names
        names[name] = gpu_function(called) if called is not None and is_used else value
    copy = types.FunctionType(function.__code__, names, function.__name__, function.__defaults__)
    if IS_SIMULATED:  # the simulator's functions are Python's
        return copy
    compiled: Callable[..., Any] = cuda.jit(device=True)(copy)
    return compiled


def _as_device_array(argument: Any) -> Any:
    """A kernel's argument as numba takes it: tensors as arrays of the same memory on the GPU."""
    if isinstance(argument, Tensor):
        return cuda.as_cuda_array(argument.detach())
    if isinstance(argument, tuple):  # a named tuple, whose type has a constructor of its fields
        return type(argument)(*map(_as_device_array, argument))
    return argument


def _current_stream() -> Any:
    """The queue of torch's current work on the current GPU, as numba takes it."""
    pointer = torch.cuda.current_stream().cuda_stream
    # Torch's usual queue has the pointer 0, and is numba's default as well.
    return cuda.external_stream(pointer) if pointer else cuda.default_stream()
