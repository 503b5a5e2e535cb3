"""The views of a photo along a controlled camera path, and their completed targets (paper, appendix).

Targets are drawn from one completed scene, left open, or painted by an inpainter.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from spackle.bases import BasePrediction
from spackle.camera import Camera
from spackle.camera_path import TRAJECTORIES, DepthRange, TrajectoryKind, max_offset, trajectory
from spackle.filters import far_fill
from spackle.inpaint import INPAINTERS, Inpainter, known_inverse_depth
from spackle.pipeline import complete
from spackle.render import Renderer
from spackle.render.protocol import Rendering
from spackle.residual import hole_mask

APART = 1e-3  # eyes nearer than this to each other, in units of the path's width, show the same
SPARE = 6  # frames of a path that may coincide with others
COMPLETIONS = ("geometry", *INPAINTERS, "none")  # values of --inpainter


def draw_path(
    kind: TrajectoryKind | None, disparity: tuple[float, float], seed: int, photo_sha256: str
) -> tuple[TrajectoryKind, float]:
    """A photo's path and its disparity, drawn by seed and file alone; `kind` is kept where it is given."""
    rng = np.random.default_rng(list(hashlib.sha256(f"{seed}:{photo_sha256}".encode()).digest()))
    drawn = TRAJECTORIES[rng.integers(len(TRAJECTORIES))]
    return kind or drawn, float(rng.uniform(*disparity))


def path_cameras(
    kind: TrajectoryKind, disparity: float, camera: Camera, depth_range: DepthRange, views: int
) -> list[Camera]:
    """The photo's own view (`camera`, of the views' size), then others along the path: `views` in all, no two alike.

    Frames at the photo's eye and at the end of a closed path repeat others, so the path gets more frames instead.
    ValueError for a path that cannot be, or on which the camera does not move.
    """

    def distance(one: Camera, other: Camera) -> float:
        return float((one.position.double() - other.position.double()).norm())

    cameras = [camera]
    least = APART * max_offset(camera, disparity, depth_range)
    for frames in range(views - 1, views + SPARE) if least > 0 else ():
        cameras = [camera]
        for view in trajectory(kind, camera, disparity, depth_range, frames):
            if all(distance(view, other) > least for other in cameras):
                cameras.append(view)
        if len(cameras) >= views:
            break
    if len(cameras) < views:
        raise ValueError(f"{kind} at a disparity of {disparity:g} has no {views} different views")
    while len(cameras) > views:  # without the one nearest to the photo's
        del cameras[1 + int(np.argmin([distance(view, camera) for view in cameras[1:]]))]
    return cameras


@dataclasses.dataclass(frozen=True)
class ViewStack:
    """A photo's Gaussians, rendered from V cameras."""

    prediction: BasePrediction
    cameras: Sequence[Camera]  # the first one is the photo's
    rgb: Tensor  # [V, H, W, 3] sRGB in 0..1, over black
    depth: Tensor  # [V, H, W] expected z; 0 where alpha is 0
    alpha: Tensor  # [V, H, W] opacity
    mask: Tensor  # [V, H, W] bool: uncovered (eq. 4)


@torch.no_grad()
def render_views(prediction: BasePrediction, cameras: Sequence[Camera], renderer: Renderer) -> ViewStack:
    """Render the base from each camera."""
    drawn = [renderer.render(prediction.gaussians, camera).tensors for camera in cameras]
    rgb, depth, alpha = (torch.stack(images) for images in zip(*drawn, strict=True))
    return ViewStack(prediction, cameras, rgb, depth, alpha, hole_mask(alpha))


def complete_views(views: ViewStack, completion: str, inpainter: Inpainter | None, renderer: Renderer) -> Tensor:
    """Targets [V, H, W, 3] sRGB: new colours in the holes, elsewhere the views bit for bit.

    `completion` is one of `COMPLETIONS`; "none" leaves the holes to somebody else.
    """
    if inpainter is not None:
        return paint(inpainter, views)
    return views.rgb if completion == "none" else render_completed(views, renderer)


@torch.no_grad()
def render_completed(views: ViewStack, renderer: Renderer) -> Tensor:
    """Each hole as one completed scene shows it, filled by seeds alone in the widest view: the same in all views."""
    prediction = views.prediction
    aux = complete(prediction, views.cameras, exact=True, network=None, fill="network", renderer=renderer).aux
    targets = []
    for camera, target, hole in zip(views.cameras, views.rgb, views.mask, strict=True):
        if bool(hole.any()):
            colors = _covered(renderer.render([prediction.gaussians, aux], camera))
            target = torch.where(hole[..., None], colors, target)
        targets.append(target)
    return torch.stack(targets)


def _covered(drawn: Rendering) -> Tensor:
    """The colours [H, W, 3] of a view; the few pixels that are still uncovered get those of pixels around."""
    hole = hole_mask(drawn.alpha)
    inverse_depth = known_inverse_depth(drawn.depth, hole)
    known = inverse_depth > 0
    if not bool(hole.any()) or not bool(known.any()):
        return drawn.rgb
    return far_fill(inverse_depth, drawn.rgb.permute(2, 0, 1), known)[1].permute(1, 2, 0)


def paint(inpainter: Inpainter, views: ViewStack) -> Tensor:
    """The views with their holes painted, given as a flight along the path meets them.

    The first view, the photo's, stands where the detour is least.
    """
    eyes = torch.stack([camera.position.double() for camera in views.cameras])
    others = list(range(1, len(eyes)))
    orders = [[*others[:place], 0, *others[place:]] for place in range(len(eyes))]
    order = min(orders, key=lambda order: float(eyes[order].diff(dim=0).norm(dim=-1).sum()))
    inverse_depth = known_inverse_depth(views.depth, views.mask)
    targets = torch.empty_like(views.rgb)
    targets[order] = inpainter.paint(views.rgb[order], views.mask[order], inverse_depth[order])
    return targets
