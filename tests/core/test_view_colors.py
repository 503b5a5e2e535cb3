"""Colours that change with the view, against Legendre's functions and numbers of gsplat."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch
from helpers.scenes import random_gaussians, random_harmonics, same_bits
from torch import Tensor

from spackle.core.color import (
    extended_linear_to_srgb,
    extended_srgb_to_linear,
    linear_to_srgb,
    srgb_to_linear,
)
from spackle.core.gaussians import Gaussians, quat_to_matrix
from spackle.core.spherical_harmonics import HARMONICS_COUNTS, harmonics_of, rotate_harmonics
from spackle.core.view_colors import (
    changed_colors,
    color_change,
    view_colors,
)

PLACE = torch.tensor([0.3, -0.4, -0.5])


def unit_vectors(count: int, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.nn.functional.normalize(
        torch.randn(count, 3, generator=generator, dtype=torch.float64), dim=-1
    )


def legendre(degree: int, order: int, t: np.ndarray) -> np.ndarray:
    """The associated Legendre function P with the phase (-1)^m, from derivatives of (t² - 1)^l."""
    polynomial = np.polynomial.Polynomial([-1, 0, 1]) ** degree
    derivative = polynomial.deriv(degree + order)
    factor = (-1) ** order / (2**degree * math.factorial(degree))
    return factor * (1 - t * t) ** (order / 2) * derivative(t)


def harmonic(degree: int, order: int, directions: Tensor) -> np.ndarray:
    """The real spherical harmonic of a degree and an order from -degree to degree."""
    x, y, z = directions.numpy().T
    angle = np.arctan2(y, x)
    m = abs(order)
    ratio = math.factorial(degree - m) / math.factorial(degree + m)
    norm = math.sqrt((2 * degree + 1) / (4 * math.pi) * ratio)
    values = norm * legendre(degree, m, z)
    if order == 0:
        return values
    return math.sqrt(2) * values * (np.sin(m * angle) if order < 0 else np.cos(m * angle))


def test_harmonics_are_those_of_legendres_functions() -> None:
    directions = unit_vectors(200)
    expected = [
        harmonic(degree, order, directions)
        for degree in (1, 2, 3)
        for order in range(-degree, degree + 1)
    ]
    for degree in (1, 2, 3):
        found = harmonics_of(directions, degree)
        np.testing.assert_allclose(
            found.numpy().T, expected[: HARMONICS_COUNTS[degree]], rtol=0, atol=1e-13
        )


def test_harmonics_have_gsplats_numbers() -> None:
    # `spherical_harmonics` of gsplat 1.5.3 at this direction, for single coefficients of 1.
    direction = torch.tensor([[2.0, -1.0, 2.0]], dtype=torch.float64) / 3
    expected = [0.1628675, 0.32573501, -0.32573501, -0.24278854, 0.24278854, 0.10513052]
    expected += [-0.48557708, 0.18209141, 0.24038813, -0.42823873, 0.18620384, -0.19349884]
    expected += [-0.37240769, 0.32117905, -0.04370693]
    assert harmonics_of(direction, 3)[0].tolist() == pytest.approx(expected, abs=1e-6)


def test_harmonics_are_those_of_an_installed_gsplat() -> None:
    pytest.importorskip("gsplat")
    from gsplat.cuda._torch_impl import _spherical_harmonics

    direction = unit_vectors(1)
    coefficients = torch.cat([torch.zeros(15, 1), torch.eye(15)], dim=1)[..., None].repeat(1, 1, 3)
    found = _spherical_harmonics(3, direction.float().repeat(15, 1), coefficients)
    torch.testing.assert_close(found[:, 0].double(), harmonics_of(direction, 3)[0])


def turned(degree: int, matrix: Tensor) -> float:
    """How far turned functions, seen along turned directions, are from the functions themselves."""
    coefficients = random_harmonics(5, degree).double()
    directions = unit_vectors(50, seed=1)
    before = torch.einsum("dk,nkc->ndc", harmonics_of(directions, degree), coefficients)
    values = harmonics_of(directions @ matrix.T, degree)
    after = torch.einsum("dk,nkc->ndc", values, rotate_harmonics(coefficients, matrix))
    return float((before - after).abs().max())


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_turned_functions_have_the_old_values_along_turned_directions(degree: int) -> None:
    for quat in torch.randn(10, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(2)):
        rotation = quat_to_matrix(quat)
        assert turned(degree, rotation) < 1e-12
        assert turned(degree, rotation @ torch.diag(torch.tensor([1.0, -1, 1]).double())) < 1e-12


def test_half_turns_change_only_signs() -> None:
    coefficients = random_harmonics(7, 3)
    flipped = rotate_harmonics(coefficients, torch.diag(torch.tensor([1.0, -1, -1])))
    assert torch.equal(flipped.abs(), coefficients.abs())
    back = rotate_harmonics(flipped, torch.diag(torch.tensor([1.0, -1, -1])))
    assert torch.equal(back, coefficients)


def test_a_turned_scene_has_the_colours_that_a_turned_camera_sees() -> None:
    some = random_gaussians(20, dtype=torch.float64)
    some = dataclasses.replace(some, harmonics=random_harmonics(20, 3).double())
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3] = 2 * quat_to_matrix(torch.tensor([0.4, -0.3, 0.7, 0.2]).double())
    matrix[:3, 3] = torch.tensor([1.0, 2.0, -3.0])
    moved = some.transform(matrix)
    assert moved.harmonics is not None
    assert some.harmonics is not None
    place = PLACE.double()
    before = view_colors(some.means, some.colors, some.harmonics, place)
    moved_place = matrix[:3, :3] @ place + matrix[:3, 3]
    after = view_colors(moved.means, moved.colors, moved.harmonics, moved_place)
    torch.testing.assert_close(before, after, rtol=1e-9, atol=1e-9)
    assert float((before - some.colors).abs().max()) > 0.1


def test_colours_in_0_to_1_are_converted_as_everywhere() -> None:
    values = torch.linspace(0, 1, 1001)
    assert torch.equal(extended_srgb_to_linear(values), srgb_to_linear(values))
    assert torch.equal(extended_linear_to_srgb(values), linear_to_srgb(values))
    wide = torch.linspace(-3, 3, 601, dtype=torch.float64)
    back = extended_linear_to_srgb(extended_srgb_to_linear(wide))
    torch.testing.assert_close(back, wide, rtol=1e-6, atol=1e-6)  # the two knees do not quite meet


def test_sets_with_and_without_harmonics_are_joined() -> None:
    plain = random_gaussians(5, 1)
    low = dataclasses.replace(random_gaussians(3, 2), harmonics=random_harmonics(3, 1))
    high = dataclasses.replace(random_gaussians(2, 4), harmonics=random_harmonics(2, 3))
    joined = Gaussians.cat([plain, low, high])
    assert joined.harmonics_count == 15
    assert same_bits(joined.select(slice(8, 10)), high)
    assert same_bits(joined.select(slice(5, 8)).with_harmonics_count(3), low)
    assert same_bits(joined.select(slice(0, 5)).with_harmonics_count(0), plain)
    assert joined.harmonics is not None
    assert not joined.harmonics[:5].any()
    assert not joined.harmonics[5:8, 3:].any()
    assert Gaussians.cat([plain, plain]).harmonics is None
    moved = joined.to(dtype=torch.float64).scaled(2.0).detach()
    assert torch.equal(moved.harmonics, joined.harmonics.double())


@pytest.mark.parametrize("shape", [(3, 4, 3), (2, 15, 3), (3, 15), (3, 24, 3)])
def test_harmonics_of_a_wrong_shape_are_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"Gaussians\.harmonics has shape"):
        dataclasses.replace(random_gaussians(3), harmonics=torch.zeros(shape))


def test_the_formula_of_colours_is_that_of_splatting() -> None:
    # One Gaussian seen along x: Y of degree 1 are (-C1 y, C1 z, -C1 x) = (0, 0, -0.4886).
    harmonics = torch.zeros(1, 3, 3)
    harmonics[0, 2] = torch.tensor([1.0, -0.2, 0.0])
    means, colors = torch.tensor([[3.0, 0, 0]]), srgb_to_linear(torch.tensor([[0.6, 0.6, 0.6]]))
    seen = linear_to_srgb(view_colors(means, colors, harmonics, torch.zeros(3)))
    c1 = math.sqrt(3 / (4 * math.pi))
    assert seen[0].tolist() == pytest.approx([0.6 - c1, 0.6 + 0.2 * c1, 0.6], abs=1e-6)
    change = color_change(means, harmonics, torch.zeros(3))
    assert torch.equal(changed_colors(colors, change - 10), torch.zeros(1, 3))
