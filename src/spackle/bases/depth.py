"""Bases that lift a photo by a depth map: the map that comes with the photo, or one that a network predicted."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from spackle.bases import BasePrediction
from spackle.core.camera import Camera
from spackle.core.photo import Photo, replace_border, resize_photo
from spackle.depth.depth_map import DepthMap
from spackle.lifting.lift import lift_depth_map
from spackle.lifting.quadtree import LEVELS
from spackle.runtime.progress import Progress


class RgbdBase:
    """Lifts a photo with the photo's depth map."""

    name = "rgbd"

    def __init__(self, depth: DepthMap, lens_source: str = "calibration") -> None:
        self.depth = depth
        self.lens_source = lens_source  # source of the map's intrinsics; "" if the user gave them

    def predict(self, photo: Photo, progress: Progress | None = None) -> BasePrediction:
        """Gaussians of the photo's pixels at its working size; InputError for a map of another aspect ratio."""
        depth, (width, height) = self.depth, photo.framed_size
        depth.check_aspect_ratio(height, width, photo.path)
        own = None if depth.K is None else Camera(depth.K, torch.eye(4), *depth.depth.shape[::-1])
        if photo.frame is not None:
            frame = photo.frame
            values, valid = (
                frame.inside(grid, width, height) for grid in (depth.depth, depth.valid)
            )
            depth = dataclasses.replace(depth, depth=values, valid=valid)
            own = own and own.resized(width, height).cropped(
                frame.left, frame.top, photo.width, photo.height
            )
        photo = resize_photo(photo)
        camera = photo.camera if own is None else own.resized(photo.width, photo.height)
        prediction = lift_rgbd(photo.rgb, depth, camera)
        notes = (
            prediction.notes
            | {"depth_range": self.depth.range_in_words}
            | ({"depth": depth.note} if depth.note else {})
        )
        lens_source = "" if own is None else self.lens_source
        return dataclasses.replace(prediction, notes=notes, lens_source=lens_source)


def lift_predicted_depth(photo: Photo, depth: DepthMap, camera: Camera) -> BasePrediction:
    """Lift a photo with the depth that a network predicts; the photo's outermost lines are replaced first."""
    return lift_rgbd(replace_border(photo.rgb), depth, camera)


def lift_rgbd(rgb: Tensor, depth: DepthMap, camera: Camera, levels: int = LEVELS) -> BasePrediction:
    """Lift a photo [H, W, 3] and its depth map to Gaussians; see `lift_depth_map` for the arguments."""
    lifted = lift_depth_map(rgb, depth, camera, levels)
    return BasePrediction(lifted.gaussians, lifted.camera, lifted.notes)
