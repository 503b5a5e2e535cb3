"""Gaussians in a surface, and the slope of a depth image."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from spackle.core.camera import Camera
from spackle.core.gaussians import Gaussians, quat_to_matrix
from spackle.core.surfels import (
    CREASE_RATIO,
    DEPTH_EDGE_RATIO,
    SURFEL_THICKNESS_RATIO,
    inverse_depth_slope,
    make_surfels,
)

PROPERTY = settings(deadline=None, max_examples=40)
SLOPES = st.floats(-0.01, 0.01)
IMAGES = st.integers(0, 2**32 - 1).flatmap(
    lambda seed: st.tuples(
        st.just(seed), st.integers(1, 7), st.integers(1, 7), st.sampled_from([0.001, 0.02, 0.5])
    )
)


def double(*values: object) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def lens(fx: float = 90, fy: float = 110) -> Camera:
    """A camera that is neither at the origin nor level nor square."""
    camera = Camera.from_focal(fx, 64, 48).to(dtype=torch.float64)
    camera.K[1, 1], camera.K[0, 2] = fy, 29.0
    return camera.looking(double(0.4, -0.3, -1.0).squeeze(0), double(0.1, 0.2, 3.0).squeeze(0))


def one_sample(
    camera: Camera, uv: Tensor, inverse: float, slope: tuple[float, float], spread: float
) -> Gaussians:
    grey = torch.full((1, 3), 0.5, dtype=torch.float64)
    return make_surfels(camera, uv[None], double(inverse), double(slope), spread, grey, double(1.0))


def random_image(seed: int, height: int, width: int, roughness: float) -> Tensor:
    """Inverse depths around one, some pixels jumping by half."""
    generator = torch.Generator().manual_seed(seed)
    smooth = 1 + roughness * (
        torch.rand(height, width, generator=generator, dtype=torch.float64) - 0.5
    )
    return torch.where(torch.rand(height, width, generator=generator) < 0.2, 1.5 * smooth, smooth)


@PROPERTY
@given(SLOPES, SLOPES, st.floats(2, 62), st.floats(2, 46), st.floats(0.1, 2))
def test_in_space_a_sample_is_the_image_of_its_pixel_disc(
    sx: float, sy: float, u: float, v: float, inverse: float
) -> None:
    camera, spread, step = lens(), 0.7, 1e-4

    def surface(du: float, dv: float) -> Tensor:
        depth = 1 / (inverse * (1 + sx * du + sy * dv))
        return camera.unproject(double(u + du, v + dv).squeeze(0), double(depth).squeeze(0))

    found = one_sample(
        camera, double(u, v).squeeze(0), inverse, (sx * inverse, sy * inverse), spread
    )
    across = (surface(step, 0) - surface(-step, 0)) / (2 * step)
    down = (surface(0, step) - surface(0, -step)) / (2 * step)
    normal = torch.linalg.cross(across, down)
    normal = normal / normal.norm()
    thickness = SURFEL_THICKNESS_RATIO * found.scales[0, :2].min()
    expected = spread**2 * (torch.outer(across, across) + torch.outer(down, down))
    expected += thickness**2 * torch.outer(normal, normal)
    scale = float(expected.diagonal().sum())
    torch.testing.assert_close(found.covariances()[0] / scale, expected / scale, rtol=0, atol=1e-6)
    torch.testing.assert_close(found.means[0], surface(0, 0))
    assert abs(float(quat_to_matrix(found.quats)[0, :, 2] @ normal)) == pytest.approx(1, abs=1e-6)


def plain_slope(row: list[float]) -> list[float]:
    """The slope along one row, one pixel at a time."""
    slopes, last = [], len(row) - 1
    for k, here in enumerate(row):
        if last == 0:
            slopes.append(0.0)
            continue
        backward = here - row[k - 1] if k > 0 else row[1] - row[0]
        forward = row[k + 1] - here if k < last else row[last] - row[last - 1]
        slope, steepest = (backward + forward) / 2, DEPTH_EDGE_RATIO
        if abs(forward - backward) > CREASE_RATIO * here:
            slope, steepest = backward if abs(backward) < abs(forward) else forward, CREASE_RATIO
        slopes.append(slope if abs(slope) <= steepest * here else 0.0)
    return slopes


@PROPERTY
@given(IMAGES)
def test_slopes_match_a_plain_loop(image: tuple[int, int, int, float]) -> None:
    inverse = random_image(*image)
    across = torch.tensor([plain_slope(row.tolist()) for row in inverse], dtype=torch.float64)
    down = torch.tensor(
        [plain_slope(column.tolist()) for column in inverse.T], dtype=torch.float64
    ).T
    torch.testing.assert_close(
        inverse_depth_slope(inverse), torch.stack([across, down], dim=-1), rtol=0, atol=1e-12
    )
