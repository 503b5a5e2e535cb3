"""Cameras: projection, viewing direction, resizing, and refusals."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from spackle.core.camera import Camera, look_at

PROPERTY = settings(deadline=None, max_examples=40)
COORDINATES = st.tuples(*[st.floats(-5, 5)] * 3)
PHOTO = Camera.from_focal(100, 200, 100)


@st.composite
def cameras(draw: st.DrawFn) -> Camera:
    """Any intrinsics and position; the view is not vertical."""
    eye, target = (torch.tensor(draw(COORDINATES), dtype=torch.float64) for _ in range(2))
    across = target - eye
    assume(float(across[[0, 2]].norm()) > max(0.1, 0.05 * float(across.norm())))
    camera = Camera.from_focal(
        draw(st.floats(5, 2000)), draw(st.integers(1, 500)), draw(st.integers(1, 500))
    )
    camera.K[0, 2] += draw(st.floats(-50, 50))
    camera.K[1, 1] *= draw(st.floats(0.8, 1.2))
    return camera.to(dtype=torch.float64).looking(eye, target)


def test_impossible_cameras_are_refused() -> None:
    wrong: dict[str, Any] = {
        "K": torch.zeros(4, 4),
        "world_to_camera": torch.zeros(3, 4),
        "width": 0,
    }
    for name, value in wrong.items():
        with pytest.raises(ValueError, match=r"Camera\.K|Camera\.world_to_camera|empty"):
            dataclasses.replace(PHOTO, **{name: value})
    for focal in (0, math.nan, math.inf):
        with pytest.raises(ValueError, match="focal"):
            Camera.from_focal(focal, 4, 4)


def test_projection_by_hand() -> None:
    uv, z = PHOTO.project(
        torch.tensor([[1.0, -0.5, 2.0], [0.0, 0.0, 7.0], [0.0, 0.0, -2.0], [1.0, 0.0, 0.0]])
    )
    assert uv[:3].tolist() == [[150.0, 25.0], [100.0, 50.0], [100.0, 50.0]]
    assert z.tolist() == [2.0, 7.0, -2.0, 0.0]
    assert float(uv[3, 0]) == math.inf
    assert PHOTO.unproject(torch.tensor([150.0, 25.0]), torch.tensor(2.0)).tolist() == [
        1.0,
        -0.5,
        2.0,
    ]
    centers = Camera.from_focal(10, 5, 3).pixel_centers()
    assert (centers.shape, centers[0, 0].tolist(), centers[2, 4].tolist()) == (
        (3, 5, 2),
        [0.5, 0.5],
        [4.5, 2.5],
    )
    assert Camera.from_focal(10, 5, 3).pixel_centers(stride=2).tolist() == [
        [[1.0, 1.0], [3.0, 1.0]]
    ]


@PROPERTY
@given(cameras(), COORDINATES, st.tuples(*[st.floats(-300, 800)] * 2), *[st.integers(1, 700)] * 2)
def test_unprojection_inverts_projection_and_resizing_scales_pixels(
    camera: Camera, point: tuple[float, ...], pixel: tuple[float, float], width: int, height: int
) -> None:
    uv, z = camera.project(
        camera.unproject(torch.tensor(pixel).double(), torch.tensor(2.5).double())
    )
    assert [*uv.tolist(), float(z)] == pytest.approx([*pixel, 2.5], rel=1e-6, abs=1e-5)
    world = torch.tensor(point, dtype=torch.float64)
    uv, z = camera.project(world)
    assume(abs(float(z)) > 1e-2)
    torch.testing.assert_close(camera.unproject(uv, z), world, rtol=1e-6, atol=1e-6)
    resized, even = camera.resized(width, height), camera.even()
    factors = torch.tensor([width / camera.width, height / camera.height], dtype=torch.float64)
    torch.testing.assert_close(resized.project(world)[0], uv * factors, rtol=1e-6, atol=1e-6)
    assert (resized.width, resized.height) == (width, height)
    assert (even.width - camera.width, even.height - camera.height) == (
        camera.width % 2,
        camera.height % 2,
    )


@PROPERTY
@given(*[COORDINATES] * 3)
def test_look_at_puts_the_target_on_the_axis_and_up_upwards(eye: Any, target: Any, up: Any) -> None:
    try:
        matrix = look_at(
            *(torch.tensor(part, dtype=torch.float64) for part in (eye, target, up))
        ).numpy()
    except ValueError:
        return
    rotation, distance = matrix[:3, :3], math.dist(eye, target)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(rotation) > 0
    assert matrix @ [*target, 1] == pytest.approx([0, 0, distance, 1], abs=1e-8 * max(1, distance))
    assert (rotation @ up)[0] == pytest.approx(0, abs=1e-8)
    assert (rotation @ up)[1] < 0  # y points down
