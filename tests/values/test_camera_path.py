"""Camera paths: the closed forms of the trajectories, and the interpolation between keyframes."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import box_before_wall
from torch import Tensor

from spackle.camera import Camera, look_at
from spackle.camera_path import (
    TRAJECTORIES,
    DepthRange,
    Keyframe,
    KeyframePath,
    PathError,
    extremes,
    interpolate,
    max_offset,
    trajectory,
)
from spackle.gaussians import Gaussians
from spackle.views import PathOptions

PHOTO = Camera.from_focal(500, 400, 300)  # the diagonal of W/f and H/f is exactly one
RANGE = DepthRange(near=2.0, focus=4.0)
CAMERA = Camera.from_focal(60, 64, 48)
DEPTHS = DepthRange(near=1.5, focus=4.0)
TARGET = (0.0, 0.0, 4.0)
KEYS = (
    Keyframe(0.0, (0.0, 0.0, 0.0), TARGET),
    Keyframe(0.5, (0.4, -0.1, 0.2), TARGET, fov=40.0),
    Keyframe(2.0, (-0.4, 0.0, 0.0), (0.1, 0.0, 3.0), up=(0.2, -1.0, 0.0)),
)


@st.composite
def samples(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray]:
    """Increasing times [K] and values [K, 2]."""
    steps = draw(st.lists(st.floats(1e-3, 1e3), min_size=1, max_size=7))
    count = len(steps) + 1
    values = draw(st.lists(st.tuples(*[st.floats(-100, 100)] * 2), min_size=count, max_size=count))
    return np.cumsum([0.0, *steps]), np.array(values)


@settings(deadline=None, max_examples=100)
@given(samples(), st.booleans())
def test_a_path_passes_through_its_keys_and_never_beyond_them(
    drawn: tuple[np.ndarray, np.ndarray], closed: bool
) -> None:
    times, values = drawn
    period = times[-1] + 1.7 if closed else None
    assert np.array_equal(interpolate(times, values, times, period), values)
    ends = [*times, period] if period else times
    around = np.concatenate([values, values[:1]]) if closed else values
    for k in range(len(ends) - 1):
        between = interpolate(times, values, np.linspace(ends[k], ends[k + 1], 9), period)
        low, high = np.minimum(around[k], around[k + 1]), np.maximum(around[k], around[k + 1])
        assert ((between >= low) & (between <= high)).all()
        assert (np.diff(between, axis=0) * (around[k + 1] - around[k]) >= -1e-9 * np.abs(around).max() ** 2).all()


def test_the_interpolation_is_the_monotone_cubic_of_the_textbooks() -> None:
    scipy = pytest.importorskip("scipy.interpolate")
    rng = np.random.default_rng(0)
    times, values = np.cumsum(rng.uniform(0.1, 2, 9)), rng.normal(size=(9, 3))
    wanted = np.linspace(times[1], times[-2], 200)  # at the very ends the textbooks differ
    expected = scipy.PchipInterpolator(times, values)(wanted)
    np.testing.assert_allclose(interpolate(times, values, wanted), expected, atol=1e-12)


@settings(deadline=None, max_examples=50)
@given(*[st.tuples(*[st.floats(-5, 5)] * 3)] * 3)
def test_a_view_looks_at_its_target_with_its_up_upwards(eye: Any, target: Any, up: Any) -> None:
    try:
        matrix = look_at(*(torch.tensor(part, dtype=torch.float64) for part in (eye, target, up))).numpy()
    except ValueError:
        return
    rotation, distance = matrix[:3, :3], math.dist(eye, target)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(rotation) > 0
    assert matrix[:3] @ [*target, 1] == pytest.approx([0, 0, distance], abs=1e-8 * max(1, distance))
    assert (rotation @ up)[0] == pytest.approx(0, abs=1e-8)
    assert (rotation @ up)[1] < 0  # y points down


def test_frames_begin_and_end_at_the_keys_and_the_lens_zooms() -> None:
    path = KeyframePath(KEYS)
    same = CAMERA.looking(*(torch.tensor(part) for part in (KEYS[1].eye, KEYS[1].target)))
    views = path.cameras(CAMERA, 5, DEPTHS)  # at 0, 0.5, 1, 1.5, 2 s
    keys = path.key_cameras(CAMERA, DEPTHS)
    for index, key in ((0, 0), (1, 1), (4, 2)):
        assert torch.equal(views[index].world_to_camera, keys[key].world_to_camera)
        torch.testing.assert_close(views[index].position, torch.tensor(KEYS[key].eye), atol=1e-6, rtol=0)
    torch.testing.assert_close(views[1].world_to_camera, same.world_to_camera)  # as a trajectory would look from there
    assert views[1].focal[0] == pytest.approx(32 / math.tan(math.radians(20)))
    assert views[4].focal[0] == pytest.approx(60)
    assert 60 < views[2].focal[0] < views[1].focal[0]
    assert (path.frame_count(30), path.seconds) == (61, 2)


def test_a_closed_path_comes_back_without_showing_the_first_view_twice() -> None:
    path = KeyframePath(KEYS, closed=True)
    assert path.seconds == 3  # two steps of 1 s in the mean, and one back
    assert path.frame_count(10) == 30
    views = path.cameras(CAMERA, 30, DEPTHS)
    eyes = torch.stack([view.position for view in views])
    jumps = (eyes - eyes.roll(1, 0)).norm(dim=1)
    assert float(jumps[0]) < 2 * float(jumps.median())
    assert len({tuple(eye.tolist()) for eye in eyes}) == 30
    in_disparity = dataclasses.replace(path, unit="disparity").cameras(CAMERA, 30, DEPTHS)
    torch.testing.assert_close(in_disparity[7].position, max_offset(CAMERA, 1.0, DEPTHS) * eyes[7])
    torch.testing.assert_close(path.at([3.0], CAMERA, DEPTHS)[0].position, eyes[0], atol=1e-6, rtol=0)


def test_what_happens_between_keys_is_looked_at_too() -> None:
    through = KeyframePath((Keyframe(0, (0, 0, 0), (0, 0, 2)), Keyframe(1, (0, 0, 4), (0, 0, 2))))
    with pytest.raises(PathError, match=r"at 0\.5 s.*coincide.*add a keyframe"):
        through.cameras(CAMERA, 3, DEPTHS)
    over = KeyframePath((Keyframe(0, (0, 0, 0), (0, 1, 1)), Keyframe(1, (0, 0, 0), (0, 1, -1))))
    with pytest.raises(PathError, match="up lies along the view"):
        over.cameras(CAMERA, 3, DEPTHS)
    slow = KeyframePath((KEYS[0], Keyframe(1e6, (1, 0, 0), TARGET)))
    with pytest.raises(PathError, match="--frames"):
        PathOptions().fly(box_before_wall().base(), CAMERA, slow)


def points_of(depths: Tensor) -> Gaussians:
    """Gaussians on the optical axis."""
    n = len(depths)
    means = torch.stack([torch.zeros(n), torch.zeros(n), depths], dim=1)
    return Gaussians(means, torch.ones(n, 4), torch.ones(n, 3), torch.ones(n), torch.ones(n, 3))


def test_depths_are_quantiles_of_what_stands_in_front_and_the_focus_is_two_metres_away_at_least() -> None:
    depths = 3 + 5 * torch.rand(5000, generator=torch.Generator().manual_seed(0))
    found = DepthRange.of(points_of(torch.cat([depths, torch.tensor([-1.0, 0.0, math.nan])])))
    assert [found.near, found.focus] == pytest.approx(np.quantile(depths.double().numpy(), [0.001, 0.1]))
    found = DepthRange.of(points_of(torch.linspace(0.5, 1.5, 101)))
    assert (found.near, found.focus) == (pytest.approx(0.501, abs=1e-6), 2.0)
    with pytest.raises(ValueError, match="in front"):
        DepthRange.of(points_of(torch.tensor([-1.0, 0.0])))


def test_the_widest_offset_by_hand() -> None:
    assert max_offset(PHOTO, 0.3, RANGE) == pytest.approx(0.3 * 1.0 * 2.0)
    tall = PHOTO.K.clone()
    tall[1, 1] = 250  # W/fx = 0.8, H/fy = 1.2
    assert max_offset(dataclasses.replace(PHOTO, K=tall), 0.5, RANGE) == pytest.approx(math.sqrt(0.64 + 1.44))
    assert max_offset(PHOTO.resized(800, 600), 0.3, RANGE) == pytest.approx(0.6)  # resolution plays no part


def closed_form(kind: str, offset: float, near: float, k: int, frames: int) -> tuple[float, float, float]:
    """The eye's place in frame k, written down once more."""

    def share(index: int, count: int) -> float:
        return index / (count - 1) if count > 1 else 0.0

    turn, across = 2 * math.pi * share(k, frames), frames // 2
    if kind == "swipe":
        return offset * (2 * share(k, frames) - 1), 0.0, 0.0
    if kind == "shake" and k < across:
        return offset * math.sin(2 * math.pi * share(k, across)), 0.0, 0.0
    if kind == "shake":
        return 0.0, offset * math.sin(2 * math.pi * share(k - across, frames - across)), 0.0
    if kind == "rotate":
        return offset * math.sin(turn), offset * math.cos(turn), 0.0
    return offset * math.sin(turn), 0.0, 0.15 * near * (1 - math.cos(turn)) / 2


@pytest.mark.parametrize("kind", TRAJECTORIES)
@pytest.mark.parametrize("frames", [1, 2, 7, 60])
def test_paths_have_their_closed_forms(kind: str, frames: int) -> None:
    path = trajectory(kind, PHOTO, 0.4, RANGE, frames)  # type: ignore[arg-type]
    assert len(path) == frames
    if kind == "swipe" and frames > 1:
        ends = extremes(PHOTO, 0.4, RANGE)
        assert all(torch.equal(a.world_to_camera, path[k].world_to_camera) for a, k in zip(ends, (0, -1), strict=True))
    for k, camera in enumerate(path):
        uv, _ = camera.project(torch.tensor([0.0, 0.0, RANGE.focus]))
        assert uv.tolist() == pytest.approx([200, 150], abs=1e-3)
        assert torch.equal(camera.K, PHOTO.K)
        assert camera.position.tolist() == pytest.approx(closed_form(kind, 0.8, 2.0, k, frames), abs=1e-6)
    old = trajectory("rotate_forward", PHOTO, 0.4, RANGE, 3)  # type: ignore[arg-type]
    new = trajectory("rotate-forward", PHOTO, 0.4, RANGE, 3)
    assert all(torch.equal(a.world_to_camera, b.world_to_camera) for a, b in zip(old, new, strict=True))


def test_impossible_paths_are_refused() -> None:
    for kind, disparity, frames, says in (
        ("spiral", 0.3, 60, "rotate-forward"),
        ("swipe", 3, 60, "disparity"),
        ("swipe", 0.3, 0, "at least one frame"),
    ):
        with pytest.raises(ValueError, match=says):
            trajectory(kind, PHOTO, disparity, RANGE, frames)  # type: ignore[arg-type]
