"""Oracles of the kernels of depth maps: SciPy's cheapest paths, plain Python."""

from __future__ import annotations

import contextlib
import itertools
import math
from collections.abc import Callable, Iterator
from types import ModuleType

import numpy as np
import pytest

from spackle.bases.edges import Bools

Pixel = tuple[int, int]


@contextlib.contextmanager
def uncompiled(*modules: ModuleType) -> Iterator[None]:
    """Run the kernels of some modules as the Python that they are written in, which checks every index."""
    with pytest.MonkeyPatch.context() as patch, np.errstate(all="ignore"):
        for module in modules:
            for name, value in vars(module).items():
                if hasattr(value, "py_func"):
                    patch.setattr(module, name, value.py_func)
        yield


def around(shape: tuple[int, ...], pixel: Pixel, reach: int = 1) -> list[Pixel]:
    """The pixels of an image within `reach` of one, itself among them."""
    rows, columns = (range(max(p - reach, 0), min(p + reach + 1, n)) for p, n in zip(pixel, shape, strict=False))
    return list(itertools.product(rows, columns))


def cheapest(sources: Bools, targets: Bools, cost: Callable[[Pixel, Pixel], float]) -> dict[Pixel, Pixel]:
    """The source that each target is cheapest to reach from, by SciPy; `cost` is that of a step between neighbours."""
    csgraph = pytest.importorskip("scipy.sparse.csgraph")
    pixels = list(np.ndindex(*targets.shape))
    number, steps = {pixel: k for k, pixel in enumerate(pixels)}, np.zeros((len(pixels), len(pixels)))
    for p in pixels:
        for q in around(targets.shape, p):
            if targets[q] and p != q:
                steps[number[p], number[q]] = math.dist(p, q) + cost(p, q)
    *_, found = csgraph.dijkstra(steps, indices=np.flatnonzero(sources), return_predecessors=True, min_only=True)
    return {pixel: pixels[start] for pixel, start in zip(pixels, found.tolist(), strict=True) if start >= 0}
