"""Oracles for kernels of depth maps: plain Python, and SciPy's cheapest paths."""

from __future__ import annotations

import contextlib
import itertools
import math
from collections.abc import Callable, Iterator
from types import ModuleType

import numpy as np
import pytest

from spackle.lifting.edges import Bools

Pixel = tuple[int, int]


@contextlib.contextmanager
def uncompiled(*modules: ModuleType) -> Iterator[None]:
    """Run the kernels of these modules as plain Python, which checks indices."""
    with pytest.MonkeyPatch.context() as patch, np.errstate(all="ignore"):
        for module in modules:
            for name, value in vars(module).items():
                if hasattr(value, "py_func"):
                    patch.setattr(module, name, value.py_func)
        yield


def around(shape: tuple[int, ...], pixel: Pixel, reach: int = 1) -> list[Pixel]:
    """The pixels of an image within `reach` rows and columns."""
    rows, columns = (
        range(max(p - reach, 0), min(p + reach + 1, n)) for p, n in zip(pixel, shape, strict=False)
    )
    return list(itertools.product(rows, columns))


def cheapest(
    sources: Bools, targets: Bools, cost: Callable[[Pixel, Pixel], float]
) -> dict[Pixel, Pixel]:
    """For each target the source of its cheapest path; `cost` is added to the length of each
    step.
    """
    csgraph = pytest.importorskip("scipy.sparse.csgraph")
    pixels = list(np.ndindex(*targets.shape))
    number, steps = (
        {pixel: k for k, pixel in enumerate(pixels)},
        np.zeros((len(pixels), len(pixels))),
    )
    for p in pixels:
        for q in around(targets.shape, p):
            if targets[q] and p != q:
                steps[number[p], number[q]] = math.dist(p, q) + cost(p, q)
    *_, found = csgraph.dijkstra(
        steps, indices=np.flatnonzero(sources), return_predecessors=True, min_only=True
    )
    return {
        pixel: pixels[start]
        for pixel, start in zip(pixels, found.tolist(), strict=True)
        if start >= 0
    }
