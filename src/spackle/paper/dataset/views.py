"""The views of a photo along a camera path, and their completed targets (paper, appendix).

`draw_random_path` and `cameras_along_path` choose the cameras, `render_views` renders the photo's
Gaussians, and `complete_views` fills the holes: what the photo does not show. An inpainter paints
the holes so that all views agree, or one completed scene fills the holes, or they stay black.
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
from spackle.scene_fill.fill import farthest_first, view_differences

# Two views are the same if their cameras are closer than this times the path's greatest offset.
SAME_VIEW_DISTANCE = 1e-3
MAX_EXTRA_FRAMES = 8  # of a path, tried because frames may coincide; `shake` needs 8 for 10 views
SAME_SURFACE_TOLERANCE = 0.03  # two depths with less relative difference belong to one surface
MIN_INVERSE_DEPTH = 1e-6  # the smallest inverse depth to divide by
# How holes may be completed, the values of the option `inpainter`: painted by an inpainter, filled
# from one completed scene ("geometry"), or left black ("none").
COMPLETIONS = (*INPAINTERS, "geometry", "none")


def draw_random_path(
    kind: SharpTrajectory | None,
    disparity_range: tuple[float, float],
    seed: int,
    photo_sha256: str,
) -> tuple[SharpTrajectory, float]:
    """Draw the path of a photo's views at random; returns its kind, and how far the camera moves.

    The draw depends on `seed` and the photo's content alone, not on its name or on other photos.

    Args:
        kind: fixes the kind of path; None: one of SHARP's paths at random.
        disparity_range: least and greatest disparity, which says how far the camera moves.
        seed: another seed gives another path.
        photo_sha256: digest of the photo's file.
    """
    digest = hashlib.sha256(f"{seed}:{photo_sha256}".encode()).digest()
    rng = np.random.default_rng(list(digest))  # the digest's 32 bytes are the seed
    # Drawn also if the kind is fixed, so that the disparity is the same in both cases.
    random_kind = SHARP_TRAJECTORIES[rng.integers(len(SHARP_TRAJECTORIES))]
    disparity = float(rng.uniform(*disparity_range))
    return kind or random_kind, disparity


def cameras_along_path(
    kind: SharpTrajectory,
    disparity: float,
    camera: Camera,
    depth_range: DepthRange,
    view_count: int,
) -> list[Camera]:
    """Choose different cameras for a photo's views: first the photo's, then cameras along a path.

    Some cameras of a path may coincide: the path may pass through the photo's camera, and a closed
    path ends where it begins. Repeated cameras are dropped, and replaced by more frames of the
    path.

    Args:
        kind: the kind of path, such as "swipe".
        disparity: how far the camera moves; 0.3 is large.
        camera: the photo's camera, of the views' size.
        depth_range: near and far depth of the scene, to which the movement is relative.
        view_count: number of cameras.

    Raises:
        ValueError: the path is impossible, or the camera does not move.
    """
    cameras = [camera]
    min_distance = SAME_VIEW_DISTANCE * disparity_to_offset(camera, disparity, depth_range)
    if min_distance > 0:
        for frame_count in range(view_count - 1, view_count + MAX_EXTRA_FRAMES):
            path = trajectory_cameras(kind, camera, disparity, depth_range, frame_count)
            cameras = different_cameras([camera, *path], min_distance)
            if len(cameras) >= view_count:
                break
    if len(cameras) < view_count:
        raise ValueError(
            f"{kind} at a disparity of {disparity:g} has no {view_count} different views"
        )

    # Of too many views, those nearest to the photo's show the smallest holes.
    while len(cameras) > view_count:
        distances = [eye_distance(other, camera) for other in cameras[1:]]
        del cameras[1 + int(np.argmin(distances))]
    return cameras


def different_cameras(cameras: Sequence[Camera], min_distance: float) -> list[Camera]:
    """The cameras without those that are closer than `min_distance` to an earlier one."""
    different: list[Camera] = []
    for camera in cameras:
        if all(eye_distance(camera, other) > min_distance for other in different):
            different.append(camera)
    return different


def eye_distance(one: Camera, other: Camera) -> float:
    """The distance between the positions of two cameras."""
    return float((one.position.double() - other.position.double()).norm())


@dataclasses.dataclass(frozen=True)
class ViewStack:
    """A photo's Gaussians, rendered from V cameras."""

    prediction: BasePrediction  # the Gaussians, and the photo's camera
    cameras: Sequence[Camera]  # the first camera is the photo's
    rgb: Tensor  # [V, H, W, 3] sRGB in 0..1, over black
    depth: Tensor  # [V, H, W] expected z; 0 where alpha is 0
    alpha: Tensor  # [V, H, W] opacity
    mask: Tensor  # [V, H, W] bool: uncovered (eq. 4)


@torch.no_grad()
def render_views(
    prediction: BasePrediction, cameras: Sequence[Camera], renderer: Renderer
) -> ViewStack:
    """Render a photo's Gaussians from each camera; the first camera is the photo's.

    The mask of a view marks the pixels that the Gaussians leave uncovered (eq. 4 of the paper).
    """
    renderings = [renderer.render(prediction.gaussians, camera) for camera in cameras]
    rgb = torch.stack([rendering.rgb for rendering in renderings])
    depth = torch.stack([rendering.depth for rendering in renderings])
    alpha = torch.stack([rendering.alpha for rendering in renderings])
    return ViewStack(prediction, cameras, rgb, depth, alpha, hole_mask(alpha))


def complete_views(
    views: ViewStack, completion: str, inpainter: Inpainter | None, renderer: Renderer
) -> Tensor:
    """The targets of views, [V, H, W, 3] sRGB: new colours in the holes, elsewhere the views.

    Args:
        views: the rendered views. Outside of the holes the targets have the same bits.
        completion: how holes are completed, one of `COMPLETIONS`; "none" leaves them black.
        inpainter: paints the holes; None if `completion` is "none" or "geometry".
        renderer: renders a scene whose holes were filled without an inpainter. Its colours are the
            targets of "geometry"; its depth tells inpainters of single pictures which places of two
            views show the same point.
    """
    if completion == "none":
        return views.rgb
    if inpainter is None:  # "geometry"
        completed, _ = render_completed(views, renderer)
        return torch.where(views.mask[..., None], completed, views.rgb)
    if inpainter.paints_views_together:
        return paint_video(inpainter, views)
    return paint_view_by_view(inpainter, views, renderer)


@torch.no_grad()
def render_completed(views: ViewStack, renderer: Renderer) -> tuple[Tensor, Tensor]:
    """Render one completed scene in all views, so that the views agree.

    The scene is completed without a network: Gaussians in the holes continue what surrounds them.
    Pixels that stay uncovered take the colour and depth of their neighbours.

    Returns:
        Colours [V, H, W, 3] sRGB and inverse depth [V, H, W]. Views without holes stay as they are.
    """
    prediction = views.prediction
    completed_scene = complete(
        prediction,
        views.cameras,
        exact=True,  # only these views will be rendered, and no views between them
        network=None,  # no network changes the first guess of the Gaussians in the holes
        fill="network",  # the name for "add no texture to the colours of these Gaussians"
        renderer=renderer,
    )
    added = completed_scene.aux  # the Gaussians in the holes
    colors = views.rgb.clone()
    inverse_depths = known_inverse_depth(views.depth, views.mask)
    for index, camera in enumerate(views.cameras):
        if not bool(views.mask[index].any()):
            continue
        rendering = renderer.render([prediction.gaussians, added], camera)
        rgb = rendering.rgb
        inverse_depth = known_inverse_depth(rendering.depth, hole_mask(rendering.alpha))

        # Pixels can be filled only from known ones, and only if some are missing.
        known_count = int(inverse_depth.count_nonzero())
        if 0 < known_count < inverse_depth.numel():
            inverse_depth, filled_rgb = fill_from_far_side(
                inverse_depth, rgb.permute(2, 0, 1), inverse_depth > 0
            )
            rgb = filled_rgb.permute(1, 2, 0)
        colors[index] = rgb
        inverse_depths[index] = inverse_depth
    return colors, inverse_depths


@torch.no_grad()
def paint_view_by_view(inpainter: Inpainter, views: ViewStack, renderer: Renderer) -> Tensor:
    """Paint the views' holes with an inpainter of single pictures, so that all views agree.

    The view farthest from the photo comes first, because it has the largest holes. What a painted
    view shows is copied into the same places of the next views' holes; the inpainter paints only
    the rest. Where these places are follows from the depth of a scene that is completed first.

    Returns:
        The completed views [V, H, W, 3] sRGB.
    """
    _, inverse_depths = render_completed(views, renderer)
    targets = views.rgb.clone()
    painted: list[int] = []  # views whose holes are filled
    photo_camera = views.prediction.camera
    near_depth = DepthRange.of(views.prediction.gaussians).near
    differences = view_differences([*views.cameras, photo_camera], photo_camera, near_depth)
    for index in farthest_first(differences):
        camera = views.cameras[index]
        target = targets[index]
        hole = views.mask[index].clone()

        # What an earlier view shows at a hole's points is copied. `target` shares the memory of
        # `targets`, so that the copied colours are in both.
        for other in painted:
            row, column = hole.nonzero(as_tuple=True)
            pixels = camera.pixel_centers().to(target)[row, column]
            depth = 1 / inverse_depths[index][row, column].clamp_min(MIN_INVERSE_DEPTH)
            points = camera.unproject(pixels, depth)
            colors, is_seen = look_up_points(
                points, views.cameras[other], targets[other], inverse_depths[other]
            )
            target[row[is_seen], column[is_seen]] = colors[is_seen]
            hole[row[is_seen], column[is_seen]] = False

        if bool(hole.any()):
            # An inpainter gets inverse depth 0, which means unknown, in the hole.
            outside_inverse_depth = torch.where(hole, 0, inverse_depths[index])
            # The inpainter takes a stack of pictures; this one holds a single picture.
            painted_stack = inpainter.paint(target[None], hole[None], outside_inverse_depth[None])
            targets[index] = painted_stack[0]
        if bool(views.mask[index].any()):
            painted.append(index)
    return targets


def look_up_points(
    points: Tensor, camera: Camera, rgb: Tensor, inverse_depth: Tensor
) -> tuple[Tensor, Tensor]:
    """Look up what a view shows at points of the scene.

    Args:
        points: [n, 3] in world coordinates.
        camera: of the view.
        rgb: the view [H, W, 3].
        inverse_depth: the view's inverse depth [H, W].

    Returns:
        Colours [n, 3], and whether each point is seen, [n] bool: inside of the frame, and not
        behind another surface.
    """
    uv, z = camera.project(points)  # [n, 2] pixels, [n] depth
    size = uv.new_tensor([camera.width, camera.height])
    position = 2 * uv / size - 1  # -1..1 across the picture, as `grid_sample` wants it
    channels = torch.cat([rgb, inverse_depth[..., None]], -1).permute(2, 0, 1)  # [4, H, W]
    sampled = grid_sample(
        channels[None], position[None, None], align_corners=False, padding_mode="border"
    )[0, :, 0].T  # [n, 4]

    # The view shows the point itself if its depth there is the point's depth.
    is_same_surface = (sampled[:, 3] * z - 1).abs() < SAME_SURFACE_TOLERANCE
    is_in_frame = (position.abs() <= 1).all(-1)
    return sampled[:, :3], is_same_surface & (z > 0) & is_in_frame


def paint_video(inpainter: Inpainter, views: ViewStack) -> Tensor:
    """Paint the views' holes as one video, whose frames are ordered along the path.

    The photo's view is the first of the stack, but lies anywhere on the path: it is inserted where
    it lengthens the path least.

    Returns:
        The completed views [V, H, W, 3] sRGB, in the order of the stack.
    """
    eyes = torch.stack([camera.position.double() for camera in views.cameras])  # [V, 3]

    def path_length(order: list[int]) -> float:
        """The way from eye to eye in this order."""
        return float(eyes[order].diff(dim=0).norm(dim=-1).sum())

    # View 0, the photo's, is tried at every place between the others.
    others = list(range(1, len(eyes)))
    orders = [[*others[:place], 0, *others[place:]] for place in range(len(eyes))]
    order = min(orders, key=path_length)
    inverse_depth = known_inverse_depth(views.depth, views.mask)
    targets = torch.empty_like(views.rgb)
    targets[order] = inpainter.paint(views.rgb[order], views.mask[order], inverse_depth[order])
    return targets
