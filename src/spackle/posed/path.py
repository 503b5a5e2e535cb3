"""The camera's way through the places of several photos, and the views that are filled for it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from spackle.core.camera import Camera
from spackle.core.gaussians import Gaussians
from spackle.core.keyframes import Keyframe, KeyframePath
from spackle.core.trajectories import DepthRange, leftmost_and_rightmost

SECONDS_PER_PHOTO = 1.5  # from one photo to the next
MIN_SECONDS = 4.0  # of the whole way there and back, as long as a photo's video
MAX_SECONDS = 20.0
FILLED_PATH_VIEWS = 24  # views along the path that are filled; between them holes look alike
AROUND_PHOTOS = 8  # so many photos also get a view to their left and one to their right


def order_along_path(cameras: Sequence[Camera]) -> list[int]:
    """Indices of cameras in the order in which a short way leads through them.

    It begins at the camera that is farthest from the middle, and always goes on to the nearest.
    """
    positions = torch.stack([camera.position.double() for camera in cameras])  # [V, 3]
    distances = torch.cdist(positions, positions)
    start = int((positions - positions.mean(0)).norm(dim=1).argmax())
    order = [start]
    while len(order) < len(cameras):
        to_last = distances[order[-1]].clone()
        to_last[order] = torch.inf
        order.append(int(to_last.argmin()))
    return order


def central_first(cameras: Sequence[Camera]) -> list[int]:
    """Indices of cameras, those nearest to all others first."""
    positions = torch.stack([camera.position.double() for camera in cameras])
    mean_distance = torch.cdist(positions, positions).mean(1)
    return mean_distance.argsort(stable=True).tolist()


def path_through(
    cameras: Sequence[Camera], focus_depths: Sequence[float], frame_count: int
) -> list[Camera]:
    """Views along a smooth way through the cameras and back, for a video that repeats.

    Args:
        cameras: in any order, in the world; the first one gives the views' size and lens.
        focus_depths: how far before each camera the point lies at which the path looks.
        frame_count: number of views.
    """
    lens = cameras[0].even()  # videos have an even width and height
    order = order_along_path(cameras)
    keys = []
    for step, index in enumerate(order):
        camera = cameras[index]
        _, down, forward = camera.world_to_camera[:3, :3].double()
        eye = camera.position.double()
        keys.append(
            Keyframe(
                time=float(step),
                eye=_three(eye),
                target=_three(eye + focus_depths[index] * forward),
                up=_three(-down),
            )
        )
    # There and back: the video ends where it began. Slow at both ends, as a hand would turn round.
    last = len(keys) - 1
    turn = torch.linspace(0, 2 * torch.pi, frame_count + 1, dtype=torch.float64)[:-1]
    times = (last * (1 - turn.cos()) / 2).tolist()
    unused_range = DepthRange(near=1.0, focus=1.0)  # the path's unit is that of the world
    return KeyframePath(tuple(keys)).at(times, lens, unused_range)


def path_seconds(photo_count: int) -> float:
    """The duration of the way through so many photos and back."""
    return min(MAX_SECONDS, max(MIN_SECONDS, 2 * SECONDS_PER_PHOTO * (photo_count - 1)))


def focus_depth(gaussians: Gaussians, camera: Camera) -> float:
    """The median depth of the Gaussians that lie in a camera's picture, in the world's unit."""
    uv, z = camera.project(gaussians.means)
    is_inside = camera.has_in_frame(uv, z)
    # A camera that sees nothing of the scene still needs a point to look at.
    depths = z[is_inside] if bool(is_inside.any()) else z.abs()
    return float(depths.median())


def views_to_fill(
    cameras: Sequence[Camera],
    path: Sequence[Camera],
    own_gaussians: Sequence[Gaussians],
    disparity: float,
) -> list[Camera]:
    """The views whose holes are filled: the photos' own, along the path, and beside the photos.

    Args:
        cameras: of the photos, in the world; the first one comes first.
        path: the views of the video.
        own_gaussians: what each photo's base made, in the frame of the photo's camera.
        disparity: how far to the side of a photo a person may look (see `disparity_to_offset`).
    """
    # The way back shows the same as the way there.
    way_there = path[: len(path) // 2 + 1]
    step = math.ceil(len(way_there) / FILLED_PATH_VIEWS)
    views = [*cameras, *way_there[::step]]

    # Spread evenly over the photos, if there are many.
    photo_step = math.ceil(len(cameras) / AROUND_PHOTOS)
    for index in range(0, len(cameras), photo_step):
        camera = cameras[index]
        at_origin = dataclasses.replace(camera, world_to_camera=torch.eye(4))
        depth_range = DepthRange.of(own_gaussians[index])
        for beside in leftmost_and_rightmost(at_origin, disparity, depth_range):
            pose = beside.world_to_camera.double() @ camera.world_to_camera.double()
            views.append(dataclasses.replace(camera, world_to_camera=pose.float()))
    return views


def _three(vector: Tensor) -> tuple[float, float, float]:
    """The numbers of a vector [3]."""
    x, y, z = vector.tolist()
    return x, y, z
