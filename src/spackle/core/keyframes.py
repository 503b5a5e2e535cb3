"""Smooth camera paths through keyframes, which a user gives by hand or by an editor."""

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
from spackle.core.trajectories import DepthRange, disparity_to_offset

PathUnit = Literal["metres", "disparity"]
MIN_FOV_DEGREES = 1.0
MAX_FOV_DEGREES = 170.0
WORLD_UP = (0.0, -1.0, 0.0)
MIN_KEYFRAME_STEP_S = 1e-6  # time between two keyframes

Array = NDArray[np.float64]


class PathError(ValueError):
    """The keyframes, or the scene, allow no camera path; the message is the reason."""


@dataclasses.dataclass(frozen=True)
class Keyframe:
    """A camera at one time, in the frame of the photo's camera (x right, y down, z forward)."""

    time: float  # seconds
    eye: tuple[float, float, float]  # position of the camera
    target: tuple[float, float, float]  # a point on the optical axis
    up: tuple[float, float, float] = WORLD_UP  # direction that is roughly upwards in the image
    fov: float | None = None  # horizontal field of view in degrees; None: the photo's

    def __post_init__(self) -> None:
        """Raise a PathError if the keyframe describes no view, e.g. if eye and target coincide."""
        numbers = [self.time, *self.eye, *self.target, *self.up]
        if self.fov is not None:
            numbers.append(self.fov)
        if not all(math.isfinite(number) for number in numbers):
            raise PathError("every number must be finite")
        if self.fov is not None and not MIN_FOV_DEGREES <= self.fov <= MAX_FOV_DEGREES:
            raise PathError(
                f"fov must be from {MIN_FOV_DEGREES:g} to {MAX_FOV_DEGREES:g} degrees, "
                f"got {self.fov:g}"
            )
        _look_at(self.eye, self.target, self.up)  # raises for an impossible view

    def focal_px(self, camera: Camera) -> float:
        """The keyframe's focal length in pixels of `camera`, the photo's camera."""
        if self.fov is None:
            return camera.focal[0]
        return camera.width / 2 / math.tan(math.radians(self.fov) / 2)


@dataclasses.dataclass(frozen=True)
class KeyframePath:
    """A smooth path through keyframes.

    Eye, target, up and the logarithm of the focal length follow monotone cubics in time (Fritsch
    and Butland). The cubics pass through all keyframes, and stay between the values of two
    successive keyframes.
    """

    keys: tuple[Keyframe, ...]  # at least two, at increasing times
    closed: bool = False  # the path returns to its first keyframe, within the mean time of a step
    unit: PathUnit = "metres"  # "disparity": lengths are multiples of the offset for disparity 1

    def __post_init__(self) -> None:
        """Raise a PathError if keyframes are too few, or times do not increase."""
        if len(self.keys) < 2:
            raise PathError(f"a path needs at least two keyframes, got {len(self.keys)}")
        for index in range(1, len(self.keys)):
            before = self.keys[index - 1].time
            time = self.keys[index].time
            if not time - before >= MIN_KEYFRAME_STEP_S:
                raise PathError(
                    "times must increase, by a microsecond at least: "
                    f"keyframe {index} is at {time:g} s, the one before at {before:g} s"
                )
        if self.unit not in get_args(PathUnit):
            raise PathError(f"unknown unit {self.unit!r}: choose {' or '.join(get_args(PathUnit))}")

    @property
    def seconds(self) -> float:
        """Duration from the first keyframe to the last; for a closed path, back to the first."""
        span = self.keys[-1].time - self.keys[0].time
        if not self.closed:
            return span
        # The way back to the first keyframe is one step more, as long as the mean of the others.
        step_count = len(self.keys) - 1
        return span * (step_count + 1) / step_count

    def frame_count(self, fps: float) -> int:
        """The path's number of frames; that of an open path includes both its ends."""
        steps = round(self.seconds * fps)
        return max(1, steps if self.closed else steps + 1)

    def cameras(self, camera: Camera, frames: int, depth_range: DepthRange) -> list[Camera]:
        """Views at equal time steps, with the image size of the photo's camera at the origin.

        The views of an open path include both its ends. Those of a closed path leave out the end,
        because it is the first view again.

        Args:
            camera: the photo's camera.
            frames: number of views.
            depth_range: depths of the photo's Gaussians; if the path's unit is "disparity", lengths
                are multiples of the camera offset at which the nearest surface moves across the
                image's whole diagonal.

        Raises:
            PathError: between two keyframes the eye meets the target, or the view becomes parallel
                to up.
        """
        steps = frames if self.closed else max(1, frames - 1)
        start = self.keys[0].time
        times = [start + k * self.seconds / steps for k in range(frames)]
        return self.at(times, camera, depth_range)

    def at(self, times: list[float], camera: Camera, depth_range: DepthRange) -> list[Camera]:
        """Views at these times.

        Args:
            times: in seconds.
            camera: the photo's camera at the origin.
            depth_range: depths of the photo's Gaussians; they decide how long the unit "disparity"
                is.

        Raises:
            PathError: between two keyframes the eye meets the target, or the view becomes parallel
                to up.
        """
        unit_length = 1.0
        if self.unit == "disparity":
            unit_length = disparity_to_offset(camera, 1.0, depth_range)

        # Ten numbers of each keyframe are interpolated: eye, target and up, with three coordinates
        # each, and the logarithm of the focal length, because a steady zoom multiplies it.
        rows = []
        for key in self.keys:
            up = np.array(key.up) / np.linalg.norm(key.up)
            rows.append((*key.eye, *key.target, *up, math.log(key.focal_px(camera))))
        values = interpolate_monotone(
            np.array([key.time for key in self.keys]),
            np.array(rows),
            np.array(times),
            period=self.seconds if self.closed else None,
        )  # [times, 10]

        views = []
        for time, row in zip(times, values, strict=True):
            eye = row[:3] * unit_length
            target = row[3:6] * unit_length
            up = row[6:9]
            focal_px = math.exp(row[9])
            try:
                pose = _look_at(eye, target, up)
            except PathError as error:
                raise PathError(
                    f"at {time:.3g} s, between two keyframes, {error}: add a keyframe there"
                ) from None
            moved = dataclasses.replace(camera, world_to_camera=pose.to(camera.world_to_camera))
            focal_x, _ = camera.focal
            views.append(moved.zoomed(focal_px / focal_x))
        return views


def _look_at(
    eye: Sequence[float] | Array, target: Sequence[float] | Array, up: Sequence[float] | Array
) -> Tensor:
    """The matrix world_to_camera [4, 4] of a camera at `eye` that looks at `target`.

    PathError if there is no such view, because eye and target coincide or `up` is parallel to the
    viewing direction.
    """
    try:
        return look_at(
            torch.tensor(eye, dtype=torch.float64),
            torch.tensor(target, dtype=torch.float64),
            torch.tensor(up, dtype=torch.float64),
        )
    except ValueError as error:
        raise PathError(str(error)) from None


def interpolate_monotone(
    times: Array, values: Array, new_times: Array, period: float | None = None
) -> Array:
    """Interpolate curves by monotone cubics, which never leave the range of two successive values.

    Args:
        times: [K] increasing times of the values.
        values: [K, C] of C curves.
        new_times: [M] at which the curves are evaluated.
        period: if given, the curves are closed; they reach the first value at times[0] + period.

    Returns:
        [M, C].
    """
    if period is not None:
        # The tangent at a value depends on the values before and after it. A closed curve goes on
        # beyond both its ends, so the last value is put before the first one, and the first two
        # after the last one.
        times = np.concatenate([times[-1:] - period, times, times[:2] + period])
        values = np.concatenate([values[-1:], values, values[:2]])
    steps = np.diff(times)[:, None]  # [K − 1, 1]
    slopes = np.diff(values, axis=0) / steps  # [K − 1, C]
    tangents = np.concatenate([slopes[:1], _inner_tangents(steps, slopes), slopes[-1:]])  # [K, C]

    # u runs from 0 to 1 between the two values around each new time.
    segment = np.searchsorted(times, new_times, side="right") - 1
    segment = np.clip(segment, 0, len(steps) - 1)
    step = steps[segment]
    u = np.clip((new_times - times[segment])[:, None] / step, 0, 1)
    before, after = values[segment], values[segment + 1]

    # Hermite's cubic: a blend of the values before and after, plus a bend that gives the curve its
    # tangents. The blend is computed from the closer value, near which rounding errors are small.
    blend = np.where(
        u < 0.5,
        before + (3 - 2 * u) * u**2 * (after - before),
        after - (1 + 2 * u) * (1 - u) ** 2 * (after - before),
    )
    bend = (1 - u) ** 2 * u * tangents[segment] - u**2 * (1 - u) * tangents[segment + 1]
    # Rounding errors may exceed the range of both values.
    bounded: Array = np.clip(
        blend + step * bend, np.minimum(before, after), np.maximum(before, after)
    )
    return bounded


def _inner_tangents(steps: Array, slopes: Array) -> Array:
    """Tangents [K − 2, C] of a curve through K values, at all but the first and last value.

    A tangent is the weighted harmonic mean of the slopes a and b before and after the value,
    (v + w) / (v / a + w / b). With the times s before and t after the value, the weights are
    v = 2t + s and w = t + 2s. The tangent is 0 where the signs of the slopes differ, that is, at a
    maximum or minimum. So the curve never leaves the range of two successive values (Fritsch and
    Butland).

    Args:
        steps: [K − 1, 1] times between the values.
        slopes: [K − 1, C] between the values.
    """
    slope_before, slope_after = slopes[:-1], slopes[1:]
    weight_before = steps[1:] * 2 + steps[:-1]
    weight_after = steps[1:] + 2 * steps[:-1]
    is_monotone = slope_before * slope_after > 0
    # At a maximum or minimum the mean is not used; slopes of 1 avoid a division by zero there.
    safe_before = np.where(is_monotone, slope_before, 1)
    safe_after = np.where(is_monotone, slope_after, 1)
    mean = (weight_before + weight_after) / (
        weight_before / safe_before + weight_after / safe_after
    )
    tangents: Array = np.where(is_monotone, mean, 0.0)
    return tangents
