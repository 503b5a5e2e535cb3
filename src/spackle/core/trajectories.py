"""Camera paths around the photo's camera position, such as swipe and rotate.

How far the camera goes is the *disparity*: a number that means the same in every scene, because the
motion is scaled by the depth of the nearest surface. Paths of a user's own are in `keyframes.py`.
"""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple, get_args

import numpy as np
import torch
from torch import Tensor

from spackle.core.camera import Camera
from spackle.core.gaussians import Gaussians
from spackle.runtime.declared_options import MAX_DISPARITY as MAX_DISPARITY
from spackle.runtime.declared_options import SharpTrajectory as SharpTrajectory
from spackle.runtime.declared_options import TrajectoryKind as TrajectoryKind

# SHARP's trajectories, which the paper uses for data and training.
SHARP_TRAJECTORIES: tuple[SharpTrajectory, ...] = get_args(SharpTrajectory)
TRAJECTORIES: tuple[TrajectoryKind, ...] = get_args(TrajectoryKind)

NEAR_QUANTILE = 0.001  # quantile of depth that defines z_near
FOCUS_QUANTILE = 0.1  # quantile of depth that defines the focus depth
# SHARP's rule for scenes in metres: a nearer focus would turn the camera too much.
MIN_FOCUS_M = 2.0
# Relative gain in focal length along a path; hides most of the fill beyond the photo's border.
DEFAULT_OVERSCAN = 0.05
# Specks of a depth map are nearer than this share of the depth of the nearest 1 % of the scene. In
# 140 measured depth maps of rooms and of stereo pairs, z_near is at least 0.87 of that depth.
SPECK_RATIO = 0.5
SPECK_QUANTILE = 0.01
FORWARD_MOTION_RATIO = 0.15  # forward motion of rotate-forward, in units of z_near


@dataclasses.dataclass(frozen=True)
class DepthRange:
    """The two depths of a scene that a trajectory depends on, in the scene's unit."""

    near: float  # z_near, the 0.1 % quantile: nearly the nearest surface
    # The depth that stays in the middle: the 10 % quantile; in a metric scene at least 2 m.
    focus: float

    @staticmethod
    def of(gaussians: Gaussians, *, is_metric: bool = False) -> DepthRange:
        """Measure the depths of Gaussians in front of a camera at the world's origin.

        Args:
            gaussians: the scene.
            is_metric: whether its unit is known to be the metre. In any other scene, nothing may
                depend on the unit, so that the camera moves in the same way in every unit.

        Raises:
            ValueError: no Gaussian is in front of the camera.
        """
        z = gaussians.means[:, 2].detach().double().cpu().numpy()
        z = z[z > 0]
        if z.size == 0:
            raise ValueError("no Gaussian is in front of the camera")
        # Quantiles, because single stray Gaussians are nearer than any surface.
        # Numpy's quantile, because torch's takes at most 16 million values.
        near, focus = np.quantile(z, [NEAR_QUANTILE, FOCUS_QUANTILE])
        min_focus = MIN_FOCUS_M if is_metric else 0.0
        return DepthRange(near=float(near), focus=max(min_focus, float(focus)))

    @staticmethod
    def of_specks(gaussians: Gaussians) -> tuple[float, float] | None:
        """z_near, and the depth of the nearest 1 %, if only specks are as near as z_near.

        A few wrong pixels of a depth map, far before all surfaces, set z_near, and then the camera
        hardly moves. They cannot be told from a twig before the lens, so the path stays as it is.

        Returns:
            The two depths; None if z_near is that of a surface.
        """
        z = gaussians.means[:, 2].detach().double().cpu().numpy()
        z = z[z > 0]
        if z.size == 0:
            return None
        near, percent = np.quantile(z, [NEAR_QUANTILE, SPECK_QUANTILE])
        return (float(near), float(percent)) if near < SPECK_RATIO * percent else None

    def towards(self, other: DepthRange, part: float) -> DepthRange:
        """Interpolate on a logarithmic scale: this range for `part` 0, the other for `part` 1."""
        return DepthRange(
            near=self.near * (other.near / self.near) ** part,
            focus=self.focus * (other.focus / self.focus) ** part,
        )


class Framing(NamedTuple):
    """Where a path's cameras look, and how much of the border they cut off."""

    focus: float  # depth of the target, straight ahead in the photo, in the scene's unit
    overscan: float  # relative gain in focal length

    def of(self, depth_range: DepthRange) -> DepthRange:
        """The depths of a path whose cameras look at this target."""
        return dataclasses.replace(depth_range, focus=self.focus)


def disparity_to_offset(camera: Camera, disparity: float, depth_range: DepthRange) -> float:
    """Sideways offset of the camera, in the scene's unit: disparity · ‖(W/fx, H/fy)‖ · z_near.

    So a disparity of 1 moves the nearest surface by the diagonal of the image.
    """
    fx, fy = camera.focal
    return disparity * math.hypot(camera.width / fx, camera.height / fy) * depth_range.near


def trajectory_cameras(
    kind: TrajectoryKind,
    camera: Camera,
    disparity: float,
    depth_range: DepthRange,
    frames: int = 60,
    looped: bool = False,
    only: int | None = None,
) -> list[Camera]:
    """Cameras along a path around the photo's camera position; all of them look at the focus point.

    Args:
        kind: swipe (left to right), shake (left-right, then up-down), rotate (a circle),
            rotate-forward (left-right while moving forward and back), vertical (up-down, less in a
            wide image), orbit (left-right at a constant distance from the focus point), or
            dolly-zoom (backward, while zooming in so that objects at the focus point keep their
            size).
        camera: the photo's camera at the world's origin.
        disparity: the greatest camera offset; at 1, the nearest surface moves across the image's
            whole diagonal.
        depth_range: depths of the photo's Gaussians.
        frames: number of cameras.
        looped: make a path that repeats without a jump. Swipe then also returns. The other paths
            already end where they begin, so their last frame, which repeats the first, is left out.
        only: index of the only camera to compute; None computes all cameras.

    Raises:
        ValueError: an unknown path, a disparity outside 0..2, or less than one frame.
    """
    name = kind.replace("_", "-")  # a name with an underscore, as Python writes, is understood
    if name not in TRAJECTORIES:
        raise ValueError(f"unknown trajectory {kind!r}: choose one of {', '.join(TRAJECTORIES)}")
    if not 0 <= disparity <= MAX_DISPARITY:
        raise ValueError(f"disparity must be between 0 and {MAX_DISPARITY:g}, got {disparity:g}")
    if frames < 1:
        raise ValueError(f"a trajectory needs at least one frame, got {frames}")

    offset = disparity_to_offset(camera, disparity, depth_range)
    if name == "swipe":
        eyes = _swipe_eyes(offset, frames, looped)
    elif looped:
        # The last of one frame more would be the first again.
        eyes = _closed_path_eyes(name, camera, offset, depth_range, frames + 1)[:frames]
    else:
        eyes = _closed_path_eyes(name, camera, offset, depth_range, frames)
    if only is not None:
        eyes = eyes[only : only + 1]

    focus_point = eyes.new_tensor([0.0, 0.0, depth_range.focus])
    cameras = [camera.looking(eye, focus_point) for eye in eyes]
    if name == "dolly-zoom":
        # An object's size in the image is the focal length over its distance.
        zooms = [1 - float(eye[2] / depth_range.focus) for eye in eyes]
        cameras = [view.zoomed(zoom) for view, zoom in zip(cameras, zooms, strict=True)]
    return cameras


def _swipe_eyes(offset: float, frames: int, looped: bool) -> Tensor:
    """Camera positions [frames, 3], float64, from left to right, `offset` away at both ends.

    A looped path also returns to the left, and slows down at both ends.
    """
    if looped:
        # One angle more than frames, because the last angle would repeat the first frame.
        x = -offset * _full_turn(frames + 1).cos()[:frames]
    else:
        x = torch.linspace(-offset, offset, frames, dtype=torch.float64)
    zero = torch.zeros_like(x)
    return torch.stack([x, zero, zero], dim=-1)


def _closed_path_eyes(
    name: str, camera: Camera, offset: float, depth_range: DepthRange, frames: int
) -> Tensor:
    """Camera positions [frames, 3], float64, of a path whose last position is its first.

    Args:
        name: any trajectory but "swipe".
        camera: the photo's camera.
        offset: greatest distance from the photo's camera sideways, in the scene's unit.
        depth_range: depths of the photo's Gaussians.
        frames: number of positions.
    """
    focus = depth_range.focus
    turn = _full_turn(frames)
    zero = torch.zeros_like(turn)
    if name == "shake":
        x, y = _shake_offsets(offset, frames)
        xyz = [x, y, zero]
    elif name == "rotate":
        xyz = [offset * turn.sin(), offset * turn.cos(), zero]
    elif name == "vertical":
        # In a wide photo a lowered camera is soon beneath the floor.
        height_ratio = min(1.0, camera.height / camera.width)
        xyz = [zero, height_ratio * offset * turn.sin(), zero]
    elif name == "orbit":
        # An arc around the focus point (0, 0, focus), whose radius is the focus depth.
        angle = math.atan2(offset, focus) * turn.sin()
        xyz = [focus * angle.sin(), zero, focus * (1 - angle.cos())]
    elif name == "dolly-zoom":
        # From the photo's camera straight back by `offset`, and forward again.
        xyz = [zero, zero, offset * (turn.cos() - 1) / 2]
    else:  # rotate-forward
        # A fraction of the nearest depth, so that the camera stays in front of all surfaces.
        forward = FORWARD_MOTION_RATIO * depth_range.near
        xyz = [offset * turn.sin(), zero, forward * (1 - turn.cos()) / 2]
    return torch.stack(xyz, dim=-1)


def _shake_offsets(offset: float, frames: int) -> tuple[Tensor, Tensor]:
    """x and y [frames] of a camera that moves left and right, and then up and down."""
    sideways = _full_turn(frames // 2)
    up_and_down = _full_turn(frames - frames // 2)
    x = torch.cat([offset * sideways.sin(), torch.zeros_like(up_and_down)])
    y = torch.cat([torch.zeros_like(sideways), offset * up_and_down.sin()])
    return x, y


def _full_turn(count: int) -> Tensor:
    """Angles [count], float64, from 0 to 2π, both included."""
    return torch.linspace(0, 1, count, dtype=torch.float64) * 2 * math.pi


def leftmost_and_rightmost(
    camera: Camera, disparity: float, depth_range: DepthRange
) -> tuple[Camera, Camera]:
    """The leftmost and the rightmost view at a disparity, which have the widest holes.

    Args:
        camera: the photo's camera at the world's origin.
        disparity: the camera offset; at 1, the nearest surface moves across the image's whole
            diagonal.
        depth_range: depths of the photo's Gaussians.
    """
    # A swipe runs from left to right; with two frames it has only its ends.
    left, right = trajectory_cameras("swipe", camera, disparity, depth_range, frames=2)
    return left, right
