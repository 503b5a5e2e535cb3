"""The views of a photo along a controlled camera path, and their completed targets (paper, appendix).

An inpainter paints the holes so that all views agree, or one completed scene fills the holes, or they stay black.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from spackle.bases import BasePrediction
from spackle.core.camera import Camera
from spackle.core.hole_filling import fill_from_far_side
from spackle.core.trajectories import (
    SHARP_TRAJECTORIES,
    DepthRange,
    SharpTrajectory,
    disparity_to_offset,
    trajectory_cameras,
)
from spackle.inpaint import INPAINTERS, Inpainter, known_inverse_depth
from spackle.pipeline import complete
from spackle.render import Renderer
from spackle.residual import hole_mask
from spackle.scene_fill.fill import farthest_first

SAME_VIEW_DISTANCE = (
    1e-3  # two views are the same if their cameras are closer than this times the maximum offset
)
MAX_EXTRA_FRAMES = 6  # the most extra frames of a path, tried because frames may coincide
SAME_SURFACE_TOLERANCE = 0.03  # relative difference below which two depths belong to one surface
MIN_INVERSE_DEPTH = 1e-6  # the smallest inverse depth to divide by
COMPLETIONS = (*INPAINTERS, "geometry", "none")  # values of --inpainter


def draw_random_path(
    kind: SharpTrajectory | None, disparity: tuple[float, float], seed: int, photo_sha256: str
) -> tuple[SharpTrajectory, float]:
    """Draw a photo's path and disparity at random, by seed and file content; `kind` fixes the kind of path."""
    rng = np.random.default_rng(list(hashlib.sha256(f"{seed}:{photo_sha256}".encode()).digest()))
    drawn = SHARP_TRAJECTORIES[rng.integers(len(SHARP_TRAJECTORIES))]
    return kind or drawn, float(rng.uniform(*disparity))


def cameras_along_path(
    kind: SharpTrajectory, disparity: float, camera: Camera, depth_range: DepthRange, views: int
) -> list[Camera]:
    """Choose `views` different cameras: first the photo's `camera` (of the views' size), then cameras along the path.

    A path may pass through the photo's camera position, and a closed path ends where it begins. So the path is sampled
    with extra frames, and repeated views are dropped. ValueError if the path is impossible, or the camera does not
    move.
    """

    def distance(one: Camera, other: Camera) -> float:
        return float((one.position.double() - other.position.double()).norm())

    cameras = [camera]
    least = SAME_VIEW_DISTANCE * disparity_to_offset(camera, disparity, depth_range)
    for frames in range(views - 1, views + MAX_EXTRA_FRAMES) if least > 0 else ():
        cameras = [camera]
        for view in trajectory_cameras(kind, camera, disparity, depth_range, frames):
            if all(distance(view, other) > least for other in cameras):
                cameras.append(view)
        if len(cameras) >= views:
            break
    if len(cameras) < views:
        raise ValueError(f"{kind} at a disparity of {disparity:g} has no {views} different views")
    while len(cameras) > views:  # drop the view nearest to the photo's
        del cameras[1 + int(np.argmin([distance(view, camera) for view in cameras[1:]]))]
    return cameras


@dataclasses.dataclass(frozen=True)
class ViewStack:
    """A photo's Gaussians, rendered from V cameras."""

    prediction: BasePrediction
    cameras: Sequence[Camera]  # the first camera is the photo's
    rgb: Tensor  # [V, H, W, 3] sRGB in 0..1, over black
    depth: Tensor  # [V, H, W] expected z; 0 where alpha is 0
    alpha: Tensor  # [V, H, W] opacity
    mask: Tensor  # [V, H, W] bool: uncovered (eq. 4)


@torch.no_grad()
def render_views(
    prediction: BasePrediction, cameras: Sequence[Camera], renderer: Renderer
) -> ViewStack:
    """Render the base from each camera."""
    drawn = [renderer.render(prediction.gaussians, camera).tensors for camera in cameras]
    rgb, depth, alpha = (torch.stack(images) for images in zip(*drawn, strict=True))
    return ViewStack(prediction, cameras, rgb, depth, alpha, hole_mask(alpha))


def complete_views(
    views: ViewStack, completion: str, inpainter: Inpainter | None, renderer: Renderer
) -> Tensor:
    """Targets [V, H, W, 3] sRGB: new colours in the holes; elsewhere the views, bit for bit.

    `completion` is one of `COMPLETIONS`; "none" returns the views unchanged.
    """
    if completion == "none":
        return views.rgb
    if inpainter is None:
        return torch.where(views.mask[..., None], render_completed(views, renderer)[0], views.rgb)
    return (
        paint_video(inpainter, views)
        if inpainter.paints_views_together
        else paint_view_by_view(inpainter, views, renderer)
    )


@torch.no_grad()
def render_completed(views: ViewStack, renderer: Renderer) -> tuple[Tensor, Tensor]:
    """Colours [V, H, W, 3] and inverse depth [V, H, W] of one scene completed by initial Gaussians, so that all views agree.

    Pixels that stay uncovered take the colour and depth of their neighbours.
    """
    prediction = views.prediction
    aux = complete(
        prediction, views.cameras, exact=True, network=None, fill="network", renderer=renderer
    ).aux
    colors, inverse_depths = views.rgb.clone(), known_inverse_depth(views.depth, views.mask)
    for index, camera in enumerate(views.cameras):
        if bool(views.mask[index].any()):
            drawn = renderer.render([prediction.gaussians, aux], camera)
            rgb, inverse_depth = drawn.rgb, known_inverse_depth(drawn.depth, hole_mask(drawn.alpha))
            if 0 < int(inverse_depth.count_nonzero()) < inverse_depth.numel():
                inverse_depth, mixed = fill_from_far_side(
                    inverse_depth, rgb.permute(2, 0, 1), inverse_depth > 0
                )
                rgb = mixed.permute(1, 2, 0)
            colors[index], inverse_depths[index] = rgb, inverse_depth
    return colors, inverse_depths


@torch.no_grad()
def paint_view_by_view(inpainter: Inpainter, views: ViewStack, renderer: Renderer) -> Tensor:
    """Paint the views' holes one view after the other, the farthest from the photo first, so that all views agree.

    Painted views are reprojected into the next view's holes, and the inpainter paints the rest. The depth in the holes
    comes from one completed scene.
    """
    inverse_depths, targets = render_completed(views, renderer)[1], views.rgb.clone()
    painted: list[int] = []
    for index in farthest_first(views.cameras, views.prediction.camera):
        camera, hole, target = views.cameras[index], views.mask[index].clone(), targets[index]
        for other in painted:
            row, column = hole.nonzero(as_tuple=True)
            pixels = camera.pixel_centers().to(target)[row, column]
            points = camera.unproject(
                pixels, 1 / inverse_depths[index][row, column].clamp_min(MIN_INVERSE_DEPTH)
            )
            colors, seen = look_up_points(
                points, views.cameras[other], targets[other], inverse_depths[other]
            )
            target[row[seen], column[seen]] = colors[seen]
            hole[row[seen], column[seen]] = False
        if bool(hole.any()):
            known = torch.where(hole, 0, inverse_depths[index])
            targets[index] = inpainter.paint(target[None], hole[None], known[None])[0]
        if bool(views.mask[index].any()):
            painted.append(index)
    return targets


def look_up_points(
    points: Tensor, camera: Camera, rgb: Tensor, inverse_depth: Tensor
) -> tuple[Tensor, Tensor]:
    """Colours [n, 3] of points [n, 3] in a view [H, W, 3] with inverse depth [H, W], and whether each is seen [n]."""
    uv, z = camera.project(points)
    place = 2 * uv / uv.new_tensor([camera.width, camera.height]) - 1
    images = torch.cat([rgb, inverse_depth[..., None]], -1).permute(2, 0, 1)
    values = grid_sample(
        images[None], place[None, None], align_corners=False, padding_mode="border"
    )[0, :, 0].T
    same = (values[:, 3] * z - 1).abs() < SAME_SURFACE_TOLERANCE
    return values[:, :3], same & (z > 0) & (place.abs() <= 1).all(-1)


def paint_video(inpainter: Inpainter, views: ViewStack) -> Tensor:
    """Paint the views' holes as one video, whose frames are ordered along the path.

    The photo's view is inserted at the position that lengthens the path least.
    """
    eyes = torch.stack([camera.position.double() for camera in views.cameras])
    others = list(range(1, len(eyes)))
    orders = [[*others[:place], 0, *others[place:]] for place in range(len(eyes))]
    order = min(orders, key=lambda order: float(eyes[order].diff(dim=0).norm(dim=-1).sum()))
    inverse_depth = known_inverse_depth(views.depth, views.mask)
    targets = torch.empty_like(views.rgb)
    targets[order] = inpainter.paint(views.rgb[order], views.mask[order], inverse_depth[order])
    return targets
