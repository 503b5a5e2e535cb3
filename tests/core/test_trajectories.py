"""Camera paths: trajectories, depth ranges, keyframes, and the choice of the disparity."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.scenes import box_before_wall, random_gaussians
from torch import Tensor

from spackle.core.camera import Camera
from spackle.core.gaussians import Gaussians
from spackle.core.keyframes import Keyframe, KeyframePath, PathError, interpolate_monotone
from spackle.core.trajectories import (
    TRAJECTORIES,
    DepthRange,
    TrajectoryKind,
    disparity_to_offset,
    leftmost_and_rightmost,
    trajectory_cameras,
)
from spackle.render import CpuRenderer
from spackle.residual import hole_area_ratio
from spackle.runtime.errors import InputError
from spackle.views import choose_disparity

PHOTO = Camera.from_focal(500, 400, 300)  # hypot(W/f, H/f) = 1
RANGE = DepthRange(near=2.0, focus=4.0)
CAMERA = Camera.from_focal(60, 64, 48)
DEPTHS = DepthRange(near=1.5, focus=4.0)
TARGET = (0.0, 0.0, 4.0)
KEYS = (
    Keyframe(0.0, (0.0, 0.0, 0.0), TARGET),
    Keyframe(0.5, (0.4, -0.1, 0.2), TARGET, fov=40.0),
    Keyframe(2.0, (-0.4, 0.0, 0.0), (0.1, 0.0, 3.0), up=(0.2, -1.0, 0.0)),
)


@pytest.mark.parametrize("closed", [False, True])
def test_interpolation_passes_through_keys_and_stays_between_them(closed: bool) -> None:
    rng = np.random.default_rng(0)
    for count in list(range(2, 9)) * 4:
        times, values = (
            np.cumsum(10 ** rng.uniform(-3, 3, count)),
            rng.uniform(-100, 100, (count, 2)),
        )
        period = times[-1] - times[0] + 1.7 if closed else None
        assert np.array_equal(interpolate_monotone(times, values, times, period), values)
        ends = [*times, times[0] + period] if period else times
        around = np.concatenate([values, values[:1]]) if closed else values
        for k in range(len(ends) - 1):
            between = interpolate_monotone(
                times, values, np.linspace(ends[k], ends[k + 1], 9), period
            )
            low, high = np.minimum(around[k], around[k + 1]), np.maximum(around[k], around[k + 1])
            assert ((between >= low - 1e-9) & (between <= high + 1e-9)).all()
            assert (np.diff(between, axis=0) * (around[k + 1] - around[k]) >= -1e-5).all()


def test_the_interpolation_is_scipys_monotone_cubic() -> None:
    scipy = pytest.importorskip("scipy.interpolate")
    rng = np.random.default_rng(0)
    times, values = np.cumsum(rng.uniform(0.1, 2, 9)), rng.normal(size=(9, 3))
    wanted = np.linspace(times[1], times[-2], 200)  # SciPy computes other slopes at the two ends
    expected = scipy.PchipInterpolator(times, values)(wanted)
    np.testing.assert_allclose(interpolate_monotone(times, values, wanted), expected, atol=1e-12)


def test_frames_reach_the_keyframes_and_the_focal_length_changes() -> None:
    path = KeyframePath(KEYS)
    same = CAMERA.looking(*(torch.tensor(part) for part in (KEYS[1].eye, KEYS[1].target)))
    views = path.cameras(CAMERA, 5, DEPTHS)  # at 0, 0.5, 1, 1.5, 2 s
    for index, key in ((0, 0), (1, 1), (4, 2)):
        torch.testing.assert_close(
            views[index].position, torch.tensor(KEYS[key].eye), atol=1e-6, rtol=0
        )
    torch.testing.assert_close(views[1].world_to_camera, same.world_to_camera)
    assert views[1].focal[0] == pytest.approx(32 / math.tan(math.radians(20)))
    assert views[4].focal[0] == pytest.approx(60)
    assert 60 < views[2].focal[0] < views[1].focal[0]
    assert (path.frame_count(30), path.seconds) == (61, 2)


def test_a_closed_path_does_not_repeat_its_first_view() -> None:
    path = KeyframePath(KEYS, closed=True)
    assert (path.seconds, path.frame_count(10)) == (
        3,
        30,
    )  # the way back takes the mean of the two steps, 1 s
    eyes = torch.stack([view.position for view in path.cameras(CAMERA, 30, DEPTHS)])
    jumps = (eyes - eyes.roll(1, 0)).norm(dim=1)
    assert float(jumps[0]) < 2 * float(jumps.median())
    assert len({tuple(eye.tolist()) for eye in eyes}) == 30
    in_disparity = dataclasses.replace(path, unit="disparity").cameras(CAMERA, 30, DEPTHS)
    torch.testing.assert_close(
        in_disparity[7].position, disparity_to_offset(CAMERA, 1.0, DEPTHS) * eyes[7]
    )
    torch.testing.assert_close(
        path.at([3.0], CAMERA, DEPTHS)[0].position, eyes[0], atol=1e-6, rtol=0
    )


def test_impossible_views_between_keyframes_are_refused() -> None:
    with pytest.raises(PathError, match="must be finite"):
        Keyframe(0, (float("nan"), 0, 0), TARGET)
    eye = (0, 0, 0)
    for first, second, says in (
        (
            Keyframe(0, eye, (0, 0, 2)),
            Keyframe(1, (0, 0, 4), (0, 0, 2)),
            r"at 0\.5 s.*coincide.*add a keyframe",
        ),
        (
            Keyframe(0, eye, (0, 1, 1)),
            Keyframe(1, eye, (0, 1, -1)),
            "up is parallel to the viewing direction",
        ),
    ):
        with pytest.raises(PathError, match=says):
            KeyframePath((first, second)).cameras(CAMERA, 3, DEPTHS)


def points_of(depths: Tensor) -> Gaussians:
    return dataclasses.replace(
        random_gaussians(len(depths)), means=depths[:, None] * torch.tensor([0.0, 0.0, 1.0])
    )


def test_depth_range_is_quantiles_with_a_least_focus_depth() -> None:
    depths = 3 + 5 * torch.rand(5000, generator=torch.Generator().manual_seed(0))
    found = DepthRange.of(points_of(torch.cat([depths, torch.tensor([-1.0, 0.0, math.nan])])))
    assert [found.near, found.focus] == pytest.approx(
        np.quantile(depths.double().numpy(), [0.001, 0.1])
    )
    close = points_of(torch.linspace(0.5, 1.5, 101))
    found = DepthRange.of(close, is_metric=True)
    assert (found.near, found.focus) == (pytest.approx(0.501, abs=1e-6), 2.0)
    # Where the unit is not known, 2 may be anything, and no depth is special.
    found = DepthRange.of(close)
    assert (found.near, found.focus) == pytest.approx((0.501, 0.6))
    for size in (2.0**-10, 2.0**10):
        scaled = dataclasses.replace(close, means=close.means * size)
        assert DepthRange.of(scaled) == DepthRange(found.near * size, found.focus * size)
    with pytest.raises(ValueError, match="in front"):
        DepthRange.of(points_of(torch.tensor([-1.0, 0.0])))


WAVE = [0.0, 0.8, 0.0, -0.8, 0.0]
LEVEL = [0.0] * 5
AWAY, NEARER = 4 * 0.2 / math.sqrt(1.04), 4 - 4 / math.sqrt(1.04)


@pytest.mark.parametrize(
    ("kind", "frames", "places"),
    [
        ("swipe", 3, [[-0.8, 0.0, 0.8], [0.0] * 3, [0.0] * 3]),
        ("swipe", 1, [[-0.8], [0.0], [0.0]]),
        ("rotate", 5, [WAVE, [0.8, 0.0, -0.8, 0.0, 0.8], LEVEL]),
        ("shake", 10, [WAVE + LEVEL, LEVEL + WAVE, LEVEL * 2]),
        ("rotate-forward", 5, [WAVE, LEVEL, [0.0, 0.15, 0.3, 0.15, 0.0]]),
        ("rotate_forward", 1, [[0.0]] * 3),
        ("vertical", 5, [LEVEL, [0.0, 0.6, 0.0, -0.6, 0.0], LEVEL]),
        # an arc around the focus point, which is 4 m away
        ("orbit", 5, [[0.0, AWAY, 0.0, -AWAY, 0.0], LEVEL, [0.0, NEARER, 0.0, NEARER, 0.0]]),
        ("dolly-zoom", 5, [LEVEL, LEVEL, [0.0, -0.4, -0.8, -0.4, 0.0]]),
    ],
)
def test_trajectories_by_hand(kind: str, frames: int, places: list[list[float]]) -> None:
    path = trajectory_cameras(kind, PHOTO, 0.4, RANGE, frames)  # type: ignore[arg-type]
    assert len(path) == frames
    for camera, *place in zip(path, *places, strict=True):
        assert camera.position.tolist() == pytest.approx(place, abs=1e-6)
        assert camera.project(torch.tensor([0.0, 0.0, RANGE.focus]))[0].tolist() == pytest.approx(
            [200, 150], abs=1e-3
        )
        if kind == "dolly-zoom":  # a point 1 m beside the focus point keeps its pixel
            aside = camera.project(torch.tensor([1.0, 0.0, RANGE.focus]))[0].tolist()
            assert aside == pytest.approx([200 + 500 / 4, 150], abs=1e-3)
        else:
            assert torch.equal(camera.K, PHOTO.K)
    (alone,) = trajectory_cameras(kind, PHOTO, 0.4, RANGE, frames, only=frames // 2)  # type: ignore[arg-type]
    assert torch.equal(alone.world_to_camera, path[frames // 2].world_to_camera)
    assert torch.equal(alone.K, path[frames // 2].K)


@pytest.mark.parametrize("kind", TRAJECTORIES)
def test_a_looped_path_continues_at_its_beginning(kind: TrajectoryKind) -> None:
    eyes = torch.stack(
        [view.position for view in trajectory_cameras(kind, PHOTO, 0.4, RANGE, 40, looped=True)]
    )
    steps = (eyes - eyes.roll(1, 0)).norm(dim=1)
    assert float(steps[0]) <= float(steps.max())
    assert len(eyes) == 40
    plain = torch.stack([view.position for view in trajectory_cameras(kind, PHOTO, 0.4, RANGE, 41)])
    assert torch.equal(eyes, plain[:40]) == (kind != "swipe")  # swipe returns
    assert float(eyes[:, 0].min()) == pytest.approx(float(plain[:, 0].min()), abs=1e-3)


@pytest.mark.parametrize(
    ("kind", "disparity", "frames", "says"),
    [
        ("spiral", 0.3, 60, "rotate-forward"),
        ("swipe", 3, 60, "disparity"),
        ("swipe", 0.3, 0, "at least one frame"),
    ],
)
def test_impossible_paths_are_refused(kind: str, disparity: float, frames: int, says: str) -> None:
    with pytest.raises(ValueError, match=says):
        trajectory_cameras(kind, PHOTO, disparity, RANGE, frames)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("usual", "allowed"), [(0.3, 0.5), (0.3, 0.06), (0.15, 0.03), (0.3, 0.001), (0.02, 0.001)]
)
def test_choose_disparity_finds_the_largest_disparity_within_the_limit(
    usual: float, allowed: float
) -> None:
    scene, photo = box_before_wall(width=288, height=216, focal=240), Path("photo.png")
    prediction = dataclasses.replace(scene.lift(), max_disparity=usual, max_hole_ratio=allowed)
    gaussians, renderer = prediction.gaussians, CpuRenderer()

    def uncovered(disparity: float) -> float:
        ends = leftmost_and_rightmost(
            scene.camera, disparity, DepthRange.of(gaussians, is_metric=True)
        )
        return sum(hole_area_ratio(renderer.render(gaussians, end).alpha) for end in ends) / 2

    chosen = choose_disparity(prediction, renderer, photo)
    steps = [usual, *(k / 100 for k in range(4, round(100 * usual)))]
    within = [step for step in steps if uncovered(step) <= allowed]
    assert chosen.max_disparity == pytest.approx(max(within, default=min(usual, 0.04)), abs=0.0101)
    assert chosen.notes["uncovered"] == pytest.approx(uncovered(chosen.max_disparity), abs=0.01)
    assert chosen.notes["usual_disparity"] == usual
    with pytest.raises(InputError, match=r"^photo\.png: no camera path: no Gaussian is in front"):
        choose_disparity(
            dataclasses.replace(prediction, gaussians=gaussians.select(slice(0, 0))),
            renderer,
            photo,
        )
