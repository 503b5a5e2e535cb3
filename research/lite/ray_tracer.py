"""Render simple solids with exact depth, one ray for each sample.

Unlike splats, rays do not blur depth at outlines.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spackle.runtime.kernels import kernel

Floats = NDArray[np.float32]
SHEET, BOX, ELLIPSOID, CYLINDER = range(4)
FAR = 1e6
NUDGE = 1e-3  # relative distance from the surface at which a shadow ray starts


@dataclasses.dataclass(frozen=True)
class Solid:
    """A placed unit shape: sheet |x|, |y| ≤ 1 at z = 0; cube |x|, |y|, |z| ≤ 1; ball, or tube |y| ≤
    1, of radius 1.
    """

    kind: int
    center: Floats  # [3] metres
    axes: Floats  # [3, 3] columns: the unit shape's axes in the world, in metres
    texture: int  # index of the texture
    repeats: tuple[float, float]  # how often the texture repeats along its two sides
    casts: bool = True  # whether it casts a shadow


def trace(
    solids: list[Solid], textures: Floats, rays: Floats, light: Floats, ambient: float, sky: Floats
) -> tuple[Floats, Floats]:
    """Trace rays from the origin.

    Args:
        solids: the solids of the scene.
        textures: [T, S, S, 4] colours 0..1 and coverage; rays pass through coverage below 0.5.
        rays: [N, 3] directions; distances are in units of their length.
        light: [3] unit vector towards the light.
        ambient: share of ambient light.
        sky: [N, 3] colours of rays that hit nothing.

    Returns:
        Colours [N, 3] and distances [N], inf for rays that hit nothing.
    """
    inverse = np.stack([np.linalg.inv(s.axes) for s in solids]).astype(np.float32)
    kinds = np.array([s.kind for s in solids])
    centers = np.stack([s.center for s in solids]).astype(np.float32)
    skins = np.array([s.texture for s in solids])
    repeats = np.array([s.repeats for s in solids], np.float32)
    casts = np.array([s.casts for s in solids])
    # squared bounding radii
    around = 1.001 * np.array([(s.axes.astype(np.float64) ** 2).sum() for s in solids])
    colors, distances = sky.astype(np.float32).copy(), np.full(len(rays), np.inf, np.float32)
    _trace(
        kinds,
        centers,
        inverse,
        skins,
        repeats,
        casts,
        around,
        textures,
        rays,
        light,
        ambient,
        colors,
        distances,
    )
    return colors, distances


@kernel
def _hit(kind: int, o: Any, d: Any, nearest: float, found: Any) -> Any:
    """The t > `nearest` at which a ray o + t·d hits a unit shape, or FAR; writes u, v and the
    normal to `found`.
    """
    if kind == SHEET:
        if d[2] == 0.0:
            return FAR
        t = -o[2] / d[2]
        x, y = o[0] + t * d[0], o[1] + t * d[1]
        if t <= nearest or abs(x) > 1.0 or abs(y) > 1.0:
            return FAR
        found[0], found[1], found[2], found[3], found[4] = (x + 1) / 2, (y + 1) / 2, 0.0, 0.0, 1.0
        return t
    if kind == BOX:
        enter, leave, axis = -FAR, FAR, 0
        for k in range(3):
            if d[k] == 0.0:
                if abs(o[k]) > 1.0:
                    return FAR
                continue
            a, b = (-1.0 - o[k]) / d[k], (1.0 - o[k]) / d[k]
            if a > b:
                a, b = b, a
            if a > enter:
                enter, axis = a, k
            leave = min(leave, b)
        if enter > leave or enter <= nearest:
            return FAR
        p, q = (axis + 1) % 3, (axis + 2) % 3
        found[0], found[1] = (o[p] + enter * d[p] + 1) / 2, (o[q] + enter * d[q] + 1) / 2
        found[2], found[3], found[4] = 0.0, 0.0, 0.0
        found[2 + axis] = 1.0
        return enter
    # A ball, or a tube, for which y is ignored.
    w = 1.0 if kind == ELLIPSOID else 0.0
    a = d[0] * d[0] + w * d[1] * d[1] + d[2] * d[2]
    b = o[0] * d[0] + w * o[1] * d[1] + o[2] * d[2]
    c = o[0] * o[0] + w * o[1] * o[1] + o[2] * o[2] - 1.0
    root = b * b - a * c
    if root <= 0.0 or a == 0.0:
        return FAR
    for sign in range(2):
        t = (-b + (2 * sign - 1) * math.sqrt(root)) / a
        y = o[1] + t * d[1]
        if t > nearest and abs(y) <= 1.0:
            x, z = o[0] + t * d[0], o[2] + t * d[2]
            found[0], found[1] = math.atan2(z, x) / (2 * math.pi) + 0.5, (y + 1) / 2
            found[2], found[3], found[4] = x, w * y, z
            return t
    return FAR


@kernel
def _covered(textures: Any, skin: int, u: float, v: float) -> Any:
    size = textures.shape[1]
    return (
        textures[
            skin, min(int((v % 1.0) * size), size - 1), min(int((u % 1.0) * size), size - 1), 3
        ]
        >= 0.5
    )


@kernel
def _near(center: Any, start: Any, ray: Any, around: float) -> Any:
    """Whether the line start + t·ray passes a centre at most at the distance √`around`."""
    x, y, z = center[0] - start[0], center[1] - start[1], center[2] - start[2]
    along = x * ray[0] + y * ray[1] + z * ray[2]
    return (x * x + y * y + z * z - around) * (
        ray[0] ** 2 + ray[1] ** 2 + ray[2] ** 2
    ) <= along * along


@kernel
def _trace(
    kinds: Any,
    centers: Any,
    inverse: Any,
    skins: Any,
    repeats: Any,
    casts: Any,
    around: Any,
    textures: Any,
    rays: Any,
    light: Any,
    ambient: float,
    colors: Any,
    distances: Any,
) -> None:
    size = textures.shape[1]
    o, d, found, best = np.empty(3), np.empty(3), np.empty(5), np.empty(5)
    start, normal, eye = np.empty(3), np.empty(3), np.zeros(3)
    for i in range(len(rays)):
        nearest, which = FAR, -1
        for s in range(len(kinds)):
            if not _near(centers[s], eye, rays[i], around[s]):
                continue
            for k in range(3):
                o[k] = -(
                    inverse[s, k, 0] * centers[s, 0]
                    + inverse[s, k, 1] * centers[s, 1]
                    + inverse[s, k, 2] * centers[s, 2]
                )
                d[k] = (
                    inverse[s, k, 0] * rays[i, 0]
                    + inverse[s, k, 1] * rays[i, 1]
                    + inverse[s, k, 2] * rays[i, 2]
                )
            t = _hit(kinds[s], o, d, 0.05, found)
            if t < nearest and _covered(
                textures, skins[s], found[0] * repeats[s, 0], found[1] * repeats[s, 1]
            ):
                nearest, which = t, s
                best[:] = found
        if which < 0:
            continue
        distances[i] = nearest
        # The surface's normal, flipped towards the eye.
        facing, length, lit = 0.0, 0.0, 0.0
        for k in range(3):
            normal[k] = (
                inverse[which, 0, k] * best[2]
                + inverse[which, 1, k] * best[3]
                + inverse[which, 2, k] * best[4]
            )
            length += normal[k] * normal[k]
            facing += normal[k] * rays[i, k]
            lit += normal[k] * light[k]
            start[k] = nearest * (1 - NUDGE) * rays[i, k]
        lit = -lit if facing > 0 else lit
        shine = max(0.0, lit / math.sqrt(length))
        if shine > 0.0:
            for s in range(len(kinds)):
                if not casts[s] or not _near(centers[s], start, light, around[s]):
                    continue
                for k in range(3):
                    o[k], d[k] = 0.0, 0.0
                    for m in range(3):
                        o[k] += inverse[s, k, m] * (start[m] - centers[s, m])
                        d[k] += inverse[s, k, m] * light[m]
                t = _hit(kinds[s], o, d, NUDGE * nearest, found)
                if t < FAR and _covered(
                    textures, skins[s], found[0] * repeats[s, 0], found[1] * repeats[s, 1]
                ):
                    shine = 0.0
                    break
        shade = ambient + (1 - ambient) * shine
        # The texture, interpolated between the four nearest pixels.
        x, y = (
            ((best[0] * repeats[which, 0]) % 1.0) * (size - 1),
            ((best[1] * repeats[which, 1]) % 1.0) * (size - 1),
        )
        left, top = int(x), int(y)
        fx, fy = x - left, y - top
        right, bottom = min(left + 1, size - 1), min(top + 1, size - 1)
        for k in range(3):
            upper = (
                textures[skins[which], top, left, k] * (1 - fx)
                + textures[skins[which], top, right, k] * fx
            )
            lower = (
                textures[skins[which], bottom, left, k] * (1 - fx)
                + textures[skins[which], bottom, right, k] * fx
            )
            colors[i, k] = shade * (upper * (1 - fy) + lower * fy)
