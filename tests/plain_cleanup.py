"""Oracles of the kernels of depth maps: SciPy's cheapest paths, least squares, growth by rings, plain Python."""

from __future__ import annotations

import contextlib
import itertools
import math
from collections.abc import Callable, Iterator
from types import ModuleType

import numpy as np
import pytest

from spackle.bases import lift
from spackle.bases.edges import Bools, Floats
from spackle.surface import EDGE

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


def plain_planes(inverse: Floats, known: Bools, tolerance: float) -> Floats:
    """See `spackle.bases.lift.smooth_noise`: least squares on each neighbourhood."""
    result = inverse.copy()
    for y, x in itertools.product(*map(range, inverse.shape)):
        if not known[y, x]:
            continue
        near = [p for p in around(inverse.shape, (y, x), lift.RADIUS) if known[p]]
        rows = np.array([(1, u - x, v - y, inverse[v, u]) for v, u in near], float)
        plane = np.array([inverse[y, x], 0, 0], float)
        for fit in range(lift.FITS):
            steep = 0 if fit else EDGE * np.abs(rows[:, 1:3]).max(1)
            fits = rows[np.abs(rows[:, :3] @ plane - rows[:, 3]) <= (tolerance + steep) * inverse[y, x]]
            if len(fits) < lift.ENOUGH or np.linalg.matrix_rank(fits[:, :3]) < 3:
                break
            plane = np.linalg.lstsq(fits[:, :3], fits[:, 3], rcond=None)[0]
        if abs(plane[0] - inverse[y, x]) <= tolerance * inverse[y, x]:
            result[y, x] = plane[0]
    return result


def plain_flood(rgb: Floats, first_row: Bools, candidates: Bools) -> Bools:
    """See `spackle.bases.lift._flood`: growing by one ring at a time."""
    found = np.zeros(candidates.shape, bool)
    found[0] = first_row
    while True:
        grown = found.copy()
        for y, x in np.argwhere(candidates & ~found):
            for v, u in ((y - 1, x), (y + 1, x), (y, x - 1), (y, x + 1)):
                inside = 0 <= v < found.shape[0] and 0 <= u < found.shape[1]
                grown[y, x] |= inside and found[v, u] and np.abs(rgb[y, x] - rgb[v, u]).sum() <= lift.SMOOTH
        if (grown == found).all():
            return found
        found = grown
