"""Gaussians in a surface, the slope of a depth image, and the cleaning of depth maps."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import slanted_plane
from torch import Tensor

from spackle.bases.cleanup import attach_flying_pixels, attach_mixed_pixels, undo_quantisation
from spackle.camera import Camera
from spackle.gaussians import Gaussians, quat_to_matrix
from spackle.render.reference import project_covariances
from spackle.surface import CREASE, EDGE, RAGGED, THICKNESS, neighbours, surface_gaussians, surface_slope

PROPERTY = settings(deadline=None, max_examples=40)
SLOPES = st.floats(-0.01, 0.01)
IMAGES = st.integers(0, 2**32 - 1).flatmap(
    lambda seed: st.tuples(st.just(seed), st.integers(1, 7), st.integers(1, 7), st.sampled_from([0.001, 0.02, 0.5]))
)


def double(*values: object) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def lens(fx: float = 90, fy: float = 110) -> Camera:
    """A camera that is neither at the origin nor level nor square."""
    camera = Camera.from_focal(fx, 64, 48).to(dtype=torch.float64)
    camera.K[1, 1], camera.K[0, 2] = fy, 29.0
    return camera.looking(double(0.4, -0.3, -1.0).squeeze(0), double(0.1, 0.2, 3.0).squeeze(0))


def one_sample(camera: Camera, uv: Tensor, inverse: float, slope: tuple[float, float], spread: float) -> Gaussians:
    grey = torch.full((1, 3), 0.5, dtype=torch.float64)
    return surface_gaussians(camera, uv[None], double(inverse), double(slope), spread, grey, double(1.0))


def random_image(seed: int, height: int, width: int, roughness: float) -> Tensor:
    """Inverse depths around one, some pixels jumping by half."""
    generator = torch.Generator().manual_seed(seed)
    smooth = 1 + roughness * (torch.rand(height, width, generator=generator, dtype=torch.float64) - 0.5)
    return torch.where(torch.rand(height, width, generator=generator) < 0.2, 1.5 * smooth, smooth)


def test_a_sample_that_faces_the_camera_by_hand() -> None:
    camera = Camera.from_focal(100, 64, 48).to(dtype=torch.float64)
    found = one_sample(camera, double(42.0, 14.0).squeeze(0), 0.25, (0, 0), 0.5)
    assert found.means[0].tolist() == pytest.approx([0.4, -0.4, 4.0])
    assert found.scales[0].tolist() == pytest.approx([0.02, 0.02, THICKNESS * 0.02])
    assert quat_to_matrix(found.quats)[0, :, 2].abs().tolist() == pytest.approx([0, 0, 1], abs=1e-9)


@PROPERTY
@given(SLOPES, SLOPES, st.floats(2, 62), st.floats(2, 46), st.floats(0.1, 2), st.floats(0.2, 3))
def test_from_its_camera_every_sample_is_a_round_blob(
    sx: float, sy: float, u: float, v: float, inverse: float, spread: float
) -> None:
    camera = lens()
    found = one_sample(camera, double(u, v).squeeze(0), inverse, (sx * inverse, sy * inverse), spread)
    seen = project_covariances(found, camera, eps2d=0)[0] / spread**2
    torch.testing.assert_close(seen, torch.eye(2).double(), rtol=0, atol=0.01)  # the thickness adds a little


@PROPERTY
@given(SLOPES, SLOPES, st.floats(2, 62), st.floats(2, 46), st.floats(0.1, 2))
def test_in_space_a_sample_is_the_image_of_its_pixel_disc(
    sx: float, sy: float, u: float, v: float, inverse: float
) -> None:
    camera, spread, step = lens(), 0.7, 1e-4

    def surface(du: float, dv: float) -> Tensor:
        depth = 1 / (inverse * (1 + sx * du + sy * dv))
        return camera.unproject(double(u + du, v + dv).squeeze(0), double(depth).squeeze(0))

    found = one_sample(camera, double(u, v).squeeze(0), inverse, (sx * inverse, sy * inverse), spread)
    across = (surface(step, 0) - surface(-step, 0)) / (2 * step)
    down = (surface(0, step) - surface(0, -step)) / (2 * step)
    normal = torch.linalg.cross(across, down)
    normal = normal / normal.norm()
    thickness = THICKNESS * found.scales[0, :2].min()
    expected = spread**2 * (torch.outer(across, across) + torch.outer(down, down))
    expected += thickness**2 * torch.outer(normal, normal)
    scale = float(expected.diagonal().sum())
    torch.testing.assert_close(found.covariances()[0] / scale, expected / scale, rtol=0, atol=1e-6)
    torch.testing.assert_close(found.means[0], surface(0, 0))
    assert abs(float(quat_to_matrix(found.quats)[0, :, 2] @ normal)) == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize("axis", [0, 1])
def test_the_slope_of_a_plane_is_exact_up_to_its_border(axis: int) -> None:
    inverse = 1 / slanted_plane(1.5, 6, axis).depth.double()
    slope = surface_slope(inverse)
    step = float(inverse.diff(dim=axis).mean())
    torch.testing.assert_close(slope[..., 1 - axis], torch.full_like(inverse, step), rtol=1e-3, atol=0)
    torch.testing.assert_close(slope[..., axis], torch.zeros_like(inverse))


def test_a_slope_never_crosses_a_depth_edge() -> None:
    """A slanted box before a wall that slants the other way: each side keeps its own slope."""
    x = torch.arange(20, dtype=torch.float64)
    near, far = 1.0 + 0.004 * x, 0.3 - 0.001 * x
    for inverse in (torch.where(x < 10, near, far), torch.where(x < 10, far, near)):
        expected = torch.where((inverse > 0.5), 0.004, -0.001).double()
        slope = surface_slope(inverse.expand(3, 20))
        torch.testing.assert_close(slope[..., 0], expected.expand(3, 20))
        assert not slope[..., 1].any()
        down = surface_slope(inverse[:, None].expand(20, 3))
        torch.testing.assert_close(down[..., 1], expected[:, None].expand(20, 3))
    ragged = torch.where(torch.arange(20) < 10, 1.0 + 0.009 * torch.arange(20), 0.3).expand(3, 20)
    slope = surface_slope(ragged)  # a steep slope that one side alone confirms would stand out as a whisker
    assert (slope[:, :9, 0] > 0).all()
    assert not slope[:, 9, 0].any()
    lone = torch.ones(5, 5)
    lone[2, 2] = 2.0
    assert not surface_slope(lone).any()


def plain_slope(row: list[float]) -> list[float]:
    """The slope along one row, one pixel at a time."""
    slopes, last = [], len(row) - 1
    for k, here in enumerate(row):
        if last == 0:
            slopes.append(0.0)
            continue
        backward = here - row[k - 1] if k > 0 else row[1] - row[0]
        forward = row[k + 1] - here if k < last else row[last] - row[last - 1]
        slope, steepest = (backward + forward) / 2, EDGE
        if abs(forward - backward) > CREASE * here:
            slope, steepest = backward if abs(backward) < abs(forward) else forward, RAGGED
        slopes.append(slope if abs(slope) <= steepest * here else 0.0)
    return slopes


@PROPERTY
@given(IMAGES)
def test_slopes_match_a_plain_loop(image: tuple[int, int, int, float]) -> None:
    inverse = random_image(*image)
    across = torch.tensor([plain_slope(row.tolist()) for row in inverse], dtype=torch.float64)
    down = torch.tensor([plain_slope(column.tolist()) for column in inverse.T], dtype=torch.float64).T
    torch.testing.assert_close(surface_slope(inverse), torch.stack([across, down], dim=-1), rtol=0, atol=1e-12)


def test_neighbours_continue_numbers_linearly_and_end_masks() -> None:
    before, after = neighbours(torch.tensor([[1.0, 3.0, 4.0]]), axis=1)
    assert before.tolist() == [[-1, 1, 3]]
    assert after.tolist() == [[3, 4, 5]]
    before, after = neighbours(torch.tensor([[True], [True], [False]]), axis=0)
    assert before.squeeze().tolist() == [False, True, True]
    assert after.squeeze().tolist() == [True, False, False]
    for axis in (0, 1):
        one = neighbours(torch.tensor([[7.0]]), axis)
        assert [n.item() for n in one] == [7, 7]
        mask = neighbours(torch.tensor([[True]]), axis)
        assert [n.item() for n in mask] == [False, False]


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize(("hanging", "side"), [(0.7, 1.0), (0.5, 0.2), (0.95, 1.0), (0.21, 0.2)])
def test_a_flying_pixel_joins_the_nearer_side(hanging: float, side: float, turned: bool) -> None:
    row = torch.tensor([1.0, 1.0, 1.0, hanging, 0.2, 0.2, 0.2])
    expected = torch.where(row == hanging, side, row) if abs(hanging - side) > EDGE * hanging else row
    image, clean = row.expand(5, 7), expected.expand(5, 7)
    found = attach_flying_pixels(image.T.contiguous() if turned else image)
    assert torch.equal(found, clean.T if turned else clean)


def test_clean_edges_thin_things_borders_and_flat_walls_do_not_fly() -> None:
    """A pixel at the border has no neighbour on one side, so it cannot lie between two."""
    rows = [[1.0, 1.0, 0.2, 0.2], [0.2, 0.2, 1.0, 0.2, 0.2], [1.0, 1.0, 0.2, 1.0, 1.0], [0.5] * 4, [0.5]]
    rows += [[1.0, 0.2, 0.2, 0.2], [0.2, 1.0, 1.0, 1.0]]
    for row in [*rows, *(row[::-1] for row in rows)]:
        image = torch.tensor(row).expand(4, len(row))
        assert torch.equal(attach_flying_pixels(image), image)
        assert torch.equal(attach_flying_pixels(image.T), image.T)


@pytest.mark.parametrize("axis", [0, 1])
def test_no_pixel_of_a_plane_flies_however_slanted(axis: int) -> None:
    """Near the horizon each row of a floor is much farther than the one below it, and yet one surface."""
    inverse = 1 / slanted_plane(1.5, 1000, axis, width=40, height=30).depth
    torch.testing.assert_close(attach_flying_pixels(inverse), inverse, rtol=1e-5, atol=0)


def silhouette(color: float) -> tuple[Tensor, Tensor]:
    """A white near side, a black far side, and a pixel of some grey on the far side of the edge."""
    inverse = torch.tensor([1.0, 1.0, 1.0, 0.2, 0.2, 0.2, 0.2])
    shade = torch.tensor([1.0, 1.0, 1.0, color, 0.0, 0.0, 0.0])
    return inverse.expand(5, 7), shade[None, :, None].expand(5, 7, 3)


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("flipped", [False, True])
@pytest.mark.parametrize(("color", "moves"), [(0.8, True), (0.55, True), (0.45, False), (0.0, False)])
def test_a_mixed_pixel_goes_where_its_colour_belongs(color: float, moves: bool, turned: bool, flipped: bool) -> None:
    inverse, rgb = silhouette(color)
    expected = inverse.clone()
    expected[:, 3] = 1.0 if moves else 0.2
    if flipped:
        inverse, rgb, expected = inverse.flip(1), rgb.flip(1), expected.flip(1)
    if turned:
        inverse, rgb, expected = inverse.T, rgb.transpose(0, 1), expected.T
    assert torch.equal(attach_mixed_pixels(inverse, rgb), expected)


@PROPERTY
@given(IMAGES)
def test_a_mixed_pixel_only_comes_nearer_and_only_at_an_edge(image: tuple[int, int, int, float]) -> None:
    inverse = random_image(*image)
    rgb = torch.rand(*inverse.shape, 3, generator=torch.Generator().manual_seed(image[0]), dtype=torch.float64)
    found = attach_mixed_pixels(inverse, rgb)
    assert bool((found >= inverse).all())
    assert bool((found - inverse > EDGE * inverse)[found != inverse].all())
    assert set(found.flatten().tolist()) <= set(inverse.flatten().tolist())


def staircase(slope_px: float, quantum: float = 0.01) -> tuple[Tensor, Tensor]:
    """A slanted plane, and what is left of it when its inverse depths are rounded."""
    exact = (0.3 + slope_px * quantum * torch.arange(90)).expand(24, 90)
    return exact, (exact / quantum).round() * quantum


@pytest.mark.parametrize("slope_px", [0.05, 0.1, 0.37])
def test_rounding_is_undone_on_a_plane(slope_px: float) -> None:
    quantum = 0.01
    exact, stored = staircase(slope_px, quantum)
    found = undo_quantisation(stored, torch.ones_like(stored, dtype=torch.bool), quantum)
    middle = slice(15, -15)  # the outermost stairs have a neighbour on one side only

    def rms(image: Tensor) -> float:
        return math.sqrt(float((image - exact)[:, middle].square().mean()))

    assert rms(stored) > 0.25 * quantum
    assert rms(found) < 0.12 * quantum
    assert float(found.diff(dim=1)[:, middle].max()) < 0.5 * quantum


def test_steps_of_several_quanta_stay_and_unknown_pixels_do_not_pull() -> None:
    edge = torch.tensor([0.5] * 6 + [0.45] * 6).expand(4, 12)
    assert torch.allclose(undo_quantisation(edge, torch.ones(4, 12, dtype=torch.bool), 0.01), edge, atol=1e-6)
    stored, valid = torch.full((4, 9), 0.5), torch.ones(4, 9, dtype=torch.bool)
    stored[:, 4], valid[:, 4] = 0.49, False
    torch.testing.assert_close(undo_quantisation(stored, valid, 0.01), stored, rtol=0, atol=1e-6)


@PROPERTY
@given(IMAGES, st.floats(0.001, 0.1))
def test_what_was_rounded_still_rounds_to_the_same_step(image: tuple[int, int, int, float], quantum: float) -> None:
    stored = (random_image(*image).float() / quantum).round() * quantum
    valid = torch.rand(stored.shape, generator=torch.Generator().manual_seed(image[0])) < 0.8
    found = undo_quantisation(stored, valid, quantum, sweeps=30)
    assert float((found - stored).abs().max()) <= quantum / 2 * (1 + 1e-4)
    assert torch.equal(found[~valid], stored[~valid])
