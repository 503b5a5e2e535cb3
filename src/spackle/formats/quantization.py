"""Quaternions and fractions as small integers, in the ways that several formats share."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from spackle.formats.gaussian_columns import Floats

# Row k: the indices of a quaternion's components other than component k.
OTHER_COMPONENTS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])


def encode_smallest_three(quats: Floats) -> tuple[NDArray[np.int64], Floats]:
    """Split unit quaternions [N, 4] into the index of the largest component, and the others.

    The largest component need not be stored: it is made positive, which does not change the
    rotation, and follows from the other three, because the squares of all four sum to 1.

    Returns:
        The indices [N] of the largest components, and the other components [N, 3] in their
        order; each is between -√½ and √½.
    """
    largest = np.abs(quats).argmax(axis=1)  # [N]
    largest_value = np.take_along_axis(quats, largest[:, None], axis=1)  # [N, 1]
    sign = np.where(largest_value < 0, np.float32(-1), np.float32(1))
    other_columns = OTHER_COMPONENTS[largest]  # [N, 3], the indices of the other components
    others = np.take_along_axis(quats * sign, other_columns, axis=1)  # [N, 3]
    return largest, others


def decode_smallest_three(largest: NDArray[Any], others: Floats) -> Floats:
    """Return unit quaternions [N, 4]; the inverse of `encode_smallest_three`.

    Args:
        largest: [N] index of each quaternion's largest component.
        others: [N, 3] the other components, in their order.
    """
    quats = np.empty((len(others), 4), np.float32)
    other_columns = OTHER_COMPONENTS[largest]  # [N, 3]
    np.put_along_axis(quats, other_columns, others, axis=1)
    # The four squares sum to 1. After rounding, three of them may sum to a little more.
    largest_value = np.sqrt(np.maximum(0, 1 - np.square(others).sum(axis=1)))  # [N]
    largest_column = largest[:, None].astype(np.int64)  # [N, 1]
    np.put_along_axis(quats, largest_column, largest_value[:, None], axis=1)
    return quats


def components_to_fractions(components: Floats) -> Floats:
    """Map quaternion components from -√½..√½, the range of the smaller three, to 0..1."""
    fractions: Floats = np.clip(components * np.float32(0.5**0.5) + np.float32(0.5), 0, 1)
    return fractions


def fractions_to_components(fractions: Floats) -> Floats:
    """Map fractions 0..1 to quaternion components in -√½..√½."""
    return (fractions - np.float32(0.5)) * np.float32(2**0.5)


def codes_to_fractions(codes: NDArray[Any], largest_code: int) -> Floats:
    """Map integers from 0 to `largest_code` to floats in 0..1."""
    return codes.astype(np.float32) / np.float32(largest_code)
