"""A photo and its depth map, lifted: one surface-aligned Gaussian for each pixel, and a coarse backing."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from spackle.bases.cleanup import (
    attach_flying_pixels,
    attach_mixed_pixels,
    fill_missing,
    smooth_noise,
    undo_quantisation,
)
from spackle.bases.depth_map import DepthMap
from spackle.bases.edges import find_edges, sample, settle
from spackle.bases.protocol import BasePrediction, Progress
from spackle.bases.sky import push_sky
from spackle.camera import Camera
from spackle.color import srgb_to_linear
from spackle.errors import InputError
from spackle.gaussians import Gaussians
from spackle.image import Photo, resize_photo
from spackle.surface import surface_gaussians, surface_slope

# Not higher: a blob that would bring the transmittance below the renderer's stop (1e-4) is not drawn at all, so
# behind a thin veil of alpha 0.9 one of opacity 0.999 would leave a hole that nothing can fill.
OPACITY = 0.99
# Blobs of half a pixel reproduce the photo sharply, but light passes between them. Blobs wide enough to
# close the surface would blur it. So a coarse backing, one blob for 2×2 pixels, closes it from behind:
# 2 dB sharper at the photo's camera than one layer of wider blobs.
FRONT_SPREAD_PX = 0.5
BACKING_SPREAD_PX = 1.1
BACKING_GAP = 0.005  # the backing's distance behind the front, relative
BACKING_SLOPE_GAP = 4.0  # and this many pixels further along a slanted surface, so that none pokes through
MAX_BACKING_GAP = 0.2


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


def lift(rgb: Tensor, depth: DepthMap, camera: Camera) -> BasePrediction:
    """A photo and its depth to Gaussians, first one for each pixel in row-major order, then the backing.

    Args:
        rgb: [H, W, 3] sRGB in 0..1.
        depth: any size of the same aspect ratio.
        camera: the photo's, at the world's origin.

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
    inverse_depth = attach_mixed_pixels(attach_flying_pixels(inverse_depth), rgb)
    slope = surface_slope(inverse_depth)
    colors = srgb_to_linear(rgb)
    uv, flat = camera.pixel_centers().reshape(-1, 2), inverse_depth.reshape(-1)
    opacities = torch.full((len(uv),), OPACITY)
    front = surface_gaussians(camera, uv, flat, slope.reshape(-1, 2), FRONT_SPREAD_PX, colors.reshape(-1, 3), opacities)
    gaussians = Gaussians.cat([front, _backing(colors, inverse_depth, slope, camera)])
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


def _backing(colors: Tensor, inverse_depth: Tensor, slope: Tensor, camera: Camera) -> Gaussians:
    """One wide Gaussian for each 2×2 pixels, behind the farthest of them and in its surface."""
    cells = _cells(inverse_depth)
    if not cells.numel():  # one pixel high or wide
        return Gaussians.empty()
    far, pick = cells.min(dim=-1)
    slope = _cells(slope).gather(2, pick[..., None, None].expand(*pick.shape, 1, 2)).squeeze(2)
    # The cell's centre lies half a pixel from the farthest pixel's.
    offset = torch.stack([0.5 - pick % 2, 0.5 - pick // 2], dim=-1)
    at_center = (far + (slope * offset).sum(-1)).clamp_min(0.5 * far.min())
    gap = BACKING_GAP + BACKING_SLOPE_GAP * slope.abs().sum(-1) / at_center
    recede = 1.0 - gap.clamp_max(MAX_BACKING_GAP)
    # Its colour is the mean of the pixels on that surface.
    same = (cells - far[..., None] < 0.02 * far[..., None]).to(colors)
    mean = (_cells(colors) * same[..., None]).sum(2) / same.sum(2)[..., None]
    return surface_gaussians(
        camera,
        camera.pixel_centers(stride=2).reshape(-1, 2),
        (at_center * recede).reshape(-1),
        (slope * recede[..., None]).reshape(-1, 2),
        BACKING_SPREAD_PX,
        mean.reshape(-1, 3),
        torch.full((far.numel(),), OPACITY),
    )


def _cells(image: Tensor) -> Tensor:
    """[H, W, ...] to [H/2, W/2, 4, ...]: the pixels of each 2×2 cell in row-major order."""
    height, width = (n // 2 for n in image.shape[:2])
    grid = image[: 2 * height, : 2 * width].reshape(height, 2, width, 2, *image.shape[2:])
    return grid.transpose(1, 2).flatten(2, 3)
