"""Camera paths around the photo's eye, in SHARP's habits."""

from __future__ import annotations

import dataclasses
import math
from typing import Literal, get_args

import numpy as np
import torch
from torch import Tensor

from spackle.camera import Camera
from spackle.gaussians import Gaussians

TrajectoryKind = Literal["swipe", "shake", "rotate", "rotate_forward"]
TRAJECTORIES: tuple[TrajectoryKind, ...] = get_args(TrajectoryKind)

NEAR_QUANTILE = 0.001  # z_near: sets how far the eye may go
FOCUS_QUANTILE = 0.1  # depth that the camera keeps looking at
MIN_FOCUS_M = 2.0  # a nearer focus would turn the camera too much
MAX_DISPARITY = 2.0  # wider moves leave nothing of the photo in view
MAX_ZOOM = 0.15  # forward motion of rotate_forward, in units of z_near


def spelled(kind: TrajectoryKind) -> str:
    """A trajectory as --trajectory spells it, and as everything does that a person reads."""
    return kind.replace("_", "-")


@dataclasses.dataclass(frozen=True)
class DepthRange:
    """The two depths that a trajectory depends on."""

    near: float  # 0.1 % quantile
    focus: float  # 10 % quantile, at least 2 m

    @staticmethod
    def of(gaussians: Gaussians) -> DepthRange:
        """Measure the depths of Gaussians in front of the photo's camera, which is the world's."""
        z = gaussians.means[:, 2].detach().double().cpu().numpy()
        z = z[z > 0]
        if z.size == 0:
            raise ValueError("no Gaussian stands in front of the camera")
        near, focus = np.quantile(z, [NEAR_QUANTILE, FOCUS_QUANTILE])  # torch's stops at 16 M values
        return DepthRange(float(near), max(MIN_FOCUS_M, float(focus)))

    def towards(self, other: DepthRange, part: float) -> DepthRange:
        """A part of the way to another range, on a logarithmic scale."""
        near, focus = (a * (b / a) ** part for a, b in ((self.near, other.near), (self.focus, other.focus)))
        return DepthRange(near, focus)


def max_offset(camera: Camera, disparity: float, depth_range: DepthRange) -> float:
    """How far the eye moves sideways for a disparity m: m · ‖(W/f, H/f)‖ · z_near."""
    fx, fy = camera.focal
    return disparity * math.hypot(camera.width / fx, camera.height / fy) * depth_range.near


def trajectory(
    kind: TrajectoryKind, camera: Camera, disparity: float, depth_range: DepthRange, frames: int = 60
) -> list[Camera]:
    """Cameras along a path around the photo's eye, looking at the focus point.

    Args:
        kind: swipe (left to right), shake (left-right, then up-down), rotate (a circle) or
            rotate_forward (left-right while moving in and out).
        camera: the photo's camera at the world's origin.
        disparity: the widest offset, in the units of `max_offset`.
        depth_range: depths of the base's Gaussians.
        frames: number of cameras.

    Raises:
        ValueError: an unknown path, a disparity out of 0..2, or no frame.
    """
    eyes, target = _flight(kind, camera, disparity, depth_range, frames)
    return [camera.looking(eye, target) for eye in eyes]


def view_at(
    kind: TrajectoryKind, camera: Camera, disparity: float, depth_range: DepthRange, index: int, frames: int
) -> Camera:
    """One camera of `trajectory`, the rest of which is not made."""
    eyes, target = _flight(kind, camera, disparity, depth_range, frames)
    return camera.looking(eyes[index], target)


def _flight(
    kind: TrajectoryKind, camera: Camera, disparity: float, depth_range: DepthRange, frames: int
) -> tuple[Tensor, Tensor]:
    """Eye positions [frames, 3] and what they look at, [3]."""
    if kind not in TRAJECTORIES:
        raise ValueError(f"unknown trajectory {kind!r}: choose one of {', '.join(TRAJECTORIES)}")
    if not 0 <= disparity <= MAX_DISPARITY:
        raise ValueError(f"disparity must be between 0 and {MAX_DISPARITY:g}, got {disparity:g}")
    if frames < 1:
        raise ValueError(f"a trajectory needs at least one frame, got {frames}")
    offset = max_offset(camera, disparity, depth_range)
    target = torch.tensor([0.0, 0.0, depth_range.focus], dtype=torch.float64)
    return _eyes(kind, offset, MAX_ZOOM * depth_range.near, frames), target


def extremes(camera: Camera, disparity: float, depth_range: DepthRange) -> tuple[Camera, Camera]:
    """The leftmost and the rightmost view at a disparity: where holes are widest."""
    left, right = trajectory("swipe", camera, disparity, depth_range, frames=2)
    return left, right


def _eyes(kind: TrajectoryKind, side: float, forward: float, frames: int) -> Tensor:
    """Eye positions [frames, 3]."""
    zero = torch.zeros(frames, dtype=torch.float64)
    turn = torch.linspace(0, 1, frames, dtype=torch.float64) * 2 * math.pi
    if kind == "swipe":
        xyz = [torch.linspace(-side, side, frames, dtype=torch.float64), zero, zero]
    elif kind == "shake":
        across = frames // 2
        first = torch.linspace(0, 1, across, dtype=torch.float64) * 2 * math.pi
        second = torch.linspace(0, 1, frames - across, dtype=torch.float64) * 2 * math.pi
        x = torch.cat([side * first.sin(), torch.zeros_like(second)])
        y = torch.cat([torch.zeros_like(first), side * second.sin()])
        xyz = [x, y, zero]
    elif kind == "rotate":
        xyz = [side * turn.sin(), side * turn.cos(), zero]
    else:
        xyz = [side * turn.sin(), zero, forward * (1 - turn.cos()) / 2]
    return torch.stack(xyz, dim=-1)
