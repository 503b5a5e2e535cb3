"""Random textures of streets and gardens, drawn once and kept as PNG files; see `surfaces`.

A texture is a picture of S × S pixels (S is `surfaces.SIDE`) that repeats without a seam, but for
`panes`. Each function of `OUTDOOR_KINDS` draws a random texture of its kind. Pixel coordinates x
and y run from 0 to 1: x to the right and y downwards, so that on a wall y = 0 is up. Colours are
sRGB, 0 to 1.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from worlds.surfaces import (
    KINDS,
    Color,
    Draw,
    Floats,
    Rng,
    Surface,
    Texture,
    colored,
    drawn_surfaces,
    joint_distance,
    pixel_noise,
    pixel_x_and_y,
    smooth_noise,
)

ROOF_COLORS: tuple[Color, ...] = (
    (0.52, 0.28, 0.2),  # red clay
    (0.42, 0.24, 0.19),  # brown clay
    (0.3, 0.3, 0.32),  # slate
    (0.38, 0.35, 0.32),  # concrete
)
BOARD_COLORS: tuple[Color, ...] = (
    (0.86, 0.84, 0.78),  # white
    (0.6, 0.66, 0.7),  # pale blue
    (0.5, 0.2, 0.16),  # red
    (0.55, 0.5, 0.42),  # weathered wood
    (0.78, 0.72, 0.55),  # pale yellow
    (0.4, 0.47, 0.42),  # green
)


def outdoor_surfaces(folder: Path, kind: str) -> list[Surface]:
    """All surfaces of a kind; their pictures are drawn into `folder` at the first call.

    Args:
        folder: where their pictures are kept.
        kind: a key of `OUTDOOR_KINDS`, or of `surfaces.KINDS` for the kinds that rooms have too.
    """
    draw = OUTDOOR_KINDS[kind] if kind in OUTDOOR_KINDS else KINDS[kind]
    return drawn_surfaces(folder, kind, draw)


def asphalt(rng: Rng, picture_wanted: bool) -> Texture:
    """A texture of a road's asphalt: small stones in tar, with stains and a few cracks.

    `picture_wanted` is false where only size and gloss are needed.
    """
    tile_m = rng.uniform(3.5, 5.0)
    specular = 0.03  # tar is a little glossy
    roughness = 0.5
    if not picture_wanted:
        return Texture(None, tile_m, specular, roughness)

    grey = rng.uniform(0.3, 0.48)
    stones = pixel_noise(rng)  # a stone is smaller than a pixel, which is 7 to 10 mm wide
    small_stains = smooth_noise(rng, spots_across=90, octaves=3)
    large_stains = smooth_noise(rng, spots_across=3, octaves=5)
    brightness = 1 + 0.09 * stones + 0.1 * small_stains + 0.07 * large_stains

    # Cracks are thin lines, where one noise changes its sign. They are only in a quarter of the
    # road, where another noise is high.
    is_crack = np.abs(smooth_noise(rng, spots_across=3, octaves=6)) < 0.012
    is_broken_place = smooth_noise(rng, spots_across=4, octaves=3) > 0.6
    brightness = np.where(is_crack & is_broken_place, brightness * 0.55, brightness)

    warm_white = np.array([1.0, 0.985, 0.96]) + rng.normal(0, 0.01, 3)
    return Texture(colored(grey * brightness, warm_white), tile_m, specular, roughness)


def paving(rng: Rng, picture_wanted: bool) -> Texture:
    """A texture of a pavement of slabs with dark joints, 30 to 50 cm wide, or of small stones.

    Small ones are 24 cm wide and 12 cm high; half of these are bricks. `picture_wanted` is false
    where only size and gloss are needed.
    """
    rows = int(rng.choice([3, 4, 6, 10]))
    row_m = {3: 0.5, 4: 0.4, 6: 0.3, 10: 0.12}[rows]  # height of a row, by their number
    tile_m = rows * row_m
    specular = 0.02  # worn smooth by feet
    roughness = 0.6
    if not picture_wanted:
        return Texture(None, tile_m, specular, roughness)

    is_small = rows == 10
    color = np.array([0.56, 0.54, 0.5]) * rng.uniform(0.75, 1.15) + rng.normal(0, 0.02, 3)
    if is_small and rng.random() < 0.5:
        color = np.array([0.5, 0.32, 0.25]) * rng.uniform(0.8, 1.2)  # brick
    x, y = pixel_x_and_y()
    columns = 5 if is_small else rows  # slabs are square, small stones twice as wide as high

    # Every second row is shifted by half a slab. Of an odd number of rows none is, because the
    # last would meet the first of the next repeat.
    row = (y * rows).astype(int)
    row_shift = 0.5 if rows % 2 == 0 else 0.0
    across = (x * columns + row_shift * (row % 2)) % columns  # in slabs
    column = across.astype(int)
    slab_shade = 1 + rng.normal(0, 0.05, (rows, columns))[row, column]
    small_stains = smooth_noise(rng, spots_across=80, octaves=4)
    large_stains = smooth_noise(rng, spots_across=4, octaves=5)
    stains = 1 + 0.05 * small_stains + 0.05 * large_stains

    # To the nearest joint, in heights of a row. Joints have 45 % of the brightness, which is whole
    # at 1.7 % of a row's height from the joint's middle.
    to_joint = np.minimum(joint_distance(across) * rows / columns, joint_distance(y * rows))
    joint_shade = np.clip(0.45 + to_joint / 0.03, 0, 1)
    picture = colored(slab_shade * stains * joint_shade, color)
    return Texture(picture, tile_m, specular, roughness)


def cobbles(rng: Rng, picture_wanted: bool) -> Texture:
    """A texture of cobblestones: 14 rows of 14 rounded stones, 11 cm wide each.

    `picture_wanted` is false where only size and gloss are needed.
    """
    rows = 14
    tile_m = rows * 0.11
    specular = 0.03  # worn smooth by wheels
    roughness = 0.5
    if not picture_wanted:
        return Texture(None, tile_m, specular, roughness)

    # Places are counted in widths of a stone. Noise bends the rows, by a tenth of a stone. Every
    # second row is shifted by half a stone.
    x, y = pixel_x_and_y()
    down = y * rows + 0.1 * smooth_noise(rng, spots_across=24, octaves=2)
    row = down.astype(int) % rows
    row_bend = 0.12 * smooth_noise(rng, spots_across=24, octaves=2)
    across = (x * rows + 0.5 * (row % 2) + row_bend) % rows
    column = across.astype(int)
    stone_shade = 1 + rng.normal(0, 0.14, (rows, rows))[row, column]

    # Stones are round, so they get darker towards the joints, from 0.3 of a stone's width on.
    to_joint = np.minimum(joint_distance(across), joint_distance(down))
    rounded = np.clip(0.35 + 2.2 * to_joint, 0, 1)
    rough_stone = 1 + 0.08 * smooth_noise(rng, spots_across=90, octaves=3)
    brightness = stone_shade * rounded * rough_stone
    granite = np.array([0.5, 0.48, 0.46]) * rng.uniform(0.7, 1.1) + rng.normal(0, 0.015, 3)
    return Texture(colored(brightness, granite), tile_m, specular, roughness)


def grass(rng: Rng, picture_wanted: bool) -> Texture:
    """A texture of a lawn: blades of many greens, yellow in places.

    `picture_wanted` is false where only size and gloss are needed.
    """
    tile_m = rng.uniform(1.6, 2.4)
    specular = 0.0  # without any gloss
    roughness = 1.0
    if not picture_wanted:
        return Texture(None, tile_m, specular, roughness)

    # Blades are longer than wide: the mean over three pixels below each other. (It is half of
    # their sum, not a third, because a mean has less contrast.)
    dots = smooth_noise(rng, spots_across=160, octaves=2) + 0.7 * pixel_noise(rng)
    blades = (dots + np.roll(dots, 1, 0) + np.roll(dots, 2, 0)) / 2

    patches = smooth_noise(rng, spots_across=5, octaves=5)
    green = np.array([0.3, 0.38, 0.17]) * rng.uniform(0.8, 1.1)
    yellow = np.array([0.46, 0.43, 0.25])
    lawn_dryness = 0.15 + rng.uniform(-0.15, 0.25)  # 0: green, 1: yellow
    dryness = np.clip(lawn_dryness + 0.1 * patches, 0, 0.8)[..., None]
    color = green + (yellow - green) * dryness  # [S, S, 3]
    picture = color * (1 + 0.2 * blades + 0.06 * patches)[..., None]
    return Texture(picture, tile_m, specular, roughness)


def earth(rng: Rng, picture_wanted: bool) -> Texture:
    """A texture of bare brown soil, or of the pale gravel of a path, each in half of the cases.

    `picture_wanted` is false where only size and gloss are needed.
    """
    tile_m = rng.uniform(1.2, 2.0)
    specular = 0.0  # without any gloss
    roughness = 1.0
    if not picture_wanted:
        return Texture(None, tile_m, specular, roughness)

    color = np.array([0.36, 0.29, 0.22]) * rng.uniform(0.7, 1.0)  # soil
    if rng.random() < 0.5:
        color = np.array([0.62, 0.58, 0.5]) * rng.uniform(0.8, 1.1)  # gravel
    # The noise is dark where it changes its sign, so that light stones have dark lines around.
    stones = np.abs(smooth_noise(rng, spots_across=100, octaves=2))
    stains = smooth_noise(rng, spots_across=6, octaves=5)
    picture = colored(0.75 + 0.28 * stones + 0.08 * stains, color)
    return Texture(picture, tile_m, specular, roughness)


def roof_tiles(rng: Rng, picture_wanted: bool) -> Texture:
    """A texture of a roof: eight rows of round tiles (60 %) or flat slates, with some moss.

    The picture's upper side is up the roof. `picture_wanted` is false where only size and gloss are
    needed.
    """
    rows = 8
    row_m = rng.uniform(0.26, 0.34)  # height of the part of a tile that one sees
    tile_m = rows * row_m
    specular = 0.03  # of fired clay
    roughness = 0.5
    if not picture_wanted:
        return Texture(None, tile_m, specular, roughness)

    color = np.array(ROOF_COLORS[int(rng.integers(len(ROOF_COLORS)))]) * rng.uniform(0.8, 1.1)
    is_round = rng.random() < 0.6
    # Slates are narrower, and every second row of them is shifted by half a slate, so that no gap
    # lies above another. Round tiles lie one above the other.
    columns = rows if is_round else rows + 4
    row_shift = 0.0 if is_round else 0.5
    x, y = pixel_x_and_y()
    up = (1 - y) * rows  # in rows, from the roof's lower end
    row = up.astype(int) % rows
    across = (x * columns + row_shift * (row % 2)) % columns  # in tiles
    column = across.astype(int)
    tile_shade = 1 + rng.normal(0, 0.09, (rows, columns))[row, column]

    # A row lies over the one below it: its lower end is light, its upper end lies in the shadow of
    # the next row, and its lower edge is dark.
    up_in_row = up % 1  # 0 to 1
    brightness = tile_shade * np.clip(1.08 - 0.25 * up_in_row, 0.6, 1.1)
    brightness = np.where(up_in_row < 0.07, brightness * 0.45, brightness)
    if is_round:
        # From dark at both sides of a tile to light in its middle.
        brightness *= 0.78 + 0.3 * np.sin(np.pi * (across % 1)) ** 0.7
    else:
        gap = joint_distance(across) < 0.03  # 6 % of a slate's width
        brightness = np.where(gap, brightness * 0.6, brightness)

    # Moss is where noise is highest, on a seventh of the roof. It hides at most half of the tiles.
    moss_noise = smooth_noise(rng, spots_across=5, octaves=5)
    moss = np.clip(moss_noise - 1.1, 0, 1)[..., None]
    moss_color = np.array([0.3, 0.32, 0.2])
    weathering = 1 + 0.05 * smooth_noise(rng, spots_across=60, octaves=3)
    clean = colored(brightness * weathering, color)
    picture = clean * (1 - 0.5 * moss) + 0.5 * moss * moss_color
    return Texture(picture, tile_m, specular, roughness)


def stone_wall(rng: Rng, picture_wanted: bool) -> Texture:
    """A texture of a wall of 60 field stones in mortar; it repeats every 1.8 m.

    A stone is all pixels to which one of 60 random points is the nearest (its Voronoi cell).
    `picture_wanted` is false where only size and gloss are needed.
    """
    tile_m = 1.8
    specular = 0.0
    roughness = 1.0
    if not picture_wanted:
        return Texture(None, tile_m, specular, roughness)

    stone_count = 60
    points = rng.random((stone_count, 2))  # x and y of each
    stone, nearest, second = _nearest_points(points)

    # Stones differ in brightness, and a little in colour.
    color = np.array([0.55, 0.5, 0.44]) * rng.uniform(0.7, 1.1)
    brightness_changes = rng.normal(0, 0.05, (stone_count, 1))
    color_changes = rng.normal(0, 0.015, (stone_count, 3))
    stone_colors = np.clip(color + brightness_changes + color_changes, 0, 1)

    # Dark mortar is where two points are about equally far: their distances differ by less than
    # 0.018 of the picture's side, at which the brightness reaches 1.
    mortar_shade = np.clip(0.4 + (second - nearest) / 0.03, 0, 1)
    rough_stone = 1 + 0.1 * smooth_noise(rng, spots_across=40, octaves=5)
    brightness = mortar_shade * rough_stone
    picture = stone_colors[stone] * brightness[..., None]
    return Texture(picture, tile_m, specular, roughness)


def _nearest_points(points: Floats) -> tuple[NDArray[np.int64], Floats, Floats]:
    """[S, S] the number of the nearest point, the distance to it, and that to the second nearest.

    Distances are in sides of the picture, and go across its borders where this is shorter, so that
    it repeats. Those along y count 1.5 times, so that the pixels nearest to a point are a region
    that is wider than high. `points` are [N, 2] x and y, 0 to 1.
    """
    x, y = pixel_x_and_y()
    # Both begin farther than any point is, as the picture's sides are 1.
    nearest = np.full_like(x, 9.0)
    second = np.full_like(x, 9.0)
    nearest_number = np.zeros(x.shape, np.int64)
    for number, (point_x, point_y) in enumerate(points):
        right = np.abs(x - point_x)
        down = np.abs(y - point_y)
        distance = np.hypot(np.minimum(right, 1 - right), 1.5 * np.minimum(down, 1 - down))
        is_nearer = distance < nearest
        second = np.where(is_nearer, nearest, np.minimum(second, distance))
        nearest_number = np.where(is_nearer, number, nearest_number)
        nearest = np.where(is_nearer, distance, nearest)
    return nearest_number, nearest, second


def boards(rng: Rng, picture_wanted: bool) -> Texture:
    """A texture of weatherboards, painted or weathered: eight horizontal boards, 15 cm high each.

    `picture_wanted` is false where only size and gloss are needed.
    """
    rows = 8
    tile_m = rows * 0.15
    specular = 0.02  # of old paint
    roughness = 0.6
    if not picture_wanted:
        return Texture(None, tile_m, specular, roughness)

    color = np.array(BOARD_COLORS[int(rng.integers(len(BOARD_COLORS)))]) * rng.uniform(0.85, 1.08)
    _, y = pixel_x_and_y()
    up = (1 - y) * rows  # in boards, from below
    board = up.astype(int) % rows
    # Each board overlaps the one below it and slants outwards. Its lower edge is a dark shadow;
    # above that the board gets lighter upwards, as it looks more to the sky.
    up_in_board = up % 1  # 0 to 1
    slant = np.where(up_in_board < 0.06, 0.5, 0.93 + 0.1 * up_in_board)
    board_shade = 1 + rng.normal(0, 0.02, rows)[board]
    # The wood's streaks run along the boards: every eighth column of noise, 8 pixels wide.
    noise = smooth_noise(rng, spots_across=90, octaves=3)
    streaks = np.repeat(noise[:, ::8], 8, 1)[:, : noise.shape[1]]
    picture = colored(slant * board_shade * (1 + 0.03 * streaks), color)
    return Texture(picture, tile_m, specular, roughness)


def panes(rng: Rng, picture_wanted: bool) -> Texture:
    """A texture of a window by day: a dark room, mostly with a cloth before it; glossy as glass.

    The cloth is curtains at both sides (45 %), a net (15 %) or a blind (15 %). The picture is laid
    over a window once, whatever the window's size, so that its size of 1 m and its borders do not
    matter. `picture_wanted` is false where only size and gloss are needed.
    """
    tile_m = 1.0
    specular = 0.09  # glass mirrors about 4 % at each of its two sides
    roughness = 0.04
    if not picture_wanted:
        return Texture(None, tile_m, specular, roughness)

    # By day a room is dark, seen from outside. Its floor, which gets light through the window, is
    # brighter than its ceiling: y runs down.
    x, y = pixel_x_and_y()
    room_brightness = rng.uniform(0.04, 0.16)
    room_color = np.array([1.0, 0.95, 0.9]) * room_brightness
    furniture = smooth_noise(rng, spots_across=3, octaves=3)  # dim shapes
    room = colored(0.6 + 0.5 * y + 0.1 * furniture, room_color)

    # [S, S] how much of the room the cloth hides, 0 to 1, and the brightness of the cloth's 9 to
    # 15 upright folds.
    cover = np.zeros_like(x)
    cloth = rng.random()
    cloth_color = np.array([0.78, 0.76, 0.7]) * rng.uniform(0.55, 1.0)
    fold_count = rng.integers(9, 16)
    uneven_phase = smooth_noise(rng, spots_across=3, octaves=3)
    folds = 0.85 + 0.15 * np.sin(2 * np.pi * fold_count * x + uneven_phase)
    if cloth < 0.45:
        # Curtains at both sides, gathered at half of their height.
        width = rng.uniform(0.12, 0.34)
        width_here = width * (1 - 0.25 * np.sin(np.pi * y))
        cover = (np.minimum(x, 1 - x) < width_here).astype(np.float64)
    elif cloth < 0.6:
        # A net before all of it, which one sees through.
        cover = np.full_like(x, 0.55)
    elif cloth < 0.75:
        # A blind, partly down, of 24 slats with dark gaps instead of folds.
        lower_end = rng.uniform(0.2, 0.75)
        cover = (y < lower_end).astype(np.float64)
        folds = np.where(y * 24 % 1 > 0.2, 1.0, 0.85)
    picture = room + (colored(folds, cloth_color) - room) * cover[..., None]
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
