"""Made textures of walls, floors and fabrics, drawn once and kept as pictures.

All repeat without a seam. Each kind has a size in metres, so that planks are as wide as planks.
"""

from __future__ import annotations

import dataclasses
import functools
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from spackle.runtime.files import atomic_path
from worlds.lights import cloud_noise

Rng = np.random.Generator
Image3 = NDArray[np.float64]  # [S, S, 3] sRGB in 0..1
SIDE = 512  # pixels
PER_KIND = 16
SURFACES_VERSION = 2  # increases whenever the pictures change

WOODS = ((0.62, 0.45, 0.28), (0.72, 0.56, 0.38), (0.45, 0.3, 0.18), (0.3, 0.19, 0.12),
         (0.8, 0.68, 0.5), (0.55, 0.52, 0.48), (0.5, 0.27, 0.16))  # fmt: skip
STONES = (
    (0.75, 0.72, 0.68),
    (0.5, 0.5, 0.5),
    (0.3, 0.3, 0.32),
    (0.85, 0.82, 0.78),
    (0.6, 0.5, 0.42),
)


@dataclasses.dataclass(frozen=True)
class Surface:
    """A texture, and how large and shiny it is."""

    kind: str
    file: str
    tile_m: float  # width of one repeat
    specular: float
    roughness: float


# A surface's picture, the width of one repeat in metres, the share of light that is mirrored when
# looked at straight on, and the roughness: 0 for a mirror, 1 for chalk. The picture is None if it
# is not wanted, because its file is there; the three numbers are drawn before the picture, so that
# they are the same with and without it.
Drawn = tuple[Image3 | None, float, float, float]
Draw = Callable[[Rng, bool], Drawn]  # whether the picture is wanted


def surfaces(folder: Path, kind: str) -> list[Surface]:
    """All surfaces of a kind, a key of `KINDS`; drawn into `folder` at the first call."""
    return drawn_surfaces(folder, kind, KINDS[kind])


@functools.lru_cache(64)
def drawn_surfaces(folder: Path, kind: str, draw: Draw) -> list[Surface]:
    """PER_KIND random surfaces of a kind; their pictures are drawn if `folder` lacks their files.

    Args:
        folder: for the pictures, whose names begin with the kind.
        kind: also the seed, with a surface's number.
        draw: makes a random surface of the kind.
    """
    folder.mkdir(parents=True, exist_ok=True)
    found = []
    for number in range(PER_KIND):
        rng = np.random.default_rng([SURFACES_VERSION, zlib.crc32(kind.encode()), number])
        path = folder / f"{kind}-v{SURFACES_VERSION}-{number:02d}.png"
        is_picture_wanted = not path.is_file()
        picture, tile_m, specular, roughness = draw(rng, is_picture_wanted)
        if picture is not None:
            with atomic_path(path) as temporary:
                Image.fromarray((np.clip(picture, 0, 1) * 255 + 0.5).astype(np.uint8)).save(
                    temporary
                )
        found.append(Surface(kind, str(path), tile_m, specular, roughness))
    return found


def _grid() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """x and y [S, S] in 0..1 at pixel centres."""
    y, x = np.mgrid[:SIDE, :SIDE]
    return (x + 0.5) / SIDE, (y + 0.5) / SIDE


def _colored(value: NDArray[np.float64], color: NDArray[np.float64] | tuple[float, ...]) -> Image3:
    """A colour times [S, S] brightness."""
    return np.asarray(value[..., None] * np.asarray(color))


def _pick(rng: Rng, colors: tuple[tuple[float, float, float], ...]) -> NDArray[np.float64]:
    """One of the colours, a little changed."""
    color = np.array(colors[int(rng.integers(len(colors)))])
    return np.asarray(np.clip(color * rng.uniform(0.85, 1.12) + rng.normal(0, 0.02, 3), 0.03, 0.95))


def _grain(rng: Rng, stretch: int = 24) -> NDArray[np.float64]:
    """[S, S] wood grain along x, around 0.

    Noise is stretched along x by repeating each value `stretch` times, and blurred over the steps
    that this leaves. Waves of it look like the rings of a tree.
    """
    fibres = cloud_noise(rng, (SIDE, SIDE), 4, 7)
    column = cloud_noise(rng, (SIDE, SIDE // stretch), 4, 5)
    column = np.repeat(column, stretch, 1)
    column = np.pad(column, ((0, 0), (0, SIDE - column.shape[1])), mode="wrap")
    kernel = np.ones(stretch) / stretch
    # Three repeats side by side, of which the middle one is kept: the texture has no seam.
    blurred = np.apply_along_axis(
        lambda row: np.convolve(np.tile(row, 3), kernel, "same")[SIDE : 2 * SIDE], 1, column
    )
    rings = np.sin(2 * np.pi * (6 * blurred + 0.3 * fibres))
    fine = np.repeat(rng.standard_normal((SIDE, SIDE // 32)), 32, 1)
    return 0.5 * rings + 0.5 * blurred + 0.25 * fine


def planks(rng: Rng, wanted: bool) -> Drawn:
    """A floor of boards."""
    boards = int(rng.integers(6, 12))
    width_m = rng.uniform(0.08, 0.2)
    specular, roughness = 0.04, rng.uniform(0.15, 0.5)
    if not wanted:
        return None, boards * width_m, specular, roughness
    color = _pick(rng, WOODS)
    x, y = _grid()

    # [S, S] the board that a pixel lies in, and the piece of this board; joints are shifted from
    # board to board.
    row = np.minimum((y * boards).astype(int), boards - 1)
    shift = rng.random(boards)[row]
    pieces = int(rng.integers(1, 4))
    piece = ((x + shift) * pieces % pieces).astype(int)
    shade = 1 + rng.normal(0, rng.uniform(0.03, 0.12), (boards, pieces))[row, piece]
    # Each piece has a shade, and grain from another place.
    grain = _grain(rng)
    moved = (np.arange(SIDE)[None] + (rng.integers(0, SIDE, (boards, pieces))[row, piece])) % SIDE
    grain = grain[np.arange(SIDE)[:, None], moved]
    picture = _colored(shade * (1 + rng.uniform(0.03, 0.1) * grain), color)
    # Dark gaps between boards and pieces.
    within = y * boards % 1
    along = (x + shift) * pieces % 1
    gap = (np.minimum(within, 1 - within) < 0.012) | (
        np.minimum(along, 1 - along) < 0.0015 * pieces
    )
    return np.where(gap[..., None], picture * 0.45, picture), boards * width_m, specular, roughness


def parquet(rng: Rng, wanted: bool) -> Drawn:
    """A floor of small blocks of wood, in squares that change direction."""
    blocks = 4
    tile_m = blocks * rng.uniform(0.25, 0.45)
    specular, roughness = 0.04, rng.uniform(0.12, 0.4)
    if not wanted:
        return None, tile_m, specular, roughness
    color = _pick(rng, WOODS)
    strips = int(rng.integers(4, 7))
    x, y = _grid()
    column = (x * blocks).astype(int)
    row = (y * blocks).astype(int)
    upright = (column + row) % 2 == 0
    # Each square has strips, which run up in every other square.
    across = np.where(upright, x * blocks % 1, y * blocks % 1)
    strip = np.minimum((across * strips).astype(int), strips - 1)
    shade = 1 + rng.normal(0, 0.09, (blocks, blocks, strips))[row, column, strip]
    grain = _grain(rng, 16)
    grain = np.where(upright, grain.T, grain)
    within = across * strips % 1
    gap = np.minimum(within, 1 - within) < 0.03
    picture = _colored(shade * (1 + 0.06 * grain), color)
    return np.where(gap[..., None], picture * 0.6, picture), tile_m, specular, roughness


def tiles(rng: Rng, wanted: bool) -> Drawn:
    """Stone or ceramic tiles with joints."""
    count = int(rng.integers(2, 5))
    side_m = rng.uniform(0.15, 0.6)
    specular, roughness = 0.05, rng.uniform(0.05, 0.35)
    if not wanted:
        return None, count * side_m, specular, roughness
    first = _pick(rng, STONES)
    second = _pick(rng, STONES) if rng.random() < 0.3 else first
    x, y = _grid()
    column = (x * count).astype(int)
    row = (y * count).astype(int)
    if count % 2:
        second = first  # a chequer with an odd number would not repeat
    even = ((column + row) % 2 == 0)[..., None]
    shade = 1 + rng.normal(0, 0.03, (count, count))[row, column]
    veins = cloud_noise(rng, (SIDE, SIDE), 6, 6)
    moved = np.roll(veins, SIDE // 3, 1)
    veins = np.where((column + row) % 2 == 0, veins, moved)
    strength = rng.uniform(0.01, 0.09)
    picture = np.where(even, first, second) * (shade * (1 + strength * veins))[..., None]
    joint = rng.uniform(0.006, 0.014)
    edge = np.minimum.reduce([x * count % 1, 1 - x * count % 1, y * count % 1, 1 - y * count % 1])
    mortar = np.array([0.55, 0.53, 0.5]) * rng.uniform(0.4, 1.4)
    picture = np.where((edge < joint)[..., None], mortar, picture)
    return picture, count * side_m, specular, roughness


def wall_tiles(rng: Rng, wanted: bool) -> Drawn:
    """Small glazed tiles of kitchens and bathrooms."""
    count = int(rng.integers(4, 9))
    ratio = int(rng.choice([1, 1, 2]))
    side_m = rng.uniform(0.07, 0.2)
    specular, roughness = 0.05, rng.uniform(0.08, 0.25)
    if not wanted:
        return None, count * side_m, specular, roughness
    color = _hue(rng, rng.uniform(0, 0.35), rng.uniform(0.6, 0.95))
    x, y = _grid()
    rows = count * ratio
    row = (y * rows).astype(int)
    shift = np.where((row % 2 == 1) & (ratio == 2), 0.5 / count, 0.0)
    across = (x + shift) * count % 1
    column = ((x + shift) * count % count).astype(int)
    shade = 1 + rng.normal(0, rng.uniform(0.0, 0.05), (rows, count))[row, column]
    edge = np.minimum(
        np.minimum(across, 1 - across), np.minimum(y * rows % 1, 1 - y * rows % 1) / ratio
    )
    noise = cloud_noise(rng, (SIDE, SIDE), 16, 4)
    picture = _colored(shade * (1 + 0.01 * noise), color)
    mortar = np.full(3, rng.uniform(0.5, 0.85))
    return np.where((edge < 0.02)[..., None], mortar, picture), count * side_m, specular, roughness


def _hue(rng: Rng, saturation: float, value: float) -> NDArray[np.float64]:
    """[3] a colour of random hue."""
    phase = rng.random() * 2 * np.pi
    wave = 0.5 + 0.5 * np.cos(phase - np.array([0, 2.09, 4.19]))  # thirds of a circle
    return np.asarray(value * (1 - saturation + saturation * wave))


def plaster(rng: Rng, wanted: bool) -> Drawn:
    """A painted wall with faint unevenness; pale colours are the most frequent."""
    tile_m = rng.uniform(1.5, 3.0)
    specular, roughness = 0.0, 1.0
    if not wanted:
        return None, tile_m, specular, roughness
    saturation = rng.choice([0.03, 0.08, 0.16, 0.35], p=[0.4, 0.3, 0.2, 0.1])
    color = _hue(rng, saturation, rng.uniform(0.78, 0.95) - 0.3 * saturation)
    broad = cloud_noise(rng, (SIDE, SIDE), 3, 6)
    fine = cloud_noise(rng, (SIDE, SIDE), 96, 3)
    value = 1 + rng.uniform(0.001, 0.008) * broad + rng.uniform(0.002, 0.012) * fine
    return _colored(value, color), tile_m, specular, roughness


def wallpaper(rng: Rng, wanted: bool) -> Drawn:
    """A wall with stripes, or a pattern of repeated figures."""
    repeats = int(rng.integers(2, 7))
    tile_m = repeats * rng.uniform(0.15, 0.5)
    if not wanted:
        return None, tile_m, 0.0, 1.0
    ground = _hue(rng, rng.uniform(0, 0.2), rng.uniform(0.65, 0.93))
    ink = np.clip(ground + rng.choice([-1, 1]) * rng.uniform(0.04, 0.2), 0.05, 0.97) * _hue(
        rng, rng.uniform(0, 0.25), 1.0
    )
    # Place within a repeat, from its middle, in −0.5..0.5.
    x, y = _grid()
    a = x * repeats % 1 - 0.5
    b = y * repeats % 1 - 0.5
    kind = rng.random()
    if kind < 0.4:  # stripes
        weight = (np.abs(a) < rng.uniform(0.08, 0.25)).astype(float)
        weight = np.maximum(weight, 0.6 * (np.abs(np.abs(a) - 0.4) < 0.02))
    elif kind < 0.75:  # flowers: a wave around the middle
        petals = int(rng.integers(4, 9))
        odd = ((x * repeats).astype(int) % 2) * 0.5
        b = (y * repeats + odd) % 1 - 0.5 if repeats % 2 == 0 else b
        radius = np.hypot(a, b)
        angle = np.arctan2(b, a)
        outline = (
            rng.uniform(0.22, 0.4) * (1 + rng.uniform(0.2, 0.6) * np.cos(petals * angle)) / 1.5
        )
        weight = (radius < outline) * 1.0 - 0.6 * (radius < outline * 0.35)
    else:  # a lattice of waves
        weight = (np.abs(np.sin(2 * np.pi * a) + np.cos(2 * np.pi * b)) < 0.3).astype(float)
    noise = cloud_noise(rng, (SIDE, SIDE), 64, 3)
    picture = ground + (ink - ground) * weight[..., None]
    return picture * (1 + 0.02 * noise[..., None]), tile_m, 0.0, 1.0


def carpet(rng: Rng, wanted: bool) -> Drawn:
    """A fitted carpet."""
    tile_m = rng.uniform(0.6, 1.2)
    if not wanted:
        return None, tile_m, 0.0, 1.0
    color = _hue(rng, rng.uniform(0.05, 0.5), rng.uniform(0.25, 0.75))
    tufts = cloud_noise(rng, (SIDE, SIDE), 128, 3)
    broad = cloud_noise(rng, (SIDE, SIDE), 3, 4)
    return _colored(1 + 0.14 * tufts + 0.04 * broad, color), tile_m, 0.0, 1.0


def rug(rng: Rng, wanted: bool) -> Drawn:
    """A rug that is seen whole, with borders and a mirrored pattern."""
    if not wanted:
        return None, 1.0, 0.0, 1.0
    colors = [_hue(rng, rng.uniform(0.2, 0.8), rng.uniform(0.15, 0.85)) for _ in range(4)]
    x, y = _grid()
    a = np.abs(2 * x - 1)
    b = np.abs(2 * y - 1)
    edge = 1 - np.maximum(a, b)
    # A quarter of noise, mirrored to all four, in four colours.
    half = SIDE // 2
    noise = cloud_noise(rng, (SIDE, SIDE), int(rng.integers(3, 12)), 3)[:half, :half]
    noise = np.concatenate([noise, noise[:, ::-1]], 1)
    noise = np.concatenate([noise, noise[::-1]], 0)
    levels = np.digitize(noise, [-0.7, 0.2, 0.9])
    if rng.random() < 0.4:  # stripes
        levels = (np.floor(y * rng.integers(8, 30)) % 3).astype(int)
    picture = np.stack(colors)[levels]
    border = rng.uniform(0.05, 0.16)
    picture = np.where((edge < border)[..., None], colors[1], picture)
    picture = np.where((np.abs(edge - border) < 0.012)[..., None], colors[3], picture)
    picture = np.where((edge < 0.02)[..., None], colors[2], picture)
    tufts = cloud_noise(rng, (SIDE, SIDE), 128, 3)
    return picture * (1 + 0.1 * tufts[..., None]), 1.0, 0.0, 1.0


def fabric(rng: Rng, wanted: bool) -> Drawn:
    """Cloth: a weave, often with stripes or checks."""
    tile_m = rng.uniform(0.25, 0.6)
    if not wanted:
        return None, tile_m, 0.0, 1.0
    color = _hue(rng, rng.uniform(0.0, 0.7), rng.uniform(0.2, 0.85))
    other = np.clip(color * rng.uniform(0.4, 1.5), 0.05, 0.95)
    x, y = _grid()
    threads = 128
    weave = np.sin(2 * np.pi * threads * x) * np.sin(2 * np.pi * threads * y)
    picture = _colored(1 + 0.08 * weave, color)
    kind = rng.random()
    count = int(rng.integers(3, 9))
    stripes = (x * count % 1) < rng.uniform(0.2, 0.5)
    checks = (y * count % 1) < rng.uniform(0.2, 0.5)
    if kind < 0.2:
        picture = np.where(stripes[..., None], picture / color * other, picture)
    elif kind < 0.35:
        weight = (stripes * 0.5 + checks * 0.5)[..., None]
        picture = picture / color * (color + (other - color) * weight)
    noise = cloud_noise(rng, (SIDE, SIDE), 32, 5)
    return picture * (1 + 0.06 * noise[..., None]), tile_m, 0.0, 1.0


def wood(rng: Rng, wanted: bool) -> Drawn:
    """Wood of furniture, with its grain along v."""
    tile_m = rng.uniform(0.5, 1.0)
    specular, roughness = 0.04, rng.uniform(0.25, 0.6)
    if not wanted:
        return None, tile_m, specular, roughness
    grain = _grain(rng, 32).T
    return (
        _colored(1 + rng.uniform(0.04, 0.12) * grain, _pick(rng, WOODS)),
        tile_m,
        specular,
        roughness,
    )


def brick(rng: Rng, wanted: bool) -> Drawn:
    """A wall of bricks, plain or painted."""
    rows = 10
    tile_m = rows * 0.075
    if not wanted:
        return None, tile_m, 0.0, 1.0
    columns = 3
    color = np.array([0.55, 0.3, 0.22]) * rng.uniform(0.7, 1.3)
    if rng.random() < 0.35:
        color = np.full(3, rng.uniform(0.6, 0.9))
    x, y = _grid()
    row = (y * rows).astype(int)
    across = (x * columns + 0.5 * (row % 2)) % columns
    column = across.astype(int)
    shade = 1 + rng.normal(0, 0.1, (rows, columns))[row, column]
    noise = cloud_noise(rng, (SIDE, SIDE), 24, 5)
    picture = _colored(shade * (1 + 0.08 * noise), color)
    edge = np.minimum(
        np.minimum(across % 1, 1 - across % 1) * 3.3, np.minimum(y * rows % 1, 1 - y * rows % 1)
    )
    mortar = np.full(3, rng.uniform(0.4, 0.75)) * (1 + 0.05 * noise[..., None])
    return np.where((edge < 0.08)[..., None], mortar, picture), tile_m, 0.0, 1.0


def marble(rng: Rng, wanted: bool) -> Drawn:
    """Polished stone with veins, or terrazzo."""
    tile_m = rng.uniform(0.8, 1.6)
    specular, roughness = 0.05, rng.uniform(0.04, 0.2)
    if not wanted:
        return None, tile_m, specular, roughness
    base = _pick(rng, STONES)
    noise = cloud_noise(rng, (SIDE, SIDE), 4, 7)
    veins = np.exp(-np.abs(noise) * rng.uniform(6, 14))
    dark = base * rng.uniform(0.45, 0.8)
    picture = base + (dark - base) * (veins * rng.uniform(0.3, 0.9))[..., None]
    return picture, tile_m, specular, roughness


def concrete(rng: Rng, wanted: bool) -> Drawn:
    """Concrete or rough plaster."""
    tile_m = rng.uniform(1.5, 2.5)
    if not wanted:
        return None, tile_m, 0.02, 0.6
    noise = cloud_noise(rng, (SIDE, SIDE), 4, 8)
    value = 1 + rng.uniform(0.02, 0.06) * noise
    return (
        _colored(value, np.full(3, rng.uniform(0.35, 0.7)) + rng.normal(0, 0.015, 3)),
        tile_m,
        0.02,
        0.6,
    )


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
