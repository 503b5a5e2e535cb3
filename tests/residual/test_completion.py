"""The paper's method for one view, compared with eqs. 2 to 9 written cell by cell."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from helpers.holes import CPU, box_view, random_network, view_of
from helpers.scenes import away, box_before_wall, shifted
from torch import Tensor

from spackle.core.camera import Camera
from spackle.core.color import linear_to_srgb, srgb_to_linear
from spackle.core.gaussians import Gaussians
from spackle.core.surfels import make_surfels
from spackle.core.trajectories import DepthRange, leftmost_and_rightmost
from spackle.render.protocol import Rendering
from spackle.render.reference import ReferenceRenderer
from spackle.residual import InitialGaussians, ResidualNet, ViewCompletion, complete_view
from spackle.residual.architectures import open_residual
from spackle.residual.composer import COLOR_MARGIN, DELTA_CHANNELS, compose
from spackle.residual.features import ViewFeatures
from spackle.scene_fill import fill_view

REFERENCE = ReferenceRenderer()


def logit(p: float) -> float:
    p = min(max(p, 1 / 512), 1 - 1 / 1024)
    return math.log(p / (1 - p))


def sigmoid(x: float) -> float:
    return 1 / (1 + math.exp(-x))


def augmented(
    initial: InitialGaussians, row: int, column: int, delta: list[float], camera: Camera
) -> Gaussians:
    """g_i of eq. 5: the initial Gaussian of a cell plus the deltas, composed as in SHARP."""
    u, v = (float(x) + d for x, d in zip(initial.uv[row, column], delta[:2], strict=True))
    relative = float(initial.inverse_depth[row, column]) / initial.unit
    inverse = initial.unit * math.log1p(
        math.expm1(relative) * math.exp(0.1 * delta[2])
    )  # softplus(softplus⁻¹ + δ)
    rgb = [
        sigmoid(logit(float(c)) + d)
        for c, d in zip(initial.rgb[row, column], delta[10:13], strict=True)
    ]
    opacity = sigmoid(logit(0.99) + delta[13])
    surfel = make_surfels(
        camera,
        torch.tensor([[u, v]]),
        torch.tensor([inverse]),
        initial.slope[row, column][None],
        1.3,
        srgb_to_linear(torch.tensor([rgb])),
        torch.tensor([opacity]),
    )
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
    view = REFERENCE.render(base, camera)  # eqs. 2 and 3
    holes = [[float(a) < 0.95 for a in row] for row in view.alpha]  # eq. 4
    steps = view_of(view, camera, photo)
    deltas: Tensor = f_res(steps.network_input(f_res.inputs))[0]  # eq. 5
    chosen = []
    for row in range(deltas.shape[1]):
        for column in range(deltas.shape[2]):
            if holes[2 * row][2 * column]:  # eq. 7, on a grid of every second pixel
                chosen.append(
                    augmented(steps.initial, row, column, deltas[:, row, column].tolist(), camera)
                )
    aux = Gaussians.cat(chosen)
    return aux, REFERENCE.render(Gaussians.cat([base, aux]), camera)  # eqs. 8 and 9


@pytest.mark.parametrize("size", [(48, 36), (47, 35)])
def test_a_completed_view_matches_the_equations(size: tuple[int, int]) -> None:
    scene = box_before_wall(width=size[0], height=size[1], focal=40)
    base, network = scene.base(), random_network()
    camera = leftmost_and_rightmost(scene.camera, 0.3, DepthRange.of(base, is_metric=True))[1]
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


@pytest.mark.parametrize("hole_share", [0.0, 0.1, 0.5, 1.0])
@pytest.mark.parametrize("size", [(1, 9), (7, 8), (8, 8), (14, 13)])
def test_cells_are_those_whose_first_pixel_is_a_hole_or_else_the_least_opaque(
    size: tuple[int, int], hole_share: float
) -> None:
    rows, columns = size
    generator = torch.Generator().manual_seed(rows)
    hole = torch.rand(2 * rows, 2 * columns, generator=generator) < hole_share
    # Many equal opacities, all holes below the threshold.
    steps = (4 * torch.rand(hole.shape, generator=generator)).round() / 4
    alpha = torch.where(hole, 0.9 * steps, 0.95 + 0.05 * steps)
    rendering = Rendering(torch.zeros(*hole.shape, 3), torch.ones(hole.shape), alpha)
    camera = Camera.from_focal(20, 2 * columns, 2 * rows)
    view = ViewCompletion(rendering, camera, camera)
    masked = hole[::2, ::2]
    assert torch.equal(view.cells(), masked)
    cells = view.cells(at_least=64)
    if int(masked.sum()) >= 64:
        assert torch.equal(cells, masked)
    else:
        assert int(cells.sum()) == min(64, cells.numel())
        opacity = ViewFeatures.of(rendering).alpha
        if not cells.all():
            assert opacity[cells].max() <= opacity[~cells].min()


class CountedView(ViewCompletion):
    """Notes which inputs a network asks for."""

    def __init__(self, rendering: Rendering, camera: Camera, photo_camera: Camera) -> None:
        super().__init__(rendering, camera, photo_camera, self.get_photo)
        self.asked: list[str] = []

    def get_photo(self) -> Tensor:
        self.asked.append("the photo itself")
        return torch.rand(72, 96, 3, generator=torch.Generator().manual_seed(0))

    def input(self, name: str) -> Tensor:
        self.asked.append(name)
        return super().input(name)


def test_a_network_gets_only_the_inputs_that_it_names() -> None:
    context, camera = box_view()
    rendering = CPU.render(context.base, camera)
    for names in (("rgb", "mask"), ("photo", "depth"), ("initial",)):
        view = CountedView(rendering, camera, context.photo_camera)
        channels = sum(ViewCompletion.INPUT_CHANNELS[name] for name in names)
        assert view.network_input(names).shape == (1, channels, 36, 48)
        expected = list(names)
        if "photo" in names:
            expected.insert(1, "the photo itself")
        assert view.asked == expected
        # Each part is computed when it is asked for.
        assert ("initial" in vars(view)) == (names != ("rgb", "mask"))
    with pytest.raises(ValueError, match="unknown input 'rim'"):
        view.network_input(("rim",))


def test_the_papers_network_matches_no_patches_and_traces_no_lines_for_its_inputs(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    calls: list[str] = []
    for name in ("match_patches", "trace_epipolar_lines"):
        monkeypatch.setattr(
            f"spackle.scene_fill.view_completion.{name}", lambda *_, name=name: calls.append(name)
        )
    context, camera = box_view()
    network = random_network(name="sharp-decoder")
    aux = complete_view(context.base, camera, context.photo_camera, CPU, network)
    whole = fill_view(dataclasses.replace(context, network=network, texture=None), camera).aux
    assert len(aux) > 100
    assert len(whole) > 100
    assert not calls


@pytest.mark.parametrize("name", ["unet", "sharp-decoder"])
def test_no_holes_give_nothing_and_no_network_the_initial_gaussians(name: str) -> None:
    scene = box_before_wall(width=48, height=36, focal=40)
    base = scene.base()
    assert len(complete_view(base, scene.camera, scene.camera, CPU, None)) == 0
    camera = away(scene.camera)
    initial, untrained = (
        complete_view(base, camera, scene.camera, CPU, f_res)
        for f_res in (None, open_residual(name))
    )
    assert len(initial) == 24 * 18  # all cells
    torch.testing.assert_close(initial.means, untrained.means, rtol=1e-3, atol=1e-3)


VIEW = shifted(Camera.from_focal(60, 64, 48), 0.4)
DRAWN = torch.rand(20, 8, generator=torch.Generator().manual_seed(0))
UV = DRAWN[:, :2] * torch.tensor([64.0, 48.0])
INITIAL = InitialGaussians(
    UV, 0.1 + DRAWN[:, 2], 0.01 * (DRAWN[:, 3:5] - 0.5), 0.1 + 0.8 * DRAWN[:, 5:]
)
BEFORE = compose(INITIAL, None, VIEW)


def test_zero_deltas_give_the_initial_gaussians() -> None:
    zeros = torch.zeros(20, DELTA_CHANNELS)
    for one, other in zip(BEFORE.tensors, compose(INITIAL, zeros, VIEW).tensors, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-5)
    uv, z = VIEW.project(BEFORE.means)
    torch.testing.assert_close(uv, INITIAL.uv, rtol=0, atol=1e-3)
    torch.testing.assert_close(z, 1 / INITIAL.inverse_depth)
    torch.testing.assert_close(linear_to_srgb(BEFORE.colors), INITIAL.rgb)
    assert len(compose(INITIAL.select(torch.zeros(20, dtype=torch.bool)), zeros[:0], VIEW)) == 0
    extremes = dataclasses.replace(INITIAL, rgb=(DRAWN[:, 5:] > 0.5).float())  # black and white
    found = linear_to_srgb(compose(extremes, zeros, VIEW).colors)
    assert (
        float((found - extremes.rgb).abs().max()) <= COLOR_MARGIN * 1.01
    )  # within one step of 8-bit colour


@pytest.mark.parametrize("by", [-1e4, -20.0, -1.0, 1.0, 20.0, 1e4])
def test_deltas_keep_bounds(by: float) -> None:
    deltas = torch.zeros(20, DELTA_CHANNELS)
    deltas[:, 2] = deltas[:, 10:] = by
    after = compose(INITIAL, deltas, VIEW)
    _, z = VIEW.project(after.means)
    assert float(z.min()) > 0  # never behind the camera
    assert bool(
        ((z < 1 / INITIAL.inverse_depth) == (by > 0)).all()
    )  # a larger inverse depth is nearer
    for one, other in ((BEFORE.colors, after.colors), (BEFORE.opacities, after.opacities)):
        assert 0 <= float(other.min()) <= float(other.max()) <= 1
        assert bool(((other > one) == (by > 0)).all())
