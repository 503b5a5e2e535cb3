"""Read networks that Deep Compression has packed (Han et al., 2016), such as SqueezeNet's .net.

The file has, for all layers, the number of stored weights, [L] uint32. Then each layer has:

- a table of 256 values, float32;
- the biases, float32;
- for each stored weight the number of its value in the table, uint8;
- for each stored weight the number of zeros before it, 4 bits, the lower half of a byte first.

Weights between the stored ones are 0.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from spackle.runtime.errors import as_input_error
from spackle.runtime.files import check_file

Array = NDArray[Any]
Shape = tuple[int, ...]

TABLE_SIZE = 256  # values that a convolution's weights may have


def read_deep_compression(
    path: Path, shapes: Mapping[str, Shape], layer_count: int, advice: str
) -> dict[str, Array]:
    """The weights and biases of a network's first layers, as "NAME.w" and "NAME.b", float32.

    Args:
        path: the file.
        shapes: the shape of each layer's weights, by the layer's name, in the file's order; the
            first entry of a shape is the number of biases.
        layer_count: the number of layers in the file, of which `shapes` may lack the last ones.
        advice: what to do if the file cannot be used; the end of the message.

    Raises:
        InputError: the file is missing, or has not these layers.
    """
    check_file(path, "weight file")
    arrays = {}
    with (
        as_input_error(path, f"not a network of Deep Compression ({{reason}}): {advice}"),
        open(path, "rb") as file,
    ):
        # Weights that are 0 are not stored; each layer has a number of those that are.
        stored_counts = _read(file, np.dtype("<u4"), layer_count)
        # A layer has a table of the values that its weights share, its biases, and its weights.
        for (name, shape), stored_count in zip(shapes.items(), stored_counts, strict=False):
            table = _read(file, np.dtype("<f4"), TABLE_SIZE)
            arrays[f"{name}.b"] = _read(file, np.dtype("<f4"), shape[0])
            arrays[f"{name}.w"] = _read_weights(file, table, shape, int(stored_count))
    return arrays


def _read_weights(file: BinaryIO, table: Array, shape: Shape, stored_count: int) -> Array:
    """A layer's weights, float32, in the given shape; ValueError if they do not fit into it.

    Args:
        file: open where the layer's weights begin.
        table: [256] the values that weights may have.
        shape: of the result.
        stored_count: how many weights the file has; all others are 0.
    """
    value_numbers = _read(file, np.dtype("u1"), stored_count)  # which value of the table
    pairs = _read(file, np.dtype("u1"), (stored_count + 1) // 2)
    # How many zeros come before each stored weight. A byte has two such numbers, the lower half
    # first; the last half byte may be unused.
    zeros_before = np.stack([pairs % 16, pairs // 16], axis=-1).ravel()[:stored_count]

    # Each stored weight lies one place behind its zeros, and these behind the weight before.
    places = np.cumsum(zeros_before.astype(np.int64) + 1) - 1
    weight_count = int(np.prod(shape))
    if stored_count > 0 and places[-1] >= weight_count:
        raise ValueError("too many weights in a layer")
    # Weights that are not stored have the first value of the table, which is 0.
    value_number_of_weight = np.zeros(weight_count, np.uint8)
    value_number_of_weight[places] = value_numbers
    return np.asarray(table[value_number_of_weight].reshape(shape))


def _read(file: BinaryIO, dtype: np.dtype[Any], count: int) -> Array:
    """The next `count` numbers of a file; ValueError if it ends before."""
    content = file.read(count * dtype.itemsize)
    if len(content) < count * dtype.itemsize:
        raise ValueError("the file is cut off")
    return np.frombuffer(content, dtype)
