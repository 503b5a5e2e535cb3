"""Camera paths: trajectories around the photo's camera position, and smooth paths through keyframes."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from spackle.core.camera import Camera, look_at
from spackle.core.gaussians import Gaussians

SharpTrajectory = Literal["swipe", "shake", "rotate", "rotate-forward"]
TrajectoryKind = Literal[SharpTrajectory, "vertical", "orbit", "dolly-zoom"]
# SHARP's trajectories, which the paper uses for data and training.
SHARP_TRAJECTORIES: tuple[SharpTrajectory, ...] = get_args(SharpTrajectory)
TRAJECTORIES: tuple[TrajectoryKind, ...] = get_args(TrajectoryKind)
PathUnit = Literal["metres", "disparity"]

NEAR_QUANTILE = 0.001  # quantile of depth that defines z_near
FOCUS_QUANTILE = 0.1  # quantile of depth that defines the focus depth
MIN_FOCUS_M = 2.0  # metres; a nearer focus would turn the camera too much
MAX_DISPARITY = 2.0  # beyond, the photo is out of view
DEFAULT_OVERSCAN = (
    0.05  # relative gain in focal length, which hides most of the fill beyond the photo's border
)
MAX_ZOOM = 0.15  # forward motion of rotate-forward, in units of z_near

MIN_FOV, MAX_FOV = 1.0, 170.0  # degrees
WORLD_UP = (0.0, -1.0, 0.0)
LEAST_STEP = 1e-6  # least time between two keyframes, in seconds
Array = NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class DepthRange:
    """The two depths that a trajectory depends on."""

    near: float  # z_near: the 0.1 % quantile
    focus: float  # 10 % quantile, at least 2 m

    @staticmethod
    def of(gaussians: Gaussians) -> DepthRange:
        """Measure the depths of Gaussians in front of a camera at the world's origin."""
        z = gaussians.means[:, 2].detach().double().cpu().numpy()
        z = z[z > 0]
        if z.size == 0:
            raise ValueError("no Gaussian is in front of the camera")
        near, focus = np.quantile(
            z, [NEAR_QUANTILE, FOCUS_QUANTILE]
        )  # torch's quantile takes at most 16 M values
        return DepthRange(float(near), max(MIN_FOCUS_M, float(focus)))

    def towards(self, other: DepthRange, part: float) -> DepthRange:
        """Interpolate on a logarithmic scale between this range (`part` 0) and another range (`part` 1)."""
        near, focus = (
            a * (b / a) ** part for a, b in ((self.near, other.near), (self.focus, other.focus))
        )
        return DepthRange(near, focus)


def disparity_to_offset(camera: Camera, disparity: float, depth_range: DepthRange) -> float:
    """Sideways offset of the camera for a disparity m: m · ‖(W/f, H/f)‖ · z_near."""
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
        kind: swipe (left to right), shake (left-right, then up-down), rotate (a circle), rotate-forward (left-right
            while moving forward and back), vertical (up-down, less in a wide image), orbit (left-right at a constant
            distance from the focus point), or dolly-zoom (backward, while zooming in so that objects at the focus
            point keep their size).
        camera: the photo's camera at the world's origin.
        disparity: the widest offset, see `disparity_to_offset`.
        depth_range: depths of the base's Gaussians.
        frames: number of cameras.
        looped: make a path that repeats without a jump. Swipe then also returns. The other paths already end where they
            begin, so their last frame, which repeats the first, is left out.
        only: index of the only camera to compute; None computes all cameras.

    Raises:
        ValueError: an unknown path, a disparity outside 0..2, or less than one frame.
    """
    name = kind.replace("_", "-")
    if name not in TRAJECTORIES:
        raise ValueError(f"unknown trajectory {kind!r}: choose one of {', '.join(TRAJECTORIES)}")
    if not 0 <= disparity <= MAX_DISPARITY:
        raise ValueError(f"disparity must be between 0 and {MAX_DISPARITY:g}, got {disparity:g}")
    if frames < 1:
        raise ValueError(f"a trajectory needs at least one frame, got {frames}")
    side, forward, focus = (
        disparity_to_offset(camera, disparity, depth_range),
        MAX_ZOOM * depth_range.near,
        depth_range.focus,
    )
    frames += looped
    zero = torch.zeros(frames, dtype=torch.float64)
    turn = torch.linspace(0, 1, frames, dtype=torch.float64) * 2 * math.pi
    if name == "swipe":
        xyz = [
            -side * turn.cos()
            if looped
            else torch.linspace(-side, side, frames, dtype=torch.float64),
            zero,
            zero,
        ]
    elif name == "shake":
        across = frames // 2
        first = torch.linspace(0, 1, across, dtype=torch.float64) * 2 * math.pi
        second = torch.linspace(0, 1, frames - across, dtype=torch.float64) * 2 * math.pi
        x = torch.cat([side * first.sin(), torch.zeros_like(second)])
        y = torch.cat([torch.zeros_like(first), side * second.sin()])
        xyz = [x, y, zero]
    elif name == "rotate":
        xyz = [side * turn.sin(), side * turn.cos(), zero]
    elif name == "vertical":
        flat = min(
            1.0, camera.height / camera.width
        )  # in a wide photo a lowered camera is soon beneath the floor
        xyz = [zero, flat * side * turn.sin(), zero]
    elif name == "orbit":
        angle = math.atan2(side, focus) * turn.sin()
        xyz = [focus * angle.sin(), zero, focus * (1 - angle.cos())]
    elif name == "dolly-zoom":
        xyz = [zero, zero, side * (turn.cos() - 1) / 2]
    else:
        xyz = [side * turn.sin(), zero, forward * (1 - turn.cos()) / 2]
    eyes, target = torch.stack(xyz, dim=-1)[: frames - looped], zero.new_tensor([0.0, 0.0, focus])
    if only is not None:
        eyes = eyes[only : only + 1]
    views = [camera.looking(eye, target) for eye in eyes]
    if name == "dolly-zoom":
        views = [
            view.zoomed(1 - float(eye[2] / focus)) for view, eye in zip(views, eyes, strict=True)
        ]
    return views


def leftmost_and_rightmost(
    camera: Camera, disparity: float, depth_range: DepthRange
) -> tuple[Camera, Camera]:
    """The leftmost and the rightmost view at a disparity, which have the widest holes."""
    left, right = trajectory_cameras("swipe", camera, disparity, depth_range, frames=2)
    return left, right


class PathError(ValueError):
    """The keyframes, or the scene, allow no camera path; the message is the reason."""


@dataclasses.dataclass(frozen=True)
class Keyframe:
    """A camera at one time, in the coordinates of the photo's camera (x right, y down, z forward)."""

    time: float  # seconds
    eye: tuple[float, float, float]  # position of the camera
    target: tuple[float, float, float]  # a point on the optical axis
    up: tuple[float, float, float] = WORLD_UP  # direction that is roughly upwards in the image
    fov: float | None = None  # horizontal field of view in degrees; None: the photo's

    def __post_init__(self) -> None:
        """Raise a PathError if the keyframe describes no view, for instance if eye and target coincide."""
        numbers = (
            self.time,
            *self.eye,
            *self.target,
            *self.up,
            *([] if self.fov is None else [self.fov]),
        )
        if not all(map(math.isfinite, numbers)):
            raise PathError("every number must be finite")
        if self.fov is not None and not MIN_FOV <= self.fov <= MAX_FOV:
            raise PathError(
                f"fov must be from {MIN_FOV:g} to {MAX_FOV:g} degrees, got {self.fov:g}"
            )
        _look_at(self.eye, self.target, self.up)


@dataclasses.dataclass(frozen=True)
class KeyframePath:
    """A smooth path through keyframes.

    Eye, target, up and the logarithm of the focal length follow monotone cubics in time (Fritsch and Butland). The
    cubics pass through all keyframes, and stay between the values of two successive keyframes.
    """

    keys: tuple[Keyframe, ...]  # at least two, at increasing times
    closed: bool = False  # whether the path returns to its first keyframe, within the mean time between keyframes
    unit: PathUnit = "metres"  # "disparity": lengths are multiples of the offset for --disparity 1

    def __post_init__(self) -> None:
        """Raise a PathError if keyframes are too few, or times do not increase."""
        if len(self.keys) < 2:
            raise PathError(f"a path needs at least two keyframes, got {len(self.keys)}")
        for index, (one, other) in enumerate(zip(self.keys, self.keys[1:], strict=False)):
            if not other.time - one.time >= LEAST_STEP:
                order = (
                    f"keyframe {index + 1} is at {other.time:g} s, the one before at {one.time:g} s"
                )
                raise PathError(f"times must increase, by a microsecond at least: {order}")
        if self.unit not in get_args(PathUnit):
            raise PathError(f"unknown unit {self.unit!r}: choose {' or '.join(get_args(PathUnit))}")

    @property
    def seconds(self) -> float:
        """Duration from the first keyframe to the last, or, for a closed path, back to the first."""
        span = self.keys[-1].time - self.keys[0].time
        return span * len(self.keys) / (len(self.keys) - 1) if self.closed else span

    def frame_count(self, fps: float) -> int:
        """The path's number of frames."""
        return max(1, round(self.seconds * fps) + (not self.closed))

    def cameras(self, camera: Camera, frames: int, depth_range: DepthRange) -> list[Camera]:
        """Views at equal time steps; their size is that of `camera`, the photo's camera at the origin.

        An open path includes both its ends; a closed path does not end with its first frame. `depth_range`
        determines the length of the unit "disparity".

        Raises:
            PathError: between two keyframes the eye meets the target, or the view becomes parallel to up.
        """
        steps = frames if self.closed else max(1, frames - 1)
        return self.at(
            [self.keys[0].time + k * self.seconds / steps for k in range(frames)],
            camera,
            depth_range,
        )

    def at(self, times: list[float], camera: Camera, depth_range: DepthRange) -> list[Camera]:
        """Views at these times in seconds; see `cameras`."""
        length = disparity_to_offset(camera, 1.0, depth_range) if self.unit == "disparity" else 1.0
        fx = camera.focal[0]
        focals = [
            fx if key.fov is None else camera.width / 2 / math.tan(math.radians(key.fov) / 2)
            for key in self.keys
        ]
        rows = [
            (*key.eye, *key.target, *(np.array(key.up) / np.linalg.norm(key.up)), math.log(focal))
            for key, focal in zip(self.keys, focals, strict=True)
        ]
        period = self.seconds if self.closed else None
        values = interpolate_monotone(
            np.array([key.time for key in self.keys]), np.array(rows), np.array(times), period
        )
        views = []
        for time, row in zip(times, values, strict=True):
            try:
                pose = _look_at(row[:3] * length, row[3:6] * length, row[6:9])
            except PathError as error:
                raise PathError(
                    f"at {time:.3g} s, between two keyframes, {error}: add a keyframe there"
                ) from None
            moved = dataclasses.replace(camera, world_to_camera=pose.to(camera.world_to_camera))
            views.append(moved.zoomed(math.exp(row[9]) / fx))
        return views


def _look_at(*vectors: Sequence[float] | Array) -> Tensor:
    try:
        return look_at(*(torch.tensor(vector, dtype=torch.float64) for vector in vectors))
    except ValueError as error:
        raise PathError(str(error)) from None


def interpolate_monotone(
    times: Array, values: Array, wanted: Array, period: float | None = None
) -> Array:
    """Interpolate `values` [K, C], given at increasing `times` [K], at the times `wanted` [M] by monotone cubics.

    Returns [M, C]. With a period, the curves are closed: they return to the first value at times[0] + period.
    """
    if period is not None:
        times = np.concatenate([times[-1:] - period, times, times[:2] + period])
        values = np.concatenate([values[-1:], values, values[:2]])
    steps = np.diff(times)[:, None]
    slopes = np.diff(values, axis=0) / steps
    tangents = np.concatenate([slopes[:1], _inner_tangents(steps, slopes), slopes[-1:]])
    segment = np.clip(np.searchsorted(times, wanted, side="right") - 1, 0, len(steps) - 1)
    step = steps[segment]
    u = np.clip((wanted - times[segment])[:, None] / step, 0, 1)
    a, b = values[segment], values[segment + 1]
    bend = (1 - u) ** 2 * u * tangents[segment] - u**2 * (1 - u) * tangents[segment + 1]
    mixed = np.where(
        u < 0.5, a + (3 - 2 * u) * u**2 * (b - a), b - (1 + 2 * u) * (1 - u) ** 2 * (b - a)
    )
    bounded: Array = np.clip(
        mixed + step * bend, np.minimum(a, b), np.maximum(a, b)
    )  # rounding may exceed the bounds
    return bounded


def _inner_tangents(steps: Array, slopes: Array) -> Array:
    """Tangents [K − 2, C]: weighted harmonic means of the slopes before and after a point; 0 if the signs differ."""
    before, after = slopes[:-1], slopes[1:]
    first, second = steps[1:] * 2 + steps[:-1], steps[1:] + 2 * steps[:-1]
    agree = before * after > 0
    safe_before, safe_after = np.where(agree, before, 1), np.where(agree, after, 1)
    mean = (first + second) / (first / safe_before + second / safe_after)
    tangents: Array = np.where(agree, mean, 0.0)
    return tangents
