"""Occlusion guards move aux Gaussians behind the surfaces that other views show."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import torch
from helpers.scenes import away, shifted
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from spackle.core.camera import Camera
from spackle.core.gaussians import Gaussians
from spackle.core.surfels import BEHIND_SURFACE_RATIO
from spackle.scene_fill import OcclusionGuard
from spackle.scene_fill.occlusion_guard import (
    DEPTH_STEPS,
    MAX_REACH_PX,
    PIT_RADIUS_WIDTHS,
    VISIBLE_SIGMAS,
    WINDOW_RADIUS_PX,
    move_behind_surfaces,
    without_pits,
)  # fmt: skip

PROPERTY = settings(deadline=None, max_examples=20)
SEEDS = st.integers(0, 2**32 - 1)


def plain_push(
    aux: Gaussians, eye: Tensor, guards: Sequence[OcclusionGuard]
) -> tuple[list[float], list[int]]:
    """The factors and indices of the Gaussians that `move_behind_surfaces` keeps, in plain
    Python.
    """

    def blocked(point: Tensor, covariance: Tensor) -> bool:
        for guard in guards:
            camera = guard.camera.to(dtype=torch.float64)
            local, (uv, z) = camera.to_camera(point), camera.project(point)
            if float(z) <= 0:
                continue
            rotation = camera.world_to_camera[:3, :3]
            spread = rotation @ covariance @ rotation.T
            reach = []
            for axis in (0, 1):
                row = torch.zeros(3, dtype=torch.float64)
                row[axis], row[2] = 1 / z, -local[axis] / z**2
                deviation = float(camera.K[axis, axis] * (row @ spread @ row).clamp_min(0).sqrt())
                reach.append(min(VISIBLE_SIGMAS * deviation + 1, MAX_REACH_PX))
            (u, v), (height, width) = uv.tolist(), guard.depth.shape
            if not (-reach[0] <= u <= width + reach[0] and -reach[1] <= v <= height + reach[1]):
                continue
            across, down = (
                math.ceil(max(r - WINDOW_RADIUS_PX, 0) / (2 * WINDOW_RADIUS_PX)) for r in reach
            )
            for j, i in itertools.product(range(-down, down + 1), range(-across, across + 1)):
                row_ = math.floor(v + 2 * WINDOW_RADIUS_PX * j)
                column = math.floor(u + 2 * WINDOW_RADIUS_PX * i)
                seen = guard.depth[min(max(row_, 0), height - 1), min(max(column, 0), width - 1)]
                if float(z) < float(seen) * (1 + BEHIND_SURFACE_RATIO):
                    return True
        return False

    factors, kept = [], []
    covariances = aux.covariances().double()
    for index, mean in enumerate(aux.means.double()):
        for step in range(DEPTH_STEPS):
            factor = 1 / (1 - step / DEPTH_STEPS)
            if not blocked(
                eye.double() + factor * (mean - eye.double()), factor**2 * covariances[index]
            ):
                factors.append(factor)
                kept.append(index)
                break
    return factors, kept


def random_aux(count: int, seed: int) -> Gaussians:
    """Random Gaussians around the origin."""
    generator = torch.Generator().manual_seed(seed)
    means = 6 * torch.randn(count, 3, generator=generator)
    quats, drawn = (
        torch.randn(count, 4, generator=generator),
        torch.rand(count, 7, generator=generator),
    )
    return Gaussians(means, quats, drawn[:, :3], drawn[:, 3], drawn[:, 4:])


@PROPERTY
@given(SEEDS)
def test_pushing_matches_a_plain_loop(seed: int) -> None:
    aux, generator = random_aux(30, seed), torch.Generator().manual_seed(seed)
    camera = Camera.from_focal(20, 16, 12)
    cameras = [camera, shifted(camera, 1.5), away(camera)]
    depths = [8 * torch.rand(12, 16, generator=generator) for _ in cameras]
    guards = [OcclusionGuard(c, d * (d > 3)) for c, d in zip(cameras, depths, strict=True)]
    eye = torch.randn(3, generator=generator)
    factors, kept = plain_push(aux, eye, guards)
    found, factor = move_behind_surfaces(aux, eye, guards), torch.tensor(factors)[:, None]
    assert len(found) == len(kept)
    torch.testing.assert_close(
        found.means, eye + factor * (aux.means[kept] - eye), rtol=1e-4, atol=1e-4
    )
    torch.testing.assert_close(found.scales, aux.scales[kept] * factor, rtol=1e-4, atol=0)
    for name in ("quats", "opacities", "colors"):
        assert torch.equal(getattr(found, name), getattr(aux, name)[kept])


@PROPERTY
@given(SEEDS, st.floats(0.2, 1))
def test_closing_of_depths_matches_a_plain_loop(seed: int, share: float) -> None:
    generator = torch.Generator().manual_seed(seed)
    depth, cells = (
        1 + torch.rand(9, 75, generator=generator),
        torch.rand(9, 75, generator=generator) < share,
    )
    cells[0, 0] = True
    found, places = without_pits(depth[cells], cells), cells.nonzero()
    near = (places[:, None] - places).abs().amax(-1) <= round(75 * PIT_RADIUS_WIDTHS)
    farthest = torch.where(near, depth[cells], 0).amax(1)
    assert torch.equal(found, torch.where(near, farthest, torch.inf).amin(1))
    assert (found >= depth[cells]).all()
