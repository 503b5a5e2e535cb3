"""Cameras and their paths: projection, looking, and the closed forms of the trajectories."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from spackle.camera import Camera

PROPERTY = settings(deadline=None, max_examples=40)
COORDINATES = st.tuples(*[st.floats(-5, 5)] * 3)
PHOTO = Camera.from_focal(500, 400, 300)  # the diagonal of W/f and H/f is exactly one


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


def test_what_is_no_camera_is_refused() -> None:
    for name, shape in (("K", (4, 4)), ("world_to_camera", (3, 4))):
        with pytest.raises(ValueError, match=rf"Camera\.{name}"):
            dataclasses.replace(PHOTO, **{name: torch.zeros(shape)})
    for size in ((0, 5), (5, -1)):
        with pytest.raises(ValueError, match="empty"):
            Camera.from_focal(10, *size)
    for focal in (0, -1, math.nan, math.inf):
        with pytest.raises(ValueError, match="focal"):
            Camera.from_focal(focal, 4, 4)


def test_projection_by_hand() -> None:
    camera = Camera.from_focal(100, 200, 100)
    uv, z = camera.project(torch.tensor([[1.0, -0.5, 2.0], [0.0, 0.0, 7.0]]))
    assert uv.tolist() == [[150.0, 25.0], [100.0, 50.0]]
    assert z.tolist() == [2.0, 7.0]
    assert camera.unproject(torch.tensor([150.0, 25.0]), torch.tensor(2.0)).tolist() == [1.0, -0.5, 2.0]
    assert camera.focal == (100.0, 100.0)
    uv, z = camera.project(torch.tensor([[0.0, 0.0, -2.0], [1.0, 0.0, 0.0]]))  # behind, and beside
    assert float(z[0]) == -2
    assert bool(uv[0].isfinite().all())
    assert float(uv[1, 0]) == math.inf


def test_pixel_centres_lie_at_half_integers() -> None:
    centers = Camera.from_focal(10, 5, 3).pixel_centers()
    assert centers.shape == (3, 5, 2)
    assert centers[0, 0].tolist() == [0.5, 0.5]
    assert centers[2, 4].tolist() == [4.5, 2.5]
    cells = Camera.from_focal(10, 5, 3).pixel_centers(stride=2)
    assert cells.tolist() == [[[1.0, 1.0], [3.0, 1.0]]]


@PROPERTY
@given(cameras(), COORDINATES, st.tuples(st.floats(-300, 800), st.floats(-300, 800)), st.floats(0.01, 1000))
def test_points_and_pixels_come_back_even_from_behind(
    camera: Camera, point: tuple[float, ...], pixel: tuple[float, float], depth: float
) -> None:
    uv, z = camera.project(camera.unproject(torch.tensor(pixel).double(), torch.tensor(depth).double()))
    assert float(z) == pytest.approx(depth, rel=1e-6, abs=1e-9)
    assert uv.tolist() == pytest.approx(pixel, rel=1e-6, abs=1e-5)
    world = torch.tensor(point, dtype=torch.float64)
    uv, z = camera.project(world)
    assume(abs(float(z)) > 1e-3)
    torch.testing.assert_close(camera.unproject(uv, z), world, rtol=1e-6, atol=1e-6)


@PROPERTY
@given(cameras())
def test_a_looking_camera_is_rigid_and_level_and_has_its_target_in_the_middle(camera: Camera) -> None:
    target = camera.position + 3 * camera.world_to_camera[2, :3]
    again = PHOTO.to(dtype=torch.float64).looking(camera.position, target)
    uv, z = again.project(target)
    assert [*uv.tolist(), float(z)] == pytest.approx([200, 150, 3], abs=1e-6)
    torch.testing.assert_close(again.world_to_camera, camera.world_to_camera, rtol=0, atol=1e-9)
    rotation = camera.world_to_camera[:3, :3]
    torch.testing.assert_close(rotation @ rotation.T, torch.eye(3).double(), rtol=0, atol=1e-9)
    assert float(torch.linalg.det(rotation)) == pytest.approx(1)
    right, down, _ = rotation
    assert float(right[1]) == pytest.approx(0, abs=1e-12)  # the horizon is level
    assert float(down[1]) > 0  # and the sky is up
    assert camera.world_to_camera[3].tolist() == [0, 0, 0, 1]


def test_looking_by_hand() -> None:
    camera = PHOTO.looking(torch.tensor([1.0, 2.0, 3.0]), torch.tensor([5.0, 2.0, 3.0]))
    expected = torch.tensor([[0.0, 0.0, -1.0, 3.0], [0.0, 1.0, 0.0, -2.0], [1.0, 0.0, 0.0, -1.0], [0.0, 0.0, 0.0, 1.0]])
    torch.testing.assert_close(camera.world_to_camera, expected)
    for target in ((0, 0, 0), (0, 1, 0), (0, -3, 0)):  # nowhere, and straight up or down
        with pytest.raises(ValueError, match=r"coincide|along the view"):
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
    even = camera.even()
    assert (even.width - camera.width, even.height - camera.height) == (camera.width % 2, camera.height % 2)
    torch.testing.assert_close(even.K, camera.resized(even.width, even.height).K)
