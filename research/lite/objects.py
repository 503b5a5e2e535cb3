"""Solids of synthetic scenes, and objects that consist of several solids."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from ray_tracer import BOX, CYLINDER, ELLIPSOID, SHEET, Floats, Solid
from textures import CUT, LATTICE, LEAVES, PEAK, RING, WHOLE

Array = NDArray[Any]
Rng = np.random.Generator
UP = np.array([0.0, -1.0, 0.0])  # y points down


def turn(yaw: float) -> Array:
    """[3, 3] rotation around the vertical."""
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def nod(pitch: float) -> Array:
    """[3, 3] rotation around the axis to the right."""
    c, s = math.cos(pitch), math.sin(pitch)
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


def lean(roll: float) -> Array:
    """[3, 3] rotation around the optical axis."""
    c, s = math.cos(roll), math.sin(roll)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def anyhow(rng: Rng) -> Array:
    """[3, 3] rotation around the vertical by a random angle."""
    return turn(rng.uniform(-math.pi, math.pi))


def solid(
    rng: Rng,
    kind: int,
    center: Array,
    axes: Array,
    texture: int | None = None,
    *,
    casts: bool = True,
) -> Solid:
    """A solid; None as `texture` means a random texture without gaps."""
    skin = int(rng.integers(WHOLE)) if texture is None else texture
    many = (2.0, 1.0) if kind in (ELLIPSOID, CYLINDER) else (1.0, 1.0)
    return Solid(kind, _f(center), _f(axes), skin, many, casts)


def wall(rng: Rng, center: Array, axes: Array, across: float, up: float) -> Solid:
    """A sheet that casts no shadow; `across` and `up` are half its width and height."""
    return solid(rng, SHEET, center, axes @ np.diag([across, up, 1.0]), casts=False)


def ground(
    rng: Rng, axes: Array, center: Array, wide: float, deep: float, repeats: float = 3.0
) -> Solid:
    """A level sheet: floor, table or ceiling."""
    many = float(rng.uniform(1, repeats))
    level = axes @ nod(math.pi / 2) @ np.diag([wide, deep, 1.0])
    return Solid(
        SHEET, _f(axes @ center), _f(level), int(rng.integers(WHOLE)), (many, many), casts=False
    )


def cut(rng: Rng) -> int:
    """The index of a random texture with an outline."""
    return WHOLE + int(rng.integers(CUT))


def pole(
    rng: Rng, foot: Array, tall: float, thick: float, axes: Array, texture: int | None = None
) -> Solid:
    """A round post from a foot upwards, in the upward direction of `axes`."""
    return solid(
        rng,
        CYLINDER,
        foot + axes @ UP * tall / 2,
        axes @ np.diag([thick, tall / 2, thick]),
        texture,
    )


def _f(value: object) -> Floats:
    return np.asarray(value, np.float32)


Triple = tuple[float, float, float]


def thing(rng: Rng, foot: Array, size: float, yaw: float) -> list[Solid]:
    """An object like furniture: a box, perhaps with more on top, a table, a ball, a tube or a
    cut-out.
    """
    wide, deep, tall = (
        size * rng.uniform(0.4, 1.3),
        size * rng.uniform(0.3, 1.2),
        size * rng.uniform(0.3, 1.6),
    )
    axes, choice = turn(yaw), rng.random()
    if choice < 0.4:
        body = [solid(rng, BOX, foot + tall * UP, axes @ np.diag([wide, tall, deep]))]
        if rng.random() < 0.4:
            body += thing(rng, foot + 2 * tall * UP, 0.5 * size, rng.uniform(-math.pi, math.pi))
        return body
    if choice < 0.55:  # a top and four legs
        top = solid(rng, BOX, foot + 1.9 * tall * UP, axes @ np.diag([wide, 0.1 * tall, deep]))
        corners = (
            (a * 0.85 * wide, -0.9 * tall, b * 0.85 * deep) for a in (-1, 1) for b in (-1, 1)
        )
        leg = axes @ np.diag([0.06 * wide, 0.9 * tall, 0.06 * wide])
        return [
            top,
            *(solid(rng, BOX, foot + axes @ np.array(c), leg, top.texture) for c in corners),
        ]
    if choice < 0.7:
        return [solid(rng, ELLIPSOID, foot + tall * UP, axes @ np.diag([wide, tall, deep]))]
    if choice < 0.82:
        return tube(rng, foot, 0.6 * min(wide, deep), 2 * tall)
    return [
        solid(
            rng,
            SHEET,
            foot + tall * UP,
            turn(rng.normal(0, 0.4)) @ np.diag([wide, tall, 1.0]),
            cut(rng),
        )
    ]


def tube(rng: Rng, foot: Array, thick: float, tall: float) -> list[Solid]:
    """A round tin with its lid."""
    lid = solid(
        rng, SHEET, foot + tall * UP, nod(math.pi / 2) @ np.diag([0.7 * thick, 0.7 * thick, 1.0])
    )
    return [pole(rng, foot, tall, thick, np.eye(3)), lid]


def books(rng: Rng, foot: Array, size: float) -> list[Solid]:
    """Books, either upright side by side, a little askew, or in a pile."""
    axes, count = turn(rng.normal(0, 0.5)), int(rng.integers(1, 6))
    made, along = [], 0.0
    if rng.random() < 0.5:
        for _ in range(count):
            thick, tall, deep = (
                size * rng.uniform(0.06, 0.25),
                size * rng.uniform(0.7, 1.2),
                size * rng.uniform(0.5, 1),
            )
            if count == 1 or rng.random() < 0.15:  # the cover faces the front
                thick, deep = 0.8 * tall, thick
            tilt = lean(rng.normal(0, 0.08)) @ nod(rng.normal(0, 0.06))
            center = (
                foot + axes @ np.array([along + thick, 0.0, 0.3 * size * rng.random()]) + tall * UP
            )
            made.append(solid(rng, BOX, center, axes @ tilt @ np.diag([thick, tall, deep])))
            along += 2.05 * thick
        return made
    for _ in range(count):
        thick = size * rng.uniform(0.06, 0.25)
        flat = turn(rng.normal(0, 0.4)) @ np.diag(
            [size * rng.uniform(0.6, 1.1), thick, size * rng.uniform(0.5, 0.9)]
        )
        made.append(solid(rng, BOX, foot + (along + thick) * UP, axes @ flat))
        along += 2 * thick
    return made


def bottle(rng: Rng, foot: Array, size: float) -> list[Solid]:
    """A pin, vase or bottle: round, with a neck, sometimes with a ball on top."""
    thick, tall = size * rng.uniform(0.2, 0.6), size * rng.uniform(0.5, 1.2)
    body = solid(rng, ELLIPSOID, foot + tall * UP, np.diag([thick, tall, thick]))
    neck = pole(
        rng, foot + 1.4 * tall * UP, tall, rng.uniform(0.3, 0.6) * thick, np.eye(3), body.texture
    )
    head = solid(
        rng,
        ELLIPSOID,
        foot + 2.4 * tall * UP,
        np.eye(3) * thick * rng.uniform(0.6, 1),
        body.texture,
    )
    return [body, neck, head][: int(rng.integers(1, 4))]


def doll(rng: Rng, foot: Array, size: float) -> list[Solid]:
    """A doll with body, head and limbs."""
    axes, skin = turn(rng.normal(0, 0.6)) @ lean(rng.normal(0, 0.25)), int(rng.integers(WHOLE))
    body, head = (
        ((0.0, -0.6, 0.0), (0.5, 0.6, 0.4), None),
        ((0.0, -1.5, 0.0), (0.4, 0.45, 0.4), skin),
    )
    parts: list[tuple[Triple, Triple, int | None]] = [body, head]
    parts += [
        ((a * rng.uniform(0.3, 0.6), b, -0.3), (0.15, 0.4, 0.15), skin)
        for a in (-1, 1)
        for b in (-0.8, -0.2)
    ]
    return [
        solid(
            rng,
            ELLIPSOID,
            foot + axes @ np.array(place) * size,
            axes @ np.diag(radii) * size,
            texture,
        )
        for place, radii, texture in parts[: int(rng.integers(2, 7))]
    ]


def plant(rng: Rng, foot: Array, size: float) -> list[Solid]:
    """A plant: a pot, thin stems, leaves with gaps between them."""
    made = [pole(rng, foot, 0.6 * size, 0.35 * size, np.eye(3))]
    for _ in range(rng.integers(2, 7)):
        axes, tall = (
            turn(rng.uniform(-3, 3)) @ lean(rng.normal(0, 0.35)),
            size * rng.uniform(0.6, 1.8),
        )
        made.append(pole(rng, foot + 0.5 * size * UP, tall, 0.03 * size, axes))
        crown, wide = foot + 0.5 * size * UP + axes @ UP * tall, size * rng.uniform(0.2, 0.6)
        made.append(
            solid(
                rng, SHEET, crown, turn(rng.normal(0, 0.6)) @ nod(rng.normal(0, 0.4)) * wide, LEAVES
            )
        )
    return made


def sticks(rng: Rng, foot: Array, size: float) -> list[Solid]:
    """Pens in a cup: thin, leaning, at different depths."""
    cup = pole(rng, foot, 0.8 * size, 0.3 * size, np.eye(3))
    tilts = (turn(rng.uniform(-3, 3)) @ lean(rng.normal(0, 0.3)) for _ in range(rng.integers(1, 6)))
    return [
        cup,
        *(pole(rng, foot, size * rng.uniform(1.2, 2.2), 0.04 * size, axes) for axes in tilts),
    ]


def flat(rng: Rng, foot: Array, size: float) -> list[Solid]:
    """An upright cut-out: a cone, a ring, a lattice, or the outline of an object."""
    texture = int(rng.choice((PEAK, PEAK, RING, LATTICE, cut(rng))))
    wide, tall = size * rng.uniform(0.4, 1.0), size * rng.uniform(0.5, 1.2)
    axes = turn(rng.normal(0, 0.5)) @ nod(rng.normal(0, 0.15))
    return [solid(rng, SHEET, foot + tall * UP, axes @ np.diag([wide, tall, 1.0]), texture)]


ORNAMENTS: tuple[Callable[[Rng, Array, float], list[Solid]], ...] = (
    books,
    bottle,
    doll,
    plant,
    sticks,
    flat,
)


def ornament(rng: Rng, foot: Array, size: float) -> list[Solid]:
    """A random small object for tables and shelves, about `size` wide to each side."""
    if (choice := int(rng.integers(len(ORNAMENTS) + 2))) < len(ORNAMENTS):
        return ORNAMENTS[choice](rng, foot, size)
    return thing(rng, foot, size, rng.uniform(-math.pi, math.pi))
