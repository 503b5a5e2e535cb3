"""Solids in their places, one at a time, and how they are turned."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spackle.training.depth.raycast import CYLINDER, ELLIPSOID, SHEET, Floats, Solid
from spackle.training.depth.skins import CUT, WHOLE

Array = NDArray[Any]
Rng = np.random.Generator
UP = np.array([0.0, -1.0, 0.0])  # y points down


def turn(yaw: float) -> Array:
    """[3, 3] around the vertical."""
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def nod(pitch: float) -> Array:
    """[3, 3] around the line to the right."""
    c, s = math.cos(pitch), math.sin(pitch)
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


def lean(roll: float) -> Array:
    """[3, 3] around the line of sight."""
    c, s = math.cos(roll), math.sin(roll)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def anyhow(rng: Rng) -> Array:
    """Turned by anything around the vertical."""
    return turn(rng.uniform(-math.pi, math.pi))


def solid(rng: Rng, kind: int, center: Array, axes: Array, texture: int | None = None, *, casts: bool = True) -> Solid:
    """One shape; a random whole texture where none is given."""
    skin = int(rng.integers(WHOLE)) if texture is None else texture
    many = (2.0, 1.0) if kind in (ELLIPSOID, CYLINDER) else (1.0, 1.0)
    return Solid(kind, _f(center), _f(axes), skin, many, casts)


def wall(rng: Rng, center: Array, axes: Array, across: float, up: float) -> Solid:
    """A sheet without a shadow, as large as half of it each way."""
    return solid(rng, SHEET, center, axes @ np.diag([across, up, 1.0]), casts=False)


def ground(rng: Rng, axes: Array, center: Array, wide: float, deep: float, repeats: float = 3.0) -> Solid:
    """A level sheet: floor, table or ceiling."""
    many = float(rng.uniform(1, repeats))
    level = axes @ nod(math.pi / 2) @ np.diag([wide, deep, 1.0])
    return Solid(SHEET, _f(axes @ center), _f(level), int(rng.integers(WHOLE)), (many, many), casts=False)


def cut(rng: Rng) -> int:
    """A texture with the outline of some thing."""
    return WHOLE + int(rng.integers(CUT))


def pole(rng: Rng, foot: Array, tall: float, thick: float, axes: Array, texture: int | None = None) -> Solid:
    """A round post from a foot upwards, upwards as `axes` has it."""
    return solid(rng, CYLINDER, foot + axes @ UP * tall / 2, axes @ np.diag([thick, tall / 2, thick]), texture)


def _f(value: object) -> Floats:
    return np.asarray(value, np.float32)
