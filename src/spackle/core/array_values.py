"""Values that programs hold become plain arrays: PIL pictures, tensors, masked and foreign arrays.

`plain_array` is the one way in for photos and depth maps that come as values. No number loses
precision on it, and a mask keeps its meaning.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor
from torch.utils.dlpack import from_dlpack

from spackle.runtime.errors import InputError, as_input_error, short_repr

Array = NDArray[Any]

# The methods by which arrays of other packages (xarray, JAX, CuPy, TensorFlow, pandas) are read.
ARRAY_METHODS = ("__array__", "__dlpack__")


@dataclasses.dataclass(frozen=True)
class PlainArray:
    """An array of integers or floats in the machine's byte order."""

    numbers: Array  # of any shape; int, uint or float of at most 64 bits
    known: NDArray[np.bool_] | None  # of the same shape: false where a mask hides a number


def is_array_like(value: object) -> bool:
    """Whether `plain_array` takes a value: a PIL picture, a tensor, an array, or nested lists."""
    if isinstance(value, Image.Image | Tensor | np.ndarray | list | tuple):
        return True
    return any(hasattr(value, method) for method in ARRAY_METHODS)


def plain_array(value: Any, name: str | Path) -> PlainArray:
    """The numbers of a value that a program holds, without loss, and which of them are known.

    Args:
        value: a PIL picture (its stored numbers), a tensor on any device, a NumPy array, a masked
            array, nested lists, or an array of another package with `__array__` or `__dlpack__`.
        name: what the value is called in messages.

    Raises:
        InputError: the value has no numbers, or they are neither integers nor floats.
    """
    problem = f"{type(value).__name__} cannot be read as an array ({{reason}}): give an array"
    with as_input_error(name, problem):
        numbers, known = _numbers_and_mask(value)

    # NumPy has no bfloat16. JAX adds it as a type of bytes (kind V), which converts to float32.
    if numbers.dtype.kind == "V" and "float" in numbers.dtype.name:
        numbers = numbers.astype(np.float32)
    if numbers.dtype.kind not in "fiu":
        shape = short_repr(tuple(numbers.shape))
        raise InputError(f"{name}: an array of {numbers.dtype} {shape}: give integers or floats")

    # PyTorch takes neither another byte order nor floats of more than 64 bits.
    if numbers.dtype.itemsize > np.dtype(np.float64).itemsize:
        numbers = numbers.astype(np.float64)
    return PlainArray(numbers.astype(numbers.dtype.newbyteorder("="), copy=False), known)


def _numbers_and_mask(value: Any) -> tuple[Array, NDArray[np.bool_] | None]:
    """The numbers of a value as they are, and a mask that is true where they are known, if any."""
    if isinstance(value, Tensor):
        return _tensor_numbers(value), None
    if isinstance(value, np.ma.MaskedArray):
        hidden = np.ma.getmaskarray(value)
        return np.asarray(value.data), np.logical_not(hidden)
    # CuPy refuses `__array__`, because it would copy from the GPU; DLPack is its way.
    if not hasattr(value, "__array__") and hasattr(value, "__dlpack__"):
        return _tensor_numbers(from_dlpack(value)), None
    try:
        return np.asarray(value), None
    except TypeError:
        if not hasattr(value, "__dlpack__"):
            raise
        return _tensor_numbers(from_dlpack(value)), None


def _tensor_numbers(tensor: Tensor) -> Array:
    """The numbers of a tensor on any device; floats that NumPy lacks become float32."""
    tensor = tensor.detach().cpu().resolve_conj().resolve_neg()
    # NumPy has float16, but neither bfloat16 nor the floats of 8 bits.
    if tensor.is_floating_point() and tensor.dtype not in (
        torch.float16,
        torch.float32,
        torch.float64,
    ):
        tensor = tensor.float()
    if tensor.layout != torch.strided:
        tensor = tensor.to_dense()
    numbers: Array = tensor.numpy()
    return numbers


def without_unit_axes(array: Array, axis_count: int) -> Array:
    """The array with at most `axis_count` axes: others of length 1 are left out, from the front.

    A network's output [1, H, W] or [1, 1, H, W] and a picture [H, W, 1] thus become [H, W]. An
    array that has more longer axes keeps those.
    """
    while array.ndim > axis_count and 1 in array.shape:
        array = array.squeeze(array.shape.index(1))
    return array
