"""Made still lifes, heaps and shelves: many things close together, seen from a camera at the origin."""

from __future__ import annotations

import math

import numpy as np

from spackle.training.depth.indoors import Scene, board
from spackle.training.depth.raycast import BOX, SHEET, Solid
from spackle.training.depth.shapes import UP, Array, Rng, cut, ground, lean, nod, pole, solid, turn, wall
from spackle.training.depth.skins import LATTICE, WHOLE
from spackle.training.depth.things import books, bottle, doll, flat, ornament, thing, tube


def still_life(rng: Rng) -> Scene:
    """Many things close together on a table, nearly at the height of the eye, before boards and cloth."""
    reach = rng.uniform(0.9, 2.2)
    eye, near = reach * rng.uniform(0.12, 0.45), reach * rng.uniform(0.45, 0.7)
    solids = [board(rng, reach * 1.02, 0.25, 0.08), ground(rng, np.eye(3), np.array([0.0, eye, 0.0]), 4.0, reach)]
    for _ in range(rng.integers(0, 4)):  # posters and cartons just before what is behind
        z = reach * rng.uniform(0.8, 1.0)
        half = reach * rng.uniform(0.1, 0.45, 2)
        x, hung = rng.uniform(-0.5, 0.5) * z, rng.random() < 0.5
        foot = np.array([x, eye - (reach * rng.uniform(0, 0.4) if hung else 0.0), z])
        axes = turn(rng.normal(0, 0.35)) @ nod(rng.normal(0, 0.12)) @ lean(rng.normal(0, 0.06))
        skin = None if rng.random() < 0.7 else cut(rng) if rng.random() < 0.5 else LATTICE
        solids.append(solid(rng, SHEET, foot + half[1] * UP, axes @ np.diag([*half, 1.0]), skin))
    if rng.random() < 0.35:
        solids += _cloth(rng, eye, reach * rng.uniform(0.6, 0.95))
    for _ in range(rng.integers(5, 19)):
        z = rng.uniform(near, 0.97 * reach)
        foot = np.array([rng.uniform(-0.55, 0.55) * z, eye, z])
        solids += ornament(rng, foot, z * rng.uniform(0.05, 0.2))
    return solids, math.radians(rng.uniform(-4, 34))


def heap(rng: Rng) -> Scene:
    """Rows of things one behind and above the other that fill the picture."""
    z, slope = rng.uniform(0.8, 2.0), rng.uniform(0.15, 1.4)
    kinds = [(doll, bottle, books, flat, ornament)[int(k)] for k in rng.integers(0, 5, 2)]
    solids, y = [board(rng, z * rng.uniform(1.5, 2.2), 0.2, 0.1)], rng.uniform(0.35, 0.6) * z
    lowest, nearest = y, z
    while y > -0.5 * z and len(solids) < 90:
        size, x = z * rng.uniform(0.07, 0.16), -0.6 * z
        while x < 0.6 * z:
            foot = np.array([x, y + rng.normal(0, 0.2) * size, z + rng.normal(0, 0.4) * size])
            solids += kinds[int(rng.integers(2))](rng, foot, size)
            x += size * rng.uniform(0.8, 2.0)
        rise = size * rng.uniform(0.9, 1.8)
        y, z = y - rise, z + slope * rise
    under = nod(math.atan2(nearest - z, lowest - y))  # what they lie on
    solids.append(wall(rng, np.array([0.0, (y + lowest) / 2, (nearest + z) / 2 + 0.5 * size]), under, 4.0, 4.0))
    return solids, 0.0


def shelf(rng: Rng) -> Scene:
    """Boards with rows of things on them, from nearly in front, by chance something that stands before them."""
    away, deep, across = rng.uniform(0.9, 2.8), rng.uniform(0.2, 0.5), rng.uniform(0.8, 2.5)
    axes, skin = turn(rng.normal(0, 0.35)), int(rng.integers(WHOLE))
    at = np.array([rng.normal(0, 0.3), 0.0, away])
    back = at + axes @ (0, 0, 2 * deep)
    solids = [wall(rng, back, axes, 4.0 * across, 5.0), ground(rng, axes, np.array([0, rng.uniform(1, 1.6), 0]), 8, 8)]
    for side in (-1, 1):
        frame = np.diag([0.02, 3.0, deep])
        solids.append(solid(rng, BOX, at + axes @ (side * across, 0.3, deep), axes @ frame, skin))
    height = rng.uniform(0.4, 0.9)
    while height > -1.2 and len(solids) < 90:
        plank = at + axes @ (0, height, deep)
        solids.append(solid(rng, BOX, plank, axes @ np.diag([across, 0.015, deep]), skin))
        gap, x = rng.uniform(0.22, 0.5), -across + 0.1
        while x < across and rng.random() < 0.97:
            size = gap * rng.uniform(0.12, 0.38)
            foot = at + axes @ np.array([x + size, height - 0.015, deep * rng.uniform(0.2, 1.0)])
            if (choice := int(rng.integers(4))) == 2:
                solids += tube(rng, foot, 0.5 * size, gap * rng.uniform(0.3, 0.8))
            else:
                solids += (bottle if choice == 3 else books)(rng, foot, size)
            x += size * rng.uniform(1.8, 4.0)
        height -= gap
    if rng.random() < 0.5:
        place = np.array([rng.uniform(-0.4, 0.4), rng.uniform(0.2, 0.8), rng.uniform(0.5, 0.85) * away])
        solids += thing(rng, place, rng.uniform(0.1, 0.4), rng.uniform(-math.pi, math.pi))
    if rng.random() < 0.3:
        foot = np.array([rng.uniform(-0.5, 0.5), 1.5, rng.uniform(0.6, 0.9) * away])
        solids.append(pole(rng, foot, rng.uniform(1.2, 3), rng.uniform(0.01, 0.05), lean(rng.normal(0, 0.2))))
    return solids, math.radians(rng.uniform(-10, 15))


def _cloth(rng: Rng, floor: float, away: float) -> list[Solid]:
    """Hanging folds: narrow sheets edge to edge, turned this way and that."""
    skin, made = int(rng.integers(WHOLE)), list[Solid]()
    tall, x, z = away * rng.uniform(0.2, 0.6), rng.uniform(-0.7, 0.3) * away, away
    back = nod(rng.uniform(-0.5, 0.1))
    for number in range(int(rng.integers(2, 8))):
        half, angle = away * rng.uniform(0.03, 0.12), (-1) ** number * rng.uniform(0.1, 1.0)
        step: Array = turn(angle) @ np.array([half, 0, 0])
        center = np.array([x, floor - tall, z]) + step
        made.append(solid(rng, SHEET, center, turn(angle) @ back @ np.diag([half, tall, 1.0]), skin))
        x, z = x + 2 * step[0], z + 2 * step[2]
    return made
