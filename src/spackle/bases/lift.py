"""A photo and its depth map, lifted: from the map as measured to surface-aligned Gaussians."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from spackle.bases.cleanup import attach_flying_pixels, fill_missing, push_sky, smooth_noise, undo_quantisation
from spackle.bases.depth_map import DepthMap
from spackle.bases.edges import find_edges, sample, settle
from spackle.bases.protocol import BasePrediction, Progress
from spackle.bases.quadtree import LEVELS
from spackle.bases.splats import layered_gaussians
from spackle.camera import Camera
from spackle.color import srgb_to_linear
from spackle.errors import InputError
from spackle.image import Photo, resize_photo


class RgbdBase:
    """Lifts a photo by a depth map that came with it."""

    name = "rgbd"

    def __init__(self, depth: DepthMap, lens_source: str = "calibration") -> None:
        self.depth = depth
        self.lens_source = lens_source  # of the map's intrinsics; "" if they are the user's

    def predict(self, photo: Photo, progress: Progress | None = None) -> BasePrediction:
        """Gaussians of the photo's pixels at its working size; InputError for a map of another aspect ratio."""
        depth, (width, height) = self.depth, photo.framed_size
        depth.check_shape(height, width, photo.path)
        own = None if depth.K is None else Camera(depth.K, torch.eye(4), *depth.depth.shape[::-1])
        if photo.frame is not None:
            frame = photo.frame
            values, valid = (frame.inside(grid, width, height) for grid in (depth.depth, depth.valid))
            depth = dataclasses.replace(depth, depth=values, valid=valid)
            own = own and own.resized(width, height).cropped(frame.left, frame.top, photo.width, photo.height)
        photo = resize_photo(photo)
        camera = photo.camera if own is None else own.resized(photo.width, photo.height)
        prediction = lift(photo.rgb, depth, camera)
        notes = prediction.notes | ({"depth": depth.note} if depth.note else {})
        return dataclasses.replace(prediction, notes=notes, lens_source="" if own is None else self.lens_source)


def lift(rgb: Tensor, depth: DepthMap, camera: Camera, levels: int = LEVELS) -> BasePrediction:
    """A photo and its depth to Gaussians, see `layered_gaussians`.

    Args:
        rgb: [H, W, 3] sRGB in 0..1.
        depth: any size of the same aspect ratio.
        camera: the photo's, at the world's origin.
        levels: of tiles that share a Gaussian; 0 for one a pixel.

    Raises:
        InputError: not one pixel has a depth.
    """
    rgb = rgb.detach().float()
    values = depth.depth.detach().float()
    valid = depth.valid & torch.isfinite(values) & (values > 0)
    sound = dataclasses.replace(depth, depth=values.where(valid, 0.0), valid=valid)
    inverse_depth, known = _inverse_depth(sound, rgb, camera)
    inverse_depth, known, sky = push_sky(inverse_depth, rgb, known)
    missing = 1.0 - float(known.float().mean())
    if not known.any():
        raise InputError(f"{depth.path}: no depth is left at {camera.width}×{camera.height}: give a denser map")
    inverse_depth = fill_missing(inverse_depth, rgb, known)
    inverse_depth = attach_flying_pixels(inverse_depth)
    gaussians = layered_gaussians(inverse_depth, srgb_to_linear(rgb), camera, levels)
    notes: dict[str, float | int | str] = {"depth_filled": round(missing, 4)}
    if sky:
        notes["sky"] = round(sky, 4)
    if depth.depth.shape != inverse_depth.shape:
        notes["depth_resampled_from"] = f"{depth.depth.shape[1]}×{depth.depth.shape[0]}"
    return BasePrediction(gaussians, camera, notes)


def _inverse_depth(depth: DepthMap, rgb: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Inverse depth on the photo's grid and where it is known, [H, W] each; a clean map of that size stays as it is."""
    inverse = torch.where(depth.valid, 1.0 / depth.depth, torch.zeros_like(depth.depth))
    if depth.quantity == "disparity" and depth.quantum is not None:
        inverse = undo_quantisation(inverse, depth.valid, depth.quantum)
    known = depth.valid.contiguous().numpy()
    smooth = smooth_noise(inverse.contiguous().numpy(), known)
    rows, columns = known.shape
    fx, fy = camera.focal
    edges = find_edges(smooth, known, (fx * columns / camera.width, fy * rows / camera.height))
    sampled = sample(smooth, known, edges, camera.height, camera.width)
    settled, found = settle(sampled, rgb.contiguous().numpy())
    return torch.from_numpy(settled), torch.from_numpy(found)
