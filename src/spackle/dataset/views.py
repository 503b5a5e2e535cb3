"""The views that a dataset has of a photo: a controlled camera path, drawn with the base (paper, appendix)."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from spackle.camera import Camera
from spackle.camera_path import TRAJECTORIES, DepthRange, TrajectoryKind, max_offset, trajectory
from spackle.gaussians import Gaussians
from spackle.render import Renderer
from spackle.residual import MASK_THRESHOLD, hole_mask

VIEWS = 20  # the paper's, the photo's own view among them
DISPARITY = (0.1, 0.6)  # from a small move to the widest in the paper's figures
APART = 1e-3  # eyes nearer than this to each other, in units of the path's width, show the same
SPARE = 6  # frames of a path that may coincide with others


@dataclasses.dataclass(frozen=True)
class ViewChoices:
    """What decides which views a photo gets."""

    seed: int = 0
    views: int = VIEWS  # of a photo, its own among them
    trajectory: TrajectoryKind | None = None  # drawn for each photo where None
    disparity: tuple[float, float] = DISPARITY  # drawn between these, see `spackle.camera_path.max_offset`
    threshold: float = MASK_THRESHOLD


@dataclasses.dataclass(frozen=True)
class PathChoice:
    """Where the camera goes."""

    kind: TrajectoryKind
    disparity: float


def draw_path(choices: ViewChoices, photo_sha256: str) -> PathChoice:
    """The path of a photo: the same for the same seed and the same photo's file, whatever else the dataset holds."""
    digest = hashlib.sha256(f"{choices.seed}:{photo_sha256}".encode()).digest()
    rng = np.random.default_rng(list(digest))
    drawn = TRAJECTORIES[rng.integers(len(TRAJECTORIES))]
    return PathChoice(choices.trajectory or drawn, float(rng.uniform(*choices.disparity)))


def path_cameras(path: PathChoice, camera: Camera, depth_range: DepthRange, views: int = VIEWS) -> list[Camera]:
    """The photo's own view (`camera`, of the views' size), then others along the path: `views` in all, no two alike.

    Frames at the photo's eye and at the end of a closed path repeat others, so the path gets more frames instead.
    ValueError for a path that cannot be, or on which the camera does not move.
    """
    cameras = [camera]
    least = APART * max_offset(camera, path.disparity, depth_range)
    for frames in range(views - 1, views + SPARE) if least > 0 else ():
        cameras = [camera]
        for view in trajectory(path.kind, camera, path.disparity, depth_range, frames):
            if all(_distance(view, other) > least for other in cameras):
                cameras.append(view)
        if len(cameras) >= views:
            break
    if len(cameras) < views:
        raise ValueError(f"{path.kind} at a disparity of {path.disparity:g} has no {views} different views")
    while len(cameras) > views:  # the least interesting one
        del cameras[1 + int(np.argmin([_distance(view, camera) for view in cameras[1:]]))]
    return cameras


def _distance(one: Camera, other: Camera) -> float:
    return float((one.position.double() - other.position.double()).norm())


@dataclasses.dataclass(frozen=True)
class ViewStack:
    """A photo's Gaussians and what V cameras see of them."""

    base: Gaussians
    photo_camera: Camera
    cameras: Sequence[Camera]  # the first one is the photo's
    rgb: Tensor  # [V, H, W, 3] sRGB in 0..1, over black
    depth: Tensor  # [V, H, W] expected z; 0 where alpha is 0
    alpha: Tensor  # [V, H, W] opacity
    mask: Tensor  # [V, H, W] bool: uncovered


@torch.no_grad()
def render_views(
    base: Gaussians,
    photo_camera: Camera,
    cameras: Sequence[Camera],
    renderer: Renderer,
    threshold: float = MASK_THRESHOLD,
) -> ViewStack:
    """Draw the base from each camera; a pixel with less opacity than `threshold` is uncovered (eq. 4)."""
    drawn = [renderer.render(base, camera) for camera in cameras]
    rgb, depth, alpha = (torch.stack([getattr(view, name) for view in drawn]) for name in ("rgb", "depth", "alpha"))
    return ViewStack(base, photo_camera, tuple(cameras), rgb, depth, alpha, hole_mask(alpha, threshold))
