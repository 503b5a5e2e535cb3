"""Houses by rules: walls with windows that lie in them, doors, roofs, chimneys, balconies, shops.

A house is built with its front along x at y = 0, looking towards −y; its ground is at z = 0.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from worlds.meshes import Faces, Material, Mesh, box, joined, rotation_z
from worlds.shell import material_of
from worlds.surfaces import Surface

Rng = np.random.Generator
FindSurface = Callable[..., Surface]  # a random surface of one of the given kinds
FRAME_M = 0.06  # width of a window frame's bars
ROOF_M = 0.14  # thickness of a roof
METAL = Material((0.32, 0.33, 0.34), specular=0.15, roughness=0.3)
ZINC = Material((0.55, 0.56, 0.57), specular=0.12, roughness=0.32)
PAINTS = (
    (0.92, 0.92, 0.9), (0.9, 0.88, 0.82), (0.3, 0.32, 0.34), (0.25, 0.32, 0.28),
    (0.42, 0.28, 0.18), (0.55, 0.16, 0.14), (0.2, 0.28, 0.42), (0.16, 0.16, 0.17),
)  # fmt: skip
RoofKind = Literal["ridge along", "ridge across", "flat"]
ROOFS: tuple[RoofKind, ...] = ("ridge along", "ridge across", "flat")


@dataclasses.dataclass(frozen=True)
class Hole:
    """A rectangle in a wall in which a window or door lies."""

    left: float
    right: float
    low: float
    high: float
    kind: Literal["window", "door", "shop"]


@dataclasses.dataclass(frozen=True)
class Style:
    """What the parts of a house look like; neighbours of one row may share it."""

    wall: Surface
    base: Surface  # of the lowest part of the walls
    tint: tuple[float, float, float]
    roof: Surface
    frame: Material
    door: Material
    floor_m: float
    window_m: tuple[float, float]  # width and height
    bars: tuple[int, int]  # columns and rows of panes
    trim: Material | None  # around windows
    shutters: Material | None


def paint(rng: Rng) -> Material:
    """A glossy paint of doors, frames and fences."""
    red, green, blue = np.clip(
        np.array(PAINTS[int(rng.integers(len(PAINTS)))]) * rng.uniform(0.85, 1.1), 0.03, 0.95
    )
    return Material((float(red), float(green), float(blue)), specular=0.04, roughness=0.3)


def choose_style(rng: Rng, find: FindSurface) -> Style:
    """A random style."""
    kinds = ["brick", "plaster", "plaster", "boards", "concrete", "stone_wall"]
    shares = [0.34, 0.22, 0.14, 0.16, 0.06, 0.08]
    wall = find(str(rng.choice(kinds, p=shares)))
    # Plaster is painted in warm, pale colours more often than in cold ones.
    shade = rng.uniform(0.75, 1.0)
    tint = (shade, shade * rng.uniform(0.9, 1.0), shade * rng.uniform(0.75, 1.0))
    white = Material((0.9, 0.9, 0.88), specular=0.04, roughness=0.3)
    stone = find("concrete", "stone_wall")
    return Style(
        wall=wall,
        base=stone,
        tint=tint if wall.kind == "plaster" else (1.0, 1.0, 1.0),
        roof=find("roof_tiles"),
        frame=white if rng.random() < 0.65 else paint(rng),
        door=paint(rng),
        floor_m=rng.uniform(2.7, 3.2),
        window_m=(rng.uniform(0.8, 1.5), rng.uniform(1.2, 1.8)),
        bars=(int(rng.choice([1, 2, 2, 3])), int(rng.choice([1, 1, 2, 2, 3]))),
        trim=material_of(find("concrete"), (1.2, 1.15, 1.1)) if rng.random() < 0.5 else None,
        shutters=paint(rng) if rng.random() < 0.22 else None,
    )


def roof_kind(rng: Rng, town: bool) -> RoofKind:
    """The kind of a roof: flat ones stand in towns, and gables towards the street in suburbs."""
    shares = [0.6, 0.1, 0.3] if town else [0.5, 0.45, 0.05]
    return ROOFS[int(rng.choice(3, p=shares))]


def flat_polygon(
    points: Sequence[Sequence[float]],
    u_axis: Sequence[float],
    v_axis: Sequence[float],
    material: Material,
    tile_m: float,
) -> Mesh:
    """A convex polygon of P points, as a fan; its texture lies along two unit vectors [3]."""
    corners = np.array(points, np.float64)
    axes = np.array([u_axis, v_axis], np.float64)
    order = np.array([[0, k, k + 1] for k in range(1, len(corners) - 1)])
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    normal = normal / np.linalg.norm(normal)
    uv = corners @ axes.T / tile_m
    count = len(order)
    return Mesh(
        corners[order].astype(np.float32),
        np.broadcast_to(normal, (count, 3, 3)).astype(np.float32),
        uv[order].astype(np.float32),
        np.zeros(count, np.int32),
        (material,),
    )


def pole(
    start: Sequence[float], end: Sequence[float], radius: float, material: Material, sides: int = 8
) -> Mesh:
    """A round bar between two points [3], without ends."""
    first = np.array(start, np.float64)
    axis = np.array(end, np.float64) - first
    unit = axis / np.linalg.norm(axis)
    helper = np.array([1.0, 0, 0]) if abs(unit[2]) > 0.9 else np.array([0, 0, 1.0])
    across = np.cross(unit, helper)
    across /= np.linalg.norm(across)
    other = np.cross(unit, across)
    angle = 2 * math.pi * np.arange(sides + 1) / sides
    around = np.cos(angle)[:, None] * across + np.sin(angle)[:, None] * other  # [sides + 1, 3]
    ring = first + radius * around
    top = ring + axis
    corners = np.concatenate(
        [np.stack([ring[:-1], ring[1:], top[1:]], 1), np.stack([ring[:-1], top[1:], top[:-1]], 1)]
    )
    normals = np.concatenate(
        [
            np.stack([around[:-1], around[1:], around[1:]], 1),
            np.stack([around[:-1], around[1:], around[:-1]], 1),
        ]
    )
    count = len(corners)
    return Mesh(
        corners.astype(np.float32),
        normals.astype(np.float32),
        np.zeros((count, 3, 2), np.float32),
        np.zeros(count, np.int32),
        (material,),
    )


def holed_wall(
    faces: Faces,
    width: float,
    low: float,
    high: float,
    holes: Sequence[Hole],
    material: Material,
    tile_m: float,
) -> None:
    """Add the parts of a wall at y = 0 that are not in a hole; it begins at x = 0, seen from −y.

    Args:
        faces: where they are added.
        width: metres.
        low, high: heights of the wall's ends.
        holes: do not overlap.
        material: of the wall.
        tile_m: width of a repeat of its texture.
    """
    xs = sorted({0.0, width, *(x for one in holes for x in (one.left, one.right))})
    for left, right in itertools.pairwise(xs):
        # The column is cut by the holes that it crosses.
        mine = sorted(
            (one for one in holes if one.left < right - 1e-6 and one.right > left + 1e-6),
            key=lambda one: one.low,
        )
        bottoms = [low, *(one.high for one in mine)]
        tops = [*(one.low for one in mine), high]
        for bottom, top in zip(bottoms, tops, strict=True):
            if top - bottom > 1e-6:
                side = (right - left, 0, 0)
                offset = (left / tile_m, bottom / tile_m)
                faces.quad((left, 0, bottom), side, (0, 0, top - bottom), material, tile_m, offset)


def fill_hole(faces: Faces, rng: Rng, hole: Hole, style: Style, find: FindSurface) -> None:
    """Add what is in a hole: its sides, and a window, door or shop window with sill and trim."""
    left, right, low, high = hole.left, hole.right, hole.low, hole.high
    deep = rng.uniform(0.09, 0.2)
    side = material_of(style.wall, style.tint)
    tile = style.wall.tile_m
    inward = (0, deep, 0)
    outward = (0, -deep, 0)
    faces.quad((left, 0, low), inward, (0, 0, high - low), side, tile)
    faces.quad((right, deep, low), outward, (0, 0, high - low), side, tile)
    faces.quad((left, 0, high), inward, (right - left, 0, 0), side, tile)
    faces.quad((left, deep, low), outward, (right - left, 0, 0), side, tile)
    bar = FRAME_M
    front = deep - 0.05

    def piece(x0: float, x1: float, z0: float, z1: float) -> None:
        """A bar of the frame."""
        faces.box((x0, front, z0), (x1, deep, z1), style.frame)

    piece(left, left + bar, low, high)
    piece(right - bar, right, low, high)
    piece(left, right, high - bar, high)
    piece(left, right, low, low + bar)
    pane = material_of(find("panes"))
    faces.quad((left, deep - 0.015, low), (right - left, 0, 0), (0, 0, high - low), pane)
    if hole.kind == "door":
        _add_door(faces, hole, style, deep)
        return

    columns, rows = style.bars
    if hole.kind == "shop":
        columns, rows = max(1, round((right - left) / 1.5)), 1
    for number in range(1, columns):
        x = left + (right - left) * number / columns
        piece(x - 0.025, x + 0.025, low, high)
    for number in range(1, rows):
        z = low + (high - low) * number / rows
        piece(left, right, z - 0.018, z + 0.018)
    if hole.kind == "window":
        _add_trim(faces, hole, style, deep)


def _add_door(faces: Faces, hole: Hole, style: Style, deep: float) -> None:
    """Add a door with four panels, a handle, a step, and a pane above if it is high."""
    left, right, low, high = hole.left, hole.right, hole.low, hole.high
    front = deep - 0.05
    top = high - (0.35 if high - low > 2.25 else FRAME_M)
    inner_left, inner_right = left + FRAME_M, right - FRAME_M
    faces.box((inner_left, front + 0.015, low), (inner_right, deep, top), style.door)
    middle = (left + right) / 2
    for start, end in ((inner_left + 0.1, middle - 0.05), (middle + 0.05, inner_right - 0.1)):
        for z0, z1 in ((low + 0.15, low + 0.85), (low + 1.0, top - 0.15)):
            faces.box((start, front, z0), (end, front + 0.02, z1), style.door)
    faces.box((left, front, top), (right, deep, top + FRAME_M), style.frame)
    knob = right - 0.2
    faces.box((knob, front - 0.05, low + 1.0), (knob + 0.04, front + 0.02, low + 1.08), METAL)
    step = material_of(style.base)
    faces.box((left - 0.15, -0.45, low - 0.14), (right + 0.15, deep, low), step)


def _add_trim(faces: Faces, hole: Hole, style: Style, deep: float) -> None:
    """Add the sill of a window, and stones and shutters around it where the style has them."""
    left, right, low, high = hole.left, hole.right, hole.low, hole.high
    stone = style.trim if style.trim is not None else style.frame
    faces.box((left - 0.05, -0.06, low - 0.05), (right + 0.05, deep, low), stone)
    if style.trim is not None:
        wide = 0.12
        faces.box((left - wide, -0.025, high), (right + wide, 0.01, high + 1.4 * wide), stone)
        faces.box((left - wide, -0.02, low), (left, 0.01, high), stone)
        faces.box((right, -0.02, low), (right + wide, 0.01, high), stone)
    if style.shutters is not None:
        wide = (right - left) / 2
        for x in (left - wide - 0.03, right + 0.03):
            faces.box((x, -0.05, low), (x + wide, -0.01, high), style.shutters)
            for z in np.arange(low + 0.08, high - 0.08, 0.09):
                slat = ((x + 0.06, -0.062, z), (x + wide - 0.06, -0.05, z + 0.05))
                faces.box(*slat, style.shutters)


def window_row(
    width: float, bottom: float, size: tuple[float, float], every: float, edge: float = 0.5
) -> list[Hole]:
    """Windows side by side in a wall, as many as fit with one each `every` metres."""
    count = int((width - 2 * edge) / every)
    wide, high = size
    if count < 1 or width < wide + 2 * edge:
        return []
    each = (width - 2 * edge) / count
    wide = min(wide, each - 0.3)
    lefts = [edge + each * (number + 0.5) - wide / 2 for number in range(count)]
    return [Hole(left, left + wide, bottom, bottom + high, "window") for left in lefts]


def house(
    rng: Rng,
    find: FindSurface,
    style: Style,
    width: float,
    depth: float,
    floors: int,
    roof: RoofKind,
    *,
    shop: bool = False,
    balconies: bool = False,
) -> Mesh:
    """A house of `width` by `depth` metres.

    Args:
        rng, find: for all random choices.
        style: its materials.
        width, depth: metres.
        floors: how many, without the roof's.
        roof: its kind.
        shop: whether the ground floor is a shop.
        balconies: whether upper floors have some.
    """
    wall = material_of(style.wall, style.tint)
    tile = style.wall.tile_m
    ground = rng.uniform(0.15, 0.5) if not shop else 0.12  # height of the ground floor
    height = ground + floors * style.floor_m
    every = style.window_m[0] + rng.uniform(0.7, 1.6)
    sill = rng.uniform(0.75, 1.0)
    front: list[Hole] = []
    for floor in range(floors):
        bottom = ground + floor * style.floor_m
        tall = min(style.window_m[1], style.floor_m - sill - 0.25)
        row = window_row(width, bottom + sill, (style.window_m[0], tall), every)
        if floor == 0 and shop:
            row = _shop_front(rng, width, bottom, style.floor_m)
        elif floor == 0:
            row = _with_door(rng, row, width, bottom)
        front += row
    faces = Faces()
    holed_wall(faces, width, 0, height, front, wall, tile)
    for hole in front:
        fill_hole(faces, rng, hole, style, find)
    if balconies:
        _add_balconies(faces, rng, front, style, ground + 0.5 * style.floor_m)
    # A base of another material, a little before the wall, but not before doors.
    if style.wall.kind != style.base.kind and rng.random() < 0.7 and ground > 0.2:
        stone = material_of(style.base)
        doors = [one for one in front if one.kind == "door"]
        starts = [0.0, *(one.right for one in doors)]
        ends = [*(one.left for one in doors), width]
        for start, end in zip(starts, ends, strict=True):
            faces.box((start, -0.03, 0), (end, 0, ground), stone, style.base.tile_m)
    parts = [faces.mesh()]
    if shop:
        parts += _awning_and_sign(rng, find, width, ground + style.floor_m)

    # Sides and back, with a few windows.
    for turn, length, offset in (
        (90.0, depth, (width, 0, 0)),
        (180.0, width, (width, depth, 0)),
        (-90.0, depth, (0, depth, 0)),
    ):
        holes = []
        for floor in range(floors):
            if rng.random() < 0.8:
                bottom = ground + floor * style.floor_m + sill
                holes += window_row(length, bottom, (style.window_m[0], 1.2), 3.5, 1.0)
        side = Faces()
        holed_wall(side, length, 0, height, holes, wall, tile)
        for hole in holes:
            fill_hole(side, rng, hole, style, find)
        parts.append(side.mesh().moved(rotation_z(turn), offset))
    parts += _roof(rng, style, width, depth, height, roof)
    # A downpipe at one end of the front.
    x = 0.12 if rng.random() < 0.5 else width - 0.12
    parts.append(pole((x, -0.09, 0.1), (x, -0.09, height - 0.05), 0.045, ZINC))
    return joined(parts)


def _with_door(rng: Rng, row: list[Hole], width: float, bottom: float) -> list[Hole]:
    """A row of windows of which one has become the door."""
    high = bottom + rng.uniform(2.05, 2.5)
    wide = rng.uniform(0.95, 1.2)
    if not row:
        return [Hole(width / 2 - wide / 2, width / 2 + wide / 2, bottom, high, "door")]
    number = int(rng.integers(len(row)))
    middle = (row[number].left + row[number].right) / 2
    door = Hole(middle - wide / 2, middle + wide / 2, bottom, high, "door")
    return [*row[:number], door, *row[number + 1 :]]


def _shop_front(rng: Rng, width: float, bottom: float, floor_m: float) -> list[Hole]:
    """Shop windows beside a door."""
    top = bottom + floor_m - 0.65
    door = 1.1
    start = 0.35 if rng.random() < 0.5 else width - 0.35 - door
    holes = [Hole(start, start + door, bottom, min(top, bottom + 2.4), "door")]
    left, right = (start + door + 0.25, width - 0.35) if start < 1 else (0.35, start - 0.25)
    if right - left > 1:
        holes.append(Hole(left, right, bottom + 0.45, top, "shop"))
    return sorted(holes, key=lambda one: one.left)


def _awning_and_sign(rng: Rng, find: FindSurface, width: float, top: float) -> list[Mesh]:
    """A board above a shop, and sometimes a cloth that slants down before it."""
    board = paint(rng)
    faces = Faces()
    faces.box((0.25, -0.1, top - 0.6), (width - 0.25, 0, top - 0.1), board)
    # Letters: bars of random widths.
    ink = Material((0.93, 0.9, 0.8) if max(board.color) < 0.6 else (0.15, 0.13, 0.12))
    x = width * rng.uniform(0.25, 0.35)
    low = top - 0.48
    while x < width * 0.68:
        wide = rng.uniform(0.08, 0.2)
        faces.box((x, -0.12, low), (x + 0.04, -0.1, low + 0.26), ink)
        if rng.random() < 0.7:
            level = low + rng.choice([0.0, 0.11, 0.22])
            faces.box((x, -0.12, level), (x + wide, -0.1, level + 0.04), ink)
        if rng.random() < 0.5:
            faces.box((x + wide - 0.04, -0.12, low), (x + wide, -0.1, low + 0.26), ink)
        x += wide + 0.06
    parts = []
    if rng.random() < 0.6:
        cloth = material_of(find("fabric"))
        out = rng.uniform(0.9, 1.4)
        drop = rng.uniform(0.3, 0.6)
        upper = top - 0.65
        wide = width - 0.6
        faces.quad((0.3, -out, upper - drop), (wide, 0, 0), (0, out, drop), cloth, 1.2)
        faces.quad((0.3, -out, upper - drop - 0.22), (wide, 0, 0), (0, 0, 0.22), cloth, 1.2)
        for x in (0.32, width - 0.32):
            parts.append(pole((x, -out, upper - drop), (x, 0, upper - drop), 0.012, METAL))
    return [faces.mesh(), *parts]


def _add_balconies(
    faces: Faces, rng: Rng, holes: Sequence[Hole], style: Style, above: float
) -> None:
    """Add balconies before some of the windows that lie above a height."""
    slab = material_of(style.base)
    for hole in holes:
        if hole.kind != "window" or hole.low < above or rng.random() < 0.5:
            continue
        left, right = hole.left - 0.45, hole.right + 0.45
        floor = hole.low - 0.6
        out = -1.0
        faces.box((left, out, floor - 0.14), (right, 0, floor), slab)
        # Two rails and bars between them, before the balcony and at both sides.
        for z, thick in ((floor + 1.0, 0.045), (floor + 0.08, 0.025)):
            faces.box((left, out, z), (right, out + 0.04, z + thick), METAL)
            faces.box((left, out, z), (left + 0.04, 0, z + thick), METAL)
            faces.box((right - 0.04, out, z), (right, 0, z + thick), METAL)
        for x in np.arange(left + 0.06, right - 0.03, 0.12):
            faces.box((x, out + 0.01, floor), (x + 0.016, out + 0.026, floor + 1.0), METAL)
        for y in np.arange(out + 0.12, -0.03, 0.12):
            for x in (left + 0.012, right - 0.028):
                faces.box((x, y, floor), (x + 0.016, y + 0.016, floor + 1.0), METAL)


def _roof(
    rng: Rng, style: Style, width: float, depth: float, height: float, kind: RoofKind
) -> list[Mesh]:
    """The roof of a house whose walls end at `height`."""
    wall = material_of(style.wall, style.tint)
    tile = style.wall.tile_m
    if kind == "flat":
        top = height + rng.uniform(0.25, 0.6)
        edge = style.trim if style.trim is not None else material_of(style.base)
        thick = 0.22  # of the walls around it
        faces = Faces()
        faces.box((0, 0, height), (width, thick, top), wall, tile)
        faces.box((0, depth - thick, height), (width, depth, top), wall, tile)
        faces.box((0, 0, height), (thick, depth, top), wall, tile)
        faces.box((width - thick, 0, height), (width, depth, top), wall, tile)
        # Their covers, which reach over the front.
        faces.box((-0.06, -0.08, top), (width + 0.06, 0.26, top + 0.09), edge)
        faces.box((-0.06, -0.04, top), (0.26, depth, top + 0.09), edge)
        faces.box((width - 0.26, -0.04, top), (width + 0.06, depth, top + 0.09), edge)
        cover = Material((0.4, 0.39, 0.37))
        faces.quad((0, 0, height + 0.02), (width, 0, 0), (0, depth, 0), cover)
        return [faces.mesh()]
    # A gable roof is built with its ridge along x, and turned if it shall run across.
    along, across = (width, depth) if kind == "ridge along" else (depth, width)
    rise = across / 2 * math.tan(math.radians(rng.uniform(32, 48)))
    over = rng.uniform(0.05, 0.35)  # beyond the gables
    eave = rng.uniform(0.25, 0.5)
    parts = []
    for turn, offset in ((0.0, (0.0, 0.0, 0.0)), (180.0, (along, across, 0.0))):
        slope = _slope(rng, style, along, across, height, rise, over, eave)
        parts.append(slope.moved(rotation_z(turn), offset))
    # The walls of the gables, and the ridge.
    top = height + rise
    middle = across / 2
    gables = (
        [(0.0, across, height), (0.0, 0.0, height), (0.0, middle, top)],
        [(along, 0.0, height), (along, across, height), (along, middle, top)],
    )
    parts += [flat_polygon(points, (0, 1, 0), (0, 0, 1), wall, tile) for points in gables]
    tiles = material_of(style.roof)
    ridge = top + ROOF_M
    parts.append(pole((-over, middle, ridge), (along + over, middle, ridge), 0.1, tiles))
    if rng.random() < 0.75:
        x = float(rng.choice([0.4, along - 1.0, along / 2]))
        y = middle + float(rng.choice([-0.8, 0.3]))
        end = top + rng.uniform(0.6, 1.2)
        stone = material_of(style.base if style.wall.kind == "boards" else style.wall)
        faces = Faces()
        faces.box((x, y, height + rise * 0.4), (x + 0.6, y + 0.5, end), stone, tile)
        cap = material_of(style.base)
        faces.box((x - 0.06, y - 0.06, end), (x + 0.66, y + 0.56, end + 0.08), cap)
        parts.append(faces.mesh())
        for at in (x + 0.15, x + 0.42):
            parts.append(pole((at, y + 0.25, end), (at, y + 0.25, end + 0.35), 0.09, tiles))
    roof = joined(parts)
    if kind == "ridge across":
        return [roof.moved(rotation_z(90), (width, 0, 0))]
    return [roof]


def _slope(
    rng: Rng,
    style: Style,
    along: float,
    across: float,
    height: float,
    rise: float,
    over: float,
    eave: float,
) -> Mesh:
    """One half of a gable roof, which rises from y = 0 to y = `across` / 2.

    Args:
        rng: for a skylight.
        style: its materials.
        along, across: the house's sides along the ridge and across it.
        height: of the walls' upper ends.
        rise: of the ridge above them.
        over: how far it reaches beyond the gables.
        eave: how far it reaches beyond the wall.
    """
    drop = eave * rise / (across / 2)  # of the lower edge below the wall's end
    low = height - drop
    side = (along + 2 * over, 0, 0)
    up = np.array([0, across / 2 + eave, rise + drop])
    start = np.array([-over, -eave, low + ROOF_M])
    faces = Faces()
    faces.quad(start.tolist(), side, up.tolist(), material_of(style.roof), style.roof.tile_m)
    faces.quad((-over, -eave, low), up.tolist(), side, style.frame)  # from below
    edge = ((-over, -eave - 0.02, low - 0.06), (along + over, -eave, low + ROOF_M))
    faces.box(*edge, style.frame)
    # Boards along the gables, 2 cm thick.
    for x in (-over - 0.02, -over, along + over, along + over + 0.02):
        faces.quad((x, -eave, low - 0.04), up.tolist(), (0, 0, ROOF_M + 0.06), style.frame)
    if rng.random() < 0.4 and along > 5:
        # A skylight: a pane that lies 6 cm above the tiles, with sides of metal.
        unit = up / np.linalg.norm(up)
        normal = np.cross([1.0, 0, 0], unit)
        corner = start + np.array([over + rng.uniform(1, along - 2), 0, 0])
        corner = corner + rng.uniform(0.35, 0.6) * up
        wide, high = np.array([0.8, 0, 0]), 1.2 * unit
        glass = Material((0.1, 0.11, 0.12), specular=0.1, roughness=0.05)
        lift = 0.06 * normal
        faces.quad((corner + lift).tolist(), wide.tolist(), high.tolist(), glass)
        for begin, length in ((corner, wide), (corner + high, wide), (corner, high)):
            faces.quad(begin.tolist(), length.tolist(), lift.tolist(), METAL)
        faces.quad((corner + wide).tolist(), high.tolist(), lift.tolist(), METAL)
    gutter = low + ROOF_M - 0.07
    front = -eave - 0.08
    pipe = pole((-over, front, gutter), (along + over, front, gutter), 0.06, ZINC)
    return joined([faces.mesh(), pipe])


def leafy(
    rng: Rng,
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    leaves: int,
    color: tuple[float, float, float],
    leaf_m: float = 0.07,
) -> Mesh:
    """A clipped hedge in a box [3] to [3]: a dark body, and leaves over all sides of it.

    Each leaf is a kite of two triangles, in one of eight shades.
    """
    size = high - low
    inner = box((low + 0.06).tolist(), (high - 0.06).tolist(), Material((0.06, 0.09, 0.04)))
    # Leaves lie on the five visible sides, by their areas.
    areas = np.array([size[1] * size[2], size[1] * size[2], size[0] * size[2], size[0] * size[2],
                      size[0] * size[1]])  # fmt: skip
    side = rng.choice(5, size=leaves, p=areas / areas.sum())
    place = rng.random((leaves, 3))
    depth = np.abs(rng.normal(0, 0.035, leaves)) / np.maximum(size, 0.1).max()
    place[side == 0, 0] = depth[side == 0]
    place[side == 1, 0] = 1 - depth[side == 1]
    place[side == 2, 1] = depth[side == 2]
    place[side == 3, 1] = 1 - depth[side == 3]
    place[side == 4, 2] = 1 - depth[side == 4]
    middle = low + place * size + rng.normal(0, 0.018, (leaves, 3))
    outward = np.array([(-1, 0, 0), (1, 0, 0), (0, -1, 0), (0, 1, 0), (0, 0, 1)], np.float64)[side]
    normal = outward + rng.normal(0, 0.55, (leaves, 3)) + np.array([0, 0, 0.3])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    along = np.cross(normal, rng.standard_normal((leaves, 3)))
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    across = np.cross(normal, along)
    length = leaf_m * rng.uniform(0.7, 1.3, (leaves, 1))
    tip = middle + length / 2 * along
    root = middle - length / 2 * along
    right = middle + 0.28 * length * across
    left = middle - 0.28 * length * across
    corners = np.concatenate([np.stack([root, right, tip], 1), np.stack([root, tip, left], 1)])
    shades = rng.integers(8, size=leaves)
    base = np.array(color)
    skins = []
    for number in range(8):
        red, green, blue = np.clip(
            base * (0.7 + 0.09 * number) + rng.normal(0, 0.012, 3), 0.02, 0.9
        )
        skins.append(
            Material((float(red), float(green), float(blue)), specular=0.03, roughness=0.5)
        )
    count = 2 * leaves
    cover = Mesh(
        corners.astype(np.float32),
        np.repeat(np.concatenate([normal, normal])[:, None], 3, 1).astype(np.float32),
        np.zeros((count, 3, 2), np.float32),
        np.concatenate([shades, shades]).astype(np.int32),
        tuple(skins),
    )
    return joined([inner, cover])
