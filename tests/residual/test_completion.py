"""The paper's method for one view, compared with eqs. 2 to 9 written cell by cell."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from helpers.holes import CPU, random_network
from helpers.scenes import away, box_before_wall, shifted
from torch import Tensor

from spackle.core.camera import Camera
from spackle.core.color import linear_to_srgb, srgb_to_linear
from spackle.core.gaussians import Gaussians
from spackle.core.surfels import make_surfels
from spackle.core.trajectories import DepthRange, leftmost_and_rightmost
from spackle.render.protocol import Rendering
from spackle.render.reference import ReferenceRenderer
from spackle.residual import InitialGaussians, ResidualNet, ViewFeatures, complete_view, initialize
from spackle.residual.architectures import open_residual
from spackle.residual.completion import compose
from spackle.residual.network import COLOR_MARGIN, DELTA_CHANNELS, find_rim, network_input

R = ReferenceRenderer()


def logit(p: float) -> float:
    p = min(max(p, 1 / 512), 1 - 1 / 1024)
    return math.log(p / (1 - p))


def sigmoid(x: float) -> float:
    return 1 / (1 + math.exp(-x))


def augmented(
    seeds: InitialGaussians, row: int, column: int, delta: list[float], camera: Camera
) -> Gaussians:
    """g_i of eq. 5: the base values of a cell plus the deltas, composed as in SHARP."""
    u, v = (float(x) + d for x, d in zip(seeds.uv[row, column], delta[:2], strict=True))
    relative = float(seeds.inverse_depth[row, column]) / seeds.unit
    inverse = seeds.unit * math.log1p(
        math.expm1(relative) * math.exp(0.1 * delta[2])
    )  # softplus(softplus⁻¹ + δ)
    rgb = [
        sigmoid(logit(float(c)) + d)
        for c, d in zip(seeds.rgb[row, column], delta[10:13], strict=True)
    ]
    opacity = sigmoid(logit(0.99) + delta[13])
    surfel = make_surfels(
        camera, torch.tensor([[u, v]]), torch.tensor([inverse]), seeds.slope[row, column][None], 1.3,
        srgb_to_linear(torch.tensor([rgb])), torch.tensor([opacity]),
    )  # fmt: skip
    # A scale grows by a sigmoid from 1/4 to 4 whose value and slope at zero are one.
    factors = [
        0.25 + 3.75 * sigmoid(d * 3.75 / (0.75 * 3) + math.log(0.75 / 3)) for d in delta[3:6]
    ]
    quats = surfel.quats + 0.1 * torch.tensor([delta[6:10]])
    return Gaussians(
        surfel.means,
        quats,
        surfel.scales * torch.tensor([factors]),
        surfel.opacities,
        surfel.colors,
    )


def paper(
    base: Gaussians, camera: Camera, photo: Camera, f_res: ResidualNet
) -> tuple[Gaussians, Rendering]:
    """𝒢̃_aug(v), and the final view."""
    view = R.render(base, camera)  # eqs. 2 and 3
    holes = [[float(a) < 0.95 for a in row] for row in view.alpha]  # eq. 4
    features = ViewFeatures.of(view)
    seeds = initialize(features, camera, photo)
    deltas: Tensor = f_res(
        network_input(features, seeds, find_rim(features, seeds, camera, photo)[0])
    )[0]  # eq. 5
    chosen = []
    for row in range(deltas.shape[1]):
        for column in range(deltas.shape[2]):
            if holes[2 * row][2 * column]:  # eq. 7, on a grid of every second pixel
                chosen.append(
                    augmented(seeds, row, column, deltas[:, row, column].tolist(), camera)
                )
    aux = Gaussians.cat(chosen)
    return aux, R.render(Gaussians.cat([base, aux]), camera)  # eqs. 8 and 9


@pytest.mark.parametrize("size", [(48, 36), (47, 35)])
def test_a_completed_view_matches_the_equations(size: tuple[int, int]) -> None:
    scene = box_before_wall(width=size[0], height=size[1], focal=40)
    base, network = scene.base(), random_network()
    camera = leftmost_and_rightmost(scene.camera, 0.3, DepthRange.of(base))[1]
    aux = complete_view(base, camera, scene.camera, CPU, network, precision="fp32")
    with torch.no_grad():
        expected, final = paper(base, camera, scene.camera, network)
    assert len(aux) == len(expected) > 100
    for name in ("means", "quats", "scales", "opacities", "colors"):
        one, other = (getattr(part, name).view(len(aux), -1) for part in (aux, expected))
        same = torch.isclose(one, other, rtol=2e-3, atol=2e-3).all(-1).float().mean()
        # The rotation of a circular Gaussian depends on the last bit.
        assert float(same) > (0.95 if name == "quats" else 0.999), name
    found = CPU.render([base, aux], camera)
    assert float((found.rgb - final.rgb).abs().mean()) < 1e-3
    assert float((found.alpha - final.alpha).abs().mean()) < 1e-3


def test_the_least_number_of_gaussians() -> None:
    scene = box_before_wall(width=96, height=72)
    base = scene.base()
    for network in (None, random_network()):
        assert len(complete_view(base, scene.camera, scene.camera, CPU, network, least=64)) == 64


@pytest.mark.parametrize("name", ["unet", "sharp-decoder"])
def test_no_holes_give_nothing_and_no_network_the_seeds(name: str) -> None:
    scene = box_before_wall(width=48, height=36, focal=40)
    base = scene.base()
    assert len(complete_view(base, scene.camera, scene.camera, CPU, None)) == 0
    camera = away(scene.camera)
    seeds, untrained = (
        complete_view(base, camera, scene.camera, CPU, f_res)
        for f_res in (None, open_residual(name))
    )
    assert len(seeds) == 24 * 18  # all cells
    torch.testing.assert_close(seeds.means, untrained.means, rtol=1e-3, atol=1e-3)


VIEW = shifted(Camera.from_focal(60, 64, 48), 0.4)
DRAWN = torch.rand(20, 8, generator=torch.Generator().manual_seed(0))
UV = DRAWN[:, :2] * torch.tensor([64.0, 48.0])
SEEDS = InitialGaussians(
    UV, 0.1 + DRAWN[:, 2], 0.01 * (DRAWN[:, 3:5] - 0.5), 0.1 + 0.8 * DRAWN[:, 5:]
)
BEFORE = compose(SEEDS, None, VIEW)


def test_zero_deltas_give_the_seeds() -> None:
    zeros = torch.zeros(20, DELTA_CHANNELS)
    for one, other in zip(BEFORE.tensors, compose(SEEDS, zeros, VIEW).tensors, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-5)
    uv, z = VIEW.project(BEFORE.means)
    torch.testing.assert_close(uv, SEEDS.uv, rtol=0, atol=1e-3)
    torch.testing.assert_close(z, 1 / SEEDS.inverse_depth)
    torch.testing.assert_close(linear_to_srgb(BEFORE.colors), SEEDS.rgb)
    assert len(compose(SEEDS.select(torch.zeros(20, dtype=torch.bool)), zeros[:0], VIEW)) == 0
    extremes = dataclasses.replace(SEEDS, rgb=(DRAWN[:, 5:] > 0.5).float())  # black and white
    found = linear_to_srgb(compose(extremes, zeros, VIEW).colors)
    assert (
        float((found - extremes.rgb).abs().max()) <= COLOR_MARGIN * 1.01
    )  # within one step of 8-bit colour


@pytest.mark.parametrize("by", [-1e4, -20.0, -1.0, 1.0, 20.0, 1e4])
def test_deltas_keep_bounds(by: float) -> None:
    deltas = torch.zeros(20, DELTA_CHANNELS)
    deltas[:, 2] = deltas[:, 10:] = by
    after = compose(SEEDS, deltas, VIEW)
    _, z = VIEW.project(after.means)
    assert float(z.min()) > 0  # never behind the camera
    assert bool(
        ((z < 1 / SEEDS.inverse_depth) == (by > 0)).all()
    )  # a larger inverse depth is nearer
    for one, other in ((BEFORE.colors, after.colors), (BEFORE.opacities, after.opacities)):
        assert 0 <= float(other.min()) <= float(other.max()) <= 1
        assert bool(((other > one) == (by > 0)).all())
