"""Houses by rules: walls with windows that lie in them, doors, roofs, chimneys, balconies, shops.

All coordinates are metres. A house stands on z = 0 with its front in the plane y = 0, from x = 0 to
x = its width: y < 0 is before the house, y > 0 is inside of it. The other walls are built in the
same way, each as if it were the front, and then turned to their places.
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
FRAME_M = 0.06  # width of the bars around a window or door
FRAME_DEPTH_M = 0.05  # of these bars, along y
ROOF_M = 0.14  # thickness of a roof
DOWNPIPE_RADIUS_M = 0.045
METAL = Material((0.32, 0.33, 0.34), specular=0.15, roughness=0.3)
ZINC = Material((0.55, 0.56, 0.57), specular=0.12, roughness=0.32)
# sRGB colours of doors, frames, shutters and fences.
PAINTS = (
    (0.92, 0.92, 0.9), (0.9, 0.88, 0.82), (0.3, 0.32, 0.34), (0.25, 0.32, 0.28),
    (0.42, 0.28, 0.18), (0.55, 0.16, 0.14), (0.2, 0.28, 0.42), (0.16, 0.16, 0.17),
)  # fmt: skip
# A gable roof with its ridge along the front (along x) or across it (along y), or a flat roof.
RoofKind = Literal["ridge along", "ridge across", "flat"]
ROOFS: tuple[RoofKind, ...] = ("ridge along", "ridge across", "flat")


@dataclasses.dataclass(frozen=True)
class Hole:
    """A rectangle in a wall in which a window or door lies, in metres."""

    left: float  # x, seen from outside
    right: float
    low: float  # z
    high: float
    kind: Literal["window", "door", "shop"]


@dataclasses.dataclass(frozen=True)
class Style:
    """What the parts of a house look like; neighbours of one row may share it."""

    wall: Surface
    base: Surface  # stone: of the lowest part of the walls, steps, balconies and covers
    tint: tuple[float, float, float]  # linear factors of the wall's colour
    roof: Surface
    frame: Material  # of windows and doors
    door: Material
    floor_m: float  # from one floor to the next
    window_m: tuple[float, float]  # width and height
    bars: tuple[int, int]  # columns and rows of panes in a window
    trim: Material | None  # of a frame of stones around windows; None: there is none
    shutters: Material | None  # None: there are none


def paint(rng: Rng) -> Material:
    """A random glossy paint of doors, frames, shutters and fences."""
    red, green, blue = np.clip(
        np.array(PAINTS[int(rng.integers(len(PAINTS)))]) * rng.uniform(0.85, 1.1), 0.03, 0.95
    )
    return Material((float(red), float(green), float(blue)), specular=0.04, roughness=0.3)


def choose_style(rng: Rng, find: FindSurface) -> Style:
    """A random style of a house.

    Args:
        rng: for all random choices but those of surfaces.
        find: gives a random surface of one of the kinds that it is called with.
    """
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
        # Concrete made lighter and a little warmer looks like sandstone.
        trim=material_of(find("concrete"), (1.2, 1.15, 1.1)) if rng.random() < 0.5 else None,
        shutters=paint(rng) if rng.random() < 0.22 else None,
    )


def roof_kind(rng: Rng, town: bool) -> RoofKind:
    """A random kind of roof: flat ones are frequent in towns, gables to the street in suburbs."""
    shares = [0.6, 0.1, 0.3] if town else [0.5, 0.45, 0.05]
    return ROOFS[int(rng.choice(3, p=shares))]


def flat_polygon(
    points: Sequence[Sequence[float]],
    u_axis: Sequence[float],
    v_axis: Sequence[float],
    material: Material,
    tile_m: float,
) -> Mesh:
    """A convex polygon of P points, as a fan of P − 2 triangles.

    Args:
        points: [P, 3] metres, counterclockwise seen from the side to which it looks.
        u_axis, v_axis: [3] unit vectors along which its texture's u and v run.
        material: of all triangles.
        tile_m: width of one repeat of the texture.
    """
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
    """A round bar between two points, without caps at its ends.

    Args:
        start, end: [3] of its axis, in metres.
        radius: metres.
        material: without a picture, as all texture coordinates are 0.
        sides: of the prism of which it consists; its normals are those of a round bar.
    """
    first = np.array(start, np.float64)
    axis = np.array(end, np.float64) - first
    unit = axis / np.linalg.norm(axis)
    # Two unit vectors at right angles to the axis and to each other, from any other direction.
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
    """Add a wall in the plane y = 0, from x = 0 to `width`, without the parts in its holes.

    It looks towards −y.

    Args:
        faces: gets its rectangles.
        width: metres.
        low, high: z of its lower and upper end.
        holes: rectangles that stay open; they do not overlap.
        material: of the wall.
        tile_m: width of a repeat of its texture.
    """
    xs = sorted({0.0, width, *(x for one in holes for x in (one.left, one.right))})
    # Between two of these x lies a column, which is cut by the holes that it crosses.
    for left, right in itertools.pairwise(xs):
        crossed = sorted(
            (one for one in holes if one.left < right - 1e-6 and one.right > left + 1e-6),
            key=lambda one: one.low,
        )
        bottoms = [low, *(one.high for one in crossed)]
        tops = [*(one.low for one in crossed), high]
        for bottom, top in zip(bottoms, tops, strict=True):
            if top - bottom > 1e-6:
                side = (right - left, 0, 0)
                offset = (left / tile_m, bottom / tile_m)
                faces.quad((left, 0, bottom), side, (0, 0, top - bottom), material, tile_m, offset)


def fill_hole(faces: Faces, rng: Rng, hole: Hole, style: Style, find: FindSurface) -> None:
    """Add what is in a hole of a wall: its sides in the wall, and a window, door or shop window.

    The wall lies at y = 0 and looks towards −y. The pane lies 7 to 19 cm behind its face.

    Args:
        faces: gets all.
        rng: for the depth.
        hole: in the wall.
        style: of the house.
        find: gives a random surface of one of the kinds that it is called with.
    """
    left, right, low, high = hole.left, hole.right, hole.low, hole.high
    depth = rng.uniform(0.09, 0.2)  # y of the frame's side towards the room
    wall = material_of(style.wall, style.tint)
    tile = style.wall.tile_m
    inward = (0, depth, 0)
    outward = (0, -depth, 0)
    faces.quad((left, 0, low), inward, (0, 0, high - low), wall, tile)
    faces.quad((right, depth, low), outward, (0, 0, high - low), wall, tile)
    faces.quad((left, 0, high), inward, (right - left, 0, 0), wall, tile)
    faces.quad((left, depth, low), outward, (right - left, 0, 0), wall, tile)
    bar = FRAME_M

    def add_bar(x0: float, x1: float, z0: float, z1: float) -> None:
        """Add a bar of the frame, from x0 to x1 and z0 to z1."""
        faces.box((x0, depth - FRAME_DEPTH_M, z0), (x1, depth, z1), style.frame)

    add_bar(left, left + bar, low, high)
    add_bar(right - bar, right, low, high)
    add_bar(left, right, high - bar, high)
    add_bar(left, right, low, low + bar)
    # One sheet in the whole hole, 15 mm before the frame's inner side.
    pane = material_of(find("panes"))
    faces.quad((left, depth - 0.015, low), (right - left, 0, 0), (0, 0, high - low), pane)
    if hole.kind == "door":
        _add_door(faces, hole, style, depth)
        return

    columns, rows = style.bars
    if hole.kind == "shop":  # panes of about 1.5 m, from the lower to the upper end
        columns, rows = max(1, round((right - left) / 1.5)), 1
    for number in range(1, columns):  # upright bars 5 cm wide
        x = left + (right - left) * number / columns
        add_bar(x - 0.025, x + 0.025, low, high)
    for number in range(1, rows):  # horizontal bars 36 mm high
        z = low + (high - low) * number / rows
        add_bar(left, right, z - 0.018, z + 0.018)
    if hole.kind == "window":
        _add_sill_and_trim(faces, hole, style, depth)


def _add_door(faces: Faces, hole: Hole, style: Style, depth: float) -> None:
    """Add a door with four panels, a bar above it, a handle and a step to a hole with its frame.

    In holes higher than 2.25 m the door ends 0.35 m below the upper end, so that the pane of glass
    that `fill_hole` has put into the whole hole shows above it.

    Args:
        faces: gets all.
        hole: in a wall at y = 0 that looks towards −y.
        style: of the house.
        depth: y of the door's side towards the room, in metres.
    """
    left, right, low, high = hole.left, hole.right, hole.low, hole.high
    front = depth - FRAME_DEPTH_M
    top = high - (0.35 if high - low > 2.25 else FRAME_M)
    inner_left, inner_right = left + FRAME_M, right - FRAME_M
    faces.box((inner_left, front + 0.015, low), (inner_right, depth, top), style.door)
    # Panels 15 mm before the door: two beside each other, low ones and high ones.
    middle = (left + right) / 2
    for x0, x1 in ((inner_left + 0.1, middle - 0.05), (middle + 0.05, inner_right - 0.1)):
        for z0, z1 in ((low + 0.15, low + 0.85), (low + 1.0, top - 0.15)):
            faces.box((x0, front, z0), (x1, front + 0.02, z1), style.door)
    faces.box((left, front, top), (right, depth, top + FRAME_M), style.frame)
    handle = right - 0.2
    low_corner = (handle, front - 0.05, low + 1.0)
    faces.box(low_corner, (handle + 0.04, front + 0.02, low + 1.08), METAL)
    # The step is 14 cm high and reaches 45 cm before the wall.
    step = material_of(style.base)
    faces.box((left - 0.15, -0.45, low - 0.14), (right + 0.15, depth, low), step)


def _add_sill_and_trim(faces: Faces, hole: Hole, style: Style, depth: float) -> None:
    """Add the sill of a window, and a frame of stones and shutters where the style has them.

    Args:
        faces: gets all.
        hole: of the window, in a wall at y = 0 that looks towards −y.
        style: of the house.
        depth: y to which the sill reaches inside of the wall, in metres.
    """
    left, right, low, high = hole.left, hole.right, hole.low, hole.high
    stone = style.trim if style.trim is not None else style.frame
    faces.box((left - 0.05, -0.06, low - 0.05), (right + 0.05, depth, low), stone)
    if style.trim is not None:
        # Stones above, left and right of the window, 2 cm before the wall.
        width = 0.12
        top = high + 1.4 * width
        faces.box((left - width, -0.025, high), (right + width, 0.01, top), stone)
        faces.box((left - width, -0.02, low), (left, 0.01, high), stone)
        faces.box((right, -0.02, low), (right + width, 0.01, high), stone)
    if style.shutters is not None:
        # Two open shutters beside the window, each as wide as half of it, with slats before them.
        width = (right - left) / 2
        for x in (left - width - 0.03, right + 0.03):
            faces.box((x, -0.05, low), (x + width, -0.01, high), style.shutters)
            for z in np.arange(low + 0.08, high - 0.08, 0.09):
                slat = ((x + 0.06, -0.062, z), (x + width - 0.06, -0.05, z + 0.05))
                faces.box(*slat, style.shutters)


def window_row(
    wall_width: float,
    bottom: float,
    size_m: tuple[float, float],
    spacing_m: float,
    end_m: float = 0.5,
) -> list[Hole]:
    """Equal windows side by side in a wall, from left to right; none if the wall is too narrow.

    Args:
        wall_width: metres.
        bottom: z of the windows' lower ends.
        size_m: width and height of a window; it gets narrower if 0.3 m would not be left between
            two of them.
        spacing_m: the least distance from one window's middle to the next.
        end_m: of the wall, left and right of all windows.
    """
    count = int((wall_width - 2 * end_m) / spacing_m)
    width, height = size_m
    if count < 1 or wall_width < width + 2 * end_m:
        return []
    spacing = (wall_width - 2 * end_m) / count
    width = min(width, spacing - 0.3)
    lefts = [end_m + spacing * (number + 0.5) - width / 2 for number in range(count)]
    return [Hole(left, left + width, bottom, bottom + height, "window") for left in lefts]


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
    """A house on z = 0, with its front at y = 0 from x = 0 to `width`, looking towards −y.

    It has walls with windows on all sides, one door in the front, a roof and a downpipe.

    Args:
        rng: for all random choices but those of surfaces.
        find: gives a random surface of one of the kinds that it is called with.
        style: its materials, and sizes of floors and windows.
        width, depth: metres along x and y, without what the roof reaches over.
        floors: how many, without that below the roof.
        roof: its kind.
        shop: whether the ground floor is a shop.
        balconies: whether some windows of the upper floors have one.
    """
    wall = material_of(style.wall, style.tint)
    tile = style.wall.tile_m
    ground = rng.uniform(0.15, 0.5) if not shop else 0.12  # z of the ground floor
    height = ground + floors * style.floor_m  # of the walls
    window_width, window_height = style.window_m
    spacing = window_width + rng.uniform(0.7, 1.6)
    sill = rng.uniform(0.75, 1.0)  # height of windows above their floor
    # At least 25 cm of wall remain above a window.
    window_height = min(window_height, style.floor_m - sill - 0.25)
    front: list[Hole] = []
    for floor in range(floors):
        bottom = ground + floor * style.floor_m
        row = window_row(width, bottom + sill, (window_width, window_height), spacing)
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
        # Only before windows above the middle of the ground floor: those of the upper floors.
        _add_balconies(faces, rng, front, style, ground + 0.5 * style.floor_m)
    # A base of another material, 3 cm before the wall, but not before doors.
    if style.wall.kind != style.base.kind and rng.random() < 0.7 and ground > 0.2:
        base = material_of(style.base)
        doors = [one for one in front if one.kind == "door"]
        starts = [0.0, *(one.right for one in doors)]
        ends = [*(one.left for one in doors), width]
        for start, end in zip(starts, ends, strict=True):
            faces.box((start, -0.03, 0), (end, 0, ground), base, style.base.tile_m)
    parts = [faces.mesh()]
    if shop:
        parts += _sign_and_awning(rng, find, width, ground + style.floor_m)

    # The right side, the back and the left side, as walls of this length that are turned by these
    # degrees and moved.
    for turn, length, offset in (
        (90.0, depth, (width, 0, 0)),
        (180.0, width, (width, depth, 0)),
        (-90.0, depth, (0, depth, 0)),
    ):
        holes = []
        for floor in range(floors):
            if rng.random() < 0.8:
                # A few windows 1.2 m high, at least 3.5 m from each other.
                bottom = ground + floor * style.floor_m + sill
                holes += window_row(length, bottom, (window_width, 1.2), 3.5, 1.0)
        side = Faces()
        holed_wall(side, length, 0, height, holes, wall, tile)
        for hole in holes:
            fill_hole(side, rng, hole, style, find)
        parts.append(side.mesh().moved(rotation_z(turn), offset))
    if roof == "flat":
        parts.append(_flat_roof(rng, style, width, depth, height))
    else:
        parts.append(_gable_roof(rng, style, width, depth, height, roof))
    # A downpipe before one end of the front, from 10 cm above the ground.
    x = 0.12 if rng.random() < 0.5 else width - 0.12
    parts.append(pole((x, -0.09, 0.1), (x, -0.09, height - 0.05), DOWNPIPE_RADIUS_M, ZINC))
    return joined(parts)


def _with_door(rng: Rng, windows: list[Hole], width: float, floor: float) -> list[Hole]:
    """A row of windows of which a random one is replaced by a door; only a door if there are none.

    Args:
        rng: chooses the window, and the door's size.
        windows: of the ground floor, from left to right.
        width: of the wall, in metres.
        floor: z of the ground floor, where the door begins.
    """
    top = floor + rng.uniform(2.05, 2.5)
    door_width = rng.uniform(0.95, 1.2)
    if not windows:
        left, right = width / 2 - door_width / 2, width / 2 + door_width / 2
        return [Hole(left, right, floor, top, "door")]
    number = int(rng.integers(len(windows)))
    middle = (windows[number].left + windows[number].right) / 2
    door = Hole(middle - door_width / 2, middle + door_width / 2, floor, top, "door")
    return [*windows[:number], door, *windows[number + 1 :]]


def _shop_front(rng: Rng, width: float, floor: float, floor_m: float) -> list[Hole]:
    """The holes of a shop's front, from left to right: a door at one end, and a large window.

    Where less than 1 m is left for the window, there is only the door.

    Args:
        rng: chooses the door's end.
        width: of the wall, in metres.
        floor: z of the ground floor.
        floor_m: from this floor to the next.
    """
    top = floor + floor_m - 0.65  # the sign is above
    door_width = 1.1
    door_is_left = rng.random() < 0.5
    door_left = 0.35 if door_is_left else width - 0.35 - door_width
    door_right = door_left + door_width
    holes = [Hole(door_left, door_right, floor, min(top, floor + 2.4), "door")]
    if door_is_left:
        left, right = door_right + 0.25, width - 0.35
    else:
        left, right = 0.35, door_left - 0.25
    if right - left > 1:
        holes.append(Hole(left, right, floor + 0.45, top, "shop"))
    return sorted(holes, key=lambda one: one.left)


def _sign_and_awning(rng: Rng, find: FindSurface, width: float, ceiling: float) -> list[Mesh]:
    """The sign of a shop with letters, and in 60 % an awning below it: a cloth that slants down.

    Args:
        rng: for all random choices but the cloth's surface.
        find: gives a random surface of one of the kinds that it is called with.
        width: of the front at y = 0, in metres; the awning hangs before it, at y < 0.
        ceiling: z of the ground floor's upper end.
    """
    board = paint(rng)
    faces = Faces()
    faces.box((0.25, -0.1, ceiling - 0.6), (width - 0.25, 0, ceiling - 0.1), board)
    # What looks like letters from afar: each has an upright bar at its left, and some have a
    # horizontal bar and an upright one at their right. They are light on dark boards and dark on
    # light ones.
    ink = Material((0.93, 0.9, 0.8) if max(board.color) < 0.6 else (0.15, 0.13, 0.12))
    x = width * rng.uniform(0.25, 0.35)
    low = ceiling - 0.48
    while x < width * 0.68:
        letter_width = rng.uniform(0.08, 0.2)
        right = x + letter_width
        faces.box((x, -0.12, low), (x + 0.04, -0.1, low + 0.26), ink)
        if rng.random() < 0.7:
            level = low + rng.choice([0.0, 0.11, 0.22])
            faces.box((x, -0.12, level), (right, -0.1, level + 0.04), ink)
        if rng.random() < 0.5:
            faces.box((right - 0.04, -0.12, low), (right, -0.1, low + 0.26), ink)
        x += letter_width + 0.06
    parts = []
    if rng.random() < 0.6:
        cloth = material_of(find("fabric"))
        reach = rng.uniform(0.9, 1.4)  # before the front
        drop = rng.uniform(0.3, 0.6)  # of its outer end below the inner one
        outer = ceiling - 0.65 - drop  # z of its outer end
        cloth_width = width - 0.6
        faces.quad((0.3, -reach, outer), (cloth_width, 0, 0), (0, reach, drop), cloth, 1.2)
        # A flap 22 cm high hangs down from its outer end.
        faces.quad((0.3, -reach, outer - 0.22), (cloth_width, 0, 0), (0, 0, 0.22), cloth, 1.2)
        for x in (0.32, width - 0.32):  # bars that hold it
            parts.append(pole((x, -reach, outer), (x, 0, outer), 0.012, METAL))
    return [faces.mesh(), *parts]


def _add_balconies(
    faces: Faces, rng: Rng, holes: Sequence[Hole], style: Style, above: float
) -> None:
    """Add a balcony with railings before every second window, at random, of those above a height.

    Args:
        faces: gets them.
        rng: chooses the windows.
        holes: of a wall at y = 0 that looks towards −y, where the balconies are.
        style: of the house.
        above: z in metres above which a window's lower end must lie.
    """
    slab = material_of(style.base)
    for hole in holes:
        if hole.kind != "window" or hole.low < above or rng.random() < 0.5:
            continue
        left, right = hole.left - 0.45, hole.right + 0.45
        floor = hole.low - 0.6  # the window begins behind the railing, which is 1 m high
        front = -1.0  # y of its outer side
        rail = floor + 1.0  # z of the upper rail
        faces.box((left, front, floor - 0.14), (right, 0, floor), slab)
        # Two rails, the upper one and a thin one at the floor: at the front and at both sides.
        for z, thickness in ((rail, 0.045), (floor + 0.08, 0.025)):
            faces.box((left, front, z), (right, front + 0.04, z + thickness), METAL)
            faces.box((left, front, z), (left + 0.04, 0, z + thickness), METAL)
            faces.box((right - 0.04, front, z), (right, 0, z + thickness), METAL)
        # Upright bars of 16 mm, one each 12 cm: at the front, then at both sides.
        for x in np.arange(left + 0.06, right - 0.03, 0.12):
            faces.box((x, front + 0.01, floor), (x + 0.016, front + 0.026, rail), METAL)
        for y in np.arange(front + 0.12, -0.03, 0.12):
            for x in (left + 0.012, right - 0.028):
                faces.box((x, y, floor), (x + 0.016, y + 0.016, rail), METAL)


def _flat_roof(rng: Rng, style: Style, width: float, depth: float, height: float) -> Mesh:
    """A flat roof with a low wall (a parapet) around it, which is covered with stone.

    Args:
        rng: for the parapet's height.
        style: of the house.
        width, depth: of the house, from x = 0 and y = 0 on; its front is at y = 0.
        height: z of the upper end of the house's walls.
    """
    wall = material_of(style.wall, style.tint)
    tile = style.wall.tile_m
    top = height + rng.uniform(0.25, 0.6)
    cover = style.trim if style.trim is not None else material_of(style.base)
    thickness = 0.22
    faces = Faces()
    faces.box((0, 0, height), (width, thickness, top), wall, tile)
    faces.box((0, depth - thickness, height), (width, depth, top), wall, tile)
    faces.box((0, 0, height), (thickness, depth, top), wall, tile)
    faces.box((width - thickness, 0, height), (width, depth, top), wall, tile)
    # Covers 9 cm thick, which reach 4 to 8 cm over the walls: at the front, left and right. There
    # is none at the back, which no camera sees.
    cover_top = top + 0.09
    faces.box((-0.06, -0.08, top), (width + 0.06, 0.26, cover_top), cover)
    faces.box((-0.06, -0.04, top), (0.26, depth, cover_top), cover)
    faces.box((width - 0.26, -0.04, top), (width + 0.06, depth, cover_top), cover)
    # The roof itself, 2 cm above the walls' ends.
    tar = Material((0.4, 0.39, 0.37))
    faces.quad((0, 0, height + 0.02), (width, 0, 0), (0, depth, 0), tar)
    return faces.mesh()


def _gable_roof(
    rng: Rng, style: Style, width: float, depth: float, height: float, kind: RoofKind
) -> Mesh:
    """A roof of two slopes with the walls of its gables, its ridge, and in 75 % a chimney.

    Args:
        rng: for pitch, eaves, skylights and chimney.
        style: of the house.
        width, depth: of the house, from x = 0 and y = 0 on; its front is at y = 0.
        height: z of the upper end of the house's walls.
        kind: "ridge along": the ridge runs along the front; "ridge across": across it, so that a
            gable is above the front.
    """
    # It is built with its ridge along x, and turned at the end if that shall run along y.
    ridge_along_x = kind == "ridge along"
    length, span = (width, depth) if ridge_along_x else (depth, width)  # along and across the ridge
    middle = span / 2
    rise = span / 2 * math.tan(math.radians(rng.uniform(32, 48)))  # of the ridge above the walls
    gable_reach = rng.uniform(0.05, 0.35)  # of the slopes beyond the gables
    eave = rng.uniform(0.25, 0.5)  # of the slopes beyond the other two walls
    parts = []
    for turn, offset in ((0.0, (0.0, 0.0, 0.0)), (180.0, (length, span, 0.0))):
        slope = _slope(rng, style, length, span, height, rise, gable_reach, eave)
        parts.append(slope.moved(rotation_z(turn), offset))
    top = height + rise
    wall = material_of(style.wall, style.tint)
    gables = (
        [(0.0, span, height), (0.0, 0.0, height), (0.0, middle, top)],
        [(length, 0.0, height), (length, span, height), (length, middle, top)],
    )
    for points in gables:
        parts.append(flat_polygon(points, (0, 1, 0), (0, 0, 1), wall, style.wall.tile_m))
    # The tiles of the ridge, as a round bar.
    tiles = material_of(style.roof)
    ridge = top + ROOF_M
    ridge_ends = ((-gable_reach, middle, ridge), (length + gable_reach, middle, ridge))
    parts.append(pole(*ridge_ends, 0.1, tiles))
    if rng.random() < 0.75:
        x = float(rng.choice([0.4, length - 1.0, length / 2]))
        y = middle + float(rng.choice([-0.8, 0.3]))  # before or behind the ridge
        # It begins inside of the roof, well below the tiles, and ends above the ridge.
        begin = height + rise * 0.4
        end = top + rng.uniform(0.6, 1.2)
        parts += _chimney(style, x, y, begin, end)
    roof = joined(parts)
    return roof if ridge_along_x else roof.moved(rotation_z(90), (width, 0, 0))


def _chimney(style: Style, x: float, y: float, begin: float, end: float) -> list[Mesh]:
    """A chimney, 0.6 m along x and 0.5 m along y, with a cover of stone and two round clay pots.

    Args:
        style: of the house; the chimney is of its walls' material, but never of boards.
        x, y: of the corner with the smallest coordinates, in metres.
        begin, end: z of its lower end, and of its upper end without cover and pots.
    """
    material = material_of(style.base if style.wall.kind == "boards" else style.wall)
    faces = Faces()
    faces.box((x, y, begin), (x + 0.6, y + 0.5, end), material, style.wall.tile_m)
    cover = material_of(style.base)
    faces.box((x - 0.06, y - 0.06, end), (x + 0.66, y + 0.56, end + 0.08), cover)
    pot = material_of(style.roof)
    pots = [
        pole((pot_x, y + 0.25, end), (pot_x, y + 0.25, end + 0.35), 0.09, pot)
        for pot_x in (x + 0.15, x + 0.42)
    ]
    return [faces.mesh(), *pots]


def _slope(
    rng: Rng,
    style: Style,
    length: float,
    span: float,
    height: float,
    rise: float,
    gable_reach: float,
    eave: float,
) -> Mesh:
    """One half of a gable roof whose ridge runs along x: it rises from y = −`eave` to `span` / 2.

    It has tiles above, boards below and around, a gutter, and in 40 % a skylight.

    Args:
        rng: for a skylight.
        style: of the house.
        length, span: sides of the house along the ridge (x) and across it (y), in metres.
        height: z of the walls' upper ends.
        rise: of the ridge above them.
        gable_reach: how far it reaches beyond the gables, horizontally, at x < 0 and x > `length`.
        eave: how far it reaches beyond the wall at y = 0, horizontally.
    """
    drop = eave * rise / (span / 2)  # of the lower edge below the wall's end
    low = height - drop  # z of the boards' lower edge; the tiles lie ROOF_M above them
    along_ridge = (length + 2 * gable_reach, 0, 0)
    up = np.array([0, span / 2 + eave, rise + drop])  # from the lower edge to the ridge
    start = np.array([-gable_reach, -eave, low + ROOF_M])
    faces = Faces()
    tiles = material_of(style.roof)
    faces.quad(start.tolist(), along_ridge, up.tolist(), tiles, style.roof.tile_m)
    faces.quad((-gable_reach, -eave, low), up.tolist(), along_ridge, style.frame)  # from below
    # The board at the lower edge, 2 cm thick.
    board_low = (-gable_reach, -eave - 0.02, low - 0.06)
    faces.box(board_low, (length + gable_reach, -eave, low + ROOF_M), style.frame)
    # Boards along the gables, 2 cm thick: both faces of each.
    left, right = -gable_reach, length + gable_reach
    for x in (left - 0.02, left, right, right + 0.02):
        faces.quad((x, -eave, low - 0.04), up.tolist(), (0, 0, ROOF_M + 0.06), style.frame)
    if rng.random() < 0.4 and length > 5:
        _add_skylight(faces, rng, start, up, gable_reach, length)
    gutter_z = low + ROOF_M - 0.07
    gutter_y = -eave - 0.08
    gutter = pole((left, gutter_y, gutter_z), (right, gutter_y, gutter_z), 0.06, ZINC)
    return joined([faces.mesh(), gutter])


def _add_skylight(
    faces: Faces,
    rng: Rng,
    start: NDArray[np.float64],
    up: NDArray[np.float64],
    gable_reach: float,
    length: float,
) -> None:
    """Add a skylight to a slope: a pane of 0.8 by 1.2 m, 6 cm above the tiles, with metal sides.

    Args:
        faces: gets it.
        rng: chooses its place.
        start: [3] the slope's lower left corner, in metres; its lower edge runs along x.
        up: [3] from this corner up to the ridge.
        gable_reach: how far the slope reaches beyond the gable at x = 0.
        length: of the house along x.
    """
    unit = up / np.linalg.norm(up)
    normal = np.cross([1.0, 0, 0], unit)
    corner = start + np.array([gable_reach + rng.uniform(1, length - 2), 0, 0])
    corner = corner + rng.uniform(0.35, 0.6) * up
    width, height = np.array([0.8, 0, 0]), 1.2 * unit
    glass = Material((0.1, 0.11, 0.12), specular=0.1, roughness=0.05)
    lift = 0.06 * normal
    faces.quad((corner + lift).tolist(), width.tolist(), height.tolist(), glass)
    # The sides: below, above, left and right.
    for begin, side in (
        (corner, width),
        (corner + height, width),
        (corner, height),
        (corner + width, height),
    ):
        faces.quad(begin.tolist(), side.tolist(), lift.tolist(), METAL)


def leafy(
    rng: Rng,
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    leaves: int,
    color: tuple[float, float, float],
    leaf_m: float = 0.07,
) -> Mesh:
    """A clipped hedge in a box: a dark box inside, and leaves over all sides of it but the lower.

    Each leaf is a kite of two triangles, in one of eight shades. A kite of length l is 0.56 l wide
    and has an area of 0.28 l². Some leaves reach a few centimetres out of the box.

    Args:
        rng: for places, directions, lengths and shades of leaves.
        low, high: [3] corners with the smallest and the largest coordinates, in metres.
        leaves: how many.
        color: mean sRGB colour of leaves.
        leaf_m: mean length of a leaf in metres.
    """
    size = high - low
    inside = box((low + 0.06).tolist(), (high - 0.06).tolist(), Material((0.06, 0.09, 0.04)))
    # Leaves lie on five sides, by their areas: at low x, high x, low y, high y, and above.
    areas = np.array([size[1] * size[2], size[1] * size[2], size[0] * size[2], size[0] * size[2],
                      size[0] * size[1]])  # fmt: skip
    side = rng.choice(5, size=leaves, p=areas / areas.sum())
    # Places as shares of the box's sides, 0 to 1; that across a leaf's side is then set so that
    # the leaf lies at this side, or a little inside.
    place = rng.random((leaves, 3))
    depth = np.abs(rng.normal(0, 0.035, leaves)) / np.maximum(size, 0.1).max()
    place[side == 0, 0] = depth[side == 0]
    place[side == 1, 0] = 1 - depth[side == 1]
    place[side == 2, 1] = depth[side == 2]
    place[side == 3, 1] = 1 - depth[side == 3]
    place[side == 4, 2] = 1 - depth[side == 4]
    middle = low + place * size + rng.normal(0, 0.018, (leaves, 3))
    # Leaves look outwards on the whole, and a little upwards, to the light.
    outward = np.array([(-1, 0, 0), (1, 0, 0), (0, -1, 0), (0, 1, 0), (0, 0, 1)], np.float64)[side]
    normal = outward + rng.normal(0, 0.55, (leaves, 3)) + np.array([0, 0, 0.3])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    # Unit vectors along a leaf, from its root to its tip, and across it.
    along = np.cross(normal, rng.standard_normal((leaves, 3)))
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    across = np.cross(normal, along)
    length = leaf_m * rng.uniform(0.7, 1.3, (leaves, 1))
    tip = middle + length / 2 * along
    root = middle - length / 2 * along
    right = middle + 0.28 * length * across
    left = middle - 0.28 * length * across
    corners = np.concatenate([np.stack([root, right, tip], 1), np.stack([root, tip, left], 1)])
    shade_of_leaf = rng.integers(8, size=leaves)
    mean_color = np.array(color)
    shades = []
    for number in range(8):  # from 0.7 to 1.33 times the mean colour
        red, green, blue = np.clip(
            mean_color * (0.7 + 0.09 * number) + rng.normal(0, 0.012, 3), 0.02, 0.9
        )
        shades.append(
            Material((float(red), float(green), float(blue)), specular=0.03, roughness=0.5)
        )
    count = 2 * leaves
    cover = Mesh(
        corners.astype(np.float32),
        np.repeat(np.concatenate([normal, normal])[:, None], 3, 1).astype(np.float32),
        np.zeros((count, 3, 2), np.float32),
        np.concatenate([shade_of_leaf, shade_of_leaf]).astype(np.int32),
        tuple(shades),
    )
    return joined([inside, cover])
