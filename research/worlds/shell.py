"""What is built: walls with windows, skirting, curtains, pictures, rugs and shelves of books."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from worlds.meshes import Material, Mesh, box, joined, quad, smooth_normals
from worlds.placing import Opening, Place, WallName
from worlds.surfaces import Surface

Rng = np.random.Generator
WALL_M = 0.22  # thickness
FRAME_M = 0.06  # width of a window frame's bars
WHITE = (0.93, 0.93, 0.91)


def material_of(surface: Surface, tint: Sequence[float] = (1, 1, 1)) -> Material:
    """The material of a made surface."""
    red, green, blue = tint
    return Material(
        (1.0, 1.0, 1.0),
        surface.file,
        surface.specular,
        surface.roughness,
        tint=(red, green, blue),
    )


class WallFrame:
    """A wall's own coordinates: along it, up, and out of the room."""

    def __init__(self, place: Place, wall: WallName) -> None:
        """The wall of a room, seen from inside from its left end."""
        start = np.array([*place.wall_point(wall, 0.0, 0.0), 0.0])
        end = np.array([*place.wall_point(wall, 1.0, 0.0), 0.0])
        inside = np.array([*place.wall_point(wall, 0.0, 1.0), 0.0])
        self.start = start
        self.along = end - start
        self.out = start - inside
        self.up = np.array([0.0, 0.0, 1.0])

    def point(self, along: float, up: float, out: float = 0.0) -> list[float]:
        """[3] a point of the room."""
        point = self.start + along * self.along + up * self.up + out * self.out
        return [float(value) for value in point]

    def panel(
        self,
        left: float,
        right: float,
        bottom: float,
        top: float,
        material: Material,
        tile_m: float | None = None,
        out: float = 0.0,
    ) -> Mesh:
        """A rectangle in the wall's plane, or `out` of it, seen from inside."""
        tile = None if tile_m is None else (tile_m, tile_m)
        offset = (0.0, 0.0) if tile_m is None else (left / tile_m, bottom / tile_m)
        return quad(
            self.point(left, bottom, out),
            (right - left) * self.along,
            (top - bottom) * self.up,
            material,
            tile,
            offset,
        )

    def block(
        self,
        left: float,
        right: float,
        bottom: float,
        top: float,
        inner: float,
        outer: float,
        material: Material,
        tile_m: float | None = None,
    ) -> Mesh:
        """A box from `inner` to `outer` (both counted out of the room)."""
        one = np.array(self.point(left, bottom, inner))
        other = np.array(self.point(right, top, outer))
        tile = None if tile_m is None else (tile_m, tile_m)
        return box(np.minimum(one, other).tolist(), np.maximum(one, other).tolist(), material, tile)


def wall_with_openings(
    frame: WallFrame,
    length: float,
    height: float,
    openings: Sequence[Opening],
    material: Material,
    tile_m: float,
) -> list[Mesh]:
    """A wall without its openings, and the sides of these through the wall's thickness."""
    parts = []
    left = 0.0
    for opening in sorted(openings, key=lambda one: one.start):
        right = opening.start + opening.width
        parts.append(frame.panel(left, opening.start, 0, height, material, tile_m))
        if opening.bottom > 0:
            parts.append(frame.panel(opening.start, right, 0, opening.bottom, material, tile_m))
        if opening.top < height:
            parts.append(frame.panel(opening.start, right, opening.top, height, material, tile_m))

        # The sides of the hole, as thin boxes outside of it.
        paint = Material(WHITE)
        thin = 0.01
        low = opening.bottom
        high = opening.top
        start = opening.start
        parts.append(frame.block(start - thin, start, low, high, 0.001, WALL_M, paint))
        parts.append(frame.block(right, right + thin, low, high, 0.001, WALL_M, paint))
        parts.append(frame.block(start, right, high, high + thin, 0.001, WALL_M, paint))
        if low > 0:
            parts.append(frame.block(start, right, low - thin, low, 0.001, WALL_M, paint))
        left = right
    parts.append(frame.panel(left, length, 0, height, material, tile_m))
    return parts


def window_frame(rng: Rng, frame: WallFrame, opening: Opening, material: Material) -> list[Mesh]:
    """Frame, bars and sill of a window."""
    left = opening.start
    right = opening.start + opening.width
    low = opening.bottom
    high = opening.top
    bar = FRAME_M
    inner = 0.10
    outer = 0.16
    parts = [
        frame.block(left, left + bar, low, high, inner, outer, material),
        frame.block(right - bar, right, low, high, inner, outer, material),
        frame.block(left, right, high - bar, high, inner, outer, material),
        frame.block(left, right, low, low + bar, inner, outer, material),
    ]
    columns = max(1, round(opening.width / rng.uniform(0.55, 1.3)))
    rows = int(rng.choice([1, 1, 2, 3]))
    for number in range(1, columns):
        middle = left + opening.width * number / columns
        parts.append(
            frame.block(middle - bar / 2, middle + bar / 2, low, high, inner, outer, material)
        )
    for number in range(1, rows):
        middle = low + (high - low) * number / rows
        thin = bar / 3
        parts.append(frame.block(left, right, middle - thin, middle + thin, inner, outer, material))
    if low > 0.2:
        parts.append(frame.block(left - 0.06, right + 0.06, low - 0.04, low, -0.12, 0.1, material))
    return parts


def door_way(frame: WallFrame, opening: Opening, material: Material) -> list[Mesh]:
    """The casing around a door or passage."""
    left = opening.start
    right = opening.start + opening.width
    wide = 0.08
    return [
        frame.block(left - wide, left, 0, opening.top + wide, -0.02, 0.0, material),
        frame.block(right, right + wide, 0, opening.top + wide, -0.02, 0.0, material),
        frame.block(left, right, opening.top, opening.top + wide, -0.02, 0.0, material),
    ]


def strip(
    frame: WallFrame,
    length: float,
    openings: Sequence[Opening],
    bottom: float,
    top: float,
    thick: float,
    material: Material,
) -> list[Mesh]:
    """Skirting, a rail or a cornice along a wall, not across its openings."""
    parts = []
    left = 0.0
    cuts = [one for one in openings if one.bottom < top and one.top > bottom]
    for opening in sorted(cuts, key=lambda one: one.start):
        if opening.start > left:
            parts.append(frame.block(left, opening.start, bottom, top, -thick, 0, material))
        left = opening.start + opening.width
    if length > left:
        parts.append(frame.block(left, length, bottom, top, -thick, 0, material))
    return parts


def curtain(
    rng: Rng,
    frame: WallFrame,
    left: float,
    right: float,
    low: float,
    high: float,
    away: float,
    material: Material,
    tile_m: float,
) -> Mesh:
    """A hanging cloth in folds, between two places along a wall."""
    width = right - left
    folds = max(3, round(width / rng.uniform(0.06, 0.13)))
    columns = folds * 8 + 1
    rows = 5
    place = np.linspace(0, 1, columns)
    phase = rng.random() * 6.28
    wave = np.sin(2 * math.pi * folds * place + phase + 1.5 * np.sin(2 * math.pi * place * 1.7))
    depth = rng.uniform(0.02, 0.05)
    grid = np.zeros((rows, columns, 3))
    for row in range(rows):
        share = row / (rows - 1)
        spread = 1 - 0.06 * math.sin(math.pi * share)
        swing = depth * (0.7 + 0.3 * (1 - share)) * wave
        for column in range(columns):
            along = left + width * (0.5 + (place[column] - 0.5) * spread)
            grid[row, column] = frame.point(
                along, low + (high - low) * share, -(away + float(swing[column]))
            )
    uv = np.zeros((rows, columns, 2))
    uv[..., 0] = place * width * 1.6 / tile_m
    uv[..., 1] = np.linspace(0, high - low, rows)[:, None] / tile_m
    return _sheet(grid, uv, material)


def _sheet(grid: NDArray[np.float64], uv: NDArray[np.float64], material: Material) -> Mesh:
    """A mesh of a grid of points [R, C, 3] with texture coordinates [R, C, 2]."""

    def triangles(values: NDArray[np.float64]) -> NDArray[np.float64]:
        """[F, 3, K] the values at the corners of all triangles."""
        a = values[:-1, :-1].reshape(-1, values.shape[-1])
        b = values[:-1, 1:].reshape(-1, values.shape[-1])
        c = values[1:, 1:].reshape(-1, values.shape[-1])
        d = values[1:, :-1].reshape(-1, values.shape[-1])
        return np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])

    corners = triangles(grid).astype(np.float32)
    count = len(corners)
    return Mesh(
        corners,
        smooth_normals(corners),
        triangles(uv).astype(np.float32),
        np.zeros(count, np.int32),
        (material,),
    )


def picture_frame(
    rng: Rng,
    frame: WallFrame,
    middle: float,
    height: float,
    size: tuple[float, float],
    photo: Material,
) -> list[Mesh]:
    """A framed photo on a wall, sometimes with a mount; its middle is at `height`."""
    wide, high = size
    border = rng.uniform(0.01, 0.05)
    shade = rng.choice([0.05, 0.15, 0.6, 0.9])
    tint = (shade, shade * rng.uniform(0.7, 1.0), shade * rng.uniform(0.4, 1.0))
    wood = Material(tint, specular=0.04, roughness=0.4)
    left = middle - wide / 2
    low = height - high / 2
    parts = [
        frame.block(left - border, left + wide + border, low - border, low, -0.03, 0, wood),
        frame.block(
            left - border, left + wide + border, low + high, low + high + border, -0.03, 0, wood
        ),
        frame.block(left - border, left, low, low + high, -0.03, 0, wood),
        frame.block(left + wide, left + wide + border, low, low + high, -0.03, 0, wood),
    ]
    mount = rng.uniform(0.0, 0.2) * min(wide, high) if rng.random() < 0.5 else 0.0
    if mount:
        parts.append(
            frame.panel(left, left + wide, low, low + high, Material((0.94, 0.93, 0.9)), out=-0.012)
        )
    parts.append(
        frame.panel(
            left + mount, left + wide - mount, low + mount, low + high - mount, photo, out=-0.014
        )
    )
    return parts


@dataclasses.dataclass(frozen=True)
class Shelf:
    """A bookcase of boxes, with its back to y = 0 and its front towards −y."""

    mesh: Mesh
    width: float
    depth: float
    height: float
    boards: tuple[float, ...]  # heights on which something may stand
    free: tuple[tuple[float, float, float], ...]  # x range and height of places without books


def made_shelf(rng: Rng, wood: Material, tile_m: float) -> Shelf:
    """A bookcase with books, and some places left free."""
    width = rng.uniform(0.6, 1.8)
    depth = rng.uniform(0.24, 0.38)
    rows = int(rng.integers(2, 7))
    step = rng.uniform(0.28, 0.4)
    height = rows * step + 0.05
    board = 0.025
    tile = (tile_m, tile_m)
    parts = [
        box((-width / 2, -depth, 0), (-width / 2 + board, 0, height), wood, tile),
        box((width / 2 - board, -depth, 0), (width / 2, 0, height), wood, tile),
        box((-width / 2, -0.01, 0), (width / 2, 0, height), wood, tile),
    ]
    boards = []
    free = []
    columns = 2 if width > 1.1 else 1
    for row in range(rows + 1):
        low = row * step + 0.03
        parts.append(box((-width / 2, -depth, low - board), (width / 2, 0, low), wood, tile))
        boards.append(low)
    if columns == 2:
        parts.append(box((-board / 2, -depth, 0), (board / 2, 0, height), wood, tile))
    for row in range(rows):
        for column in range(columns):
            left = -width / 2 + board + column * width / columns
            right = left + width / columns - 2 * board
            fill = rng.choice([0.0, 0.5, 0.95], p=[0.25, 0.35, 0.4])
            end = left + (right - left) * fill
            parts += _books(rng, left, end, boards[row], step - board - 0.02, depth)
            if right - end > 0.15:
                free.append((end + 0.03, right, boards[row]))
    return Shelf(joined(parts), width, depth, height, tuple(boards), tuple(free))


def _books(
    rng: Rng, left: float, right: float, low: float, room: float, depth: float
) -> list[Mesh]:
    """Books that stand side by side from `left` to `right` on a board."""
    parts: list[Mesh] = []
    x = left
    usual = rng.uniform(0.6, 0.95) * room
    while True:
        thick = rng.uniform(0.012, 0.05)
        if x + thick > right:
            return parts
        high = min(usual * rng.uniform(0.8, 1.1), room)
        deep = min(depth - 0.02, high * rng.uniform(0.6, 0.8))
        grey = rng.uniform(0.1, 0.8)
        hue = grey + (rng.random(3) - 0.5) * rng.uniform(0.05, 0.6) * min(1.0, 1.6 * grey)
        red, green, blue = np.clip(hue, 0.03, 0.95)
        cover = Material((float(red), float(green), float(blue)), specular=0.03, roughness=0.5)
        front = -depth + 0.01 + rng.uniform(0, 0.03)
        parts.append(box((x, front, low), (x + thick, front + deep, low + high), cover))
        if rng.random() < 0.5:  # a label on the spine
            ink = Material((0.9, 0.88, 0.8) if hue.mean() < 0.5 else (0.1, 0.1, 0.12))
            bottom = low + high * rng.uniform(0.15, 0.7)
            parts.append(
                quad(
                    (x + 0.1 * thick, front - 0.001, bottom),
                    (0.8 * thick, 0, 0),
                    (0, 0, high * rng.uniform(0.05, 0.2)),
                    ink,
                )
            )
        x += thick + (rng.uniform(0.0, 0.04) if rng.random() < 0.05 else 0.0005)
