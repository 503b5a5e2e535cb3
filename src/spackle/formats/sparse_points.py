"""The sparse points of a reconstruction, which lie beside the cameras of photos.

COLMAP notes which photo sees which point. nerfstudio names a PLY file of points without such notes.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from spackle.core.camera import Camera
from spackle.formats.camera_readers import nerfstudio_points
from spackle.formats.camera_set import CameraSet
from spackle.formats.colmap import (
    DAMAGED,
    images_path,
    points_path,
    read_images,
    read_points,
)
from spackle.formats.ply_tables import PlyTables
from spackle.runtime.errors import InputError, as_input_error

# Without notes of who sees a point, one that a nearer point hides is left out: of the points in a
# square of the picture, those behind the nearest by more than a tenth.
HIDDEN_RATIO = 1.1
POINTS_PER_SQUARE = 6  # on average; squares of fewer points tell little of what hides what


@dataclasses.dataclass(frozen=True)
class SeenPoints:
    """The points that a photo sees."""

    uv: Tensor  # [N, 2] float32, pixel positions in the picture of the camera file
    z: Tensor  # [N] float32, depths in the unit of the camera file


@dataclasses.dataclass(frozen=True)
class SparsePoints:
    """The points of a reconstruction, in the world of its cameras."""

    source: Path
    xyz: Tensor  # [M, 3] float64
    # By the picture's name: where the picture sees points, [n, 2], and which, [n] rows of `xyz`.
    # None: nobody noted it.
    observations: Mapping[str, tuple[Tensor, Tensor]] | None = None

    def seen_by(self, camera: Camera, name: str) -> SeenPoints:
        """The points that a photo sees; `camera` took it, `name` is the name in the camera file."""
        # Where nobody noted who sees which point, a photo sees what no nearer point hides.
        if self.observations is None:
            return _unhidden(self.xyz, camera)
        # A photo without notes sees no points.
        uv, rows = self.observations.get(name, (torch.zeros(0, 2), torch.zeros(0).long()))
        z = camera.to_camera(self.xyz[rows])[:, 2]
        is_in_front = z > 0
        return SeenPoints(uv[is_in_front].float(), z[is_in_front].float())


def read_sparse_points(cameras: CameraSet) -> SparsePoints | None:
    """Read the points beside the cameras of COLMAP or nerfstudio; None if there are none.

    Raises:
        InputError: a file of points is damaged.
    """
    if cameras.kind == "COLMAP":
        return _colmap_points(cameras.source)
    if cameras.kind != "nerfstudio":
        return None
    found = nerfstudio_points(cameras.source)
    if found is None:
        return None
    file, to_world = found
    xyz = _ply_positions(file)
    return SparsePoints(file, xyz @ to_world[:3, :3].T + to_world[:3, 3])


def _colmap_points(model: Path) -> SparsePoints | None:
    """The points of a COLMAP model, and where each photo sees them."""
    if not points_path(model).is_file():
        return None
    point_ids, xyz = read_points(model)
    observations = {}
    with as_input_error(images_path(model), DAMAGED):
        for record in read_images(model):
            ids = record.observations["id"]
            row = np.searchsorted(point_ids, ids).clip(max=max(0, len(point_ids) - 1))
            # What the photo shows of a point that is not reliable is left out. The search finds
            # some row for its id, too, but that row has another id.
            is_known = np.zeros(len(ids), bool) if not len(xyz) else point_ids[row] == ids
            uv = torch.from_numpy(record.observations["uv"][is_known].copy())
            observations[record.name] = (uv, torch.from_numpy(row[is_known]))
    return SparsePoints(points_path(model), torch.from_numpy(xyz), observations)


def _ply_positions(file: Path) -> Tensor:
    """The positions [M, 3] float64 of a PLY file of points."""
    tables = PlyTables(file)
    vertices = tables.elements_named("vertex")
    names = ("x", "y", "z")
    # Rows that hold lists, or that follow a table of unknown length, have no known place in a file.
    is_readable = bool(vertices) and set(names) <= set(vertices[0].property_names)
    if not is_readable or not tables.has_known_place(vertices[0]):
        raise InputError(f"{file}: no table of points with x, y and z: export it again")
    rows = tables.rows(vertices[0])
    xyz = np.stack([rows[name].astype(np.float64) for name in names], axis=1)
    return torch.from_numpy(xyz[np.isfinite(xyz).all(axis=1)])


def _unhidden(xyz: Tensor, camera: Camera) -> SeenPoints:
    """The points in a camera's picture that no nearer point hides."""
    uv, z = camera.project(xyz)
    is_inside = camera.has_in_frame(uv, z)
    uv, z = uv[is_inside], z[is_inside]
    if not len(z):
        return SeenPoints(uv.float(), z.float())

    # The nearest depth in each square of the picture hides what is much farther.
    side = math.sqrt(camera.width * camera.height * POINTS_PER_SQUARE / len(z))
    column, row = (uv / side).floor().long().unbind(1)
    squares_across = int(camera.width / side) + 1
    square = row * squares_across + column
    square_count = int(square.max()) + 1
    nearest = torch.full((square_count,), torch.inf, dtype=z.dtype)
    nearest = nearest.scatter_reduce(0, square, z, "amin")
    is_seen = z <= HIDDEN_RATIO * nearest[square]
    return SeenPoints(uv[is_seen].float(), z[is_seen].float())
