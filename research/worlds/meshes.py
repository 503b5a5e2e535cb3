"""Triangles with materials: the form in which all models, walls and worlds are kept.

Lengths are in metres. A room has x to the right, y away from the front wall, and z up.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Ints = NDArray[np.int32]

Vector = Sequence[float] | NDArray[np.float64]  # [3]

CREASE_COSINE = 0.7  # faces that meet at more than 45 degrees keep an edge between them
# Points of a model that are closer than this share of its size are one point.
WELD_RATIO = 1e-5


@dataclasses.dataclass(frozen=True)
class Material:
    """How a surface looks."""

    color: tuple[float, float, float] = (0.6, 0.6, 0.6)  # sRGB, multiplies the texture
    texture: str | None = None  # name of the picture, or None for one colour
    specular: float = 0.0  # share of light that is mirrored when looked at straight on
    roughness: float = 1.0  # 0: a mirror, 1: chalk
    opacity: float = 1.0  # below 0.6 one sees through it, as through glass
    emission: float = 0.0  # how brightly it shines by itself, in units of a white wall's light
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)  # linear, multiplies colour and texture


@dataclasses.dataclass(frozen=True)
class Mesh:
    """Triangles, each with its own three corners, so that no index has to be followed."""

    corners: Floats  # [F, 3, 3] metres
    normals: Floats  # [F, 3, 3] unit vectors at the corners, for smooth shading
    uv: Floats  # [F, 3, 2] texture coordinates, v up
    material: Ints  # [F] index in `materials`
    materials: tuple[Material, ...]

    @property
    def count(self) -> int:
        """The number of triangles."""
        return len(self.corners)

    @property
    def low(self) -> Floats:
        """[3] the smallest coordinates."""
        return np.asarray(self.corners.reshape(-1, 3).min(0), np.float32)

    @property
    def high(self) -> Floats:
        """[3] the largest coordinates."""
        return np.asarray(self.corners.reshape(-1, 3).max(0), np.float32)

    def moved(self, matrix: NDArray[np.floating], offset: Sequence[float] = (0, 0, 0)) -> Mesh:
        """The mesh with all points p replaced by `matrix` [3, 3] · p + `offset` [3]."""
        matrix = np.asarray(matrix, np.float64)
        corners = self.corners @ matrix.T + np.asarray(offset, np.float64)

        # A stretched surface turns its normals by the inverse transpose.
        normals = self.normals @ np.linalg.inv(matrix)
        lengths = np.linalg.norm(normals, axis=-1, keepdims=True)
        normals = normals / np.maximum(lengths, 1e-12)
        return dataclasses.replace(
            self, corners=corners.astype(np.float32), normals=normals.astype(np.float32)
        )

    def with_materials(self, materials: Sequence[Material]) -> Mesh:
        """The same triangles with other materials, in the same order."""
        return dataclasses.replace(self, materials=tuple(materials))


def joined(meshes: Sequence[Mesh]) -> Mesh:
    """All triangles of several meshes in one mesh; equal materials become one."""
    numbers: dict[Material, int] = {}  # of distinct materials
    indices = []
    for mesh in meshes:
        # The new number of each of this mesh's materials.
        table = [numbers.setdefault(material, len(numbers)) for material in mesh.materials]
        indices.append(np.array(table, np.int32)[mesh.material])
    return Mesh(
        np.concatenate([mesh.corners for mesh in meshes]),
        np.concatenate([mesh.normals for mesh in meshes]),
        np.concatenate([mesh.uv for mesh in meshes]),
        np.concatenate(indices),
        tuple(numbers),
    )


def face_normals(corners: NDArray[np.floating]) -> NDArray[np.float64]:
    """[F, 3] normals of triangles [F, 3, 3], as long as twice the triangle's area."""
    points = np.asarray(corners, np.float64)
    first_side = points[:, 1] - points[:, 0]
    second_side = points[:, 2] - points[:, 0]
    return np.cross(first_side, second_side)


def smooth_normals(corners: NDArray[np.floating]) -> Floats:
    """[F, 3, 3] normals for triangles [F, 3, 3] that have none: smooth but for sharp edges.

    The normal at a corner is the mean over the faces that meet there, weighted by their area. Faces
    at more than 45 degrees to the corner's own face do not count, so that a box keeps its edges.
    """
    own = face_normals(corners)
    lengths = np.linalg.norm(own, axis=1, keepdims=True)
    own_unit = own / np.maximum(lengths, 1e-20)

    # Corners at one place are found by rounding.
    points = np.asarray(corners, np.float64).reshape(-1, 3)
    size = max(float(np.ptp(points, axis=0).max()), 1e-9)
    rounded = np.round(points / (size * WELD_RATIO)).astype(np.int64)
    _, place = np.unique(rounded, axis=0, return_inverse=True)
    place = place.reshape(-1)

    # For each corner, the sum over the faces at its place that look roughly the same way. Pairs of
    # faces would tell this exactly, but a fan of faces has too many pairs. So faces are sorted into
    # 26 directions, and all corners of a direction share the sums over the faces near it. The limit
    # is lower than for a pair, because a face may lie at the edge of its direction.
    face = np.repeat(np.arange(len(corners)), 3)
    bins = _direction_bins(own_unit)
    result = np.zeros((len(points), 3))
    for direction in np.unique(bins):
        near = own_unit @ _bin_direction(direction) > CREASE_COSINE - 0.35
        sums = np.zeros((place.max() + 1, 3))
        chosen = near[face]
        np.add.at(sums, place[chosen], own[face[chosen]])
        mine = bins[face] == direction
        result[mine] = sums[place[mine]]
    flat = own_unit[face]
    lengths = np.linalg.norm(result, axis=1, keepdims=True)
    result = np.where(lengths > 1e-20, result / np.maximum(lengths, 1e-20), flat)

    # A mean that leans too far from the face would shade it from the wrong side.
    leaning = (result * flat).sum(1) < CREASE_COSINE
    result[leaning] = flat[leaning]
    return np.asarray(result.reshape(-1, 3, 3), np.float32)


_BIN_DIRECTIONS = np.array(
    [
        (x, y, z)
        for x in (-1, 0, 1)
        for y in (-1, 0, 1)
        for z in (-1, 0, 1)
        if (x, y, z) != (0, 0, 0)
    ],
    np.float64,
)
_BIN_DIRECTIONS /= np.linalg.norm(_BIN_DIRECTIONS, axis=1, keepdims=True)


def _direction_bins(directions: NDArray[np.float64]) -> NDArray[np.int64]:
    """[N] the nearest of 26 directions to unit vectors [N, 3]."""
    return np.asarray((directions @ _BIN_DIRECTIONS.T).argmax(1), np.int64)


def _bin_direction(number: int) -> NDArray[np.float64]:
    """[3] the direction with this number."""
    return np.asarray(_BIN_DIRECTIONS[number])


def repaired_normals(corners: NDArray[np.floating], normals: NDArray[np.floating]) -> Floats:
    """[F, 3, 3] the given normals as unit vectors; faces with broken ones get new ones.

    Broken are zero, NaN, and normals that point to the other side of the face in a minority of
    faces (a majority only says that the face's corners run the other way round).
    """
    given = np.asarray(normals, np.float64)
    lengths = np.linalg.norm(given, axis=-1, keepdims=True)
    with np.errstate(invalid="ignore"):
        whole = (np.isfinite(given).all(-1) & (lengths[..., 0] > 1e-6)).all(1)
    given = np.where(lengths > 1e-6, given / np.maximum(lengths, 1e-6), 0.0)
    given = np.nan_to_num(given)
    if whole.all():
        return given.astype(np.float32)
    return np.where(whole[:, None, None], given, smooth_normals(corners)).astype(np.float32)


def rotation_z(degrees: float) -> NDArray[np.float64]:
    """[3, 3] a turn about the upward axis, counterclockwise seen from above."""
    angle = np.radians(degrees)
    return np.array(
        [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
    )


def quad(
    origin: Vector,
    side: Vector,
    other: Vector,
    material: Material,
    tile_m: tuple[float, float] | None = None,
    uv_offset: tuple[float, float] = (0.0, 0.0),
) -> Mesh:
    """A parallelogram; its normal is `side` × `other`.

    Args:
        origin: [3] a corner.
        side: [3] from this corner to the next; the texture's u runs along it.
        other: [3] from this corner to the last; the texture's v runs along it.
        material: of both triangles.
        tile_m: width and height of one repeat of the texture; None: one repeat in all.
        uv_offset: added to the texture coordinates, so that walls do not repeat each other.
    """
    start = np.asarray(origin, np.float64)
    u_side = np.asarray(side, np.float64)
    v_side = np.asarray(other, np.float64)
    points = np.stack([start, start + u_side, start + u_side + v_side, start + v_side])
    repeats = np.ones(2)
    if tile_m is not None:
        repeats = np.array([np.linalg.norm(u_side), np.linalg.norm(v_side)]) / np.array(tile_m)
    uv = np.array([(0, 0), (1, 0), (1, 1), (0, 1)]) * repeats + np.array(uv_offset)
    order = np.array([[0, 1, 2], [0, 2, 3]])
    normal = np.cross(u_side, v_side)
    normal = normal / np.linalg.norm(normal)
    return Mesh(
        points[order].astype(np.float32),
        np.broadcast_to(normal, (2, 3, 3)).astype(np.float32),
        uv[order].astype(np.float32),
        np.zeros(2, np.int32),
        (material,),
    )


def box(
    low: Sequence[float],
    high: Sequence[float],
    material: Material,
    tile_m: tuple[float, float] | None = None,
) -> Mesh:
    """A box between two corners, with outward normals and the texture on all six sides."""
    x0, y0, z0 = low
    x1, y1, z1 = high
    dx = (x1 - x0, 0, 0)
    dy = (0, y1 - y0, 0)
    dz = (0, 0, z1 - z0)
    back_x = (x0 - x1, 0, 0)
    back_y = (0, y0 - y1, 0)
    return joined(
        [
            quad((x0, y0, z0), dx, dz, material, tile_m),  # front
            quad((x1, y1, z0), back_x, dz, material, tile_m),  # back
            quad((x0, y1, z0), back_y, dz, material, tile_m),  # left
            quad((x1, y0, z0), dy, dz, material, tile_m),  # right
            quad((x0, y0, z1), dx, dy, material, tile_m),  # top
            quad((x0, y1, z0), dx, back_y, material, tile_m),  # bottom
        ]
    )


class Faces:
    """Many parallelograms and boxes, which become one mesh at once.

    It takes less time than to join the meshes of the functions `quad` and `box`.
    """

    def __init__(self) -> None:
        """None yet."""
        # By material, a row of twelve numbers for each parallelogram: its corner (3), its two sides
        # (3 each), the width and height of a repeat of the texture in metres (1; 0: one repeat in
        # all), and what is added to u and v (2).
        self._rows: dict[Material, list[tuple[float, ...]]] = {}

    def quad(
        self,
        origin: Sequence[float],
        side: Sequence[float],
        other: Sequence[float],
        material: Material,
        tile_m: float | None = None,
        uv_offset: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        """Add a parallelogram, which is seen from the side to which `side` × `other` points.

        Args:
            origin: [3] a corner in metres; u and v are 0 there.
            side: [3] from there to a neighbouring corner, along u.
            other: [3] to the other neighbour, along v.
            material: its surface.
            tile_m: width and height of one repeat of the texture in metres; None: the texture is
                there once.
            uv_offset: added to u and v.
        """
        size = 0.0 if tile_m is None else tile_m
        row = (*origin, *side, *other, size, *uv_offset)
        self._rows.setdefault(material, []).append(row)

    def box(
        self,
        low: Sequence[float],
        high: Sequence[float],
        material: Material,
        tile_m: float | None = None,
    ) -> None:
        """Add a box with sides along the axes: its six faces, seen from outside.

        Args:
            low: [3] the smallest coordinates in metres.
            high: [3] the largest.
            material: of all faces.
            tile_m: width and height of one repeat of the texture in metres; None: once a face.
        """
        x0, y0, z0 = low
        x1, y1, z1 = high
        x, y, z = x1 - x0, y1 - y0, z1 - z0  # lengths
        size = 0.0 if tile_m is None else tile_m
        # Corner, side along u, side along v, size of a repeat, no offset. The front is at −y.
        self._rows.setdefault(material, []).extend(
            (
                (x0, y0, z0, x, 0, 0, 0, 0, z, size, 0, 0),  # front
                (x1, y1, z0, -x, 0, 0, 0, 0, z, size, 0, 0),  # back
                (x0, y1, z0, 0, -y, 0, 0, 0, z, size, 0, 0),  # left
                (x1, y0, z0, 0, y, 0, 0, 0, z, size, 0, 0),  # right
                (x0, y0, z1, x, 0, 0, 0, y, 0, size, 0, 0),  # top
                (x0, y1, z0, x, 0, 0, 0, -y, 0, size, 0, 0),  # bottom
            )
        )

    def mesh(self) -> Mesh:
        """All of them as one mesh; ValueError if there are none."""
        parts = [_parallelograms(np.array(rows), one) for one, rows in self._rows.items()]
        return joined(parts)


def _parallelograms(rows: NDArray[np.float64], material: Material) -> Mesh:
    """The mesh of N parallelograms with one material, two triangles each.

    Args:
        rows: [N, 12] a corner (3), two sides (3 each), width and height of a repeat of the texture
            (1; 0: one repeat in all), and what is added to u and v (2); lengths in metres.
        material: of all of them.
    """
    origin, side, other = rows[:, 0:3], rows[:, 3:6], rows[:, 6:9]
    tile_m, offset = rows[:, 9:10], rows[:, 10:12]
    # The four corners, around the face, and their texture coordinates.
    points = np.stack([origin, origin + side, origin + side + other, origin + other], 1)
    lengths = np.stack([np.linalg.norm(side, axis=1), np.linalg.norm(other, axis=1)], 1)
    repeats = np.where(tile_m > 0, lengths / np.where(tile_m > 0, tile_m, 1.0), 1.0)
    square = np.array([(0, 0), (1, 0), (1, 1), (0, 1)])
    uv = square * repeats[:, None] + offset[:, None]
    normal = np.cross(side, other)
    normal = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-20)
    order = np.array([[0, 1, 2], [0, 2, 3]])  # the corners of the two triangles
    count = 2 * len(rows)
    return Mesh(
        points[:, order].reshape(count, 3, 3).astype(np.float32),
        np.repeat(normal, 6, 0).reshape(count, 3, 3).astype(np.float32),
        uv[:, order].reshape(count, 3, 2).astype(np.float32),
        np.zeros(count, np.int32),
        (material,),
    )
