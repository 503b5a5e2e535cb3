"""A palette of vectors: similar vectors are grouped, and each group shares one entry."""

from __future__ import annotations

import heapq

import numpy as np
from numpy.typing import NDArray

from spackle.formats.gaussian_columns import Floats
from spackle.runtime.kernels import Array, reordering_kernel

POWER_ITERATIONS = 3  # towards a group's principal axis; it need not be exact


def palette_labels(vectors: Floats, max_count: int) -> NDArray[np.int64]:
    """The number [N], below `max_count`, of the group to which each of the vectors [N, D] belongs.

    Vectors of a group are similar. All begin as one group. Again and again, the group with the
    largest sum of squared distances from its mean is divided: at its mean, across its principal
    axis. Equal vectors stay together.
    """
    rows = np.array(vectors, np.float32, order="C")  # sorted by group, step by step
    order = np.arange(len(rows))  # of each row, the vector that it is
    labels = np.zeros(len(rows), np.int64)
    # Groups that can be divided, the one with the largest error first: its negative error, number,
    # first row and end.
    groups = [(-np.inf, 0, 0, len(rows))]
    count = 1
    while groups and count < max_count:
        _, number, start, stop = heapq.heappop(groups)
        middle, left_error, right_error = divide_rows(rows[start:stop], order[start:stop])
        if middle in (0, stop - start):  # all vectors are equal
            continue
        labels[start + middle : stop] = count
        heapq.heappush(groups, (-left_error, number, start, start + middle))
        heapq.heappush(groups, (-right_error, count, start + middle, stop))
        count += 1
    result = np.empty(len(rows), np.int64)
    result[order] = labels
    return result


@reordering_kernel
def divide_rows(rows: Array, order: Array) -> tuple[int, float, float]:
    """Sort rows [n, D] into two parts, below and above their mean along their principal axis.

    Args:
        rows: float32, sorted in place.
        order: [n], sorted in the same way.

    Returns:
        The first row of the second part, and of each part the sum of squared distances from its
        mean. If all rows are equal, the first part has all of them or none.
    """
    count, width = rows.shape
    mean = np.zeros(width, np.float32)
    for i in range(count):
        for d in range(width):
            mean[d] += rows[i, d]
    for d in range(width):
        mean[d] /= np.float32(count)

    # The first guess of the axis: from the mean to the vector that is farthest from it.
    farthest = 0
    largest = np.float32(-1)
    for i in range(count):
        squared = np.float32(0)
        for d in range(width):
            difference = rows[i, d] - mean[d]
            squared += difference * difference
        if squared > largest:
            largest = squared
            farthest = i
    axis = rows[farthest] - mean

    # A multiplication by the covariance turns the axis towards the principal one.
    for _ in range(POWER_ITERATIONS):
        product = np.zeros(width, np.float32)
        for i in range(count):
            along = np.float32(0)
            for d in range(width):
                along += (rows[i, d] - mean[d]) * axis[d]
            for d in range(width):
                product[d] += along * (rows[i, d] - mean[d])
        size = np.float32(0)
        for d in range(width):
            size = max(size, abs(product[d]))
        if size == 0:
            break
        for d in range(width):
            axis[d] = product[d] / size

    # Rows above the mean change places with rows below it that come later.
    low = 0
    high = count
    while low < high:
        along = np.float32(0)
        for d in range(width):
            along += (rows[low, d] - mean[d]) * axis[d]
        if along <= 0:
            low += 1
            continue
        high -= 1
        for d in range(width):
            value = rows[low, d]
            rows[low, d] = rows[high, d]
            rows[high, d] = value
        vector = order[low]
        order[low] = order[high]
        order[high] = vector
    return low, squared_error(rows[:low]), squared_error(rows[low:])


@reordering_kernel
def squared_error(rows: Array) -> float:
    """The sum of squared distances of rows [n, D] from their mean."""
    count, width = rows.shape
    mean = np.zeros(width, np.float32)
    for i in range(count):
        for d in range(width):
            mean[d] += rows[i, d]
    total = 0.0
    for d in range(width):
        mean[d] /= np.float32(max(count, 1))
    for i in range(count):
        squared = np.float32(0)
        for d in range(width):
            difference = rows[i, d] - mean[d]
            squared += difference * difference
        total += float(squared)
    return total
