"""Kinds of synthetic scenes, for a camera at the origin: rooms and tables, streets and yards, still
lifes.
"""

from __future__ import annotations

import functools
import math

import numpy as np
from objects import (
    UP,
    Array,
    Rng,
    anyhow,
    books,
    bottle,
    cut,
    doll,
    flat,
    ground,
    lean,
    nod,
    ornament,
    pole,
    solid,
    thing,
    tube,
    turn,
    wall,
)
from ray_tracer import BOX, CYLINDER, ELLIPSOID, SHEET, Solid
from textures import LATTICE, LEAVES, WHOLE

Scene = tuple[list[Solid], float]  # the solids, and the downward angle of the camera


def room(rng: Rng) -> Scene:
    """A rotated room: floor, three walls, sometimes a ceiling; objects along the walls and on the
    floor.
    """
    eye, ceiling = rng.uniform(0.8, 1.8), rng.uniform(2.2, 3.2)
    deep, left, right = rng.uniform(2.0, 7.0), rng.uniform(0.8, 4.0), rng.uniform(0.8, 4.0)
    yaw = math.radians(rng.uniform(-40, 40))
    axes, middle, span = turn(yaw), (right - left) / 2, (left + right) / 2
    tall = ceiling / 2
    y = eye - tall
    solids = [
        ground(rng, axes, np.array([middle, eye, 0.0]), span + 1, deep),
        wall(rng, axes @ (middle, y, deep), axes, span, tall),
        wall(rng, axes @ (-left, y, 0.0), axes @ turn(math.pi / 2), deep, tall),
        wall(rng, axes @ (right, y, 0.0), axes @ turn(math.pi / 2), deep, tall),
    ]
    if rng.random() < 0.6:
        solids.append(ground(rng, axes, np.array([middle, eye - ceiling, 0.0]), span, deep))
    if rng.random() < 0.5:  # the main object of the picture
        z = rng.uniform(0.4, 0.8) * deep
        big = (
            ornament
            if rng.random() < 0.5
            else functools.partial(thing, yaw=rng.uniform(-math.pi, math.pi))
        )
        solids += big(rng, np.array([rng.normal(0, 0.1) * z, eye, z]), z * rng.uniform(0.15, 0.35))
    for _ in range(rng.integers(2, 9)):
        place = (rng.uniform(-left, right), eye, rng.uniform(0.9, deep))
        if rng.random() < 0.5:  # along a wall, like furniture
            side = rng.integers(3)
            place = ((-left, right, place[0])[side], eye, deep if side == 2 else place[2])
        angle = yaw if rng.random() < 0.7 else rng.uniform(-math.pi, math.pi)
        solids += thing(rng, axes @ place, rng.uniform(0.15, 0.9), angle)
    return solids, math.radians(rng.uniform(-8, 30))


def table(rng: Rng) -> Scene:
    """A table seen from above with small objects on it, sometimes a wall behind."""
    eye, reach = rng.uniform(0.25, 0.9), rng.uniform(0.8, 2.5)
    axes = turn(math.radians(rng.uniform(-30, 30)))
    top = reach if rng.random() < 0.6 else 4.0
    solids = [
        ground(rng, axes, np.array([0.0, eye, 0.0]), 4.0, top),
        wall(rng, axes @ (0, 0, reach), axes, 6.0, 4.0),
        ground(rng, axes, np.array([0.0, eye + 0.7, 0.0]), 8.0, 8.0),
    ]
    for _ in range(rng.integers(3, 12)):
        place = np.array([rng.uniform(-0.8, 0.8), eye, rng.uniform(0.35, reach)])
        solids += ornament(rng, place, rng.uniform(0.04, 0.3))
    return solids, math.radians(rng.uniform(0, 45))


def sheets(rng: Rng) -> Scene:
    """Leaning boards, cut-outs and balls, which float in front of a wall."""
    reach = rng.uniform(1.5, 4.0)
    solids = [board(rng, reach, 0.4, 0.3)]
    for _ in range(rng.integers(2, 9)):
        z = reach * rng.uniform(0.3, 0.95)
        center = np.array([rng.uniform(-0.6, 0.6) * z, rng.uniform(-0.5, 0.6) * z, z])
        axes = (
            turn(rng.normal(0, 0.5))
            @ nod(rng.normal(0, 0.4))
            @ np.diag(rng.uniform(0.05, 0.4, 3) * z)
        )
        kind = int(rng.choice((SHEET, SHEET, BOX, ELLIPSOID, CYLINDER)))
        skin = cut(rng) if kind == SHEET and rng.random() < 0.5 else None
        solids.append(solid(rng, kind, center, axes, skin))
    return solids, 0.0


def board(rng: Rng, away: float, yaw: float, pitch: float) -> Solid:
    """The sheet behind everything else, slightly rotated."""
    return wall(
        rng,
        np.array([0.0, 0.0, away]),
        turn(rng.normal(0, yaw)) @ nod(rng.normal(0, pitch)),
        9.0,
        9.0,
    )


def street(rng: Rng) -> Scene:
    """A street: ground to the horizon, houses on both sides, objects in front of them."""
    eye = rng.uniform(1.0, 2.2)
    axes = turn(math.radians(rng.uniform(-25, 25)))
    solids = [ground(rng, axes, np.array([0.0, eye, 200.0]), 300.0, 300.0, repeats=200.0)]
    for _ in range(rng.integers(0, 9)):
        size = rng.uniform(2, 9)
        side = rng.choice((-1, 1)) * rng.uniform(3, 14)
        center = axes @ (
            side + np.sign(side) * size,
            eye - rng.uniform(0.2, 0.9) * size,
            rng.uniform(4, 60),
        )
        solids.append(
            solid(rng, BOX, center, axes @ np.diag([size, size * rng.uniform(0.6, 1.5), size]))
        )
    for _ in range(rng.integers(1, 9)):
        place = np.array([rng.uniform(-6, 6), eye, 3 + 25 * rng.random() ** 2])
        solids += thing(rng, place, rng.uniform(0.3, 2.0), rng.uniform(-math.pi, math.pi))
    return solids, math.radians(rng.uniform(-8, 14))


def yard(rng: Rng) -> Scene:
    """A yard: posts, stones and trees nearby, sometimes a roof overhead, house fronts beside and
    far away, hills.
    """
    eye = rng.uniform(1.1, 2.0)
    solids = [
        ground(
            rng, turn(rng.normal(0, 0.3)), np.array([0.0, eye, 200.0]), 300.0, 300.0, repeats=200.0
        )
    ]
    if rng.random() < 0.6:
        solids.append(
            _front(rng, eye, rng.choice((-1, 1)) * rng.uniform(2, 8), rng.uniform(1, 20), 0.3)
        )
    for _ in range(rng.integers(0, 3)):
        solids.append(_front(rng, eye, rng.uniform(-25, 25), rng.uniform(15, 60), 0.8))
    for _ in range(rng.integers(1, 4) if rng.random() < 0.4 else 0):
        radii = np.array([rng.uniform(40, 120), rng.uniform(6, 30), 30.0])
        solids.append(
            solid(
                rng,
                ELLIPSOID,
                np.array([rng.uniform(-120, 120), eye, rng.uniform(110, 250)]),
                np.diag(radii),
            )
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
            solids.append(
                solid(rng, ELLIPSOID, foot, anyhow(rng) @ np.diag(size * rng.uniform(0.4, 1.2, 3)))
            )
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
    """A house front that stands on the ground, of usual length and height."""
    tall, along, deep = rng.uniform(1.5, 6), rng.uniform(2, 12), rng.uniform(2, 12)
    center = np.array([x + math.copysign(deep if abs(x) < 10 else 0.0, x), eye - tall, z])
    box = solid(rng, BOX, center, turn(rng.normal(0, yaw)) @ np.diag([deep, tall, along]))
    return Solid(box.kind, box.center, box.axes, box.texture, (float(rng.integers(1, 4)),) * 2)


def _tree(rng: Rng, foot: Array, tall: float) -> list[Solid]:
    """A tree: a trunk, and leaves around its end with gaps between them."""
    made = [pole(rng, foot, tall, rng.uniform(0.02, 0.06) * tall, lean(rng.normal(0, 0.08)))]
    for _ in range(rng.integers(2, 6)):
        place = (
            foot + np.array([rng.normal(0, 0.2), -rng.uniform(0.7, 1.2), rng.normal(0, 0.2)]) * tall
        )
        size = tall * rng.uniform(0.15, 0.4)
        if rng.random() < 0.3:
            made.append(solid(rng, ELLIPSOID, place, anyhow(rng) * size))
        else:
            made.append(solid(rng, SHEET, place, turn(rng.normal(0, 0.5)) * size, LEAVES))
    return made


def _canopy(rng: Rng, eye: float) -> list[Solid]:
    """A pillar that spreads into a mushroom-like roof with ribs; its edge may be above the
    camera.
    """
    z = rng.uniform(2.5, 9)
    x, rise = rng.uniform(-0.5, 0.5) * z, rng.uniform(0.9, 2.6)
    wide, skin = z * rng.uniform(0.4, 1.1), int(rng.integers(WHOLE))
    thick = rng.uniform(0.3, 0.9) * rise  # so that the camera is below it
    ribs = (float(rng.integers(2, 16)), 1.0)
    top = solid(rng, ELLIPSOID, np.array([x, -rise - 0.15, z]), np.diag([wide, thick, wide]), skin)
    made = [Solid(top.kind, top.center, top.axes, skin, ribs)]
    r = rng.uniform(0.02, 0.06) * z
    made.append(pole(rng, np.array([x, eye, z]), eye + rise, r, np.eye(3), skin))
    neck = solid(
        rng, ELLIPSOID, np.array([x, -rise, z]), np.diag([4 * r, 0.6 * (rise + eye), 4 * r]), skin
    )
    return [*made, Solid(neck.kind, neck.center, neck.axes, skin, ribs)]


def _eaves(rng: Rng, eye: float) -> list[Solid]:
    """A roof above the camera, with an edge in front of the camera, beams and posts."""
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
    """Rows of columns below a ceiling, sometimes a wall on one side."""
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


def still_life(rng: Rng) -> Scene:
    """A still life: many objects close together on a table near eye level, in front of boards and
    cloth.
    """
    reach = rng.uniform(0.9, 2.2)
    eye, near = reach * rng.uniform(0.12, 0.45), reach * rng.uniform(0.45, 0.7)
    solids = [
        board(rng, reach * 1.02, 0.25, 0.08),
        ground(rng, np.eye(3), np.array([0.0, eye, 0.0]), 4.0, reach),
    ]
    for _ in range(rng.integers(0, 4)):  # posters and cartons just in front of the background
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
    """A heap: rows of objects, each behind and above the one before, which fill the picture."""
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
    under = nod(math.atan2(nearest - z, lowest - y))  # the surface that they lie on
    solids.append(
        wall(
            rng, np.array([0.0, (y + lowest) / 2, (nearest + z) / 2 + 0.5 * size]), under, 4.0, 4.0
        )
    )
    return solids, 0.0


def shelf(rng: Rng) -> Scene:
    """A shelf seen almost frontally: boards with rows of objects, sometimes with something in front
    of them.
    """
    away, deep, across = rng.uniform(0.9, 2.8), rng.uniform(0.2, 0.5), rng.uniform(0.8, 2.5)
    axes, skin = turn(rng.normal(0, 0.35)), int(rng.integers(WHOLE))
    at = np.array([rng.normal(0, 0.3), 0.0, away])
    back = at + axes @ (0, 0, 2 * deep)
    solids = [
        wall(rng, back, axes, 4.0 * across, 5.0),
        ground(rng, axes, np.array([0, rng.uniform(1, 1.6), 0]), 8, 8),
    ]
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
        place = np.array(
            [rng.uniform(-0.4, 0.4), rng.uniform(0.2, 0.8), rng.uniform(0.5, 0.85) * away]
        )
        solids += thing(rng, place, rng.uniform(0.1, 0.4), rng.uniform(-math.pi, math.pi))
    if rng.random() < 0.3:
        foot = np.array([rng.uniform(-0.5, 0.5), 1.5, rng.uniform(0.6, 0.9) * away])
        solids.append(
            pole(rng, foot, rng.uniform(1.2, 3), rng.uniform(0.01, 0.05), lean(rng.normal(0, 0.2)))
        )
    return solids, math.radians(rng.uniform(-10, 15))


def _cloth(rng: Rng, floor: float, away: float) -> list[Solid]:
    """A hanging cloth: narrow adjoining sheets, rotated alternately like folds."""
    skin, made = int(rng.integers(WHOLE)), list[Solid]()
    tall, x, z = away * rng.uniform(0.2, 0.6), rng.uniform(-0.7, 0.3) * away, away
    back = nod(rng.uniform(-0.5, 0.1))
    for number in range(int(rng.integers(2, 8))):
        half, angle = away * rng.uniform(0.03, 0.12), (-1) ** number * rng.uniform(0.1, 1.0)
        step: Array = turn(angle) @ np.array([half, 0, 0])
        center = np.array([x, floor - tall, z]) + step
        made.append(
            solid(rng, SHEET, center, turn(angle) @ back @ np.diag([half, tall, 1.0]), skin)
        )
        x, z = x + 2 * step[0], z + 2 * step[2]
    return made
