"""A slow reference for `ray_tracer.trace`: one ray at a time, not compiled, in double precision."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray
from ray_tracer import BOX, ELLIPSOID, NUDGE, SHEET, Solid

Array = NDArray[Any]
# t, the texture's u and v, the normal in the unit shape's axes
Hit = tuple[float, float, float, Array]


def plain_trace(
    solids: list[Solid], textures: Array, rays: Array, light: Array, ambient: float, sky: Array
) -> tuple[Array, Array]:
    """Colours [N, 3] and distances [N], as from `trace`."""
    colors, distances = sky.astype(np.float64), np.full(len(rays), np.inf)
    for number, ray in enumerate(rays.astype(np.float64)):
        seen = [
            (*hit, solid)
            for solid in solids
            if (hit := first_hit(solid, textures, np.zeros(3), ray, 0.05))
        ]
        if not seen:
            continue
        t, u, v, direction, solid = min(seen, key=lambda hit: hit[0])
        normal = np.linalg.inv(solid.axes.astype(np.float64)).T @ direction
        normal *= -np.sign(normal @ ray) / np.linalg.norm(normal)
        shine = max(0.0, float(normal @ light))
        start = (1 - NUDGE) * t * ray
        if any(
            other.casts and first_hit(other, textures, start, light, NUDGE * t) for other in solids
        ):
            shine = 0.0
        colors[number] = (ambient + (1 - ambient) * shine) * between_pixels(
            textures[solid.texture], u, v
        )
        distances[number] = t
    return colors, distances


def first_hit(solid: Solid, textures: Array, start: Array, ray: Array, beyond: float) -> Hit | None:
    """A ray's first hit of a solid beyond `beyond`, where the texture covers it; None if there is
    none.
    """
    axes = solid.axes.astype(np.float64)
    o, d = np.linalg.solve(axes, start - solid.center), np.linalg.solve(axes, ray)
    hits = sorted(unit_hits(solid.kind, o, d), key=lambda hit: hit[0])
    if solid.kind == BOX:
        hits = hits[:1]  # a box is invisible from inside
    for t, u, v, normal in hits:
        if t > beyond:
            u, v = (u * solid.repeats[0]) % 1.0, (v * solid.repeats[1]) % 1.0
            texture = textures[solid.texture]
            row, column = (min(int(part * len(texture)), len(texture) - 1) for part in (v, u))
            return (t, u, v, normal) if texture[row, column, 3] >= 0.5 else None
    return None


def unit_hits(kind: int, o: Array, d: Array) -> Iterator[Hit]:
    """Yield all hits of a line with a unit shape."""
    if kind == SHEET:
        if d[2]:
            x, y, _ = o - o[2] / d[2] * d
            if max(abs(x), abs(y)) <= 1:
                yield -o[2] / d[2], (x + 1) / 2, (y + 1) / 2, np.array([0.0, 0.0, 1.0])
    elif kind == BOX:
        for axis in range(3):
            p, q = (axis + 1) % 3, (axis + 2) % 3
            for face in (-1, 1):
                t = (face - o[axis]) / d[axis] if d[axis] else math.inf
                place = o + t * d if d[axis] else o
                if d[axis] and max(abs(place[p]), abs(place[q])) <= 1:
                    yield t, (place[p] + 1) / 2, (place[q] + 1) / 2, np.eye(3)[axis]
    else:
        across = np.array([1.0, 1.0 if kind == ELLIPSOID else 0.0, 1.0])
        a, b, c = across @ (d * d), 2 * across @ (o * d), across @ (o * o) - 1
        if b * b <= 4 * a * c:
            return
        for t in np.roots([a, b, c]):
            place = o + t * d
            if abs(place[1]) <= 1:
                yield (
                    t,
                    math.atan2(place[2], place[0]) / (2 * math.pi) + 0.5,
                    (place[1] + 1) / 2,
                    across * place,
                )


def between_pixels(texture: Array, u: float, v: float) -> Array:
    """[3] the colour, interpolated between the four nearest pixels."""
    x, y = u * (len(texture) - 1), v * (len(texture) - 1)
    left, top = int(x), int(y)
    total = np.zeros(3)
    for row, height in ((top, 1 - (y - top)), (min(top + 1, len(texture) - 1), y - top)):
        for column, width in ((left, 1 - (x - left)), (min(left + 1, len(texture) - 1), x - left)):
            total += height * width * texture[row, column, :3]
    return total
