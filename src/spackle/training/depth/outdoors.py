"""Made streets and yards, seen from a camera at the origin."""

from __future__ import annotations

import math

import numpy as np

from spackle.training.depth.indoors import Scene
from spackle.training.depth.raycast import BOX, ELLIPSOID, SHEET, Solid
from spackle.training.depth.shapes import Array, Rng, anyhow, cut, ground, lean, nod, pole, solid, turn, wall
from spackle.training.depth.skins import LATTICE, LEAVES, WHOLE
from spackle.training.depth.things import thing


def street(rng: Rng) -> Scene:
    """Ground to the horizon, houses to both sides, things in front of them."""
    eye = rng.uniform(1.0, 2.2)
    axes = turn(math.radians(rng.uniform(-25, 25)))
    solids = [ground(rng, axes, np.array([0.0, eye, 200.0]), 300.0, 300.0, repeats=200.0)]
    for _ in range(rng.integers(0, 9)):
        size = rng.uniform(2, 9)
        side = rng.choice((-1, 1)) * rng.uniform(3, 14)
        center = axes @ (side + np.sign(side) * size, eye - rng.uniform(0.2, 0.9) * size, rng.uniform(4, 60))
        solids.append(solid(rng, BOX, center, axes @ np.diag([size, size * rng.uniform(0.6, 1.5), size])))
    for _ in range(rng.integers(1, 9)):
        place = np.array([rng.uniform(-6, 6), eye, 3 + 25 * rng.random() ** 2])
        solids += thing(rng, place, rng.uniform(0.3, 2.0), rng.uniform(-math.pi, math.pi))
    return solids, math.radians(rng.uniform(-8, 14))


def yard(rng: Rng) -> Scene:
    """Posts, stones and trees near by, by chance a roof overhead, fronts of houses at the side and far away, hills."""
    eye = rng.uniform(1.1, 2.0)
    solids = [ground(rng, turn(rng.normal(0, 0.3)), np.array([0.0, eye, 200.0]), 300.0, 300.0, repeats=200.0)]
    if rng.random() < 0.6:
        solids.append(_front(rng, eye, rng.choice((-1, 1)) * rng.uniform(2, 8), rng.uniform(1, 20), 0.3))
    for _ in range(rng.integers(0, 3)):
        solids.append(_front(rng, eye, rng.uniform(-25, 25), rng.uniform(15, 60), 0.8))
    for _ in range(rng.integers(1, 4) if rng.random() < 0.4 else 0):
        radii = np.array([rng.uniform(40, 120), rng.uniform(6, 30), 30.0])
        solids.append(
            solid(rng, ELLIPSOID, np.array([rng.uniform(-120, 120), eye, rng.uniform(110, 250)]), np.diag(radii))
        )
    for _ in range(rng.integers(0, 5)):
        z = 3 + 40 * rng.random() ** 2
        solids += _tree(rng, np.array([rng.uniform(-0.7, 0.7) * z, eye, z]), rng.uniform(2, 7))
    for _ in range(rng.integers(0, 8)):  # posts
        z = rng.uniform(1.2, 4) if rng.random() < 0.5 else rng.uniform(4, 20)
        foot = np.array([rng.uniform(-0.6, 0.6) * z, eye, z])
        tilt = turn(rng.uniform(-3, 3)) @ lean(rng.normal(0, 0.12))
        solids.append(pole(rng, foot, rng.uniform(0.8, 4), rng.uniform(0.03, 0.2), tilt))
    for _ in range(rng.integers(0, 8)):  # stones, benches, bins
        z = 1.5 + 12 * rng.random() ** 2
        foot = np.array([rng.uniform(-0.7, 0.7) * z, eye, z])
        size = rng.uniform(0.1, 0.7)
        if rng.random() < 0.5:
            solids.append(solid(rng, ELLIPSOID, foot, anyhow(rng) @ np.diag(size * rng.uniform(0.4, 1.2, 3))))
        else:
            solids += thing(rng, foot, size, rng.uniform(-math.pi, math.pi))
    if rng.random() < 0.25:  # a fence
        place = np.array([rng.uniform(-4, 4), eye - 0.6, rng.uniform(2.5, 15)])
        fence = turn(rng.normal(0, 0.6)) @ np.diag([rng.uniform(1, 6), 0.6, 1.0])
        solids.append(solid(rng, SHEET, place, fence, LATTICE))
    if (above := rng.random()) < 0.8:
        solids += (_canopy, _eaves, _branches, _arcade)[int(above / 0.2)](rng, eye)
    return solids, math.radians(rng.uniform(-14, 10))


def _front(rng: Rng, eye: float, x: float, z: float, yaw: float) -> Solid:
    """A house, its foot on the ground: long, and as tall as houses are."""
    tall, along, deep = rng.uniform(1.5, 6), rng.uniform(2, 12), rng.uniform(2, 12)
    center = np.array([x + math.copysign(deep if abs(x) < 10 else 0.0, x), eye - tall, z])
    box = solid(rng, BOX, center, turn(rng.normal(0, yaw)) @ np.diag([deep, tall, along]))
    return Solid(box.kind, box.center, box.axes, box.texture, (float(rng.integers(1, 4)),) * 2)


def _tree(rng: Rng, foot: Array, tall: float) -> list[Solid]:
    """A trunk and leaves around its end, with gaps between them."""
    made = [pole(rng, foot, tall, rng.uniform(0.02, 0.06) * tall, lean(rng.normal(0, 0.08)))]
    for _ in range(rng.integers(2, 6)):
        place = foot + np.array([rng.normal(0, 0.2), -rng.uniform(0.7, 1.2), rng.normal(0, 0.2)]) * tall
        size = tall * rng.uniform(0.15, 0.4)
        if rng.random() < 0.3:
            made.append(solid(rng, ELLIPSOID, place, anyhow(rng) * size))
        else:
            made.append(solid(rng, SHEET, place, turn(rng.normal(0, 0.5)) * size, LEAVES))
    return made


def _canopy(rng: Rng, eye: float) -> list[Solid]:
    """A pillar that spreads into a roof like a mushroom's, with ribs, whose edge may be above the camera."""
    z = rng.uniform(2.5, 9)
    x, rise = rng.uniform(-0.5, 0.5) * z, rng.uniform(0.9, 2.6)
    wide, skin = z * rng.uniform(0.4, 1.1), int(rng.integers(WHOLE))
    thick = rng.uniform(0.3, 0.9) * rise  # the camera stays below it
    ribs = (float(rng.integers(2, 16)), 1.0)
    top = solid(rng, ELLIPSOID, np.array([x, -rise - 0.15, z]), np.diag([wide, thick, wide]), skin)
    made = [Solid(top.kind, top.center, top.axes, skin, ribs)]
    r = rng.uniform(0.02, 0.06) * z
    made.append(pole(rng, np.array([x, eye, z]), eye + rise, r, np.eye(3), skin))
    neck = solid(rng, ELLIPSOID, np.array([x, -rise, z]), np.diag([4 * r, 0.6 * (rise + eye), 4 * r]), skin)
    return [*made, Solid(neck.kind, neck.center, neck.axes, skin, ribs)]


def _eaves(rng: Rng, eye: float) -> list[Solid]:
    """A roof over the camera that ends before it, with beams and posts at its edge."""
    rise, edge = rng.uniform(0.7, 2.2), rng.uniform(1.5, 9)
    axes, wide = turn(rng.normal(0, 0.4)), rng.uniform(2, 8)
    x = rng.normal(0, 0.4) * wide
    slope = nod(math.pi / 2 + rng.normal(0, 0.08))
    made = [wall(rng, axes @ (x, -rise, edge - 5), axes @ slope, wide, 5.0)]
    for _ in range(rng.integers(0, 6)):
        beam = axes @ (x, -rise + 0.1, rng.uniform(0.5, edge))
        made.append(solid(rng, BOX, beam, axes @ np.diag([wide, 0.1, 0.08])))
    for side in rng.uniform(-1, 1, int(rng.integers(0, 5))):
        foot = axes @ (x + side * wide, eye, edge)
        made.append(pole(rng, foot, eye + rise, rng.uniform(0.04, 0.2), np.eye(3)))
    return made


def _branches(rng: Rng, eye: float) -> list[Solid]:
    """Twigs and leaves that hang into the picture from above, near the camera."""
    made = []
    for _ in range(rng.integers(2, 9)):
        z = rng.uniform(0.8, 5)
        place = np.array([rng.uniform(-0.6, 0.6), -rng.uniform(0.15, 0.6), 1.0]) * z
        skin = LEAVES if rng.random() < 0.7 else cut(rng)
        axes = turn(rng.normal(0, 0.6)) @ nod(rng.normal(0, 0.5))
        made.append(solid(rng, SHEET, place, axes * z * rng.uniform(0.1, 0.35), skin))
        tilt = turn(rng.uniform(-3, 3)) @ lean(rng.normal(0, 1.0))
        made.append(pole(rng, place, rng.uniform(0.3, 1.0) * z, 0.01 * z, tilt))
    return made


def _arcade(rng: Rng, eye: float) -> list[Solid]:
    """Columns in rows below a ceiling, by chance a wall on one side."""
    rise, half, step = rng.uniform(0.8, 2.5), rng.uniform(0.9, 3), rng.uniform(1.5, 4)
    axes, thick = turn(rng.normal(0, 0.35)), rng.uniform(0.08, 0.35)
    skin, length = int(rng.integers(WHOLE)), step * rng.integers(2, 7)
    made = [ground(rng, axes, np.array([0.0, -rise, 0.0]), half + thick, length, 6.0)]
    open_sides = (-1, 1) if rng.random() < 0.5 else (rng.choice((-1, 1)),)
    for side in open_sides:
        for n in range(1, int(length / step) + 1):
            foot = axes @ (side * half, eye, n * step)
            made.append(pole(rng, foot, eye + rise, thick, np.eye(3), skin))
    if len(open_sides) == 1:
        beside = axes @ (-open_sides[0] * half, (eye - rise) / 2, 0.0)
        made.append(wall(rng, beside, axes @ turn(math.pi / 2), length, (eye + rise) / 2))
    return made
