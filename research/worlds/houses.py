"""Houses by rules: walls with windows that lie in them, doors, roofs, chimneys, balconies, shops.

All coordinates are metres. A house stands on z = 0 with its front in the plane y = 0, from x = 0 to
x = its width: y < 0 is before the house, y > 0 is inside of it. The other walls are built in the
same way, each as if it were the front, and then turned to their places. Colours are sRGB, 0 to 1.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence
from typing import Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from worlds.meshes import Faces, Material, Mesh, box, joined, rotation_z
from worlds.shell import material_of
from worlds.surfaces import Surface

Rng = np.random.Generator
FRAME_M = 0.06  # width of the bars around a window or door
FRAME_DEPTH_M = 0.05  # of these bars, along y
ROOF_THICKNESS_M = 0.14
DOWNPIPE_RADIUS_M = 0.045
METAL = Material((0.32, 0.33, 0.34), specular=0.15, roughness=0.3)  # dark: rails, handles, bars
ZINC = Material((0.55, 0.56, 0.57), specular=0.12, roughness=0.32)  # of gutters and downpipes
# Paints of doors, frames, shutters and fences.
PAINTS = (
    (0.92, 0.92, 0.9),  # white
    (0.9, 0.88, 0.82),  # cream
    (0.3, 0.32, 0.34),  # dark grey
    (0.25, 0.32, 0.28),  # dark green
    (0.42, 0.28, 0.18),  # brown
    (0.55, 0.16, 0.14),  # red
    (0.2, 0.28, 0.42),  # blue
    (0.16, 0.16, 0.17),  # black
)
# How many of all houses have walls of a kind of surface.
WALL_SHARES = {"brick": 0.34, "plaster": 0.36, "boards": 0.16, "concrete": 0.06, "stone_wall": 0.08}
# A gable roof with its ridge along the front (along x) or across it (along y), or a flat roof.
RoofKind = Literal["ridge along", "ridge across", "flat"]
ROOFS: tuple[RoofKind, ...] = ("ridge along", "ridge across", "flat")


class FindSurface(Protocol):
    """Chooses a surface."""

    def __call__(self, *kinds: str) -> Surface:
        """A random surface of one of these kinds, such as "brick"."""


class Hole(NamedTuple):
    """A rectangle in a wall in which a window or door lies, in metres.

    The wall lies in the plane y = 0 and looks towards −y: x is to the right, seen from outside.
    """

    left: float  # x
    right: float
    low: float  # z
    high: float
    kind: Literal["window", "door", "shop"]  # "shop": a shop window, down to the knees


@dataclasses.dataclass(frozen=True)
class Style:
    """What the parts of a house look like; neighbours of one row may share it."""

    wall: Surface
    tint: tuple[float, float, float]  # linear factors of the wall's colour
    stone: Surface  # of the walls' foot, of steps, balconies and covers
    roof: Surface
    frame: Material  # of windows and doors
    door: Material
    floor_m: float  # from one floor to the next
    window_m: tuple[float, float]  # width and height
    pane_grid: tuple[int, int]  # columns and rows of panes in a window
    trim: Material | None  # of the stones around windows; None: there are none
    shutters: Material | None  # None: there are none

    @property
    def wall_material(self) -> Material:
        """The walls' surface in their colour."""
        return material_of(self.wall, self.tint)


@dataclasses.dataclass(frozen=True)
class GableRoof:
    """The sizes of a gable roof whose ridge runs along x, in metres."""

    length: float  # of the house along the ridge, from x = 0
    span: float  # of the house across the ridge, from y = 0
    walls_top: float  # z of the walls' upper ends
    rise: float  # of the ridge above the walls
    gable_reach: float  # of the slopes beyond the gables, horizontally
    eave: float  # of the slopes beyond the other two walls, horizontally


def paint(rng: Rng) -> Material:
    """A random glossy paint of doors, frames, shutters and fences."""
    color = np.array(PAINTS[int(rng.integers(len(PAINTS)))])
    varied = color * rng.uniform(0.85, 1.1)
    red, green, blue = np.clip(varied, 0.03, 0.95)  # nothing is quite black or white
    return Material((float(red), float(green), float(blue)), specular=0.04, roughness=0.3)


def choose_style(rng: Rng, find: FindSurface) -> Style:
    """A random style of a house: the materials of its parts, and sizes of floors and windows.

    Args:
        rng: for all random choices but those of surfaces.
        find: gives a random surface of one of the kinds that it is called with.
    """
    wall_kind = rng.choice(list(WALL_SHARES), p=list(WALL_SHARES.values()))
    wall = find(str(wall_kind))
    # Plaster is painted in warm, pale colours more often than in cold ones: green and blue are
    # weaker than red. Other walls keep their own colour.
    red = rng.uniform(0.75, 1.0)
    warm_tint = (red, red * rng.uniform(0.9, 1.0), red * rng.uniform(0.75, 1.0))
    tint = warm_tint if wall.kind == "plaster" else (1.0, 1.0, 1.0)
    white_paint = Material((0.9, 0.9, 0.88), specular=0.04, roughness=0.3)
    return Style(
        wall=wall,
        tint=tint,
        stone=find("concrete", "stone_wall"),
        roof=find("roof_tiles"),
        frame=white_paint if rng.random() < 0.65 else paint(rng),
        door=paint(rng),
        floor_m=rng.uniform(2.7, 3.2),
        window_m=(rng.uniform(0.8, 1.5), rng.uniform(1.2, 1.8)),
        # Two columns and one or two rows of panes are the most frequent.
        pane_grid=(int(rng.choice([1, 2, 2, 3])), int(rng.choice([1, 1, 2, 2, 3]))),
        # Concrete made lighter and a little warmer looks like sandstone.
        trim=material_of(find("concrete"), (1.2, 1.15, 1.1)) if rng.random() < 0.5 else None,
        shutters=paint(rng) if rng.random() < 0.22 else None,
    )


def roof_kind(rng: Rng, town: bool) -> RoofKind:
    """A random kind of roof: flat ones are frequent in towns, gables to the street in suburbs."""
    # Shares of ridges along the street, of ridges across it, and of flat roofs.
    shares = [0.6, 0.1, 0.3] if town else [0.5, 0.45, 0.05]
    return ROOFS[int(rng.choice(len(ROOFS), p=shares))]


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
    triangle_count = len(corners) - 2
    # All triangles begin at point 0: (0, 1, 2), (0, 2, 3) and so on.
    order = np.array([[0, k, k + 1] for k in range(1, triangle_count + 1)])
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    normal = normal / np.linalg.norm(normal)
    texture_axes = np.array([u_axis, v_axis], np.float64)
    uv = corners @ texture_axes.T / tile_m
    return Mesh(
        corners[order].astype(np.float32),
        np.broadcast_to(normal, (triangle_count, 3, 3)).astype(np.float32),
        uv[order].astype(np.float32),
        np.zeros(triangle_count, np.int32),
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

    # Two unit vectors at right angles to the axis and to each other. Any vector that does not lie
    # along the axis leads to them: x for upright bars, z for others.
    is_upright = abs(unit[2]) > 0.9
    helper = np.array([1.0, 0, 0]) if is_upright else np.array([0, 0, 1.0])
    across = np.cross(unit, helper)
    across /= np.linalg.norm(across)
    other_across = np.cross(unit, across)

    # [sides + 1, 3] outward normals around the axis, of which the last is the first again, and the
    # points at both ends of the bar in their directions.
    angle = 2 * math.pi * np.arange(sides + 1) / sides
    normal = np.cos(angle)[:, None] * across + np.sin(angle)[:, None] * other_across
    start_ring = first + radius * normal
    end_ring = start_ring + axis

    # Each side of the prism is a rectangle, which is cut into two triangles along its diagonal.
    rectangles = np.stack([start_ring[:-1], start_ring[1:], end_ring[1:], end_ring[:-1]], 1)
    rectangle_normals = np.stack([normal[:-1], normal[1:], normal[1:], normal[:-1]], 1)
    corners = np.concatenate([rectangles[:, [0, 1, 2]], rectangles[:, [0, 2, 3]]])
    normals = np.concatenate([rectangle_normals[:, [0, 1, 2]], rectangle_normals[:, [0, 2, 3]]])
    triangle_count = len(corners)
    return Mesh(
        corners.astype(np.float32),
        normals.astype(np.float32),
        np.zeros((triangle_count, 3, 2), np.float32),
        np.zeros(triangle_count, np.int32),
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
    least_m = 1e-6  # what is narrower is a rounding error, not a part of the wall
    # The sides of all holes cut the wall into upright columns. A hole crosses a column in its whole
    # width or not at all.
    hole_sides = [x for hole in holes for x in (hole.left, hole.right)]
    xs = sorted({0.0, width, *hole_sides})
    for left, right in itertools.pairwise(xs):
        crossed = [
            hole for hole in holes if hole.left < right - least_m and hole.right > left + least_m
        ]
        crossed.sort(key=lambda hole: hole.low)
        # What remains of the column: from its lower end to the first hole, from there to the next
        # hole, and so on.
        bottoms = [low, *(hole.high for hole in crossed)]
        tops = [*(hole.low for hole in crossed), high]
        for bottom, top in zip(bottoms, tops, strict=True):
            if top - bottom > least_m:
                corner = (left, 0, bottom)
                side = (right - left, 0, 0)
                up = (0, 0, top - bottom)
                # The texture goes on from rectangle to rectangle.
                texture_offset = (left / tile_m, bottom / tile_m)
                faces.quad(corner, side, up, material, tile_m, texture_offset)


def fill_hole(faces: Faces, rng: Rng, hole: Hole, style: Style, find: FindSurface) -> None:
    """Add what is in a hole of a wall: its sides in the wall, and a window, door or shop window.

    The wall lies at y = 0 and looks towards −y. The pane lies 7 to 19 cm behind its face.

    Args:
        faces: gets all.
        rng: for the depth.
        hole: in the wall.
        style: materials and sizes of the house's parts.
        find: gives a random surface of one of the kinds that it is called with.
    """
    depth = rng.uniform(0.09, 0.2)  # y of the frame's side towards the room
    _add_hole_sides(faces, hole, style, depth)
    left, right, low, high, _ = hole
    _add_bar(faces, style, depth, (left, left + FRAME_M), (low, high))
    _add_bar(faces, style, depth, (right - FRAME_M, right), (low, high))
    _add_bar(faces, style, depth, (left, right), (high - FRAME_M, high))
    _add_bar(faces, style, depth, (left, right), (low, low + FRAME_M))

    # One sheet of glass in the whole hole, 15 mm before the frame's inner side. Its picture shows
    # the room behind.
    pane = material_of(find("panes"))
    faces.quad((left, depth - 0.015, low), (right - left, 0, 0), (0, 0, high - low), pane)
    if hole.kind == "door":
        _add_door(faces, hole, style, depth)
        return

    columns, rows = style.pane_grid
    if hole.kind == "shop":
        # Large panes of about 1.5 m, from the lower to the upper end.
        columns = max(1, round((right - left) / 1.5))
        rows = 1
    for number in range(1, columns):
        x = left + (right - left) * number / columns
        _add_bar(faces, style, depth, (x - 0.025, x + 0.025), (low, high))  # 5 cm wide
    for number in range(1, rows):
        z = low + (high - low) * number / rows
        _add_bar(faces, style, depth, (left, right), (z - 0.018, z + 0.018))  # 36 mm high
    if hole.kind == "window":
        _add_sill_and_trim(faces, hole, style, depth)


def _add_hole_sides(faces: Faces, hole: Hole, style: Style, depth: float) -> None:
    """Add the four sides of a hole, which one sees because the window lies deeper than the wall.

    Args:
        faces: gets them.
        hole: in a wall at y = 0 that looks towards −y.
        style: materials and sizes of the house's parts.
        depth: y where the sides end, in metres.
    """
    wall = style.wall_material
    tile_m = style.wall.tile_m
    left, right, low, high, _ = hole
    # Vectors along their edges. A face is seen from where the first × the second vector points,
    # here always to the hole's middle.
    inward = (0, depth, 0)
    outward = (0, -depth, 0)
    along = (right - left, 0, 0)
    up = (0, 0, high - low)
    faces.quad((left, 0, low), inward, up, wall, tile_m)
    faces.quad((right, depth, low), outward, up, wall, tile_m)
    faces.quad((left, 0, high), inward, along, wall, tile_m)
    faces.quad((left, depth, low), outward, along, wall, tile_m)


def _add_bar(
    faces: Faces,
    style: Style,
    depth: float,
    x_range: tuple[float, float],
    z_range: tuple[float, float],
) -> None:
    """Add a bar of the frame of a window or door, 5 cm thick along y.

    Args:
        faces: gets it.
        style: materials and sizes of the house's parts.
        depth: y of its side towards the room, in metres.
        x_range, z_range: where it begins and ends.
    """
    low_corner = (x_range[0], depth - FRAME_DEPTH_M, z_range[0])
    high_corner = (x_range[1], depth, z_range[1])
    faces.box(low_corner, high_corner, style.frame)


def _add_door(faces: Faces, hole: Hole, style: Style, depth: float) -> None:
    """Add a door with four panels, a bar above it, a handle and a step to a hole with its frame.

    In holes higher than 2.25 m the door ends 0.35 m below the upper end, so that the pane of glass
    that `fill_hole` has put into the whole hole shows above it.

    Args:
        faces: gets all.
        hole: in a wall at y = 0 that looks towards −y.
        style: materials and sizes of the house's parts.
        depth: y of the door's side towards the room, in metres.
    """
    left, right, low, high, _ = hole
    has_pane_above = high - low > 2.25
    top = high - (0.35 if has_pane_above else FRAME_M)
    frame_front = depth - FRAME_DEPTH_M  # y
    door_left = left + FRAME_M
    door_right = right - FRAME_M
    faces.box((door_left, frame_front + 0.015, low), (door_right, depth, top), style.door)

    # Panels 15 mm before the door, 10 cm from each other and from its sides: two low ones up to
    # the height of the handle, and two high ones.
    middle = (left + right) / 2
    columns = ((door_left + 0.1, middle - 0.05), (middle + 0.05, door_right - 0.1))
    rows = ((low + 0.15, low + 0.85), (low + 1.0, top - 0.15))
    for x0, x1 in columns:
        for z0, z1 in rows:
            faces.box((x0, frame_front, z0), (x1, frame_front + 0.02, z1), style.door)
    _add_bar(faces, style, depth, (left, right), (top, top + FRAME_M))

    # The handle, 4 × 8 cm, 1 m above the floor.
    handle_x = right - 0.2
    handle_z = low + 1.0
    handle_low = (handle_x, frame_front - 0.05, handle_z)
    handle_high = (handle_x + 0.04, frame_front + 0.02, low + 1.08)
    faces.box(handle_low, handle_high, METAL)

    # The step is 14 cm high and reaches 45 cm before the wall.
    step = material_of(style.stone)
    faces.box((left - 0.15, -0.45, low - 0.14), (right + 0.15, depth, low), step)


def _add_sill_and_trim(faces: Faces, hole: Hole, style: Style, depth: float) -> None:
    """Add the sill of a window, and stones around it and shutters where the style has them.

    Args:
        faces: gets all.
        hole: of the window, in a wall at y = 0 that looks towards −y.
        style: materials and sizes of the house's parts.
        depth: y to which the sill reaches inside of the wall, in metres.
    """
    left, right, low, high, _ = hole
    # The sill is 5 cm high and reaches 6 cm before the wall, so that rain drips off.
    sill = style.trim if style.trim is not None else style.frame
    faces.box((left - 0.05, -0.06, low - 0.05), (right + 0.05, depth, low), sill)

    if style.trim is not None:
        # Stones above, left and right of the window, 12 cm wide, 2 cm before the wall. That above
        # is a lintel: it is the highest and reaches the farthest.
        width = 0.12
        lintel_top = high + 1.4 * width
        faces.box((left - width, -0.025, high), (right + width, 0.01, lintel_top), style.trim)
        faces.box((left - width, -0.02, low), (left, 0.01, high), style.trim)
        faces.box((right, -0.02, low), (right + width, 0.01, high), style.trim)

    if style.shutters is not None:
        # Two open shutters beside the window, each as wide as half of it. Before them lie slats
        # 5 cm high, one each 9 cm.
        width = (right - left) / 2
        for x in (left - width - 0.03, right + 0.03):
            faces.box((x, -0.05, low), (x + width, -0.01, high), style.shutters)
            for z in np.arange(low + 0.08, high - 0.08, 0.09):
                slat_low = (x + 0.06, -0.062, z)
                slat_high = (x + width - 0.06, -0.05, z + 0.05)
                faces.box(slat_low, slat_high, style.shutters)


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
    width, height = size_m
    usable_m = wall_width - 2 * end_m
    count = int(usable_m / spacing_m)
    if count < 1 or wall_width < width + 2 * end_m:
        return []
    # Each window stands in the middle of an equal part of the wall.
    part_m = usable_m / count
    width = min(width, part_m - 0.3)
    lefts = [end_m + part_m * (number + 0.5) - width / 2 for number in range(count)]
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
        style: materials and sizes of the house's parts.
        width, depth: metres along x and y, without what the roof reaches over.
        floors: how many, without that below the roof.
        roof: its kind.
        shop: whether the ground floor is a shop.
        balconies: whether some windows of the upper floors have one.
    """
    # One enters a shop over a low step. Other houses stand a little higher above the street.
    ground_floor_z = 0.12 if shop else rng.uniform(0.15, 0.5)
    floor_zs = [ground_floor_z + floor * style.floor_m for floor in range(floors)]
    walls_top = ground_floor_z + floors * style.floor_m  # z
    window_width, usual_height = style.window_m
    spacing_m = window_width + rng.uniform(0.7, 1.6)  # from one window's middle to the next
    sill_m = rng.uniform(0.75, 1.0)  # height of windows above their floor
    # At least 25 cm of wall remain above a window.
    window_height = min(usual_height, style.floor_m - sill_m - 0.25)

    # The front.
    front_holes: list[Hole] = []
    for number, floor_z in enumerate(floor_zs):
        windows = window_row(width, floor_z + sill_m, (window_width, window_height), spacing_m)
        if number > 0:
            front_holes += windows
        elif shop:
            front_holes += _shop_front(rng, width, floor_z, style.floor_m)
        else:
            front_holes += _with_door(rng, windows, width, floor_z)
    front = Faces()
    _add_wall(front, rng, width, walls_top, front_holes, style, find)
    if balconies:
        # Only before windows above the middle of the ground floor: those of the upper floors.
        _add_balconies(front, rng, front_holes, style, ground_floor_z + 0.5 * style.floor_m)
    # In 70 %, the foot of the wall is of stone, but not of the same as the wall. On a ground floor
    # below 20 cm nothing of it would be seen.
    if style.wall.kind != style.stone.kind and rng.random() < 0.7 and ground_floor_z > 0.2:
        _add_foot(front, width, ground_floor_z, front_holes, style)
    parts = [front.mesh()]
    if shop:
        ceiling = ground_floor_z + style.floor_m
        parts += _sign_and_awning(rng, find, width, ceiling)

    # The right side, the back and the left side: walls of this length, which are built as a front,
    # turned by these degrees and moved.
    sides = (
        (depth, 90.0, (width, 0, 0)),
        (width, 180.0, (width, depth, 0)),
        (depth, -90.0, (0, depth, 0)),
    )
    for length, turn, offset in sides:
        holes: list[Hole] = []
        for floor_z in floor_zs:
            if rng.random() < 0.8:
                # A few windows 1.2 m high, at least 3.5 m from each other and 1 m from the ends.
                holes += window_row(length, floor_z + sill_m, (window_width, 1.2), 3.5, 1.0)
        side = Faces()
        _add_wall(side, rng, length, walls_top, holes, style, find)
        parts.append(side.mesh().moved(rotation_z(turn), offset))

    if roof == "flat":
        parts.append(_flat_roof(rng, style, width, depth, walls_top))
    else:
        parts.append(_gable_roof(rng, style, width, depth, walls_top, roof))
    # A downpipe before one end of the front, from 10 cm above the ground.
    pipe_x = 0.12 if rng.random() < 0.5 else width - 0.12
    pipe_ends = ((pipe_x, -0.09, 0.1), (pipe_x, -0.09, walls_top - 0.05))
    parts.append(pole(*pipe_ends, DOWNPIPE_RADIUS_M, ZINC))
    return joined(parts)


def _add_wall(
    faces: Faces,
    rng: Rng,
    length: float,
    top: float,
    holes: Sequence[Hole],
    style: Style,
    find: FindSurface,
) -> None:
    """Add a wall at y = 0 that looks towards −y, with the windows and doors in its holes.

    Args:
        faces: gets all.
        rng: for how deep windows and doors lie in the wall.
        length: of the wall, from x = 0 on, in metres.
        top: z of its upper end; it begins at z = 0.
        holes: where windows and doors are; they do not overlap.
        style: materials and sizes of the house's parts.
        find: gives a random surface of one of the kinds that it is called with.
    """
    holed_wall(faces, length, 0, top, holes, style.wall_material, style.wall.tile_m)
    for hole in holes:
        fill_hole(faces, rng, hole, style, find)


def _add_foot(faces: Faces, width: float, top: float, holes: Sequence[Hole], style: Style) -> None:
    """Add the foot of a wall, of stone: a layer 3 cm before the wall, but not before doors.

    Args:
        faces: gets it.
        width: of the wall at y = 0, which looks towards −y, in metres.
        top: z where the foot ends; it begins at z = 0.
        holes: of the wall, from left to right.
        style: materials and sizes of the house's parts.
    """
    stone = material_of(style.stone)
    doors = [hole for hole in holes if hole.kind == "door"]
    starts = [0.0, *(door.right for door in doors)]
    ends = [*(door.left for door in doors), width]
    for start, end in zip(starts, ends, strict=True):
        faces.box((start, -0.03, 0), (end, 0, top), stone, style.stone.tile_m)


def _with_door(rng: Rng, windows: list[Hole], width: float, floor_z: float) -> list[Hole]:
    """A row of windows of which a random one is replaced by a door; only a door if there are none.

    Args:
        rng: chooses the window, and the door's size.
        windows: of the ground floor, from left to right.
        width: of the wall, in metres.
        floor_z: of the ground floor, where the door begins.
    """
    top = floor_z + rng.uniform(2.05, 2.5)
    door_width = rng.uniform(0.95, 1.2)
    if not windows:
        middle = width / 2
        return [Hole(middle - door_width / 2, middle + door_width / 2, floor_z, top, "door")]
    number = int(rng.integers(len(windows)))
    middle = (windows[number].left + windows[number].right) / 2
    door = Hole(middle - door_width / 2, middle + door_width / 2, floor_z, top, "door")
    return [*windows[:number], door, *windows[number + 1 :]]


def _shop_front(rng: Rng, width: float, floor_z: float, floor_m: float) -> list[Hole]:
    """The holes of a shop's front, from left to right: a door at one end, and a large window.

    Where less than 1 m is left for the window, there is only the door.

    Args:
        rng: chooses the door's end.
        width: of the wall, in metres.
        floor_z: of the ground floor.
        floor_m: from this floor to the next.
    """
    end_m = 0.35  # of wall at both ends of the front
    top = floor_z + floor_m - 0.65  # the sign is above
    door_width = 1.1
    door_is_left = rng.random() < 0.5
    door_left = end_m if door_is_left else width - end_m - door_width
    door_right = door_left + door_width
    holes = [Hole(door_left, door_right, floor_z, min(top, floor_z + 2.4), "door")]

    # The window fills the rest of the front, 25 cm from the door and 45 cm above the floor.
    window_left = door_right + 0.25 if door_is_left else end_m
    window_right = width - end_m if door_is_left else door_left - 0.25
    if window_right - window_left > 1:
        holes.append(Hole(window_left, window_right, floor_z + 0.45, top, "shop"))
    return sorted(holes, key=lambda hole: hole.left)


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
    # Light letters on dark boards, dark ones on light boards.
    is_dark = max(board.color) < 0.6
    ink = Material((0.93, 0.9, 0.8) if is_dark else (0.15, 0.13, 0.12))
    text_left = width * rng.uniform(0.25, 0.35)
    _add_letters(faces, rng, text_left, width * 0.68, ceiling - 0.48, ink)

    bars = []
    if rng.random() < 0.6:
        cloth = material_of(find("fabric"))
        reach = rng.uniform(0.9, 1.4)  # before the front
        drop = rng.uniform(0.3, 0.6)  # of its outer end below the inner one
        outer_z = ceiling - 0.65 - drop  # of its outer end; the inner one is 5 cm below the sign
        # It begins and ends 0.3 m from the front's ends. Its texture repeats every 1.2 m.
        along = (width - 0.6, 0, 0)
        faces.quad((0.3, -reach, outer_z), along, (0, reach, drop), cloth, 1.2)
        # A flap 22 cm high hangs down from its outer end.
        faces.quad((0.3, -reach, outer_z - 0.22), along, (0, 0, 0.22), cloth, 1.2)
        # Two thin bars hold it, at its left and right end.
        for x in (0.32, width - 0.32):
            bars.append(pole((x, -reach, outer_z), (x, 0, outer_z), 0.012, METAL))
    return [faces.mesh(), *bars]


def _add_letters(
    faces: Faces, rng: Rng, left: float, right: float, low: float, ink: Material
) -> None:
    """Add what looks like a line of letters from afar, 26 cm high, on a sign at y = −0.1.

    Each has an upright bar at its left. Some have a horizontal bar at the letter's foot, middle or
    head, and some an upright one at their right.

    Args:
        faces: gets them.
        rng: for all random choices.
        left: x where the first begins, in metres.
        right: x before which the last begins.
        low: z of their lower ends.
        ink: their material.
    """
    front = -0.12  # y of the letters, which are 2 cm thick
    back = -0.1
    bar = 0.04  # width of all bars
    letter_left = left
    while letter_left < right:
        letter_width = rng.uniform(0.08, 0.2)
        letter_right = letter_left + letter_width
        faces.box((letter_left, front, low), (letter_left + bar, back, low + 0.26), ink)
        if rng.random() < 0.7:
            bar_z = low + rng.choice([0.0, 0.11, 0.22])
            faces.box((letter_left, front, bar_z), (letter_right, back, bar_z + bar), ink)
        if rng.random() < 0.5:
            faces.box((letter_right - bar, front, low), (letter_right, back, low + 0.26), ink)
        letter_left += letter_width + 0.06


def _add_balconies(
    faces: Faces, rng: Rng, holes: Sequence[Hole], style: Style, above: float
) -> None:
    """Add a balcony with railings before every second window, at random, of those above a height.

    Args:
        faces: gets them.
        rng: chooses the windows.
        holes: of a wall at y = 0 that looks towards −y, where the balconies are.
        style: materials and sizes of the house's parts.
        above: z in metres above which a window's lower end must lie.
    """
    for hole in holes:
        if hole.kind == "window" and hole.low >= above and rng.random() >= 0.5:
            # It is wider than the window, by 45 cm at both sides. The window begins behind the
            # railing, which is 1 m high.
            floor_z = hole.low - 0.6
            _add_balcony(faces, hole.left - 0.45, hole.right + 0.45, floor_z, style)


def _add_balcony(faces: Faces, left: float, right: float, floor_z: float, style: Style) -> None:
    """Add a balcony, 1 m deep, with a railing 1 m high, to a wall at y = 0 that looks towards −y.

    Args:
        faces: gets it.
        left, right: x of its sides, in metres.
        floor_z: where one stands.
        style: materials and sizes of the house's parts.
    """
    front = -1.0  # y of its outer side
    rail_z = floor_z + 1.0  # of the upper rail
    slab = material_of(style.stone)
    faces.box((left, front, floor_z - 0.14), (right, 0, floor_z), slab)

    # Two rails, the upper one and a thin one at the floor: at the front and at both sides.
    for z, height in ((rail_z, 0.045), (floor_z + 0.08, 0.025)):
        faces.box((left, front, z), (right, front + 0.04, z + height), METAL)
        faces.box((left, front, z), (left + 0.04, 0, z + height), METAL)
        faces.box((right - 0.04, front, z), (right, 0, z + height), METAL)

    # Upright bars of 16 × 16 mm, one each 12 cm, in the middle of the rails: at the front, then at
    # both sides.
    bar = 0.016
    for x in np.arange(left + 0.06, right - 0.03, 0.12):
        faces.box((x, front + 0.01, floor_z), (x + bar, front + 0.026, rail_z), METAL)
    for y in np.arange(front + 0.12, -0.03, 0.12):
        for x in (left + 0.012, right - 0.028):
            faces.box((x, y, floor_z), (x + bar, y + bar, rail_z), METAL)


def _flat_roof(rng: Rng, style: Style, width: float, depth: float, walls_top: float) -> Mesh:
    """A flat roof with a low wall (a parapet) around it, which is covered with stone.

    Args:
        rng: for the parapet's height.
        style: materials and sizes of the house's parts.
        width, depth: of the house, from x = 0 and y = 0 on; its front is at y = 0.
        walls_top: z of the upper end of the house's walls.
    """
    wall = style.wall_material
    tile_m = style.wall.tile_m
    parapet_top = walls_top + rng.uniform(0.25, 0.6)  # z
    thickness = 0.22  # of the parapet
    faces = Faces()
    # At the front, the back, left and right.
    faces.box((0, 0, walls_top), (width, thickness, parapet_top), wall, tile_m)
    faces.box((0, depth - thickness, walls_top), (width, depth, parapet_top), wall, tile_m)
    faces.box((0, 0, walls_top), (thickness, depth, parapet_top), wall, tile_m)
    faces.box((width - thickness, 0, walls_top), (width, depth, parapet_top), wall, tile_m)

    # Covers 9 cm thick, which reach 4 to 8 cm over the walls: at the front, left and right. There
    # is none at the back, which no camera sees.
    cover = style.trim if style.trim is not None else material_of(style.stone)
    cover_top = parapet_top + 0.09
    inner = thickness + 0.04  # from the outer side of the wall to the inner end of the cover
    faces.box((-0.06, -0.08, parapet_top), (width + 0.06, inner, cover_top), cover)
    faces.box((-0.06, -0.04, parapet_top), (inner, depth, cover_top), cover)
    faces.box((width - inner, -0.04, parapet_top), (width + 0.06, depth, cover_top), cover)

    # The roof itself, 2 cm above the walls' ends.
    tar = Material((0.4, 0.39, 0.37))
    faces.quad((0, 0, walls_top + 0.02), (width, 0, 0), (0, depth, 0), tar)
    return faces.mesh()


def _gable_roof(
    rng: Rng, style: Style, width: float, depth: float, walls_top: float, kind: RoofKind
) -> Mesh:
    """A roof of two slopes with the walls of its gables, its ridge, and in 75 % a chimney.

    Args:
        rng: for pitch, eaves, skylights and chimney.
        style: materials and sizes of the house's parts.
        width, depth: of the house, from x = 0 and y = 0 on; its front is at y = 0.
        walls_top: z of the upper end of the house's walls.
        kind: "ridge along": the ridge runs along the front; "ridge across": across it, so that a
            gable is above the front.
    """
    # It is built with its ridge along x, and turned at the end if that shall run along y.
    ridge_along_x = kind == "ridge along"
    length = width if ridge_along_x else depth
    span = depth if ridge_along_x else width
    pitch = math.radians(rng.uniform(32, 48))
    roof = GableRoof(
        length,
        span,
        walls_top,
        rise=span / 2 * math.tan(pitch),
        gable_reach=rng.uniform(0.05, 0.35),
        eave=rng.uniform(0.25, 0.5),
    )

    # The slope above the front, and one that is built in the same way and turned to the back.
    turns_and_offsets = ((0.0, (0.0, 0.0, 0.0)), (180.0, (length, span, 0.0)))
    slopes = [
        _slope(rng, style, roof).moved(rotation_z(turn), offset)
        for turn, offset in turns_and_offsets
    ]

    # Two triangles of wall below the slopes' ends, which look to the left and to the right.
    middle = span / 2  # y of the ridge
    ridge_z = walls_top + roof.rise
    left_points = [(0.0, span, walls_top), (0.0, 0.0, walls_top), (0.0, middle, ridge_z)]
    right_points = [(length, 0.0, walls_top), (length, span, walls_top), (length, middle, ridge_z)]
    gables = [
        flat_polygon(points, (0, 1, 0), (0, 0, 1), style.wall_material, style.wall.tile_m)
        for points in (left_points, right_points)
    ]

    # The tiles that cover the ridge: a round bar, as long as the slopes.
    bar_z = ridge_z + ROOF_THICKNESS_M
    bar_ends = ((-roof.gable_reach, middle, bar_z), (length + roof.gable_reach, middle, bar_z))
    ridge = pole(*bar_ends, 0.1, material_of(style.roof))
    parts = [*slopes, *gables, ridge]

    if rng.random() < 0.75:
        # Near one gable or in the middle of the house, before or behind the ridge. It begins
        # inside of the roof, well below the tiles, and ends above the ridge.
        x = float(rng.choice([0.4, length - 1.0, length / 2]))
        y = middle + float(rng.choice([-0.8, 0.3]))
        begin = walls_top + roof.rise * 0.4
        end = ridge_z + rng.uniform(0.6, 1.2)
        parts += _chimney(style, x, y, begin, end)
    mesh = joined(parts)
    return mesh if ridge_along_x else mesh.moved(rotation_z(90), (width, 0, 0))


def _chimney(style: Style, x: float, y: float, begin: float, end: float) -> list[Mesh]:
    """A chimney, 0.6 m along x and 0.5 m along y, with a cover of stone and two round clay pots.

    Args:
        style: of the house; the chimney is of its walls' material, but never of boards.
        x, y: of the corner with the smallest coordinates, in metres.
        begin, end: z of its lower end, and of its upper end without cover and pots.
    """
    material = material_of(style.stone if style.wall.kind == "boards" else style.wall)
    faces = Faces()
    faces.box((x, y, begin), (x + 0.6, y + 0.5, end), material, style.wall.tile_m)
    # The cover is 8 cm high and reaches 6 cm over the chimney on all sides.
    cover = material_of(style.stone)
    faces.box((x - 0.06, y - 0.06, end), (x + 0.66, y + 0.56, end + 0.08), cover)
    pot = material_of(style.roof)
    pots = [
        pole((pot_x, y + 0.25, end), (pot_x, y + 0.25, end + 0.35), 0.09, pot)
        for pot_x in (x + 0.15, x + 0.42)
    ]
    return [faces.mesh(), *pots]


def _slope(rng: Rng, style: Style, roof: GableRoof) -> Mesh:
    """The front half of a gable roof: it rises from y = −`eave` to the ridge at y = `span` / 2.

    It has tiles above, boards below and around, a gutter, and in 40 % a skylight.

    Args:
        rng: for a skylight.
        style: materials and sizes of the house's parts.
        roof: its sizes; the ridge runs along x.
    """
    left = -roof.gable_reach  # x of its ends
    right = roof.length + roof.gable_reach
    edge_y = -roof.eave  # of its lower edge
    run = roof.span / 2  # horizontally, from the wall to the ridge
    drop = roof.eave * roof.rise / run  # of the lower edge below the wall's end
    boards_z = roof.walls_top - drop  # z of the boards' lower edge
    tiles_z = boards_z + ROOF_THICKNESS_M  # z of the tiles' lower edge
    along_ridge = (roof.length + 2 * roof.gable_reach, 0, 0)
    up = np.array([0, run + roof.eave, roof.rise + drop])  # from the lower edge to the ridge

    # The tiles, seen from above, and the boards below them, seen from below.
    tiles_corner = np.array([left, edge_y, tiles_z])
    faces = Faces()
    tiles = material_of(style.roof)
    faces.quad(tiles_corner.tolist(), along_ridge, up.tolist(), tiles, style.roof.tile_m)
    faces.quad((left, edge_y, boards_z), up.tolist(), along_ridge, style.frame)
    # The board at the lower edge, 2 cm thick.
    faces.box((left, edge_y - 0.02, boards_z - 0.06), (right, edge_y, tiles_z), style.frame)
    # Boards along the gables, 2 cm thick: both faces of each.
    board_height = (0, 0, ROOF_THICKNESS_M + 0.06)
    for x in (left - 0.02, left, right, right + 0.02):
        faces.quad((x, edge_y, boards_z - 0.04), up.tolist(), board_height, style.frame)

    if rng.random() < 0.4 and roof.length > 5:  # on shorter roofs it would come near an end
        _add_skylight(faces, rng, tiles_corner, up, roof)
    # The gutter hangs before the lower edge, halfway up the roof's thickness.
    gutter_z = tiles_z - 0.07
    gutter_y = edge_y - 0.08
    gutter = pole((left, gutter_y, gutter_z), (right, gutter_y, gutter_z), 0.06, ZINC)
    return joined([faces.mesh(), gutter])


def _add_skylight(
    faces: Faces,
    rng: Rng,
    slope_corner: NDArray[np.float64],
    up: NDArray[np.float64],
    roof: GableRoof,
) -> None:
    """Add a skylight to a slope: a pane of 0.8 by 1.2 m, 6 cm above the tiles, with metal sides.

    Args:
        faces: gets it.
        rng: chooses its place.
        slope_corner: [3] the tiles' lower left corner, in metres; their lower edge runs along x.
        up: [3] from this corner up to the ridge.
        roof: its sizes; the ridge runs along x.
    """
    unit_up = up / np.linalg.norm(up)
    normal = np.cross([1.0, 0, 0], unit_up)
    # Its lower left corner: at least 1 m from both gables, around the middle of the slope.
    from_gable = rng.uniform(1, roof.length - 2)
    along = np.array([roof.gable_reach + from_gable, 0, 0])
    corner = slope_corner + along + rng.uniform(0.35, 0.6) * up

    width = np.array([0.8, 0, 0])
    height = 1.2 * unit_up
    lift = 0.06 * normal
    glass = Material((0.1, 0.11, 0.12), specular=0.1, roughness=0.05)
    faces.quad((corner + lift).tolist(), width.tolist(), height.tolist(), glass)
    sides = (
        (corner, width),  # the lower one
        (corner + height, width),  # the upper one
        (corner, height),  # left
        (corner + width, height),  # right
    )
    for side_corner, side in sides:
        faces.quad(side_corner.tolist(), side.tolist(), lift.tolist(), METAL)


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
    # The box lies 6 cm inside of the hedge's sides, so that one sees it only between leaves.
    dark_green = Material((0.06, 0.09, 0.04))
    inside = box((low + 0.06).tolist(), (high - 0.06).tolist(), dark_green)

    middle, outward = _leaf_places(rng, low, high, leaves)
    # Leaves look outwards on the whole, and a little upwards, to the light.
    normal = outward + rng.normal(0, 0.55, (leaves, 3)) + np.array([0, 0, 0.3])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    # Unit vectors along a leaf, from its root to its tip, in any direction, and across it.
    along = np.cross(normal, rng.standard_normal((leaves, 3)))
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    across = np.cross(normal, along)

    # The four corners of each kite, and its two triangles.
    length = leaf_m * rng.uniform(0.7, 1.3, (leaves, 1))
    tip = middle + length / 2 * along
    root = middle - length / 2 * along
    right = middle + 0.28 * length * across
    left = middle - 0.28 * length * across
    corners = np.concatenate([np.stack([root, right, tip], 1), np.stack([root, tip, left], 1)])
    corner_normals = np.repeat(np.concatenate([normal, normal])[:, None], 3, 1)

    # Eight shades, from 0.7 to 1.33 times the mean colour.
    shade_count = 8
    shade_of_leaf = rng.integers(shade_count, size=leaves)
    shades = [_leaf_material(rng, color, 0.7 + 0.09 * number) for number in range(shade_count)]
    triangle_count = 2 * leaves
    cover = Mesh(
        corners.astype(np.float32),
        corner_normals.astype(np.float32),
        np.zeros((triangle_count, 3, 2), np.float32),
        np.concatenate([shade_of_leaf, shade_of_leaf]).astype(np.int32),
        tuple(shades),
    )
    return joined([inside, cover])


def _leaf_places(
    rng: Rng, low: NDArray[np.float64], high: NDArray[np.float64], leaves: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """[N, 3] the middles of a hedge's N leaves, and [N, 3] the directions in which its sides look.

    Leaves lie at all sides of a box but the lower, equally dense everywhere, or a little inside.

    Args:
        rng: for the places.
        low, high: [3] corners of the box with the smallest and the largest coordinates, in metres.
        leaves: N.
    """
    size = high - low
    x_size, y_size, z_size = size
    # The sides at low x, high x, low y and high y, and the upper one.
    areas = np.array(
        [y_size * z_size, y_size * z_size, x_size * z_size, x_size * z_size, x_size * y_size]
    )
    directions = np.array([(-1, 0, 0), (1, 0, 0), (0, -1, 0), (0, 1, 0), (0, 0, 1)], np.float64)
    side = rng.choice(5, size=leaves, p=areas / areas.sum())

    # Places as shares of the box's size, 0 to 1. First they are anywhere in the box; then the
    # coordinate across a leaf's side is set, so that the leaf lies at this side.
    place = rng.random((leaves, 3))
    inset = np.abs(rng.normal(0, 0.035, leaves)) / np.maximum(size, 0.1).max()
    for number, (axis, at_high_end) in enumerate(
        ((0, False), (0, True), (1, False), (1, True), (2, True))
    ):
        on_side = side == number
        place[on_side, axis] = 1 - inset[on_side] if at_high_end else inset[on_side]
    middle = low + place * size + rng.normal(0, 0.018, (leaves, 3))  # 18 mm around there
    return middle, directions[side]


def _leaf_material(rng: Rng, color: tuple[float, float, float], shade: float) -> Material:
    """The material of leaves of one shade: an sRGB colour times `shade`, a little changed."""
    varied = np.array(color) * shade + rng.normal(0, 0.012, 3)
    red, green, blue = np.clip(varied, 0.02, 0.9)
    return Material((float(red), float(green), float(blue)), specular=0.03, roughness=0.5)
