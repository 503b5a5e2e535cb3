"""Made textures of streets and gardens, drawn once and kept as pictures; see `surfaces`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from worlds import surfaces as base
from worlds.lights import cloud_noise
from worlds.surfaces import Draw, Drawn, Surface, drawn_surfaces

Rng = np.random.Generator


def outdoor_surfaces(folder: Path, kind: str) -> list[Surface]:
    """All surfaces of a kind, of these and of the rooms'; drawn into `folder` at the first call."""
    draw = OUTDOOR_KINDS[kind] if kind in OUTDOOR_KINDS else base.KINDS[kind]
    return drawn_surfaces(folder, kind, draw)


def _place() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """x and y [S, S] in 0..1 at pixel centres."""
    y, x = np.mgrid[: base.SIDE, : base.SIDE]
    return (x + 0.5) / base.SIDE, (y + 0.5) / base.SIDE


def _noise(rng: Rng, cells: int, octaves: int = 5) -> NDArray[np.float64]:
    """[S, S] noise with details of a `cells`-th of the width."""
    return cloud_noise(rng, (base.SIDE, base.SIDE), cells, octaves)


def _shaded(
    value: NDArray[np.float64], color: NDArray[np.float64] | tuple[float, ...]
) -> NDArray[np.float64]:
    """[S, S, 3] a colour times [S, S] brightness."""
    return np.asarray(value[..., None] * np.asarray(color))


def asphalt(rng: Rng, wanted: bool) -> Drawn:
    """A road: stones in tar, worn and stained, with a few cracks."""
    tile_m = rng.uniform(3.5, 5.0)
    if not wanted:
        return None, tile_m, 0.03, 0.5
    grey = rng.uniform(0.3, 0.48)
    stones = rng.standard_normal((base.SIDE, base.SIDE))
    value = 1 + 0.09 * stones + 0.1 * _noise(rng, 90, 3) + 0.07 * _noise(rng, 3, 5)
    # Cracks run where broad noise changes its sign, and only in some places.
    crack = np.abs(_noise(rng, 3, 6)) < 0.012
    crack &= _noise(rng, 4, 3) > 0.6
    value = np.where(crack, value * 0.55, value)
    warm = np.array([1.0, 0.985, 0.96]) + rng.normal(0, 0.01, 3)
    return _shaded(grey * value, warm), tile_m, 0.03, 0.5


def paving(rng: Rng, wanted: bool) -> Drawn:
    """Slabs of a pavement, in rows that are shifted, with dark joints."""
    rows = int(rng.choice([3, 4, 6, 10]))
    side_m = {3: 0.5, 4: 0.4, 6: 0.3, 10: 0.12}[rows]
    if not wanted:
        return None, rows * side_m, 0.02, 0.6
    color = np.array([0.56, 0.54, 0.5]) * rng.uniform(0.75, 1.15) + rng.normal(0, 0.02, 3)
    if rows == 10 and rng.random() < 0.5:  # bricks
        color = np.array([0.5, 0.32, 0.25]) * rng.uniform(0.8, 1.2)
    x, y = _place()
    columns = rows if rows < 10 else 5
    row = (y * rows).astype(int)
    across = (x * columns + 0.5 * (row % 2) * (rows % 2 == 0)) % columns
    column = across.astype(int)
    shade = 1 + rng.normal(0, 0.05, (rows, columns))[row, column]
    edge = np.minimum(
        np.minimum(across % 1, 1 - across % 1) * rows / columns,
        np.minimum(y * rows % 1, 1 - y * rows % 1),
    )
    grain = 1 + 0.05 * _noise(rng, 80, 4) + 0.05 * _noise(rng, 4, 5)
    value = shade * grain * np.clip(0.45 + edge / 0.03, 0, 1)
    return _shaded(value, color), rows * side_m, 0.02, 0.6


def cobbles(rng: Rng, wanted: bool) -> Drawn:
    """Rounded stones in rows."""
    rows = 14
    if not wanted:
        return None, rows * 0.11, 0.03, 0.5
    x, y = _place()
    wobble = 0.1 * _noise(rng, 24, 2)
    b = y * rows + wobble
    row = b.astype(int) % rows
    a = (x * rows + 0.5 * (row % 2) + 0.12 * _noise(rng, 24, 2)) % rows
    column = a.astype(int)
    shade = 1 + rng.normal(0, 0.14, (rows, rows))[row, column]
    edge = np.minimum(np.minimum(a % 1, 1 - a % 1), np.minimum(b % 1, 1 - b % 1))
    value = shade * np.clip(0.35 + 2.2 * edge, 0, 1) * (1 + 0.08 * _noise(rng, 90, 3))
    color = np.array([0.5, 0.48, 0.46]) * rng.uniform(0.7, 1.1) + rng.normal(0, 0.015, 3)
    return _shaded(value, color), rows * 0.11, 0.03, 0.5


def grass(rng: Rng, wanted: bool) -> Drawn:
    """A lawn: blades of many greens, yellow in places."""
    tile_m = rng.uniform(1.6, 2.4)
    if not wanted:
        return None, tile_m, 0.0, 1.0
    fine = _noise(rng, 160, 2) + 0.7 * rng.standard_normal((base.SIDE, base.SIDE))
    # Blades are longer than wide.
    fine = (fine + np.roll(fine, 1, 0) + np.roll(fine, 2, 0)) / 2
    broad = _noise(rng, 5, 5)
    green = np.array([0.3, 0.38, 0.17]) * rng.uniform(0.8, 1.1)
    dry = np.array([0.46, 0.43, 0.25])
    weight = np.clip(0.15 + rng.uniform(-0.15, 0.25) + 0.1 * broad, 0, 0.8)[..., None]
    color = green + (dry - green) * weight
    return color * (1 + 0.2 * fine + 0.06 * broad)[..., None], tile_m, 0.0, 1.0


def earth(rng: Rng, wanted: bool) -> Drawn:
    """Bare soil, or gravel of a path."""
    tile_m = rng.uniform(1.2, 2.0)
    if not wanted:
        return None, tile_m, 0.0, 1.0
    color = np.array([0.36, 0.29, 0.22]) * rng.uniform(0.7, 1.0)
    if rng.random() < 0.5:
        color = np.array([0.62, 0.58, 0.5]) * rng.uniform(0.8, 1.1)
    stones = np.abs(_noise(rng, 100, 2))
    return _shaded(0.75 + 0.28 * stones + 0.08 * _noise(rng, 6, 5), color), tile_m, 0.0, 1.0


def roof_tiles(rng: Rng, wanted: bool) -> Drawn:
    """Tiles or slates in rows; v runs up the roof."""
    rows = 8
    tile_m = rows * rng.uniform(0.26, 0.34)
    if not wanted:
        return None, tile_m, 0.03, 0.5
    colors = ((0.52, 0.28, 0.2), (0.42, 0.24, 0.19), (0.3, 0.3, 0.32), (0.38, 0.35, 0.32))
    color = np.array(colors[int(rng.integers(4))]) * rng.uniform(0.8, 1.1)
    x, y = _place()
    waves = rng.random() < 0.6
    columns = rows if waves else rows + 4
    up = (1 - y) * rows  # from the lower end
    row = up.astype(int) % rows
    across = (x * columns + (0.0 if waves else 0.5) * (row % 2)) % columns
    column = across.astype(int)
    shade = 1 + rng.normal(0, 0.09, (rows, columns))[row, column]
    # Each row lies over the one below it, so its lower end is light and its upper end in shadow.
    value = shade * np.clip(1.08 - 0.25 * (up % 1), 0.6, 1.1)
    value = np.where(up % 1 < 0.07, value * 0.45, value)
    if waves:
        value *= 0.78 + 0.3 * np.sin(np.pi * (across % 1)) ** 0.7
    else:
        value = np.where(np.minimum(across % 1, 1 - across % 1) < 0.03, value * 0.6, value)
    moss = np.clip(_noise(rng, 5, 5) - 1.1, 0, 1)[..., None]
    picture = _shaded(value * (1 + 0.05 * _noise(rng, 60, 3)), color)
    return picture * (1 - 0.5 * moss) + 0.5 * moss * np.array([0.3, 0.32, 0.2]), tile_m, 0.03, 0.5


def stone_wall(rng: Rng, wanted: bool) -> Drawn:
    """Field stones in mortar: the cells of random points."""
    count = 60
    if not wanted:
        return None, 1.8, 0.0, 1.0
    points = rng.random((count, 2))
    x, y = _place()
    nearest = np.full((base.SIDE, base.SIDE), 9.0)
    second = nearest.copy()
    owner = np.zeros((base.SIDE, base.SIDE), int)
    for number, (px, py) in enumerate(points):
        # Distances around the texture's borders, so that it repeats; stones are wider than high.
        dx = np.abs(x - px)
        dy = np.abs(y - py)
        away = np.hypot(np.minimum(dx, 1 - dx), 1.5 * np.minimum(dy, 1 - dy))
        closer = away < nearest
        second = np.where(closer, nearest, np.minimum(second, away))
        owner = np.where(closer, number, owner)
        nearest = np.where(closer, away, nearest)
    tint = np.array([0.55, 0.5, 0.44]) * rng.uniform(0.7, 1.1)
    each = np.clip(tint + rng.normal(0, 0.05, (count, 1)) + rng.normal(0, 0.015, (count, 3)), 0, 1)
    value = np.clip(0.4 + (second - nearest) / 0.03, 0, 1) * (1 + 0.1 * _noise(rng, 40, 5))
    return each[owner] * value[..., None], 1.8, 0.0, 1.0


def boards(rng: Rng, wanted: bool) -> Drawn:
    """Painted or weathered weatherboards, one above the other."""
    rows = 8
    if not wanted:
        return None, rows * 0.15, 0.02, 0.6
    paints = ((0.86, 0.84, 0.78), (0.6, 0.66, 0.7), (0.5, 0.2, 0.16), (0.55, 0.5, 0.42),
              (0.78, 0.72, 0.55), (0.4, 0.47, 0.42))  # fmt: skip
    color = np.array(paints[int(rng.integers(len(paints)))]) * rng.uniform(0.85, 1.08)
    _, y = _place()
    up = (1 - y) * rows
    value = np.where(up % 1 < 0.06, 0.5, 0.93 + 0.1 * (up % 1))
    shade = 1 + rng.normal(0, 0.02, rows)[up.astype(int) % rows]
    streaks = np.repeat(_noise(rng, 90, 3)[:, ::8], 8, 1)[:, : base.SIDE]
    return _shaded(value * shade * (1 + 0.03 * streaks), color), rows * 0.15, 0.02, 0.6


def panes(rng: Rng, wanted: bool) -> Drawn:
    """What a window shows by day: a dark room, often with curtains or a blind before it.

    The texture is seen whole, once a window.
    """
    if not wanted:
        return None, 1.0, 0.09, 0.04
    x, y = _place()
    dark = rng.uniform(0.04, 0.16)
    room = _shaded(0.6 + 0.5 * y + 0.1 * _noise(rng, 3, 3), np.array([1.0, 0.95, 0.9]) * dark)
    weight = np.zeros_like(x)  # of the cloth before the room
    kind = rng.random()
    cloth = np.array([0.78, 0.76, 0.7]) * rng.uniform(0.55, 1.0)
    folds = 0.85 + 0.15 * np.sin(2 * np.pi * rng.integers(9, 16) * x + _noise(rng, 3, 3))
    if kind < 0.45:  # curtains at both sides
        width = rng.uniform(0.12, 0.34)
        inner = width * (1 - 0.25 * np.sin(np.pi * y))
        weight = (np.minimum(x, 1 - x) < inner).astype(np.float64)
    elif kind < 0.6:  # a net before all of it
        weight = np.full_like(x, 0.55)
    elif kind < 0.75:  # a blind, partly down
        weight = (y < rng.uniform(0.2, 0.75)).astype(np.float64)
        folds = np.where(y * 24 % 1 > 0.2, 1.0, 0.85)
    return room + (_shaded(folds, cloth) - room) * weight[..., None], 1.0, 0.09, 0.04


OUTDOOR_KINDS: dict[str, Draw] = {
    "asphalt": asphalt,
    "paving": paving,
    "cobbles": cobbles,
    "grass": grass,
    "earth": earth,
    "roof_tiles": roof_tiles,
    "stone_wall": stone_wall,
    "boards": boards,
    "panes": panes,
}
