"""Random textures of walls, floors and fabrics, drawn once and kept as PNG files.

A texture is a picture of S × S pixels (S is `SIDE`) that repeats without a seam, but for `rug`,
which is seen whole. One repeat covers `tile_m` metres of a surface, so that boards are as wide as
boards. Each function of `KINDS` draws a random texture of its kind. Pixel coordinates x and y run
from 0 to 1: x to the right and y downwards. Colours are sRGB, 0 to 1.
"""

from __future__ import annotations

import dataclasses
import functools
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from spackle.runtime.files import atomic_path
from worlds.lights import cloud_noise

Rng = np.random.Generator
Floats = NDArray[np.float64]
Color = tuple[float, float, float]  # sRGB, 0 to 1

SIDE = 512  # pixels along each side of a texture; a multiple of 32, the length of wood's fibres
PER_KIND = 16  # textures of each kind
SURFACES_VERSION = 2  # a part of the seeds; increases whenever the pictures change

WOODS: tuple[Color, ...] = (
    (0.62, 0.45, 0.28),  # oak
    (0.72, 0.56, 0.38),  # pine
    (0.45, 0.3, 0.18),  # walnut
    (0.3, 0.19, 0.12),  # wenge
    (0.8, 0.68, 0.5),  # birch
    (0.55, 0.52, 0.48),  # old and grey
    (0.5, 0.27, 0.16),  # mahogany
)
STONES: tuple[Color, ...] = (
    (0.75, 0.72, 0.68),  # limestone
    (0.5, 0.5, 0.5),  # granite
    (0.3, 0.3, 0.32),  # slate
    (0.85, 0.82, 0.78),  # white marble
    (0.6, 0.5, 0.42),  # sandstone
)


@dataclasses.dataclass(frozen=True)
class Surface:
    """A texture that is kept in a file, and how large and shiny it is."""

    kind: str  # such as "planks"
    file: str  # path of its picture, a PNG
    tile_m: float  # metres of the surface that one repeat of the picture covers, along both sides
    specular: float  # share of light that is mirrored when looked at straight on
    roughness: float  # 0: a mirror, 1: chalk


class Texture(NamedTuple):
    """A texture as it is drawn."""

    picture: Floats | None  # [S, S, 3] sRGB, clipped to 0..1 when it is saved; None: not wanted
    tile_m: float  # metres of the surface that one repeat of the picture covers, along both sides
    specular: float  # share of light that is mirrored when looked at straight on
    roughness: float  # 0: a mirror, 1: chalk


# Draws a random texture. The second argument is whether its picture is wanted; it is not if its
# file is there. Size and gloss are drawn before the picture: they are the same with and without it.
Draw = Callable[[Rng, bool], Texture]


def surfaces(folder: Path, kind: str) -> list[Surface]:
    """All surfaces of a kind; their pictures are drawn into `folder` at the first call.

    Args:
        folder: where their pictures are kept.
        kind: a key of `KINDS`, such as "planks".
    """
    return drawn_surfaces(folder, kind, KINDS[kind])


@functools.lru_cache(64)
def drawn_surfaces(folder: Path, kind: str, draw: Draw) -> list[Surface]:
    """PER_KIND random surfaces of a kind; their pictures are drawn if `folder` lacks their files.

    Args:
        folder: where their pictures are kept, as files whose names begin with the kind.
        kind: such as "planks"; with a surface's number, it is also the seed of its texture.
        draw: draws a random texture of the kind.
    """
    folder.mkdir(parents=True, exist_ok=True)
    kind_seed = zlib.crc32(kind.encode())  # Python's own hash would differ from run to run
    result = []
    for number in range(PER_KIND):
        rng = np.random.default_rng([SURFACES_VERSION, kind_seed, number])
        path = folder / f"{kind}-v{SURFACES_VERSION}-{number:02d}.png"
        picture_wanted = not path.is_file()
        texture = draw(rng, picture_wanted)
        if texture.picture is not None:
            _save_png(path, texture.picture)
        result.append(Surface(kind, str(path), texture.tile_m, texture.specular, texture.roughness))
    return result


def _save_png(path: Path, picture: Floats) -> None:
    """Write a picture [S, S, 3], whose values are clipped to 0..1, as a PNG of 8 bits."""
    values = (np.clip(picture, 0, 1) * 255 + 0.5).astype(np.uint8)  # + 0.5 rounds to the nearest
    with atomic_path(path) as temporary:
        Image.fromarray(values).save(temporary)


# --- What the textures are made of; all arrays [S, S] are pixels of one repeat


def pixel_x_and_y() -> tuple[Floats, Floats]:
    """[S, S] x (to the right) and [S, S] y (downwards) of pixel centres, 0 to 1."""
    row, column = np.mgrid[:SIDE, :SIDE]
    return (column + 0.5) / SIDE, (row + 0.5) / SIDE


def smooth_noise(rng: Rng, *, spots_across: int, octaves: int) -> Floats:
    """[S, S] noise with a mean of 0 and a deviation of 1, which repeats without a seam.

    Args:
        rng: for the noise.
        spots_across: how many of its largest light and dark spots lie side by side.
        octaves: how many sizes of spots it has, each half as large as the one before.
    """
    return cloud_noise(rng, (SIDE, SIDE), spots_across, octaves)


def pixel_noise(rng: Rng) -> Floats:
    """[S, S] noise with a mean of 0 and a deviation of 1, another value in each pixel."""
    return rng.standard_normal((SIDE, SIDE))


def joint_distance(position: Floats) -> Floats:
    """[S, S] distance from positions [S, S] to the nearest whole number: 0 to 0.5.

    Positions are counted in tiles, boards or bricks, so that joints are at whole numbers.
    """
    share_of_tile = position % 1
    return np.minimum(share_of_tile, 1 - share_of_tile)


def colored(brightness: Floats, color: Floats | Color) -> Floats:
    """[S, S, 3] a colour [3] times the brightness [S, S] of each pixel, which is 1 on the whole."""
    return np.asarray(brightness[..., None] * np.asarray(color))


def _color_like_one_of(rng: Rng, colors: tuple[Color, ...]) -> Floats:
    """[3] a random one of some sRGB colours, a little changed in brightness and in each channel."""
    color = np.array(colors[int(rng.integers(len(colors)))])
    varied = color * rng.uniform(0.85, 1.12) + rng.normal(0, 0.02, 3)
    return np.asarray(np.clip(varied, 0.03, 0.95))  # nothing is quite black or white


def _random_hue(rng: Rng, *, saturation: float, value: float) -> Floats:
    """[3] an sRGB colour of random hue.

    Args:
        rng: for the hue.
        saturation: 0: grey; 1: the darkest channel is near 0.
        value: the brightest channel is this or a little darker.
    """
    hue = rng.random() * 2 * np.pi  # as an angle in the circle of colours
    # Red, green and blue lie at 0°, 120° and 240° in this circle.
    channel_angles = np.array([0, 2.09, 4.19])
    strength = 0.5 + 0.5 * np.cos(hue - channel_angles)  # [3], 0 to 1
    return np.asarray(value * (1 - saturation + saturation * strength))


def _wood_grain(rng: Rng, stretch: int) -> Floats:
    """[S, S] the grain of wood, as changes of brightness around 0: light and dark lines along x.

    Args:
        rng: for the grain.
        stretch: how many times as long as wide its details are.
    """
    fibres = smooth_noise(rng, spots_across=4, octaves=7)

    # Noise with few columns, each of which is repeated `stretch` times: it is stretched along x.
    narrow_noise = cloud_noise(rng, (SIDE, SIDE // stretch), spots_across=4, octaves=5)
    stepped = np.repeat(narrow_noise, stretch, 1)
    missing_columns = SIDE - stepped.shape[1]  # if SIDE is no multiple of `stretch`
    stepped = np.pad(stepped, ((0, 0), (0, missing_columns)), mode="wrap")

    # The mean of `stretch` neighbours removes the steps between repeated columns.
    weights = np.ones(stretch) / stretch

    def smoothed_row(row: Floats) -> Floats:
        """A row without steps: the middle one of three side by side, so that there is no seam."""
        return np.convolve(np.tile(row, 3), weights, "same")[SIDE : 2 * SIDE]

    stretched = np.apply_along_axis(smoothed_row, 1, stepped)

    # A board cuts a tree's yearly rings lengthwise. Waves of the stretched noise look like that:
    # six rings for each unit of noise, a little bent by the fibres.
    rings = np.sin(2 * np.pi * (6 * stretched + 0.3 * fibres))
    pores = np.repeat(rng.standard_normal((SIDE, SIDE // 32)), 32, 1)  # dashes of 32 × 1 pixels
    return 0.5 * rings + 0.5 * stretched + 0.25 * pores


# --- The kinds


def planks(rng: Rng, picture_wanted: bool) -> Texture:
    """A texture of a wooden floor: 6 to 11 boards along x, 8 to 20 cm wide, of 1 to 3 pieces each.

    `picture_wanted` is false where only size and gloss are needed.
    """
    board_count = int(rng.integers(6, 12))
    board_width_m = rng.uniform(0.08, 0.2)
    tile_m = board_count * board_width_m
    specular = 0.04  # of varnish, as of glass
    roughness = rng.uniform(0.15, 0.5)
    if not picture_wanted:
        return Texture(None, tile_m, specular, roughness)

    color = _color_like_one_of(rng, WOODS)
    x, y = pixel_x_and_y()

    # [S, S] the number of the board that a pixel lies in, and of the piece of this board. Boards
    # are shifted along x, so that joints between pieces are not beside each other.
    board = (y * board_count).astype(int)
    shift = rng.random(board_count)[board]
    piece_count = int(rng.integers(1, 4))  # of each board
    along = (x + shift) * piece_count  # in pieces
    piece = (along % piece_count).astype(int)

    # Each piece has its own brightness, and its grain from another place of one large board.
    shade_deviation = rng.uniform(0.03, 0.12)
    shade = 1 + rng.normal(0, shade_deviation, (board_count, piece_count))[board, piece]
    whole_grain = _wood_grain(rng, stretch=24)
    pixel_row, pixel_column = np.indices((SIDE, SIDE))
    grain_shift = rng.integers(0, SIDE, (board_count, piece_count))[board, piece]  # in pixels
    grain = whole_grain[pixel_row, (pixel_column + grain_shift) % SIDE]
    grain_strength = rng.uniform(0.03, 0.1)
    picture = colored(shade * (1 + grain_strength * grain), color)

    # Dark gaps: between boards 2.4 % of a board's width, between pieces 0.3 % of the picture's.
    between_boards = joint_distance(y * board_count) < 0.012
    between_pieces = joint_distance(along) < 0.0015 * piece_count
    gap = between_boards | between_pieces
    picture = np.where(gap[..., None], picture * 0.45, picture)
    return Texture(picture, tile_m, specular, roughness)


def parquet(rng: Rng, picture_wanted: bool) -> Texture:
    """A texture of a floor of wooden strips, in 4 × 4 squares whose strips change direction.

    A square is 25 to 45 cm wide. `picture_wanted` is false where only size and gloss are needed.
    """
    square_count = 4  # along each side of the picture; even, so that directions repeat, too
    tile_m = square_count * rng.uniform(0.25, 0.45)
    specular = 0.04  # of varnish, as of glass
    roughness = rng.uniform(0.12, 0.4)
    if not picture_wanted:
        return Texture(None, tile_m, specular, roughness)

    color = _color_like_one_of(rng, WOODS)
    strip_count = int(rng.integers(4, 7))  # in each square
    x, y = pixel_x_and_y()
    column = (x * square_count).astype(int)
    row = (y * square_count).astype(int)

    # Strips run up, along y, in every second square, and along x in the others.
    runs_up = (column + row) % 2 == 0
    across_square = np.where(runs_up, x * square_count % 1, y * square_count % 1)  # 0 to 1
    across_strips = across_square * strip_count  # in strips
    strip = across_strips.astype(int)
    shape = (square_count, square_count, strip_count)
    shade = 1 + rng.normal(0, 0.09, shape)[row, column, strip]
    grain_along_x = _wood_grain(rng, stretch=16)
    grain = np.where(runs_up, grain_along_x.T, grain_along_x)
    picture = colored(shade * (1 + 0.06 * grain), color)

    # Dark gaps between strips, 6 % of a strip's width.
    gap = joint_distance(across_strips) < 0.03
    picture = np.where(gap[..., None], picture * 0.6, picture)
    return Texture(picture, tile_m, specular, roughness)


def tiles(rng: Rng, picture_wanted: bool) -> Texture:
    """A texture of a floor of square stone tiles with mortar between, 15 to 60 cm wide.

    In some, tiles of two colours take turns. `picture_wanted` is false where only size and gloss
    are needed.
    """
    count = int(rng.integers(2, 5))  # along each side of the picture
    side_m = rng.uniform(0.15, 0.6)
    tile_m = count * side_m
    specular = 0.05  # of polished stone
    roughness = rng.uniform(0.05, 0.35)
    if not picture_wanted:
        return Texture(None, tile_m, specular, roughness)

    first_color = _color_like_one_of(rng, STONES)
    second_color = first_color
    if rng.random() < 0.3:
        second_color = _color_like_one_of(rng, STONES)
    if count % 2:
        second_color = first_color  # with an odd number, equal tiles would meet at the seam
    x, y = pixel_x_and_y()
    column = (x * count).astype(int)
    row = (y * count).astype(int)
    is_first = (column + row) % 2 == 0  # [S, S] every second tile, as on a chessboard
    color = np.where(is_first[..., None], first_color, second_color)
    shade = 1 + rng.normal(0, 0.03, (count, count))[row, column]

    # Veins of the other tiles come from another place, so that no vein crosses the mortar.
    veins = smooth_noise(rng, spots_across=6, octaves=6)
    other_veins = np.roll(veins, SIDE // 3, 1)
    vein_strength = rng.uniform(0.01, 0.09)
    brightness = shade * (1 + vein_strength * np.where(is_first, veins, other_veins))
    picture = color * brightness[..., None]

    half_mortar = rng.uniform(0.006, 0.014)  # half of the joint's width, in tiles
    mortar_color = np.array([0.55, 0.53, 0.5]) * rng.uniform(0.4, 1.4)
    to_joint = np.minimum(joint_distance(x * count), joint_distance(y * count))  # in tiles
    picture = np.where((to_joint < half_mortar)[..., None], mortar_color, picture)
    return Texture(picture, tile_m, specular, roughness)


def wall_tiles(rng: Rng, picture_wanted: bool) -> Texture:
    """A texture of small glazed tiles of kitchens and bathrooms, 7 to 20 cm wide.

    They are square, or half as high as wide and laid as bricks are. `picture_wanted` is false where
    only size and gloss are needed.
    """
    columns = int(rng.integers(4, 9))
    width_to_height = int(rng.choice([1, 1, 2]))  # two thirds are square
    tile_m = columns * rng.uniform(0.07, 0.2)
    specular = 0.05  # of glaze
    roughness = rng.uniform(0.08, 0.25)
    if not picture_wanted:
        return Texture(None, tile_m, specular, roughness)

    color = _random_hue(rng, saturation=rng.uniform(0, 0.35), value=rng.uniform(0.6, 0.95))
    x, y = pixel_x_and_y()
    rows = columns * width_to_height
    row = (y * rows).astype(int)
    # As in a wall of bricks, every second row of flat tiles is shifted by half a tile.
    is_shifted = (row % 2 == 1) & (width_to_height == 2)
    shift = np.where(is_shifted, 0.5 / columns, 0.0)
    across = (x + shift) * columns  # in tiles
    column = (across % columns).astype(int)
    shade_deviation = rng.uniform(0.0, 0.05)
    shade = 1 + rng.normal(0, shade_deviation, (rows, columns))[row, column]
    uneven_glaze = smooth_noise(rng, spots_across=16, octaves=4)
    picture = colored(shade * (1 + 0.01 * uneven_glaze), color)

    # In widths of a tile, along both sides; so mortar is equally wide everywhere, 4 % of a tile.
    to_joint = np.minimum(joint_distance(across), joint_distance(y * rows) / width_to_height)
    mortar_color = np.full(3, rng.uniform(0.5, 0.85))  # a grey
    picture = np.where((to_joint < 0.02)[..., None], mortar_color, picture)
    return Texture(picture, tile_m, specular, roughness)


def plaster(rng: Rng, picture_wanted: bool) -> Texture:
    """A texture of a painted wall, faintly uneven; pale colours are the most frequent.

    `picture_wanted` is false where only size and gloss are needed.
    """
    tile_m = rng.uniform(1.5, 3.0)
    specular = 0.0  # without any gloss
    roughness = 1.0
    if not picture_wanted:
        return Texture(None, tile_m, specular, roughness)

    # Seven walls of ten are nearly white; strong colours are a little darker.
    saturation = rng.choice([0.03, 0.08, 0.16, 0.35], p=[0.4, 0.3, 0.2, 0.1])
    value = rng.uniform(0.78, 0.95) - 0.3 * saturation
    color = _random_hue(rng, saturation=saturation, value=value)
    broad_stains = smooth_noise(rng, spots_across=3, octaves=6)
    roller_marks = smooth_noise(rng, spots_across=96, octaves=3)
    stain_strength = rng.uniform(0.001, 0.008)
    mark_strength = rng.uniform(0.002, 0.012)
    brightness = 1 + stain_strength * broad_stains + mark_strength * roller_marks
    return Texture(colored(brightness, color), tile_m, specular, roughness)


def wallpaper(rng: Rng, picture_wanted: bool) -> Texture:
    """A texture of wallpaper: a pale ground with a figure that repeats every 15 to 50 cm.

    `picture_wanted` is false where only size and gloss are needed.
    """
    repeats = int(rng.integers(2, 7))  # of the figure, along each side of the picture
    tile_m = repeats * rng.uniform(0.15, 0.5)
    specular = 0.0  # without any gloss
    roughness = 1.0
    if not picture_wanted:
        return Texture(None, tile_m, specular, roughness)

    ground = _random_hue(rng, saturation=rng.uniform(0, 0.2), value=rng.uniform(0.65, 0.93))
    # The figure is darker or lighter than the ground, and tinted a little.
    contrast = rng.choice([-1, 1]) * rng.uniform(0.04, 0.2)
    tint = _random_hue(rng, saturation=rng.uniform(0, 0.25), value=1.0)
    ink = np.clip(ground + contrast, 0.05, 0.97) * tint
    ink_share = _wallpaper_figure(rng, repeats)
    picture = ground + (ink - ground) * ink_share[..., None]
    paper_fibres = smooth_noise(rng, spots_across=64, octaves=3)
    picture = picture * (1 + 0.02 * paper_fibres[..., None])
    return Texture(picture, tile_m, specular, roughness)


def _wallpaper_figure(rng: Rng, repeats: int) -> Floats:
    """[S, S] how much of each pixel is printed, 0 to 1: stripes, flowers or a lattice, at random.

    `repeats` is how often the figure repeats along each side of the picture.
    """
    x, y = pixel_x_and_y()
    # The place within a repeat, from its middle: −0.5 to 0.5.
    right = x * repeats % 1 - 0.5
    down = y * repeats % 1 - 0.5
    figure = rng.random()

    if figure < 0.4:
        # A stripe in the middle of each repeat, and a thin, paler line at each side of it.
        half_width = rng.uniform(0.08, 0.25)
        stripe = (np.abs(right) < half_width).astype(float)
        line = np.abs(np.abs(right) - 0.4) < 0.02
        return np.asarray(np.maximum(stripe, 0.6 * line))

    if figure < 0.75:
        # Flowers of 4 to 8 petals: the radius is a wave of the angle. Their middle is paler.
        petals = int(rng.integers(4, 9))
        if repeats % 2 == 0:
            # Every second column is half a repeat lower. With an odd number of columns, two equal
            # ones would meet at the seam.
            half_step = ((x * repeats).astype(int) % 2) * 0.5
            down = (y * repeats + half_step) % 1 - 0.5
        radius = np.hypot(right, down)
        angle = np.arctan2(down, right)
        size = rng.uniform(0.22, 0.4)
        petal_depth = rng.uniform(0.2, 0.6)
        outline = size * (1 + petal_depth * np.cos(petals * angle)) / 1.5
        return np.asarray((radius < outline) * 1.0 - 0.6 * (radius < outline * 0.35))

    # A lattice: the lines along which two waves cancel each other.
    waves = np.sin(2 * np.pi * right) + np.cos(2 * np.pi * down)
    return np.asarray((np.abs(waves) < 0.3).astype(float))


def carpet(rng: Rng, picture_wanted: bool) -> Texture:
    """A texture of a fitted carpet of one colour, with tufts of 5 to 9 mm.

    `picture_wanted` is false where only size and gloss are needed.
    """
    tile_m = rng.uniform(0.6, 1.2)
    specular = 0.0  # without any gloss
    roughness = 1.0
    if not picture_wanted:
        return Texture(None, tile_m, specular, roughness)

    color = _random_hue(rng, saturation=rng.uniform(0.05, 0.5), value=rng.uniform(0.25, 0.75))
    tufts = smooth_noise(rng, spots_across=128, octaves=3)
    stains = smooth_noise(rng, spots_across=3, octaves=4)
    picture = colored(1 + 0.14 * tufts + 0.04 * stains, color)
    return Texture(picture, tile_m, specular, roughness)


def rug(rng: Rng, picture_wanted: bool) -> Texture:
    """A texture of a whole rug, with borders around a pattern in four colours.

    The picture is laid over a rug once, whatever the rug's size, so that its size of 1 m does not
    matter. `picture_wanted` is false where only size and gloss are needed.
    """
    tile_m = 1.0
    specular = 0.0
    roughness = 1.0
    if not picture_wanted:
        return Texture(None, tile_m, specular, roughness)

    colors = [
        _random_hue(rng, saturation=rng.uniform(0.2, 0.8), value=rng.uniform(0.15, 0.85))
        for _ in range(4)
    ]
    x, y = pixel_x_and_y()

    # The pattern: a quarter of the rug is noise, which is mirrored to the right and then downwards.
    half = SIDE // 2
    noise = smooth_noise(rng, spots_across=int(rng.integers(3, 12)), octaves=3)
    quarter = noise[:half, :half]
    upper_half = np.concatenate([quarter, quarter[:, ::-1]], 1)
    mirrored_noise = np.concatenate([upper_half, upper_half[::-1]], 0)
    # Three limits between four colours, in deviations of the noise.
    color_number = np.digitize(mirrored_noise, [-0.7, 0.2, 0.9])
    if rng.random() < 0.4:
        # Instead of this, 8 to 29 stripes across the rug, in three colours by turns.
        stripe_count = rng.integers(8, 30)
        color_number = (np.floor(y * stripe_count) % 3).astype(int)
    picture = np.stack(colors)[color_number]

    # From inside: a line, the border, and the hem; widths in halves of the rug.
    to_edge = 1 - np.maximum(np.abs(2 * x - 1), np.abs(2 * y - 1))  # 1 in the middle of the rug
    border = rng.uniform(0.05, 0.16)
    picture = np.where((to_edge < border)[..., None], colors[1], picture)
    picture = np.where((np.abs(to_edge - border) < 0.012)[..., None], colors[3], picture)
    picture = np.where((to_edge < 0.02)[..., None], colors[2], picture)
    tufts = smooth_noise(rng, spots_across=128, octaves=3)
    picture = picture * (1 + 0.1 * tufts[..., None])
    return Texture(picture, tile_m, specular, roughness)


def fabric(rng: Rng, picture_wanted: bool) -> Texture:
    """A texture of woven cloth: of one colour, with stripes (20 %) or with checks (15 %).

    `picture_wanted` is false where only size and gloss are needed.
    """
    tile_m = rng.uniform(0.25, 0.6)
    specular = 0.0  # without any gloss
    roughness = 1.0
    if not picture_wanted:
        return Texture(None, tile_m, specular, roughness)

    color = _random_hue(rng, saturation=rng.uniform(0.0, 0.7), value=rng.uniform(0.2, 0.85))
    other_color = np.clip(color * rng.uniform(0.4, 1.5), 0.05, 0.95)
    x, y = pixel_x_and_y()

    # [S, S, 1] how much of the other colour a pixel has. Where both kinds of stripes of a check
    # cross, it is all of it.
    pattern = rng.random()
    stripe_count = int(rng.integers(3, 9))
    upright_stripes = ((x * stripe_count % 1) < rng.uniform(0.2, 0.5)).astype(np.float64)
    level_stripes = ((y * stripe_count % 1) < rng.uniform(0.2, 0.5)).astype(np.float64)
    other_share: Floats = np.zeros((SIDE, SIDE, 1))
    if pattern < 0.2:
        other_share = upright_stripes[..., None]
    elif pattern < 0.35:
        other_share = 0.5 * (upright_stripes + level_stripes)[..., None]
    pixel_color = color + (other_color - color) * other_share

    threads = 128  # along each side: 4 pixels each, two light and two dark ones
    weave = np.sin(2 * np.pi * threads * x) * np.sin(2 * np.pi * threads * y)
    uneven_dye = smooth_noise(rng, spots_across=32, octaves=5)
    brightness = (1 + 0.08 * weave) * (1 + 0.06 * uneven_dye)
    return Texture(pixel_color * brightness[..., None], tile_m, specular, roughness)


def wood(rng: Rng, picture_wanted: bool) -> Texture:
    """A texture of the wood of furniture, without joints; its grain runs up the picture.

    `picture_wanted` is false where only size and gloss are needed.
    """
    tile_m = rng.uniform(0.5, 1.0)
    specular = 0.04  # of varnish, as of glass
    roughness = rng.uniform(0.25, 0.6)
    if not picture_wanted:
        return Texture(None, tile_m, specular, roughness)

    grain = _wood_grain(rng, stretch=32).T  # it was along x
    grain_strength = rng.uniform(0.04, 0.12)
    color = _color_like_one_of(rng, WOODS)
    picture = colored(1 + grain_strength * grain, color)
    return Texture(picture, tile_m, specular, roughness)


def brick(rng: Rng, picture_wanted: bool) -> Texture:
    """A texture of a wall of red bricks, in 35 % painted: bricks of 25 × 7.5 cm with their mortar.

    `picture_wanted` is false where only size and gloss are needed.
    """
    rows = 10
    columns = 3
    tile_m = rows * 0.075  # as wide as high: 3 columns of 0.25 m
    specular = 0.0  # without any gloss
    roughness = 1.0
    if not picture_wanted:
        return Texture(None, tile_m, specular, roughness)

    color = np.array([0.55, 0.3, 0.22]) * rng.uniform(0.7, 1.3)  # red
    if rng.random() < 0.35:
        color = np.full(3, rng.uniform(0.6, 0.9))  # painted grey or white
    x, y = pixel_x_and_y()
    row = (y * rows).astype(int)
    across = (x * columns + 0.5 * (row % 2)) % columns  # in bricks; every second row is shifted
    column = across.astype(int)
    shade = 1 + rng.normal(0, 0.1, (rows, columns))[row, column]
    weathering = smooth_noise(rng, spots_across=24, octaves=5)
    picture = colored(shade * (1 + 0.08 * weathering), color)

    # In heights of a brick, along both sides: a brick is 3.3 times as wide as high. So mortar is
    # equally wide everywhere, 16 % of a brick's height or 12 mm.
    to_joint = np.minimum(joint_distance(across) * 3.3, joint_distance(y * rows))
    mortar_grey = rng.uniform(0.4, 0.75)
    mortar = np.full(3, mortar_grey) * (1 + 0.05 * weathering[..., None])
    picture = np.where((to_joint < 0.08)[..., None], mortar, picture)
    return Texture(picture, tile_m, specular, roughness)


def marble(rng: Rng, picture_wanted: bool) -> Texture:
    """A texture of polished stone with dark veins.

    `picture_wanted` is false where only size and gloss are needed.
    """
    tile_m = rng.uniform(0.8, 1.6)
    specular = 0.05  # of polished stone
    roughness = rng.uniform(0.04, 0.2)
    if not picture_wanted:
        return Texture(None, tile_m, specular, roughness)

    color = _color_like_one_of(rng, STONES)
    noise = smooth_noise(rng, spots_across=4, octaves=7)
    # Veins are thin lines, where the noise changes its sign: there this is 1, elsewhere near 0.
    thinness = rng.uniform(6, 14)
    veins = np.exp(-np.abs(noise) * thinness)
    vein_color = color * rng.uniform(0.45, 0.8)
    vein_strength = rng.uniform(0.3, 0.9)
    picture = color + (vein_color - color) * (veins * vein_strength)[..., None]
    return Texture(picture, tile_m, specular, roughness)


def concrete(rng: Rng, picture_wanted: bool) -> Texture:
    """A texture of grey concrete or rough plaster, with stains of all sizes.

    `picture_wanted` is false where only size and gloss are needed.
    """
    tile_m = rng.uniform(1.5, 2.5)
    specular = 0.02  # a faint gloss, as of smooth cement
    roughness = 0.6
    if not picture_wanted:
        return Texture(None, tile_m, specular, roughness)

    stains = smooth_noise(rng, spots_across=4, octaves=8)
    stain_strength = rng.uniform(0.02, 0.06)
    grey = rng.uniform(0.35, 0.7)
    color = np.full(3, grey) + rng.normal(0, 0.015, 3)  # with a touch of a colour
    return Texture(colored(1 + stain_strength * stains, color), tile_m, specular, roughness)


KINDS: dict[str, Draw] = {
    "planks": planks,
    "parquet": parquet,
    "tiles": tiles,
    "wall_tiles": wall_tiles,
    "plaster": plaster,
    "wallpaper": wallpaper,
    "carpet": carpet,
    "rug": rug,
    "fabric": fabric,
    "wood": wood,
    "brick": brick,
    "marble": marble,
    "concrete": concrete,
}
