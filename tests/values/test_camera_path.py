"""Camera paths: trajectories by hand, depths that measure them, and the interpolation between keyframes."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scenes import box_before_wall, random_gaussians
from torch import Tensor

from spackle.camera import Camera
from spackle.camera_path import (
    TRAJECTORIES,
    DepthRange,
    Keyframe,
    KeyframePath,
    PathError,
    TrajectoryKind,
    extremes,
    interpolate,
    max_offset,
    trajectory,
)
from spackle.errors import InputError
from spackle.gaussians import Gaussians
from spackle.render import CpuRenderer
from spackle.render.protocol import Rendering
from spackle.residual import hole_area_ratio
from spackle.views import PathOptions, choose_move, plan_views

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


@pytest.mark.parametrize("closed", [False, True])
def test_a_path_passes_through_its_keys_and_never_beyond(closed: bool) -> None:
    rng = np.random.default_rng(0)
    for count in list(range(2, 9)) * 8:
        times, values = np.cumsum(10 ** rng.uniform(-3, 3, count)), rng.uniform(-100, 100, (count, 2))
        period = times[-1] - times[0] + 1.7 if closed else None
        assert np.array_equal(interpolate(times, values, times, period), values)
        ends = [*times, times[0] + period] if period else times
        around = np.concatenate([values, values[:1]]) if closed else values
        for k in range(len(ends) - 1):
            between = interpolate(times, values, np.linspace(ends[k], ends[k + 1], 9), period)
            low, high = np.minimum(around[k], around[k + 1]), np.maximum(around[k], around[k + 1])
            assert ((between >= low - 1e-9) & (between <= high + 1e-9)).all()
            assert (np.diff(between, axis=0) * (around[k + 1] - around[k]) >= -1e-5).all()


def test_the_interpolation_is_scipys_monotone_cubic() -> None:
    scipy = pytest.importorskip("scipy.interpolate")
    rng = np.random.default_rng(0)
    times, values = np.cumsum(rng.uniform(0.1, 2, 9)), rng.normal(size=(9, 3))
    wanted = np.linspace(times[1], times[-2], 200)  # at the very ends the textbooks differ
    expected = scipy.PchipInterpolator(times, values)(wanted)
    np.testing.assert_allclose(interpolate(times, values, wanted), expected, atol=1e-12)


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


def test_a_closed_path_comes_back_without_the_first_view_twice() -> None:
    path = KeyframePath(KEYS, closed=True)
    assert (path.seconds, path.frame_count(10)) == (3, 30)  # two steps of 1 s in the mean, and one back
    eyes = torch.stack([view.position for view in path.cameras(CAMERA, 30, DEPTHS)])
    jumps = (eyes - eyes.roll(1, 0)).norm(dim=1)
    assert float(jumps[0]) < 2 * float(jumps.median())
    assert len({tuple(eye.tolist()) for eye in eyes}) == 30
    in_disparity = dataclasses.replace(path, unit="disparity").cameras(CAMERA, 30, DEPTHS)
    torch.testing.assert_close(in_disparity[7].position, max_offset(CAMERA, 1.0, DEPTHS) * eyes[7])
    torch.testing.assert_close(path.at([3.0], CAMERA, DEPTHS)[0].position, eyes[0], atol=1e-6, rtol=0)


def test_what_happens_between_keys_is_looked_at_too() -> None:
    for first, second, says in (
        (Keyframe(0, (0, 0, 0), (0, 0, 2)), Keyframe(1, (0, 0, 4), (0, 0, 2)), r"at 0\.5 s.*coincide.*add a keyframe"),
        (Keyframe(0, (0, 0, 0), (0, 1, 1)), Keyframe(1, (0, 0, 0), (0, 1, -1)), "up lies along the view"),
    ):
        with pytest.raises(PathError, match=says):
            KeyframePath((first, second)).cameras(CAMERA, 3, DEPTHS)
    slow = KeyframePath((KEYS[0], Keyframe(1e6, (1, 0, 0), TARGET)))
    with pytest.raises(PathError, match="--frames"):
        PathOptions().fly(box_before_wall().base(), CAMERA, slow)


def points_of(depths: Tensor) -> Gaussians:
    """Gaussians on the optical axis."""
    return dataclasses.replace(random_gaussians(len(depths)), means=depths[:, None] * torch.tensor([0.0, 0.0, 1.0]))


def test_depths_are_quantiles_and_the_focus_is_not_too_near() -> None:
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
        ("rotate-forward", 5, [WAVE, LEVEL, [0.0, 0.15, 0.3, 0.15, 0.0]]),  # 15 % of the nearest depth to and fro
        ("rotate_forward", 1, [[0.0]] * 3),
        ("vertical", 5, [LEVEL, [0.0, 0.6, 0.0, -0.6, 0.0], LEVEL]),
        # An arc around the focus point, 4 m away, to the angle that swipe sees it from.
        ("orbit", 5, [[0.0, AWAY, 0.0, -AWAY, 0.0], LEVEL, [0.0, NEARER, 0.0, NEARER, 0.0]]),
        ("dolly-zoom", 5, [LEVEL, LEVEL, [0.0, -0.4, -0.8, -0.4, 0.0]]),
    ],
)
def test_trajectories_by_hand(kind: str, frames: int, places: list[list[float]]) -> None:
    path = trajectory(kind, PHOTO, 0.4, RANGE, frames)  # type: ignore[arg-type]
    assert len(path) == frames
    for camera, *place in zip(path, *places, strict=True):
        assert camera.position.tolist() == pytest.approx(place, abs=1e-6)
        assert camera.project(torch.tensor([0.0, 0.0, RANGE.focus]))[0].tolist() == pytest.approx([200, 150], abs=1e-3)
        if kind == "dolly-zoom":  # what stands 1 m aside of the focus point stays where it is
            aside = camera.project(torch.tensor([1.0, 0.0, RANGE.focus]))[0].tolist()
            assert aside == pytest.approx([200 + 500 / 4, 150], abs=1e-3)
        else:
            assert torch.equal(camera.K, PHOTO.K)
    if kind == "swipe" and frames > 1:
        ends = zip(extremes(PHOTO, 0.4, RANGE), (path[0], path[-1]), strict=True)
        assert all(torch.equal(one.world_to_camera, other.world_to_camera) for one, other in ends)


@pytest.mark.parametrize("kind", TRAJECTORIES)
def test_a_looped_path_goes_on_at_its_beginning(kind: TrajectoryKind) -> None:
    eyes = torch.stack([view.position for view in trajectory(kind, PHOTO, 0.4, RANGE, 40, looped=True)])
    steps = (eyes - eyes.roll(1, 0)).norm(dim=1)
    assert float(steps[0]) <= float(steps.max())
    assert len(eyes) == 40
    plain = torch.stack([view.position for view in trajectory(kind, PHOTO, 0.4, RANGE, 41)])
    assert torch.equal(eyes, plain[:40]) == (kind != "swipe")  # which comes back
    assert float(eyes[:, 0].min()) == pytest.approx(float(plain[:, 0].min()), abs=1e-3)


@pytest.mark.parametrize(
    ("kind", "disparity", "frames", "says"),
    [("spiral", 0.3, 60, "rotate-forward"), ("swipe", 3, 60, "disparity"), ("swipe", 0.3, 0, "at least one frame")],
)
def test_impossible_paths_are_refused(kind: str, disparity: float, frames: int, says: str) -> None:
    with pytest.raises(ValueError, match=says):
        trajectory(kind, PHOTO, disparity, RANGE, frames)  # type: ignore[arg-type]


@pytest.mark.parametrize(("kind", "more"), [("swipe", 0), ("rotate-forward", 0), ("shake", 2), ("rotate", 2)])
def test_a_longer_lens_shows_the_middle_and_what_it_leaves_out_is_filled(kind: TrajectoryKind, more: int) -> None:
    prediction = box_before_wall().lift()
    paths = [PathOptions(kind, frames=8, overscan=overscan) for overscan in (0, 0.2)]
    plans = [plan_views(prediction, path, Path("photo.png")) for path in paths]
    for exact, longer in zip(*(plan.cameras[:8] for plan in plans), strict=True):
        assert torch.equal(exact.world_to_camera, longer.world_to_camera)
        K = exact.K.clone()
        K[:2, :2] *= 1.2
        assert torch.equal(longer.K, K)
    assert all(torch.equal(one.K, other.K) for one, other in zip(*(plan.cameras[8:] for plan in plans), strict=True))
    assert [len(plan.cameras) for plan in plans] == [8 + more + 2] * 2
    assert plans[1].measured == {"-0.3": 8 + more, "+0.3": 9 + more}


class CountingRenderer(CpuRenderer):
    """Counts its renders."""

    count = 0

    def render(self, *given: Any, **options: Any) -> Rendering:
        self.count += 1
        return super().render(*given, **options)


@pytest.fixture(scope="module")
def uncovered() -> Callable[[float], float]:
    """Which share of the two widest views of a box before a wall is holes at a disparity, at the photo's size."""
    scene = box_before_wall(width=288, height=216, focal=240)
    gaussians = scene.base()

    @functools.cache
    def share(disparity: float) -> float:
        ends = extremes(scene.camera, disparity, DepthRange.of(gaussians))
        return sum(hole_area_ratio(CpuRenderer().render(gaussians, end).alpha) for end in ends) / 2

    return share


@pytest.mark.parametrize(("usual", "allowed"), [(0.3, 0.5), (0.3, 0.06), (0.15, 0.03), (0.3, 0.001), (0.02, 0.001)])
def test_a_photo_chooses_its_move(usual: float, allowed: float, uncovered: Callable[[float], float]) -> None:
    """As trying every hundredth finds it, in a few coarse renders."""
    prediction = box_before_wall(width=288, height=216, focal=240).lift()
    prediction = dataclasses.replace(prediction, disparity=usual, uncovered=allowed)
    renderer = CountingRenderer()
    chosen = choose_move(prediction, renderer, Path("photo.png"))
    steps = [usual, *(k / 100 for k in range(4, round(100 * usual)))]
    within = [step for step in steps if uncovered(step) <= allowed]
    assert chosen.disparity == pytest.approx(max(within, default=min(usual, 0.04)), abs=0.0101)
    assert chosen.notes["uncovered"] == pytest.approx(uncovered(chosen.disparity), abs=0.01)
    assert chosen.notes["usual_disparity"] == usual
    assert renderer.count <= 10
    nowhere = dataclasses.replace(prediction, gaussians=prediction.gaussians.select(slice(0, 0)))
    with pytest.raises(InputError, match=r"^photo\.png: no camera path: no Gaussian stands in front"):
        choose_move(nowhere, renderer, Path("photo.png"))
