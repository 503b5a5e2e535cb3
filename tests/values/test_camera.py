"""Cameras and their paths: projection, looking, and the closed forms of the trajectories."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from torch import Tensor

from spackle.camera import Camera
from spackle.camera_path import TRAJECTORIES, DepthRange, extremes, max_offset, trajectory
from spackle.gaussians import Gaussians

PROPERTY = settings(deadline=None, max_examples=40)
COORDINATES = st.tuples(*[st.floats(-5, 5)] * 3)
PHOTO = Camera.from_focal(500, 400, 300)  # the diagonal of W/f and H/f is exactly one
RANGE = DepthRange(near=2.0, focus=4.0)


@st.composite
def cameras(draw: st.DrawFn) -> Camera:
    """Any lens, anywhere, not looking straight up or down."""
    eye, target = (torch.tensor(draw(COORDINATES), dtype=torch.float64) for _ in range(2))
    across = target - eye
    assume(float(across.norm()) > 0.1)
    assume(float(across[[0, 2]].norm()) > 0.05 * float(across.norm()))
    width, height = draw(st.integers(1, 500)), draw(st.integers(1, 500))
    camera = Camera.from_focal(draw(st.floats(5, 2000)), width, height).to(dtype=torch.float64)
    camera.K[0, 2] += draw(st.floats(-50, 50))
    camera.K[1, 1] *= draw(st.floats(0.8, 1.2))
    return camera.looking(eye, target)


def points_of(gaussian_depths: Tensor) -> Gaussians:
    """Gaussians on the optical axis."""
    n = len(gaussian_depths)
    means = torch.zeros(n, 3)
    means[:, 2] = gaussian_depths
    return Gaussians(means, torch.ones(n, 4), torch.ones(n, 3), torch.ones(n), torch.ones(n, 3))


def eyes(path: list[Camera]) -> Tensor:
    return torch.stack([camera.position for camera in path]).double()


@pytest.mark.parametrize(("name", "shape"), [("K", (4, 4)), ("world_to_camera", (3, 4))])
def test_matrices_of_the_wrong_shape_are_refused(name: str, shape: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match=rf"Camera\.{name}"):
        dataclasses.replace(PHOTO, **{name: torch.zeros(shape)})


@pytest.mark.parametrize("size", [(0, 5), (5, 0), (-1, 5)])
def test_an_empty_picture_is_refused(size: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match="empty"):
        Camera.from_focal(10, *size)


@pytest.mark.parametrize("focal", [0, -1, math.nan, math.inf])
def test_a_senseless_focal_length_is_refused(focal: float) -> None:
    with pytest.raises(ValueError, match="focal"):
        Camera.from_focal(focal, 4, 4)


def test_projection_by_hand() -> None:
    camera = Camera.from_focal(100, 200, 100)
    uv, z = camera.project(torch.tensor([[1.0, -0.5, 2.0], [0.0, 0.0, 7.0]]))
    assert uv.tolist() == [[150.0, 25.0], [100.0, 50.0]]
    assert z.tolist() == [2.0, 7.0]
    assert camera.unproject(torch.tensor([150.0, 25.0]), torch.tensor(2.0)).tolist() == [1.0, -0.5, 2.0]
    assert camera.focal == (100.0, 100.0)


def test_the_axes_point_right_down_and_forward() -> None:
    uv, _ = PHOTO.project(torch.tensor([[0.1, 0.0, 1.0], [0.0, 0.1, 1.0]]))
    assert uv[0].tolist() == pytest.approx([250, 150])
    assert uv[1].tolist() == pytest.approx([200, 200])


def test_pixel_centres_lie_at_half_integers() -> None:
    centers = Camera.from_focal(10, 5, 3).pixel_centers()
    assert centers.shape == (3, 5, 2)
    assert centers[0, 0].tolist() == [0.5, 0.5]
    assert centers[2, 4].tolist() == [4.5, 2.5]
    cells = Camera.from_focal(10, 5, 3).pixel_centers(stride=2)
    assert cells.tolist() == [[[1.0, 1.0], [3.0, 1.0]]]


@PROPERTY
@given(cameras(), st.tuples(st.floats(-300, 800), st.floats(-300, 800)), st.floats(0.01, 1000))
def test_pixels_come_back_from_the_world(camera: Camera, pixel: tuple[float, float], depth: float) -> None:
    uv, z = camera.project(camera.unproject(torch.tensor(pixel).double(), torch.tensor(depth).double()))
    assert float(z) == pytest.approx(depth, rel=1e-6, abs=1e-9)
    assert uv.tolist() == pytest.approx(pixel, rel=1e-6, abs=1e-5)


@PROPERTY
@given(cameras(), COORDINATES)
def test_points_come_back_from_the_picture_even_from_behind(camera: Camera, point: tuple[float, ...]) -> None:
    world = torch.tensor(point, dtype=torch.float64)
    uv, z = camera.project(world)
    assume(abs(float(z)) > 1e-3)
    torch.testing.assert_close(camera.unproject(uv, z), world, rtol=1e-6, atol=1e-6)


def test_points_behind_the_camera_have_negative_depth_and_points_beside_it_raise_nothing() -> None:
    uv, z = PHOTO.project(torch.tensor([[0.0, 0.0, -2.0], [1.0, 0.0, 0.0]]))
    assert float(z[0]) == -2
    assert bool(uv[0].isfinite().all())
    assert float(uv[1, 0]) == math.inf


def test_projection_takes_any_leading_axes() -> None:
    points = torch.rand(2, 3, 4, 3) + torch.tensor([0.0, 0.0, 1.0])
    uv, z = PHOTO.project(points)
    assert (uv.shape, z.shape) == ((2, 3, 4, 2), (2, 3, 4))
    torch.testing.assert_close(PHOTO.unproject(uv, z), points)


@PROPERTY
@given(cameras())
def test_a_looking_camera_is_rigid_and_level(camera: Camera) -> None:
    rotation = camera.world_to_camera[:3, :3]
    torch.testing.assert_close(rotation @ rotation.T, torch.eye(3).double(), rtol=0, atol=1e-9)
    assert float(torch.linalg.det(rotation)) == pytest.approx(1)
    right, down, _ = rotation
    assert float(right[1]) == pytest.approx(0, abs=1e-12)  # the horizon is level
    assert float(down[1]) > 0  # and the sky is up
    assert camera.world_to_camera[3].tolist() == [0, 0, 0, 1]


@PROPERTY
@given(COORDINATES, COORDINATES)
def test_what_is_looked_at_lies_in_the_middle(eye: tuple[float, ...], target: tuple[float, ...]) -> None:
    start, end = torch.tensor(eye).double(), torch.tensor(target).double()
    assume(float((end - start)[[0, 2]].norm()) > 0.01)
    camera = PHOTO.to(dtype=torch.float64).looking(start, end)
    uv, z = camera.project(end)
    assert uv.tolist() == pytest.approx([200, 150], abs=1e-6)
    assert float(z) == pytest.approx(float((end - start).norm()), rel=1e-9)
    torch.testing.assert_close(camera.position, start, rtol=0, atol=1e-9)


def test_looking_ahead_from_the_origin_changes_nothing() -> None:
    camera = PHOTO.looking(torch.zeros(3), torch.tensor([0.0, 0.0, 9.0]))
    assert torch.equal(camera.world_to_camera, torch.eye(4))
    assert torch.equal(camera.K, PHOTO.K)
    assert (camera.width, camera.height) == (400, 300)
    assert camera.world_to_camera.dtype == torch.float32


def test_looking_right_by_hand() -> None:
    camera = PHOTO.looking(torch.tensor([1.0, 2.0, 3.0]), torch.tensor([5.0, 2.0, 3.0]))
    expected = torch.tensor([[0.0, 0.0, -1.0, 3.0], [0.0, 1.0, 0.0, -2.0], [1.0, 0.0, 0.0, -1.0], [0.0, 0.0, 0.0, 1.0]])
    torch.testing.assert_close(camera.world_to_camera, expected)


@pytest.mark.parametrize("target", [(0, 0, 0), (0, 1, 0), (0, -3, 0)])
def test_nowhere_and_straight_up_or_down_are_refused(target: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="cannot look there"):
        PHOTO.looking(torch.zeros(3), torch.tensor(target).float())


@PROPERTY
@given(cameras(), COORDINATES, st.integers(1, 700), st.integers(1, 700))
def test_another_pixel_grid_shows_the_same_view(camera: Camera, point: tuple, width: int, height: int) -> None:
    world = torch.tensor(point, dtype=torch.float64)
    uv, z = camera.project(world)
    assume(abs(float(z)) > 1e-2)
    resized = camera.resized(width, height)
    found, again = resized.project(world)
    factors = torch.tensor([width / camera.width, height / camera.height], dtype=torch.float64)
    torch.testing.assert_close(found, uv * factors, rtol=1e-6, atol=1e-6)
    assert float(again) == float(z)
    assert (resized.width, resized.height) == (width, height)


def test_conversion_reaches_both_matrices() -> None:
    camera = PHOTO.to(dtype=torch.float64)
    assert (camera.K.dtype, camera.world_to_camera.dtype) == (torch.float64, torch.float64)


def test_depths_are_quantiles_of_what_stands_in_front() -> None:
    depths = 3 + 5 * torch.rand(5000, generator=torch.Generator().manual_seed(0))
    behind = torch.tensor([-1.0, 0.0, math.nan])
    found = DepthRange.of(points_of(torch.cat([depths, behind])))
    expected = np.quantile(depths.double().numpy(), [0.001, 0.1])
    assert [found.near, found.focus] == pytest.approx(expected)


def test_the_focus_is_never_nearer_than_two_metres() -> None:
    found = DepthRange.of(points_of(torch.linspace(0.5, 1.5, 101)))
    assert found.near == pytest.approx(0.501, abs=1e-6)
    assert found.focus == 2.0


@pytest.mark.parametrize("depths", [[], [-1.0, 0.0]])
def test_nothing_in_front_has_no_depths(depths: list[float]) -> None:
    with pytest.raises(ValueError, match="in front"):
        DepthRange.of(points_of(torch.tensor(depths)))


def test_the_widest_offset_by_hand() -> None:
    assert max_offset(PHOTO, 0.3, RANGE) == pytest.approx(0.3 * 1.0 * 2.0)
    tall = PHOTO.K.clone()
    tall[1, 1] = 250  # W/fx = 0.8, H/fy = 1.2
    assert max_offset(dataclasses.replace(PHOTO, K=tall), 0.5, RANGE) == pytest.approx(math.sqrt(0.64 + 1.44))
    assert max_offset(PHOTO.resized(800, 600), 0.3, RANGE) == pytest.approx(0.6)  # resolution plays no part


def closed_form(kind: str, offset: float, near: float, frames: int) -> list[tuple[float, float, float]]:
    """The eye's path, written down once more."""

    def at(index: int, count: int) -> float:
        return index / (count - 1) if count > 1 else 0.0

    def turn(index: int, count: int) -> float:
        return 2 * math.pi * at(index, count)

    across = frames // 2
    forms = {
        "swipe": lambda k: (offset * (2 * at(k, frames) - 1), 0.0, 0.0),
        "shake": lambda k: (
            (offset * math.sin(turn(k, across)), 0.0, 0.0)
            if k < across
            else (0.0, offset * math.sin(turn(k - across, frames - across)), 0.0)
        ),
        "rotate": lambda k: (offset * math.sin(turn(k, frames)), offset * math.cos(turn(k, frames)), 0.0),
        "rotate_forward": lambda k: (
            offset * math.sin(turn(k, frames)),
            0.0,
            0.15 * near * (1 - math.cos(turn(k, frames))) / 2,
        ),
    }
    return [forms[kind](k) for k in range(frames)]


@pytest.mark.parametrize("kind", TRAJECTORIES)
@pytest.mark.parametrize("frames", [1, 2, 7, 60])
def test_paths_have_their_closed_forms(kind: str, frames: int) -> None:
    path = trajectory(kind, PHOTO, 0.4, RANGE, frames)  # type: ignore[arg-type]
    assert len(path) == frames
    expected = torch.tensor(closed_form(kind, 0.8, 2.0, frames), dtype=torch.float64)
    torch.testing.assert_close(eyes(path), expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize("kind", TRAJECTORIES)
def test_every_camera_of_a_path_looks_at_the_focus_with_the_photos_lens(kind: str) -> None:
    for camera in trajectory(kind, PHOTO, 0.5, RANGE, 9):  # type: ignore[arg-type]
        uv, _ = camera.project(torch.tensor([0.0, 0.0, 4.0]))
        assert uv.tolist() == pytest.approx([200, 150], abs=1e-3)
        assert torch.equal(camera.K, PHOTO.K)


@pytest.mark.parametrize("kind", TRAJECTORIES)
@pytest.mark.parametrize("disparity", [0.0, 0.3, 0.6])
def test_no_eye_goes_farther_sideways_than_the_disparity_allows(kind: str, disparity: float) -> None:
    found = eyes(trajectory(kind, PHOTO, disparity, RANGE, 33))  # type: ignore[arg-type]
    assert float(found[:, :2].norm(dim=-1).max()) <= disparity * 2.0 + 1e-6
    assert float(found[:, 2].min()) >= -1e-6
    assert float(found[:, 2].max()) <= 0.3 + 1e-6


def test_the_extremes_are_the_ends_of_a_swipe() -> None:
    left, right = extremes(PHOTO, 0.5, RANGE)
    ends = trajectory("swipe", PHOTO, 0.5, RANGE, 31)
    for camera, end, x in ((left, ends[0], -1.0), (right, ends[-1], 1.0)):
        assert torch.equal(camera.world_to_camera, end.world_to_camera)
        assert camera.position.tolist() == pytest.approx([x, 0, 0], abs=1e-6)


def test_impossible_paths_are_refused() -> None:
    with pytest.raises(ValueError, match="rotate_forward"):
        trajectory("spiral", PHOTO, 0.3, RANGE)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="at least one frame"):
        trajectory("swipe", PHOTO, 0.3, RANGE, frames=0)
