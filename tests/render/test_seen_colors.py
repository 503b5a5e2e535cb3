"""The kernel of the colours that a camera sees, against the formula."""

from __future__ import annotations

import pytest
import torch
from helpers.scenes import random_gaussians, random_harmonics, turned_camera

from spackle.core.spherical_harmonics import harmonics_of
from spackle.core.view_colors import extended_linear_to_srgb, extended_srgb_to_linear
from spackle.render.view_colors import seen_colors

CAMERA = turned_camera(40, 30, 40.0)


@pytest.mark.parametrize("degree", [1, 2, 3])
@pytest.mark.parametrize("wide", [False, True])
def test_the_kernel_gives_the_formula(degree: int, wide: bool) -> None:
    some = random_gaussians(500)
    harmonics = random_harmonics(500, degree)
    # Inside of 0..1, and also outside of it.
    colors = some.colors * 3 - 1 if wide else some.colors
    found = seen_colors(some.means, colors, harmonics, CAMERA)
    # Step by step, in float64: the direction from the camera to the Gaussian, in the world.
    offsets = some.means.double() - CAMERA.position.double()
    directions = offsets / offsets.norm(dim=1, keepdim=True)
    values = harmonics_of(directions, degree)
    change = (values[:, :, None] * harmonics.double()).sum(1)
    srgb = extended_linear_to_srgb(colors.double()) + change
    expected = extended_srgb_to_linear(srgb.clamp_min(0))
    torch.testing.assert_close(found.double(), expected, rtol=2e-5, atol=2e-6)
    assert float(found.min()) == 0
    double = seen_colors(some.means.double(), colors.double(), harmonics.double(), CAMERA)
    torch.testing.assert_close(double, expected, rtol=1e-12, atol=1e-12)


def test_gradients_reach_centres_colours_and_harmonics() -> None:
    some = random_gaussians(4, dtype=torch.float64)
    harmonics = 0.2 * random_harmonics(4, 3).double()
    inputs = [t.clone().requires_grad_() for t in (some.means, 0.3 + 0.5 * some.colors, harmonics)]
    assert torch.autograd.gradcheck(lambda *tensors: seen_colors(*tensors, CAMERA), inputs)
    # Zero coefficients change no bit of a colour, but learn.
    colors, zeros = some.colors.float().requires_grad_(), torch.zeros(4, 15, 3).requires_grad_()
    seen = seen_colors(some.means.float(), colors, zeros, CAMERA)
    assert torch.equal(seen, colors)
    seen.sum().backward()
    assert zeros.grad is not None
    assert colors.grad is not None
    assert bool((zeros.grad.abs().amax(dim=(1, 2)) > 1e-3).all())
    torch.testing.assert_close(colors.grad, torch.ones(4, 3), rtol=1e-4, atol=1e-4)


def test_coefficients_that_are_not_finite_give_no_colour() -> None:
    some, harmonics = random_gaussians(3), random_harmonics(3, 1)
    harmonics[0, 1, 2] = torch.nan
    harmonics[1, 0, 0] = -torch.inf
    for dtype in (torch.float32, torch.float64):
        fields = (some.means.to(dtype), some.colors.to(dtype), harmonics.to(dtype))
        seen = seen_colors(*fields, CAMERA)
        assert bool(seen[0, 2].isnan())
        assert bool(seen[1, 0].isnan())
        assert bool(seen[2].isfinite().all())
