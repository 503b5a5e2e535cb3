"""Lengths, quaternions and fractions as small integers, in the ways that formats share."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spackle.formats.gaussian_columns import Floats, GaussianColumns

# A length of 0 counts as this, so that no ratio divides by zero.
MIN_LENGTH = 1e-30

# Formats that round lengths suit scenes in metres. A scene is in an ordinary unit if the distance
# within which its nearest 1 % of Gaussians lie is between these bounds.
NEAR_QUANTILE = 0.01
ORDINARY_DISTANCES = (1 / 16, 256.0)

MAX_LENGTH_FACTOR = 2.0**100  # beyond, and below its inverse, float32 would be left
# Formats with a logarithmic scale store what is farther than this multiple of the nearest distance
# at this multiple, and smaller. From the places that a camera reaches, nothing moves by a pixel.
MAX_DISTANCE_RATIO = 2.0**17

# Row k: the indices of a quaternion's components other than component k.
OTHER_COMPONENTS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])


def near_distance(means: NDArray[Any]) -> float:
    """The distance from the origin within which the nearest 1 % of points [N, 3] lie; N > 0."""
    coordinates = means.astype(np.float64)
    distances = np.sqrt((coordinates * coordinates).sum(axis=1))
    near_index = int(NEAR_QUANTILE * len(distances))
    return float(np.partition(distances, near_index)[near_index])


def ordinary_length_factor(means: NDArray[Any]) -> float:
    """The factor that brings points [N, 3] to an ordinary unit of length: a power of two, often 1.

    Multiplied by it, the scene of a matchbox or of a mountain range is as large as one in metres.
    The picture from the origin stays the same, and numbers keep all their bits.
    """
    if len(means) == 0:
        return 1.0
    distance = near_distance(means)
    least, greatest = ORDINARY_DISTANCES
    is_ordinary = least <= distance <= greatest
    if is_ordinary or not 1 / MAX_LENGTH_FACTOR < distance < MAX_LENGTH_FACTOR:
        return 1.0
    return 2.0 ** -round(math.log2(distance))


def check_length_factor(factor: float) -> None:
    """Raise a ValueError for a factor of lengths that no file of ours has."""
    if not 1 / MAX_LENGTH_FACTOR <= factor <= MAX_LENGTH_FACTOR:
        raise ValueError(f"all lengths were multiplied by {factor:g}")


def shrink_distant(columns: GaussianColumns, max_coordinate: float) -> GaussianColumns:
    """Move Gaussians with a coordinate beyond `max_coordinate` towards the origin, until they fit.

    Position and size shrink by the same factor, so the view from the origin stays the same.
    """
    largest_coordinate = np.abs(columns.means).max(axis=1, initial=0).astype(np.float64)  # [N]
    factor = np.minimum(1, max_coordinate / np.maximum(largest_coordinate, MIN_LENGTH))[:, None]
    means = columns.means * factor
    log_scales = columns.log_scales + np.log(factor)
    return dataclasses.replace(
        columns, means=means.astype(np.float32), log_scales=log_scales.astype(np.float32)
    )


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
