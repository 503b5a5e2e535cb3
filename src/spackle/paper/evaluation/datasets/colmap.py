"""Read COLMAP models, text or binary: cameras, points, and the points that each photo sees.

A model is a sparse reconstruction in three files: cameras (lenses), images (a pose for each
photo, and where the photo sees points) and points3D. `read_model` reads all three, by the readers
of `formats/colmap.py`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from spackle.core.camera import Camera
from spackle.formats.camera_files import checked_camera
from spackle.formats.colmap import (
    DAMAGED,
    ImageRecord,
    Lens,
    images_path,
    pose_of_image,
    read_images,
    read_lenses,
    read_points,
)
from spackle.paper.evaluation.case import Points
from spackle.runtime.errors import InputError, as_input_error

Array = NDArray[Any]

# The greatest accepted distortion at a photo's corner, as a fraction of the long side. Smaller
# distortion is ignored, because photos from close viewpoints are distorted alike.
MAX_DISTORTION_RATIO = 0.02


@dataclasses.dataclass(frozen=True)
class ColmapView:
    """A photo of a model."""

    name: str  # the name in the model, with folders
    camera: Camera  # in the model's world, float64; pixel centres at half-integers, as in COLMAP
    uv: Array  # [n, 2] pixel positions of points
    point_ids: Array  # [n] ids of these points, ascending


@dataclasses.dataclass(frozen=True)
class Model:
    """A sparse reconstruction of a scene."""

    views: tuple[ColmapView, ...]  # sorted by name
    point_ids: Array  # [m] ids of the reliable points, ascending
    xyz: Array  # [m, 3] positions in the world

    def points(self, view: ColmapView) -> Points:
        """The reliable points in front of a view that the view sees, with their depth."""
        # Where the ids that both have stand in the view's list of points, and in the model's.
        _, view_indices, model_indices = np.intersect1d(
            view.point_ids, self.point_ids, assume_unique=True, return_indices=True
        )
        positions = torch.from_numpy(self.xyz[model_indices])  # [n, 3]
        z = view.camera.to_camera(positions)[:, 2]
        uv = torch.from_numpy(view.uv[view_indices])

        is_in_front = z > 0
        return Points(uv.float()[is_in_front], z.float()[is_in_front])


def read_model(folder: Path) -> Model:
    """Read a model's cameras, images and points.

    Files are binary if there is a cameras.bin, else text.

    Raises:
        InputError: a file is missing or damaged, or a lens differs too much from a pinhole.
    """
    point_ids, xyz = read_points(folder)

    # Each file has its own block, so that a message names the damaged file.
    lenses = read_lenses(folder)
    for lens in lenses.values():
        _check_distortion(folder, lens)
    with as_input_error(images_path(folder), DAMAGED):
        views = [
            _view_of_record(images_path(folder), lenses[record.camera_key].camera, record)
            for record in read_images(folder)
        ]

    views.sort(key=lambda view: view.name)
    return Model(tuple(views), point_ids, xyz)


def _check_distortion(folder: Path, lens: Lens) -> None:
    """Raise an InputError if a lens distorts the corners of photos too much.

    Args:
        folder: of the model, for messages.
        lens: the lens.
    """
    # Distortion grows outwards, so the corner that is farthest from the principal point decides.
    # Divided by the focal lengths, its distance is in the units of the distortion's formulas.
    fx, fy = lens.camera.focal
    cx, cy = lens.camera.K[:2, 2].tolist()
    corner_x = max(cx, lens.camera.width - cx) / fx
    corner_y = max(cy, lens.camera.height - cy) / fy
    squared_radius = corner_x**2 + corner_y**2
    shift = _max_distortion_shift(lens.distortion, squared_radius)
    max_shift_px = MAX_DISTORTION_RATIO * max(lens.camera.width, lens.camera.height)
    is_small = shift * max(fx, fy) <= max_shift_px  # false for NaN
    if not is_small:
        cameras_path = folder / f"cameras{images_path(folder).suffix}"
        raise InputError(
            f"{cameras_path}: the camera distorts the corners of photos: undistort the photos first"
        )


def _max_distortion_shift(distortion: Sequence[float], squared_radius: float) -> float:
    """How far a lens may shift a point at most, at focal length 1.

    Radial distortion shifts a point at the radius r by k1 r³ + k2 r⁵ + k3 r⁷; a divisor of
    1 + k4 r² + k5 r⁴ + k6 r⁶ shifts it by as much again, to first order. Tangential distortion
    shifts it by at most 3 (|p1| + |p2|) r².

    Args:
        distortion: k1, k2, p1, p2, k3, k4, k5, k6. The list may end earlier; the numbers that are
            missing are 0.
        squared_radius: r², the point's squared distance from the optical axis.
    """
    numbers = [*distortion, *[0.0] * (8 - len(distortion))]
    k1, k2, p1, p2, *further = numbers
    tangential = [p1, p2]
    numerator = [k1, k2, further[0]]
    divisor = further[1:]
    shift = 0.0
    for radial in (numerator, divisor):
        for order, k in enumerate(radial):
            # (r²)^1.5 is r³, (r²)^2.5 is r⁵, and (r²)^3.5 is r⁷.
            shift += abs(k) * squared_radius ** (order + 1.5)
    return shift + 3 * sum(abs(p) for p in tangential) * squared_radius


def _view_of_record(path: Path, lens: Camera, record: ImageRecord) -> ColmapView:
    """The view of a record: its camera, and the points that it sees, each once.

    Args:
        path: the file, for messages.
        lens: the camera at the world's origin.
        record: the photo.

    Raises:
        InputError: the pose is no rotation and translation.
    """
    world_to_camera = pose_of_image(record, str(path))
    where = f"{path}: the pose of {record.name}"
    camera = checked_camera(
        lens.K, world_to_camera, lens.width, lens.height, where, dtype=torch.float64
    )

    # A feature of the photo that belongs to no point has the id -1.
    observations = record.observations[record.observations["id"] >= 0]
    # A photo may see a point twice; the first observation is kept.
    _, first_indices = np.unique(observations["id"], return_index=True)
    observations = observations[first_indices]
    return ColmapView(record.name, camera, observations["uv"].copy(), observations["id"].copy())
