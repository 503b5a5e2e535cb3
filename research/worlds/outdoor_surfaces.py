"""Made textures of streets and gardens, drawn once and kept as pictures; see `surfaces`.

A texture is a picture of S × S pixels (S is `surfaces.SIDE`) that repeats without a seam, but for
`panes`. Each function here draws a random one. Pixel coordinates x and y run from 0 to 1: x to the
right and y downwards, so that on a wall y = 0 is up.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from worlds import surfaces as base
from worlds.lights import cloud_noise
from worlds.surfaces import Draw, Surface, drawn_surfaces

Rng = np.random.Generator


class Texture(NamedTuple):
    """A drawn texture, in the order of `surfaces.Drawn`."""

    picture: NDArray[np.float64] | None  # [S, S, 3] sRGB, clipped to 0..1 later; None: not wanted
    tile_m: float  # metres of the surface that one repeat of the picture covers
    specular: float  # share of light that is mirrored when looked at straight on
    roughness: float  # 0: a mirror, 1: chalk


def outdoor_surfaces(folder: Path, kind: str) -> list[Surface]:
    """All surfaces of a kind; drawn into `folder` at the first call.

    Args:
        folder: where their pictures are kept.
        kind: a key of `OUTDOOR_KINDS`, or of `surfaces.KINDS` for the kinds that rooms have too.
    """
    draw = OUTDOOR_KINDS[kind] if kind in OUTDOOR_KINDS else base.KINDS[kind]
    return drawn_surfaces(folder, kind, draw)


def _pixel_x_and_y() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """[S, S] x (to the right) and [S, S] y (downwards) of pixel centres, 0 to 1."""
    row, column = np.mgrid[: base.SIDE, : base.SIDE]
    return (column + 0.5) / base.SIDE, (row + 0.5) / base.SIDE


def _noise(rng: Rng, cells: int, octaves: int = 5) -> NDArray[np.float64]:
    """[S, S] noise with a mean of 0 and a deviation of about 1, which repeats without a seam.

    Args:
        rng: for the noise.
        cells: its largest spots are as wide as this part of the picture: 3: a third.
        octaves: how often half as large spots are added.
    """
    return cloud_noise(rng, (base.SIDE, base.SIDE), cells, octaves)


def _colored(
    brightness: NDArray[np.float64], color: NDArray[np.float64] | tuple[float, ...]
) -> NDArray[np.float64]:
    """[S, S, 3] a colour [3] times [S, S] brightness."""
    return np.asarray(brightness[..., None] * np.asarray(color))


def asphalt(rng: Rng, picture_wanted: bool) -> Texture:
    """A texture of a road's asphalt: stones in tar, worn and stained, with a few cracks.

    `picture_wanted` is false where only size and gloss are needed.
    """
    tile_m = rng.uniform(3.5, 5.0)
    picture: NDArray[np.float64] | None = None
    if picture_wanted:
        grey = rng.uniform(0.3, 0.48)
        stones = rng.standard_normal((base.SIDE, base.SIDE))
        small_stains = _noise(rng, 90, 3)
        large_stains = _noise(rng, 3, 5)
        brightness = 1 + 0.09 * stones + 0.1 * small_stains + 0.07 * large_stains
        # Cracks are thin lines, where broad noise changes its sign; and only in some places.
        cracked = np.abs(_noise(rng, 3, 6)) < 0.012
        cracked &= _noise(rng, 4, 3) > 0.6
        brightness = np.where(cracked, brightness * 0.55, brightness)
        warm_white = np.array([1.0, 0.985, 0.96]) + rng.normal(0, 0.01, 3)
        picture = _colored(grey * brightness, warm_white)
    return Texture(picture, tile_m, specular=0.03, roughness=0.5)


def paving(rng: Rng, picture_wanted: bool) -> Texture:
    """A texture of a pavement's slabs in rows, with dark joints; where they are small, of bricks.

    `picture_wanted` is false where only size and gloss are needed.
    """
    rows = int(rng.choice([3, 4, 6, 10]))
    row_m = {3: 0.5, 4: 0.4, 6: 0.3, 10: 0.12}[rows]  # height of a row, by their number
    picture: NDArray[np.float64] | None = None
    if picture_wanted:
        color = np.array([0.56, 0.54, 0.5]) * rng.uniform(0.75, 1.15) + rng.normal(0, 0.02, 3)
        if rows == 10 and rng.random() < 0.5:  # bricks
            color = np.array([0.5, 0.32, 0.25]) * rng.uniform(0.8, 1.2)
        x, y = _pixel_x_and_y()
        columns = rows if rows < 10 else 5  # small slabs are twice as wide as high
        row = (y * rows).astype(int)
        # Every second row is shifted by half a slab. Of an odd number of rows none is, because the
        # last would meet the first of the next repeat.
        across = (x * columns + 0.5 * (row % 2) * (rows % 2 == 0)) % columns
        column = across.astype(int)
        slab_shade = 1 + rng.normal(0, 0.05, (rows, columns))[row, column]
        # To the nearest joint, in heights of a row.
        joint_distance = np.minimum(
            np.minimum(across % 1, 1 - across % 1) * rows / columns,
            np.minimum(y * rows % 1, 1 - y * rows % 1),
        )
        stains = 1 + 0.05 * _noise(rng, 80, 4) + 0.05 * _noise(rng, 4, 5)
        brightness = slab_shade * stains * np.clip(0.45 + joint_distance / 0.03, 0, 1)
        picture = _colored(brightness, color)
    return Texture(picture, rows * row_m, specular=0.02, roughness=0.6)


def cobbles(rng: Rng, picture_wanted: bool) -> Texture:
    """A texture of cobblestones: 14 rows of 14 rounded stones, 11 cm wide each.

    `picture_wanted` is false where only size and gloss are needed.
    """
    rows = 14
    picture: NDArray[np.float64] | None = None
    if picture_wanted:
        x, y = _pixel_x_and_y()
        # In widths of a stone; noise bends the rows. Every second row is shifted by half a stone.
        down = y * rows + 0.1 * _noise(rng, 24, 2)
        row = down.astype(int) % rows
        across = (x * rows + 0.5 * (row % 2) + 0.12 * _noise(rng, 24, 2)) % rows
        column = across.astype(int)
        stone_shade = 1 + rng.normal(0, 0.14, (rows, rows))[row, column]
        joint_distance = np.minimum(
            np.minimum(across % 1, 1 - across % 1), np.minimum(down % 1, 1 - down % 1)
        )
        rounded = np.clip(0.35 + 2.2 * joint_distance, 0, 1)  # darker towards the joints
        brightness = stone_shade * rounded * (1 + 0.08 * _noise(rng, 90, 3))
        color = np.array([0.5, 0.48, 0.46]) * rng.uniform(0.7, 1.1) + rng.normal(0, 0.015, 3)
        picture = _colored(brightness, color)
    return Texture(picture, rows * 0.11, specular=0.03, roughness=0.5)


def grass(rng: Rng, picture_wanted: bool) -> Texture:
    """A texture of a lawn: blades of many greens, yellow in places.

    `picture_wanted` is false where only size and gloss are needed.
    """
    tile_m = rng.uniform(1.6, 2.4)
    picture: NDArray[np.float64] | None = None
    if picture_wanted:
        blades = _noise(rng, 160, 2) + 0.7 * rng.standard_normal((base.SIDE, base.SIDE))
        # Blades are longer than wide: each is drawn out over three pixels.
        blades = (blades + np.roll(blades, 1, 0) + np.roll(blades, 2, 0)) / 2
        patches = _noise(rng, 5, 5)
        green = np.array([0.3, 0.38, 0.17]) * rng.uniform(0.8, 1.1)
        yellow = np.array([0.46, 0.43, 0.25])
        dryness = np.clip(0.15 + rng.uniform(-0.15, 0.25) + 0.1 * patches, 0, 0.8)[..., None]
        color = green + (yellow - green) * dryness
        picture = color * (1 + 0.2 * blades + 0.06 * patches)[..., None]
    return Texture(picture, tile_m, specular=0.0, roughness=1.0)


def earth(rng: Rng, picture_wanted: bool) -> Texture:
    """A texture of bare brown soil, or of the pale gravel of a path.

    `picture_wanted` is false where only size and gloss are needed.
    """
    tile_m = rng.uniform(1.2, 2.0)
    picture: NDArray[np.float64] | None = None
    if picture_wanted:
        color = np.array([0.36, 0.29, 0.22]) * rng.uniform(0.7, 1.0)
        if rng.random() < 0.5:  # gravel
            color = np.array([0.62, 0.58, 0.5]) * rng.uniform(0.8, 1.1)
        stones = np.abs(_noise(rng, 100, 2))
        picture = _colored(0.75 + 0.28 * stones + 0.08 * _noise(rng, 6, 5), color)
    return Texture(picture, tile_m, specular=0.0, roughness=1.0)


def roof_tiles(rng: Rng, picture_wanted: bool) -> Texture:
    """A texture of a roof: eight rows of tiles or slates; the picture's upper side is up the roof.

    `picture_wanted` is false where only size and gloss are needed.
    """
    rows = 8
    tile_m = rows * rng.uniform(0.26, 0.34)  # the range is a row's height
    picture: NDArray[np.float64] | None = None
    if picture_wanted:
        colors = ((0.52, 0.28, 0.2), (0.42, 0.24, 0.19), (0.3, 0.3, 0.32), (0.38, 0.35, 0.32))
        color = np.array(colors[int(rng.integers(4))]) * rng.uniform(0.8, 1.1)
        x, y = _pixel_x_and_y()
        curved = rng.random() < 0.6  # tiles, one above the other; otherwise flat slates, shifted
        columns = rows if curved else rows + 4
        up = (1 - y) * rows  # in rows, from the roof's lower end
        row = up.astype(int) % rows
        across = (x * columns + (0.0 if curved else 0.5) * (row % 2)) % columns
        column = across.astype(int)
        tile_shade = 1 + rng.normal(0, 0.09, (rows, columns))[row, column]
        # A row lies over the one below it, so its lower end is light and its upper end in shadow.
        brightness = tile_shade * np.clip(1.08 - 0.25 * (up % 1), 0.6, 1.1)
        brightness = np.where(up % 1 < 0.07, brightness * 0.45, brightness)  # its lower edge
        if curved:
            brightness *= 0.78 + 0.3 * np.sin(np.pi * (across % 1)) ** 0.7
        else:
            joint_distance = np.minimum(across % 1, 1 - across % 1)
            brightness = np.where(joint_distance < 0.03, brightness * 0.6, brightness)
        moss = np.clip(_noise(rng, 5, 5) - 1.1, 0, 1)[..., None]
        clean = _colored(brightness * (1 + 0.05 * _noise(rng, 60, 3)), color)
        picture = clean * (1 - 0.5 * moss) + 0.5 * moss * np.array([0.3, 0.32, 0.2])
    return Texture(picture, tile_m, specular=0.03, roughness=0.5)


def stone_wall(rng: Rng, picture_wanted: bool) -> Texture:
    """A texture of a wall of 60 field stones in mortar.

    A stone is all pixels to which one of 60 random points is the nearest (its Voronoi cell).
    `picture_wanted` is false where only size and gloss are needed.
    """
    tile_m, specular, roughness = 1.8, 0.0, 1.0
    if not picture_wanted:
        return Texture(None, tile_m, specular, roughness)
    stones = 60
    points = rng.random((stones, 2))
    x, y = _pixel_x_and_y()
    # [S, S] distances to the nearest and the second nearest point, and the nearest point's number.
    # They begin farther than any point is, as the picture's sides are 1.
    nearest = np.full((base.SIDE, base.SIDE), 9.0)
    second = nearest.copy()
    stone = np.zeros((base.SIDE, base.SIDE), int)
    for number, (px, py) in enumerate(points):
        # Distances around the picture's borders, so that it repeats. Those along y count more, so
        # that stones are wider than high.
        dx = np.abs(x - px)
        dy = np.abs(y - py)
        distance = np.hypot(np.minimum(dx, 1 - dx), 1.5 * np.minimum(dy, 1 - dy))
        closer = distance < nearest
        second = np.where(closer, nearest, np.minimum(second, distance))
        stone = np.where(closer, number, stone)
        nearest = np.where(closer, distance, nearest)
    color = np.array([0.55, 0.5, 0.44]) * rng.uniform(0.7, 1.1)
    # Stones differ in brightness, and a little in colour.
    brightness_changes = rng.normal(0, 0.05, (stones, 1))
    color_changes = rng.normal(0, 0.015, (stones, 3))
    stone_colors = np.clip(color + brightness_changes + color_changes, 0, 1)
    # Dark mortar is where two points are about equally far: their distances differ by less than
    # 0.018 of the picture's side, at which the brightness reaches 1.
    mortar = np.clip(0.4 + (second - nearest) / 0.03, 0, 1)
    brightness = mortar * (1 + 0.1 * _noise(rng, 40, 5))
    return Texture(stone_colors[stone] * brightness[..., None], tile_m, specular, roughness)


def boards(rng: Rng, picture_wanted: bool) -> Texture:
    """A texture of weatherboards, painted or weathered: eight horizontal boards, 15 cm high each.

    `picture_wanted` is false where only size and gloss are needed.
    """
    rows = 8
    picture: NDArray[np.float64] | None = None
    if picture_wanted:
        paints = ((0.86, 0.84, 0.78), (0.6, 0.66, 0.7), (0.5, 0.2, 0.16), (0.55, 0.5, 0.42),
                  (0.78, 0.72, 0.55), (0.4, 0.47, 0.42))  # fmt: skip
        color = np.array(paints[int(rng.integers(len(paints)))]) * rng.uniform(0.85, 1.08)
        _, y = _pixel_x_and_y()
        up = (1 - y) * rows  # in boards, from below
        # Each board slants outwards: below it lies the shadow of its edge, and above that the
        # board gets lighter upwards.
        slant = np.where(up % 1 < 0.06, 0.5, 0.93 + 0.1 * (up % 1))
        board_shade = 1 + rng.normal(0, 0.02, rows)[up.astype(int) % rows]
        # The wood's streaks run along the boards: every eighth column of noise, 8 pixels wide.
        streaks = np.repeat(_noise(rng, 90, 3)[:, ::8], 8, 1)[:, : base.SIDE]
        picture = _colored(slant * board_shade * (1 + 0.03 * streaks), color)
    return Texture(picture, rows * 0.15, specular=0.02, roughness=0.6)


def panes(rng: Rng, picture_wanted: bool) -> Texture:
    """A texture of a window by day: a dark room, mostly with a cloth before it; glossy as glass.

    The cloth is curtains at both sides, a net or a blind. The picture is laid over a window once,
    whatever the window's size, so that its size of 1 m and its borders do not matter.
    `picture_wanted` is false where only size and gloss are needed.
    """
    tile_m, specular, roughness = 1.0, 0.09, 0.04
    if not picture_wanted:
        return Texture(None, tile_m, specular, roughness)
    x, y = _pixel_x_and_y()
    room_brightness = rng.uniform(0.04, 0.16)
    room_color = np.array([1.0, 0.95, 0.9]) * room_brightness
    # The floor, which gets light through the window, is brighter than the ceiling: y runs down.
    room = _colored(0.6 + 0.5 * y + 0.1 * _noise(rng, 3, 3), room_color)
    cover = np.zeros_like(x)  # [S, S] how much of the room the cloth hides
    kind = rng.random()
    cloth_color = np.array([0.78, 0.76, 0.7]) * rng.uniform(0.55, 1.0)
    # Brightness of upright folds, 9 to 15 of them.
    folds = 0.85 + 0.15 * np.sin(2 * np.pi * rng.integers(9, 16) * x + _noise(rng, 3, 3))
    if kind < 0.45:  # curtains at both sides, gathered at half of their height
        width = rng.uniform(0.12, 0.34)
        width_here = width * (1 - 0.25 * np.sin(np.pi * y))
        cover = (np.minimum(x, 1 - x) < width_here).astype(np.float64)
    elif kind < 0.6:  # a net before all of it
        cover = np.full_like(x, 0.55)
    elif kind < 0.75:  # a blind of 24 slats, partly down
        cover = (y < rng.uniform(0.2, 0.75)).astype(np.float64)
        folds = np.where(y * 24 % 1 > 0.2, 1.0, 0.85)
    picture = room + (_colored(folds, cloth_color) - room) * cover[..., None]
    return Texture(picture, tile_m, specular, roughness)


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
