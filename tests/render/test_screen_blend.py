"""Gaussians that are given in the image, against plain Python and against the CPU renderer."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers.plain_cleanup import uncompiled
from helpers.scenes import psnr

from spackle.core.camera import Camera
from spackle.core.color import linear_to_srgb
from spackle.core.surfels import make_surfels
from spackle.render import CpuRenderer, screen_blend
from spackle.render.screen_blend import blend_screen_gaussians


@pytest.mark.parametrize("seed", [1, 2])
def test_the_compiled_kernel_agrees_with_plain_python(seed: int) -> None:
    rng = np.random.default_rng(seed)
    spots = (rng.random((40, 5)) * [17, 15, 2, 2, 0.5] + [0, 0, 0.4, 0.4, 0.4]).astype(np.float32)
    colors = torch.from_numpy(spots[:, 2:] / 3)
    compiled = blend_screen_gaussians(spots, colors, 15, 17).numpy()
    assert compiled.any()
    with uncompiled(screen_blend):
        plain = blend_screen_gaussians(spots, colors, 15, 17).numpy()
    np.testing.assert_allclose(compiled, plain, rtol=2e-3, atol=2e-4)


def test_the_picture_is_that_of_the_renderer() -> None:
    torch.manual_seed(0)
    n = 300
    camera = Camera.from_focal(40, 40, 300)  # more rows than one thread takes
    uv = torch.rand(n, 2) * torch.tensor([44, 308]) - 4
    sigma = 0.4 + 3 * torch.rand(n, 2)
    inverse_depth = (0.2 + torch.rand(n)).sort(descending=True).values
    opacity = 0.2 + 0.79 * torch.rand(n)
    colors = torch.rand(n, 3)
    spots = torch.cat([uv, sigma, opacity[:, None]], 1).numpy()
    blended = blend_screen_gaussians(spots, colors, 300, 40)
    gaussians = make_surfels(camera, uv, inverse_depth, torch.zeros(n, 2), sigma, colors, opacity)
    assert psnr(linear_to_srgb(blended), CpuRenderer().render(gaussians, camera).rgb) > 50
