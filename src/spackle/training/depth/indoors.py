"""Made rooms and tables, seen from a camera at the origin."""

from __future__ import annotations

import functools
import math

import numpy as np

from spackle.training.depth.raycast import BOX, CYLINDER, ELLIPSOID, SHEET, Solid
from spackle.training.depth.shapes import Rng, cut, ground, nod, solid, turn, wall
from spackle.training.depth.things import ornament, thing

Scene = tuple[list[Solid], float]  # what there is, and how far the camera looks down


def room(rng: Rng) -> Scene:
    """Floor, three walls and by chance a ceiling, turned; things along the walls and on the floor."""
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
    if rng.random() < 0.5:  # what the photo is of
        z = rng.uniform(0.4, 0.8) * deep
        big = ornament if rng.random() < 0.5 else functools.partial(thing, yaw=rng.uniform(-math.pi, math.pi))
        solids += big(rng, np.array([rng.normal(0, 0.1) * z, eye, z]), z * rng.uniform(0.15, 0.35))
    for _ in range(rng.integers(2, 9)):
        place = (rng.uniform(-left, right), eye, rng.uniform(0.9, deep))
        if rng.random() < 0.5:  # along a wall, as furniture stands
            side = rng.integers(3)
            place = ((-left, right, place[0])[side], eye, deep if side == 2 else place[2])
        angle = yaw if rng.random() < 0.7 else rng.uniform(-math.pi, math.pi)
        solids += thing(rng, axes @ place, rng.uniform(0.15, 0.9), angle)
    return solids, math.radians(rng.uniform(-8, 30))


def table(rng: Rng) -> Scene:
    """A surface seen from above with small things on it, by chance a wall behind."""
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
    """Leaning boards, cut-outs and balls in front of a wall, floating as they like."""
    reach = rng.uniform(1.5, 4.0)
    solids = [board(rng, reach, 0.4, 0.3)]
    for _ in range(rng.integers(2, 9)):
        z = reach * rng.uniform(0.3, 0.95)
        center = np.array([rng.uniform(-0.6, 0.6) * z, rng.uniform(-0.5, 0.6) * z, z])
        axes = turn(rng.normal(0, 0.5)) @ nod(rng.normal(0, 0.4)) @ np.diag(rng.uniform(0.05, 0.4, 3) * z)
        kind = int(rng.choice((SHEET, SHEET, BOX, ELLIPSOID, CYLINDER)))
        skin = cut(rng) if kind == SHEET and rng.random() < 0.5 else None
        solids.append(solid(rng, kind, center, axes, skin))
    return solids, 0.0


def board(rng: Rng, away: float, yaw: float, pitch: float) -> Solid:
    """What stands behind all else, more or less turned."""
    return wall(rng, np.array([0.0, 0.0, away]), turn(rng.normal(0, yaw)) @ nod(rng.normal(0, pitch)), 9.0, 9.0)
