"""Kernels for the items of a list or the pixels of an image: one text for processor and GPU.

A body says what is computed for one item or pixel. Called with all tensors, the kernel runs for all
of them on the tensors' device: by several threads of the processor, or by numba's CUDA on a GPU
(kernels_on_gpu.py).
"""

from __future__ import annotations

import functools
import inspect
import math
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import torch
from torch import Tensor

from spackle.runtime.device import CHUNKS_PER_THREAD, parallel_for_chunks, thread_count
from spackle.runtime.kernels import FASTMATH, compile_kernel

MIN_CHUNK_ITEMS = 2048  # fewer items, or pixels, are not worth another thread

# The loops around a kernel for items or pixels, as the processor runs them. They are compiled from
# text, because numba keeps compiled code on disk only for functions that belong to a source file.
_LOOP_OVER_ITEMS = """
def {loop}(start, stop, {arguments}):
    for item in range(start, stop):
        {body}(item, {arguments})
"""
_LOOP_OVER_PIXELS = """
def {loop}(start, stop, columns, {arguments}):
    for row in range(start, stop):
        for column in range(columns):
            {body}(row, column, {arguments})
"""


class ParallelKernel:
    """Runs a function for all items of a list, or for all pixels of an image, in any order.

    It computes where the tensors among its arguments are. On the processor, several threads share
    the items, or the rows of pixels.
    """

    def __init__(self, body: Callable[..., None], loop: str, index_count: int) -> None:
        """Compile nothing yet; that happens at the first call.

        Args:
            body: what is computed for one item or pixel. Its first arguments are the item's number,
                or the pixel's row and column. Of the arrays, it may write only the elements of this
                item or pixel, because many run at the same time.
            loop: the text of the loop around it.
            index_count: 1 for items, 2 for pixels.
        """
        self.body = body
        self.index_count = index_count
        self.__name__ = body.__name__
        self.__doc__ = body.__doc__
        names = list(inspect.signature(body).parameters)
        loop_name = f"{body.__name__}_for_all"
        text = loop.format(
            loop=loop_name, body=body.__name__, arguments=", ".join(names[index_count:])
        )

        # The loop stands in the body's module and file, by which numba knows where its machine code
        # belongs on disk, and whether it is still the right one.
        # Numba's runtime ("nrt") would count at each call of the body who uses the arrays, which
        # takes longer than most bodies. Without it, a body can make no arrays of its own.
        inlined_body = compile_kernel(body, FASTMATH, forceinline=True, _nrt=False)
        module: dict[str, Any] = {"__name__": body.__module__, body.__name__: inlined_body}
        exec(compile(text, inspect.getfile(body), "exec"), module)
        self.loop: Callable[..., None] = compile_kernel(module[loop_name], FASTMATH, _nrt=False)

    def __call__(self, size: int | Sequence[int], *arguments: Any) -> None:
        """Run the body for all items or pixels.

        Args:
            size: the number of items; or the rows and columns of the image.
            arguments: what follows the index in the body: tensors, all on one device and contiguous
                in memory; named tuples of tensors and numbers; numbers.
        """
        shape = (size,) if isinstance(size, int) else tuple(size)
        device = next(tensor.device for tensor in _tensors(arguments))
        if device.type == "cuda":
            from spackle.runtime import kernels_on_gpu  # needs the extra cuda

            kernels_on_gpu.run(self.body, shape, arguments, device)
            return

        arrays = [_as_array(argument) for argument in arguments]
        columns = shape[1:]  # empty for items
        # Handing a chunk to another thread takes as long as computing some hundred items.
        items_a_row = math.prod(columns)
        chunk_length = max(
            math.ceil(shape[0] / (CHUNKS_PER_THREAD * thread_count())),
            math.ceil(MIN_CHUNK_ITEMS / max(items_a_row, 1)),
        )
        parallel_for_chunks(
            lambda start, stop: self.loop(start, stop, *columns, *arrays), shape[0], chunk_length
        )


def kernel_for_items(body: Callable[..., None]) -> ParallelKernel:
    """A function of one item's number, which then runs for all items of a list."""
    return ParallelKernel(body, _LOOP_OVER_ITEMS, index_count=1)


def kernel_for_pixels(body: Callable[..., None]) -> ParallelKernel:
    """A function of one pixel's row and column, which then runs for all pixels of an image."""
    return ParallelKernel(body, _LOOP_OVER_PIXELS, index_count=2)


def _tensors(arguments: Iterable[Any]) -> Iterator[Tensor]:
    """All tensors among a kernel's arguments, also those in named tuples."""
    for argument in arguments:
        if isinstance(argument, Tensor):
            yield argument
        elif isinstance(argument, tuple):
            yield from _tensors(argument)


def _as_array(argument: Any) -> Any:
    """A kernel's argument as numba takes it: tensors as arrays of the same memory."""
    if isinstance(argument, Tensor):
        return argument.numpy()
    if isinstance(argument, tuple):  # a named tuple, whose type has a constructor of its fields
        return type(argument)(*map(_as_array, argument))
    return argument


def device_for_kernels(device: torch.device) -> torch.device:
    """Where kernels for items and pixels compute, if torch's tensors are on the given device.

    That is the device itself, or the processor, if the device is a GPU on which numba's kernels do
    not run; a warning says why, once for each process.
    """
    if device.type != "cuda":
        return device
    reason = _reason_against_gpu(device)
    return device if reason is None else torch.device("cpu")


@functools.cache
def _reason_against_gpu(device: torch.device) -> str | None:
    """Why kernels do not run on a GPU, of which a warning is given; None if they do."""
    try:
        from spackle.runtime import kernels_on_gpu  # needs the extra cuda
    except ImportError as error:
        reason: str | None = f"{error}: pip install 'spackle-nvs[cuda]'"
    else:
        reason = kernels_on_gpu.reason_against(device)
    if reason is not None:
        warnings.warn(f"holes are filled on the processor, not on {device}: {reason}", stacklevel=2)
    return reason
