"""The residual: cues, seeds, composition, network, carving and completion."""

from __future__ import annotations

import copy
import dataclasses
import functools
import itertools
import math
from collections.abc import Sequence

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import (
    away,
    box_before_wall,
    box_mask,
    cast,
    motorcycle,
    motorcycle_base,
    psnr,
    same_bits,
    shifted,
    slanted_plane,
    wall,
)
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d

from spackle.camera import Camera
from spackle.camera_path import DepthRange, TrajectoryKind, extremes, trajectory
from spackle.color import linear_to_srgb, srgb_to_linear
from spackle.fill import FAR_BIAS, far_fill
from spackle.gaussians import Gaussians
from spackle.render import CpuRenderer
from spackle.render.protocol import Rendering
from spackle.residual import Completer, Cues, ResidualNet, Seeds, hole_area_ratio, hole_mask, make_seeds
from spackle.residual.compose import COLOR_MARGIN, DELTA_CHANNELS, compose
from spackle.residual.hole_features import CELL
from spackle.residual.network import IN_CHANNELS, network_input
from spackle.residual.occlusion_guard import (
    CLEARANCE,
    MAX_REACH_PX,
    REACH,
    STEPS,
    WINDOW_PX,
    OcclusionGuard,
    push_behind,
)
from spackle.residual.seeds import BEHIND, BLOB_CELLS, OPACITY, Rim, cell_centers
from spackle.residual.view_order import farthest_first
from spackle.surface import surface_slope

CPU = CpuRenderer()
PROPERTY = settings(deadline=None, max_examples=40)
SEEDS = st.integers(0, 2**32 - 1)
SIZES = st.tuples(st.integers(1, 7), st.integers(1, 7))
ODD = (63, 47)


def random_view(seed: int, height: int, width: int) -> Rendering:
    """A rendering as it may come: holes, veils and solid pixels; depth 0 where alpha is 0."""
    generator = torch.Generator().manual_seed(seed)
    kind = torch.randint(0, 4, (height, width), generator=generator)
    veil = torch.rand(height, width, generator=generator)
    alpha = torch.where(kind == 0, 0.0, torch.where(kind == 1, veil, 0.96 + 0.039 * veil))
    rgb = linear_to_srgb(alpha[..., None] * torch.rand(height, width, 3, generator=generator))
    depth = torch.where(alpha > 0, 0.5 + 20 * torch.rand(height, width, generator=generator), 0.0)
    return Rendering(rgb, depth, alpha)


def flat_seeds(count: int, seed: int = 0) -> tuple[Seeds, Camera]:
    """Seeds all over a picture, their colours off black and white."""
    generator = torch.Generator().manual_seed(seed)
    camera = shifted(Camera.from_focal(60, 64, 48), 0.4)
    uv = torch.rand(count, 2, generator=generator) * torch.tensor([64.0, 48.0])
    inverse = 0.1 + torch.rand(count, generator=generator)
    slope = 0.01 * (torch.rand(count, 2, generator=generator) - 0.5)
    return Seeds(uv, inverse, slope, 0.1 + 0.8 * torch.rand(count, 3, generator=generator)), camera


@functools.cache
def trained() -> ResidualNet:
    """A network whose last layers are not zero, so that everything in it matters."""
    torch.manual_seed(0)
    network = ResidualNet()
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.add_(0.02 * torch.randn_like(parameter))
    return network


def box_view(disparity: float = 0.2, side: int = 1) -> tuple[Completer, Camera]:
    """A box before a wall, and a view that looks behind the box."""
    scene = box_before_wall()
    completer = Completer(scene.base(), scene.camera, CPU)
    return completer, extremes(scene.camera, disparity, DepthRange.of(completer.base))[side]


# Cues


def test_a_hole_is_where_alpha_is_below_the_threshold() -> None:
    alpha = torch.tensor([[0.0, 0.9499, 0.95, 1.0]])
    assert hole_mask(alpha).tolist() == [[True, True, False, False]]
    assert hole_area_ratio(alpha) == 0.5
    assert hole_area_ratio(alpha, threshold=0.5) == 0.25


def plain_cell(view: Rendering, row: int, column: int) -> tuple[list[float], float, float, bool]:
    """One cell of the cues in plain Python; an odd last row or column counts twice."""
    height, width = view.alpha.shape
    pixels = [(min(2 * row + dy, height - 1), min(2 * column + dx, width - 1)) for dy in (0, 1) for dx in (0, 1)]
    alphas = [float(view.alpha[p]) for p in pixels]
    light = [sum(float(srgb_to_linear(view.rgb[p])[c]) for p in pixels) for c in range(3)]
    rgb = [float(linear_to_srgb(torch.tensor(x / max(sum(alphas), 1e-6)))) for x in light]
    covered = [1 / float(view.depth[p]) for p, alpha in zip(pixels, alphas, strict=True) if alpha >= 0.95]
    return rgb, min(covered, default=0.0), sum(alphas) / 4, len(covered) < 4


@PROPERTY
@given(SEEDS, SIZES)
def test_cues_match_a_plain_loop(seed: int, size: tuple[int, int]) -> None:
    view = random_view(seed, *size)
    cues = Cues.of(view)
    rows, columns = math.ceil(size[0] / 2), math.ceil(size[1] / 2)
    assert cues.mask.shape == (rows, columns)
    for row in range(rows):
        for column in range(columns):
            rgb, inverse, alpha, mask = plain_cell(view, row, column)
            assert cues.rgb[row, column].tolist() == pytest.approx(rgb, abs=1e-4)
            assert float(cues.inverse_depth[row, column]) == pytest.approx(inverse, rel=1e-5)
            assert float(cues.alpha[row, column]) == pytest.approx(alpha, abs=1e-6)
            assert bool(cues.mask[row, column]) == mask
            assert bool(cues.covered[row, column]) != mask


def test_cues_are_cut_off_from_what_made_them() -> None:
    view = random_view(0, 6, 6)
    cues = Cues.of(Rendering(*(t.clone().requires_grad_() for t in (view.rgb, view.depth, view.alpha))))
    assert not any(t.requires_grad for t in (cues.rgb, cues.inverse_depth, cues.alpha))


# Seeds


def plain_seeds(cues: Cues, camera: Camera, photo_camera: Camera) -> Seeds:
    """`make_seeds` of a view that shows something: whole grids, one torch operation at a time."""
    share = avg_pool2d(cues.covered.float()[None, None], 3, stride=1, padding=1, count_include_pad=False)[0, 0]
    choices = (cues.covered & (share > 0.5), cues.covered, cues.inverse_depth > 0)
    known = next(choice for choice in choices if choice.any())
    uv, colors = cell_centers(camera), cues.rgb.permute(2, 0, 1)
    across, _ = far_fill(cues.inverse_depth, colors, known, far_bias=0.0)
    point = camera.to(dtype=torch.float64).unproject(uv.double(), 1.0 / across.double())
    place, z = photo_camera.project(point)
    size = torch.tensor([photo_camera.width, photo_camera.height])
    inside = ((place >= 0) & (place < size)).all(-1) & (z > 0)
    filled, rgb = far_fill(cues.inverse_depth, colors, known, far_bias=torch.where(inside, FAR_BIAS, 0.0))
    seen = torch.where(cues.inverse_depth > 0, cues.inverse_depth, torch.inf)
    close = -max_pool2d(-seen[None, None], 2 * BLOB_CELLS + 1, stride=1, padding=BLOB_CELLS)[0, 0]
    inverse_depth = torch.where(cues.mask, torch.minimum(filled, close) * (1.0 - BEHIND), filled)
    slope = surface_slope(inverse_depth) / CELL
    return Seeds(uv, inverse_depth, slope, rgb.permute(1, 2, 0), float(inverse_depth.median()))


@PROPERTY
@given(SEEDS, st.tuples(st.integers(1, 40), st.integers(1, 40)), st.floats(0, 1))
def test_seeds_match_their_plain_twin(seed: int, size: tuple[int, int], solid: float) -> None:
    view = random_view(seed, *size)
    generator = torch.Generator().manual_seed(seed)
    closed = torch.rand(size, generator=generator) < solid
    closed[seed % size[0], seed % size[1]] = True
    depth = torch.where(closed, 1 + 3 * torch.rand(size, generator=generator), view.depth)
    cues = Cues.of(Rendering(view.rgb, depth, torch.where(closed, 1.0, view.alpha)))
    photo_camera = Camera.from_focal(25, size[1], size[0])
    camera = photo_camera.looking(torch.rand(3, generator=generator) - 0.5, torch.tensor([0.1, 0.2, 3.0]))
    found, plain = make_seeds(cues, camera, photo_camera), plain_seeds(cues, camera, photo_camera)
    for field in dataclasses.fields(Seeds):
        one, other = getattr(found, field.name), getattr(plain, field.name)
        torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-7, msg=field.name)


def test_chosen_seeds_are_those_of_the_grid() -> None:
    completer, camera = box_view()
    cues = Cues.of(CPU.render(completer.base, camera))
    seeds = make_seeds(cues, camera, completer.photo_camera)
    chosen = seeds.select(cues.mask)
    for name in ("uv", "inverse_depth", "slope", "rgb"):
        assert torch.equal(getattr(chosen, name), getattr(seeds, name)[cues.mask])
    assert chosen.unit == seeds.unit


def test_cell_centres_cover_odd_pictures_too() -> None:
    centers = cell_centers(Camera.from_focal(10, 5, 3))
    assert centers.shape == (2, 3, 2)
    assert centers[1, 2].tolist() == [5.0, 3.0]


@pytest.mark.parametrize("side", [0, 1])
def test_behind_a_box_seeds_continue_the_wall_in_depth_and_colour(side: int) -> None:
    completer, camera = box_view(side=side)
    cues = Cues.of(CPU.render(completer.base, camera))
    seeds = make_seeds(cues, camera, completer.photo_camera)
    points = cast(camera, 6.0)[1::2, 1::2]
    uv, _ = completer.photo_camera.project(points)
    x, y = uv.long().unbind(-1)
    inside = (x >= 0) & (x < 96) & (y >= 0) & (y < 72)
    behind = cues.mask & inside & box_mask(96, 72)[y.clamp(0, 71), x.clamp(0, 95)]
    assert int(behind.sum()) > 20
    depth = 1 / seeds.inverse_depth[behind]
    assert float((depth > 4).float().mean()) > 0.75  # the box stands at 2, the wall at 6
    bluish = seeds.rgb[..., 2] > seeds.rgb[..., 0]
    assert float(bluish[behind].float().mean()) > 0.8


def test_seeds_of_a_hole_lie_behind_all_that_is_seen_close_by() -> None:
    completer, camera = box_view()
    cues = Cues.of(CPU.render(completer.base, camera))
    seeds = make_seeds(cues, camera, completer.photo_camera)
    for y, x in cues.mask.nonzero().tolist():
        close = cues.inverse_depth[max(y - 2, 0) : y + 3, max(x - 2, 0) : x + 3]
        if bool((close > 0).any()):
            assert float(seeds.inverse_depth[y, x]) < float(close[close > 0].min()) * 0.998


def test_beyond_the_photos_border_a_plane_goes_on() -> None:
    scene = wall()
    camera = shifted(scene.camera, 1.0)
    cues = Cues.of(CPU.render(scene.base(), camera))
    assert 0.05 < float(cues.mask.float().mean()) < 0.5
    seeds = make_seeds(cues, camera, scene.camera)
    z = camera.unproject(seeds.uv, 1 / seeds.inverse_depth)[..., 2]
    assert float((z[cues.mask] / 4 - 1).abs().max()) < 0.15


def test_covered_cells_keep_what_they_show() -> None:
    completer, camera = box_view()
    cues = Cues.of(CPU.render(completer.base, camera))
    seeds = make_seeds(cues, camera, completer.photo_camera)
    solid = ~cues.mask
    share = torch.nn.functional.avg_pool2d(solid[None, None].float(), 3, 1, 1, count_include_pad=False)[0, 0]
    kept = solid & (share > 0.5)
    assert torch.equal(seeds.inverse_depth[kept], cues.inverse_depth[kept])
    assert torch.equal(seeds.rgb[kept], cues.rgb[kept])


@pytest.mark.parametrize("axis", [0, 1])
def test_the_slope_of_seeds_is_by_pixel_not_by_cell(axis: int) -> None:
    scene = slanted_plane(2, 4, axis)
    seeds = make_seeds(Cues.of(CPU.render(scene.base(), scene.camera)), scene.camera, scene.camera)
    expected = (1 / 2 - 1 / 4) / (scene.depth.shape[axis] - 1)
    middle = seeds.slope[10:-10, 10:-10]
    torch.testing.assert_close(middle[..., 1 - axis].mean(), torch.tensor(expected), rtol=0.02, atol=0)
    assert float(middle[..., axis].abs().max()) < 0.05 * expected


def test_a_stray_speck_does_not_colour_a_hole() -> None:
    """One far green cell in the middle of a hole in a red wall."""
    rgb, depth, alpha = torch.zeros(48, 64, 3), torch.full((48, 64), 2.0), torch.ones(48, 64)
    rgb[..., 0] = 0.8
    alpha[12:36, 16:48] = 0
    speck = (slice(24, 26), slice(30, 32))
    alpha[speck], depth[speck], rgb[speck] = 1.0, 50.0, torch.tensor([0.0, 0.8, 0.0])
    rgb, depth = rgb * (alpha > 0)[..., None], depth * (alpha > 0)
    camera = Camera.from_focal(60, 64, 48)
    seeds = make_seeds(Cues.of(Rendering(rgb, depth, alpha)), camera, camera)
    assert float(seeds.rgb[6:18, 8:24, 1].mean()) < 0.1


@PROPERTY
@given(SEEDS, SIZES)
def test_seeds_of_any_view_are_finite_and_in_front_of_the_camera(seed: int, size: tuple[int, int]) -> None:
    camera = Camera.from_focal(20, size[1], size[0])
    seeds = make_seeds(Cues.of(random_view(seed, *size)), camera, camera)
    for image in (seeds.uv, seeds.inverse_depth, seeds.slope, seeds.rgb):
        assert bool(image.isfinite().all())
    assert float(seeds.inverse_depth.min()) > 0
    assert 0 <= float(seeds.rgb.min()) <= float(seeds.rgb.max()) <= 1


def test_where_nothing_is_seen_seeds_make_a_grey_wall() -> None:
    camera = Camera.from_focal(20, 5, 3)
    empty = Rendering(torch.zeros(3, 5, 3), torch.zeros(3, 5), torch.zeros(3, 5))
    seeds = make_seeds(Cues.of(empty), camera, camera)
    assert torch.equal(seeds.inverse_depth, torch.full((2, 3), 0.1))
    assert torch.equal(seeds.rgb, torch.full((2, 3, 3), 0.5))


# Composition


def test_no_deltas_and_zero_deltas_both_give_the_seeds() -> None:
    seeds, camera = flat_seeds(50)
    none, zeros = compose(seeds, None, camera), compose(seeds, torch.zeros(50, DELTA_CHANNELS), camera)
    for one, other in zip(none.tensors, zeros.tensors, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-5)
    uv, z = camera.project(none.means)
    torch.testing.assert_close(uv, seeds.uv, rtol=0, atol=1e-3)
    torch.testing.assert_close(z, 1 / seeds.inverse_depth)
    torch.testing.assert_close(none.colors, srgb_to_linear(seeds.rgb))
    assert torch.equal(none.opacities, torch.full((50,), OPACITY))


def test_black_and_white_seeds_survive_the_sigmoid_within_a_step_of_8_bits() -> None:
    seeds, camera = flat_seeds(2)
    seeds = dataclasses.replace(seeds, rgb=torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]))
    found = linear_to_srgb(compose(seeds, torch.zeros(2, DELTA_CHANNELS), camera).colors)
    assert float((found - seeds.rgb).abs().max()) <= COLOR_MARGIN * 1.01


def moved(channels: Sequence[int], by: float) -> tuple[Gaussians, Gaussians, Seeds, Camera]:
    """Seeds without deltas, and with one delta."""
    seeds, camera = flat_seeds(20)
    deltas = torch.zeros(20, DELTA_CHANNELS)
    deltas[:, list(channels)] = by
    return compose(seeds, None, camera), compose(seeds, deltas, camera), seeds, camera


def test_the_first_two_channels_move_a_gaussian_on_the_image() -> None:
    _, after, seeds, camera = moved([0], 1.5)
    uv, z = camera.project(after.means)
    torch.testing.assert_close(uv, seeds.uv + torch.tensor([1.5, 0.0]), rtol=0, atol=1e-3)
    torch.testing.assert_close(z, 1 / seeds.inverse_depth, rtol=1e-4, atol=0)
    _, after, seeds, camera = moved([1], -2.0)
    torch.testing.assert_close(camera.project(after.means)[0], seeds.uv - torch.tensor([0.0, 2.0]), rtol=0, atol=1e-3)


def test_the_third_channel_moves_it_along_its_ray_and_never_behind_the_eye() -> None:
    for by in (-20.0, -1.0, 1.0, 20.0):
        before, after, seeds, camera = moved([2], by)
        uv, z = camera.project(after.means)
        torch.testing.assert_close(uv, seeds.uv, rtol=0, atol=1e-2)
        assert float(z.min()) > 0
        assert bool(((z < camera.project(before.means)[1]) == (by > 0)).all())  # inverse depth: more is nearer


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_scales_change_by_a_bounded_factor_each_axis_alone(axis: int) -> None:
    for by, low, high in ((-1e4, 0.2499, 0.2501), (-0.01, 0.98, 0.995), (0.01, 1.005, 1.02), (1e4, 3.999, 4.001)):
        before, after, _, _ = moved([3 + axis], by)
        factor = after.scales / before.scales
        assert low < float(factor[:, axis].min()) <= float(factor[:, axis].max()) < high
        others = [k for k in range(3) if k != axis]
        torch.testing.assert_close(factor[:, others], torch.ones(20, 2), rtol=1e-4, atol=0)


def test_colour_and_opacity_stay_within_bounds_whatever_the_delta() -> None:
    for by in (-1e4, -1.0, 1.0, 1e4):
        before, after, _, _ = moved(range(10, 14), by)
        assert 0 <= float(after.colors.min()) <= float(after.colors.max()) <= 1
        assert 0 <= float(after.opacities.min()) <= float(after.opacities.max()) <= 1
        assert bool(((after.colors > before.colors) == (by > 0)).all())
        assert bool(((after.opacities > before.opacities) == (by > 0)).all())


def test_each_delta_reaches_its_own_gaussian_alone() -> None:
    seeds, camera = flat_seeds(9)
    deltas = torch.zeros(9, DELTA_CHANNELS)
    deltas[4] = 0.3
    before, after = compose(seeds, torch.zeros_like(deltas), camera), compose(seeds, deltas, camera)
    for one, other in zip(before.tensors, after.tensors, strict=True):
        changed = (one != other).reshape(9, -1).any(-1)
        assert changed.tolist() == [k == 4 for k in range(9)]


def test_choosing_cells_and_composing_may_swap() -> None:
    """A cell's Gaussian depends on its own seed and delta and on the view, not on which others were chosen."""
    seeds, camera = flat_seeds(40)
    deltas = 0.5 * torch.randn(40, DELTA_CHANNELS, generator=torch.Generator().manual_seed(1))
    chosen = seeds.inverse_depth > seeds.inverse_depth.median()
    whole, part = compose(seeds, deltas, camera).select(chosen), compose(seeds.select(chosen), deltas[chosen], camera)
    for one, other in zip(whole.tensors, part.tensors, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-5)


def test_no_seeds_compose_to_no_gaussians() -> None:
    seeds, camera = flat_seeds(5)
    none = seeds.select(torch.zeros(5, dtype=torch.bool))
    assert len(compose(none, None, camera)) == 0
    assert len(compose(none, torch.zeros(0, DELTA_CHANNELS), camera)) == 0


def test_gradients_reach_every_delta() -> None:
    seeds, camera = flat_seeds(8)
    deltas = torch.zeros(8, DELTA_CHANNELS, requires_grad=True)
    found = compose(seeds, deltas, camera)
    generator = torch.Generator().manual_seed(0)
    torch.stack([(t * torch.rand(t.shape, generator=generator)).sum() for t in found.tensors]).sum().backward()
    assert deltas.grad is not None
    assert bool(deltas.grad.isfinite().all())
    assert bool((deltas.grad != 0).all())


# Network


def test_the_network_has_the_papers_size() -> None:
    count = sum(parameter.numel() for parameter in ResidualNet().parameters())
    assert count == pytest.approx(8.02e6, abs=0.02e6)


@pytest.mark.parametrize("size", [(1, 1), (1, 40), (17, 31), (32, 48)])
def test_the_network_takes_any_size(size: tuple[int, int]) -> None:
    with torch.no_grad():
        deltas = trained()(torch.randn(1, IN_CHANNELS, *size))
    assert deltas.shape == (1, DELTA_CHANNELS, *size)
    assert bool(deltas.isfinite().all())
    assert bool((deltas != 0).any())


def test_an_untrained_network_gives_zeros_so_that_the_view_is_the_seeds() -> None:
    completer, camera = box_view()
    with torch.no_grad():
        assert not ResidualNet()(torch.randn(1, IN_CHANNELS, 20, 24)).any()
    plain = completer.complete_view(camera)
    untrained = dataclasses.replace(completer, network=ResidualNet()).complete_view(camera)
    assert len(plain) == len(untrained)
    torch.testing.assert_close(untrained.means, plain.means, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(untrained.scales, plain.scales, rtol=1e-4, atol=0)
    torch.testing.assert_close(untrained.opacities, plain.opacities, rtol=1e-4, atol=0)
    torch.testing.assert_close(linear_to_srgb(untrained.colors), linear_to_srgb(plain.colors), rtol=0, atol=2e-3)


def test_pictures_of_a_batch_do_not_mix() -> None:
    network = trained()
    features = torch.randn(2, IN_CHANNELS, 24, 32, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        together, alone = network(features), torch.cat([network(f[None]) for f in features])
    torch.testing.assert_close(together, alone, rtol=1e-3, atol=1e-4)


def test_the_networks_input_knows_no_unit_of_length() -> None:
    completer, camera = box_view()
    view = CPU.render(completer.base, camera)

    def features(unit: float) -> Tensor:
        cues = Cues.of(dataclasses.replace(view, depth=view.depth * unit))
        eye = camera.world_to_camera.clone()
        eye[:3, 3] *= unit
        scaled = dataclasses.replace(camera, world_to_camera=eye)
        seeds = make_seeds(cues, scaled, completer.photo_camera)
        return network_input(cues, seeds, Rim.of(cues, seeds, scaled, completer.photo_camera))

    found = features(1.0)
    assert found.shape == (1, IN_CHANNELS, 36, 48)
    assert bool(found.isfinite().all())
    torch.testing.assert_close(features(1000.0), found, rtol=0, atol=0.02)


def test_a_rendered_loss_trains_the_network_and_leaves_the_base_alone() -> None:
    scene = box_before_wall(width=48, height=36, focal=40)
    base = Gaussians(*(t.requires_grad_() for t in scene.base().tensors))
    camera = extremes(scene.camera, 0.2, DepthRange.of(base))[1]
    network = copy.deepcopy(trained())
    cues = Cues.of(CPU.render(base, camera))
    seeds = make_seeds(cues, camera, scene.camera)
    features = network_input(cues, seeds, Rim.of(cues, seeds, camera, scene.camera))
    deltas = network(features)[0].permute(1, 2, 0)[cues.mask]
    aux = compose(seeds.select(cues.mask), deltas, camera)
    assert not features.requires_grad
    view = CPU.render([base.detach(), aux], camera)
    (view.rgb.mean() + view.depth.mean() + view.alpha.mean()).backward()
    for name, parameter in network.named_parameters():
        assert parameter.grad is not None, name
        assert bool(parameter.grad.isfinite().all()), name
        assert bool((parameter.grad != 0).any()), name
    assert all(t.grad is None for t in base.tensors)


def test_an_untrained_network_can_leave_zero() -> None:
    scene = box_before_wall(width=48, height=36, focal=40)
    base, camera = scene.base(), shifted(scene.camera, 0.5)
    network = ResidualNet()
    cues = Cues.of(CPU.render(base, camera))
    seeds = make_seeds(cues, camera, scene.camera)
    features = network_input(cues, seeds, Rim.of(cues, seeds, camera, scene.camera))
    deltas = network(features)[0].permute(1, 2, 0)[cues.mask]
    CPU.render([base, compose(seeds.select(cues.mask), deltas, camera)], camera).rgb.mean().backward()
    for head in (network.geometry, network.texture):
        assert head[-1].weight.grad is not None
        assert bool((head[-1].weight.grad != 0).any())


# Carving


def plain_push(aux: Gaussians, eye: Tensor, guards: Sequence[OcclusionGuard]) -> tuple[list[float], list[int]]:
    """The factors and the survivors of `push_behind`, one Gaussian at a time."""

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
                reach.append(min(REACH * deviation + 1, MAX_REACH_PX))
            (u, v), (height, width) = uv.tolist(), guard.depth.shape
            if not (-reach[0] <= u <= width + reach[0] and -reach[1] <= v <= height + reach[1]):
                continue
            across, down = (math.ceil(max(r - WINDOW_PX, 0) / (2 * WINDOW_PX)) for r in reach)
            for j, i in itertools.product(range(-down, down + 1), range(-across, across + 1)):
                row_, column = math.floor(v + 2 * WINDOW_PX * j), math.floor(u + 2 * WINDOW_PX * i)
                seen = guard.depth[min(max(row_, 0), height - 1), min(max(column, 0), width - 1)]
                if float(z) < float(seen) * (1 + CLEARANCE):
                    return True
        return False

    factors, kept = [], []
    covariances = aux.covariances().double()
    for index, mean in enumerate(aux.means.double()):
        for step in range(STEPS):
            factor = 1 / (1 - step / STEPS)
            if not blocked(eye.double() + factor * (mean - eye.double()), factor**2 * covariances[index]):
                factors.append(factor)
                kept.append(index)
                break
    return factors, kept


def random_aux(count: int, seed: int) -> Gaussians:
    """Gaussians all around the origin, some behind it."""
    generator = torch.Generator().manual_seed(seed)
    means = 6 * torch.randn(count, 3, generator=generator)
    quats, scales = torch.randn(count, 4, generator=generator), torch.rand(count, 3, generator=generator)
    return Gaussians(means, quats, scales, torch.rand(count, generator=generator), torch.rand(count, 3))


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
    found, factor = push_behind(aux, eye, guards), torch.tensor(factors)[:, None]
    assert len(found) == len(kept)
    torch.testing.assert_close(found.means, eye + factor * (aux.means[kept] - eye), rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(found.scales, aux.scales[kept] * factor, rtol=1e-4, atol=0)
    for name in ("quats", "opacities", "colors"):
        assert torch.equal(getattr(found, name), getattr(aux, name)[kept])


def test_a_shield_is_the_farthest_depth_within_reach_and_none_over_holes() -> None:
    depth, alpha = torch.full((20, 30), 3.0), torch.ones(20, 30)
    depth[10, 15] = 7.0
    alpha[:, 20:] = 0.5
    guard = OcclusionGuard.of(Rendering(torch.zeros(20, 30, 3), depth, alpha), Camera.from_focal(20, 30, 20))
    block = torch.full((20, 30), 3.0)
    block[:, 20 + WINDOW_PX :] = 0
    block[10 - WINDOW_PX : 11 + WINDOW_PX, 15 - WINDOW_PX : 16 + WINDOW_PX] = 7
    assert torch.equal(guard.depth, block)


@PROPERTY
@given(SEEDS, st.tuples(st.integers(1, 90), st.integers(1, 30)))
def test_a_shield_is_the_maximum_over_windows(seed: int, size: tuple[int, int]) -> None:
    view = random_view(seed, *size)
    guard = OcclusionGuard.of(view, Camera.from_focal(20, size[1], size[0]))
    seen = torch.where(hole_mask(view.alpha), 0.0, view.depth)[None, None]
    assert torch.equal(guard.depth, max_pool2d(seen, 2 * WINDOW_PX + 1, stride=1, padding=WINDOW_PX)[0, 0])


def test_pushing_changes_nothing_for_the_eye_that_asked() -> None:
    completer, camera = box_view()
    aux = completer.complete_view(camera, [])
    pushed = push_behind(aux, camera.position, [completer.photo_guard()])
    assert len(pushed) == len(aux)
    assert bool((camera.to_camera(pushed.means)[:, 2] > camera.to_camera(aux.means)[:, 2] + 0.1).any())
    uv, _ = camera.project(pushed.means)
    torch.testing.assert_close(uv, camera.project(aux.means)[0], rtol=0, atol=1e-2)
    one, other = CPU.render(aux, camera), CPU.render(pushed, camera)
    torch.testing.assert_close(other.alpha, one.alpha, rtol=0, atol=0.05)


def test_without_shields_or_gaussians_nothing_is_pushed() -> None:
    aux, eye = random_aux(5, 0), torch.zeros(3)
    assert same_bits(push_behind(aux, eye, []), aux)
    guard = OcclusionGuard(Camera.from_focal(20, 16, 12), torch.full((12, 16), 5.0))
    assert len(push_behind(Gaussians.empty(), eye, [guard])) == 0


def test_what_stands_behind_the_shields_camera_is_not_its_business() -> None:
    aux = dataclasses.replace(random_aux(1, 0), means=torch.tensor([[0.1, 0.2, -3.0]]))
    guard = OcclusionGuard(Camera.from_focal(20, 16, 12), torch.full((12, 16), 5.0))
    assert same_bits(push_behind(aux, torch.zeros(3), [guard]), aux)


# Completion of a view


@pytest.mark.parametrize("side", [0, 1])
@pytest.mark.parametrize("disparity", [0.2, 0.5])
def test_completion_closes_a_view(disparity: float, side: int) -> None:
    completer, camera = box_view(disparity, side)
    before = CPU.render(completer.base, camera)
    aux = completer.complete_view(camera, [completer.photo_guard()])
    after = CPU.render([completer.base, aux], camera)
    assert hole_area_ratio(after.alpha) < 0.03 * hole_area_ratio(before.alpha)
    seen = ~hole_mask(before.alpha)
    assert psnr(after.rgb[seen], before.rgb[seen]) > 35


@pytest.mark.parametrize("network", [False, True])
@pytest.mark.parametrize("there", [False, True])
def test_the_completed_view_is_bit_for_bit_that_of_drawing_everything(network: bool, there: bool) -> None:
    completer, camera = box_view(0.4)
    completer = dataclasses.replace(completer, network=trained() if network else None)
    aux = completer.complete_view(box_view(0.2)[1]) if there else Gaussians.empty()
    new, drawn = completer.completed_view(camera, aux=aux)
    whole = CPU.render([completer.base, aux, new], camera)
    assert len(new) > 100
    for one, other in zip((drawn.rgb, drawn.depth, drawn.alpha), (whole.rgb, whole.depth, whole.alpha), strict=True):
        assert torch.equal(one, other)


def test_aux_gaussians_already_there_are_seen_and_not_returned() -> None:
    completer, camera = box_view()
    first = completer.complete_view(camera)
    again = completer.complete_view(camera, aux=first)
    assert len(first) > 100
    assert len(again) < 0.02 * len(first)


@pytest.mark.parametrize("network", [False, True])
def test_an_odd_view_is_completed(network: bool) -> None:
    scene = wall(4.0, *ODD)
    completer = Completer(scene.base(), scene.camera, CPU, trained() if network else None)
    camera = shifted(scene.camera, 0.8)
    aux = completer.complete_view(camera)
    assert len(aux) > 20
    before, after = CPU.render(completer.base, camera), CPU.render([completer.base, aux], camera)
    assert before.alpha.shape == (47, 63)
    assert hole_area_ratio(after.alpha) < (0.5 if network else 0.03) * hole_area_ratio(before.alpha)


@pytest.mark.parametrize("size", [(64, 48), ODD])
@pytest.mark.parametrize("network", [False, True])
def test_a_view_of_nothing_at_all_becomes_a_wall(size: tuple[int, int], network: bool) -> None:
    scene = wall(4.0, *size)
    completer = Completer(scene.base(), scene.camera, CPU, ResidualNet() if network else None)
    camera = away(scene.camera)
    assert hole_area_ratio(CPU.render(completer.base, camera).alpha) == 1
    aux = completer.complete_view(camera, [completer.photo_guard()])
    assert all(bool(t.isfinite().all()) for t in aux.tensors)
    assert hole_area_ratio(CPU.render([completer.base, aux], camera).alpha) < 0.01


def test_an_empty_base_is_completed_too() -> None:
    camera = Camera.from_focal(60, 64, 48)
    completer = Completer(Gaussians.empty(), camera, CPU)
    aux = completer.complete_view(camera, [completer.photo_guard()])
    assert hole_area_ratio(CPU.render(aux, camera).alpha) < 0.01


def test_base_gaussians_behind_the_camera_play_no_part() -> None:
    completer, camera = box_view()
    generator = torch.Generator().manual_seed(0)
    behind = Gaussians(
        camera.unproject(camera.pixel_centers()[::8, ::8].reshape(-1, 2), -3 * torch.ones(108)),
        torch.randn(108, 4, generator=generator),
        torch.full((108, 3), 0.3),
        torch.ones(108),
        torch.rand(108, 3, generator=generator),
    )
    more = dataclasses.replace(completer, base=Gaussians.cat([completer.base, behind]))
    assert same_bits(more.complete_view(camera), completer.complete_view(camera))


@pytest.mark.parametrize("network", [False, True])
def test_completion_repeats_bit_for_bit(network: bool) -> None:
    completer, camera = box_view()
    if network:
        completer = dataclasses.replace(completer, network=trained())
    guards = [completer.photo_guard()]
    first = completer.complete_view(camera, guards)
    assert len(first) > 0
    assert same_bits(completer.complete_view(camera, guards), first)


# Completion of a scene


def test_the_widest_view_comes_first_and_any_beginning_is_spread_out() -> None:
    camera = Camera.from_focal(50, 40, 30)
    order = farthest_first([shifted(camera, x) for x in (-1.0, -0.2, 0.0, 0.6, 1.1)], camera)
    assert order == [4, 0, 3, 1, 2]  # the photo's own place counts as visited
    assert sorted(farthest_first([camera] * 3, camera)) == [0, 1, 2]


def test_a_whole_path_is_closed_by_one_set() -> None:
    completer, _ = box_view()
    path = trajectory("swipe", completer.photo_camera, 0.3, DepthRange.of(completer.base), frames=9)
    calls: list[tuple[int, int]] = []
    aux = completer.complete_scene(path, progress=lambda done, total: calls.append((done, total)))
    assert [done for done, _ in calls] == list(range(1, len(calls) + 1))
    assert {total for _, total in calls} == {9}
    for camera in path:
        after = hole_area_ratio(CPU.render([completer.base, aux], camera).alpha)
        assert after <= max(5e-3, 0.03 * hole_area_ratio(CPU.render(completer.base, camera).alpha))


@pytest.mark.parametrize("disparity", [0.3, 0.5])
@pytest.mark.parametrize("kind", ["rotate_forward", "rotate"])
def test_a_long_path_and_its_extremes_are_closed_by_one_set(kind: TrajectoryKind, disparity: float) -> None:
    """As the command line asks for it: the extremes come after the path, and lie beside it."""
    completer, _ = box_view()
    depths = DepthRange.of(completer.base)
    path = trajectory(kind, completer.photo_camera, disparity, depths, frames=60)
    sides = extremes(completer.photo_camera, disparity, depths)
    aux = completer.complete_scene([*path, *sides])
    for camera in [*path[::4], *sides]:
        before = hole_area_ratio(CPU.render(completer.base, camera).alpha)
        after = hole_area_ratio(CPU.render([completer.base, aux], camera).alpha)
        assert after <= max(2e-3, 0.03 * before)


def test_scene_completion_visits_every_view() -> None:
    completer, _ = box_view()
    for exact in (False, True):
        calls: list[int] = []
        path = [completer.photo_camera] * 7
        aux = completer.complete_scene(path, exact, progress=lambda done, _, calls=calls: calls.append(done))
        assert len(aux) == 0  # the photo has no holes in its own view
        assert calls == list(range(1, 8))


def test_a_path_without_cameras_needs_nothing() -> None:
    completer, _ = box_view()
    assert len(completer.complete_scene([])) == 0


def test_no_aux_gaussian_of_a_scene_stands_before_the_photos_surface() -> None:
    completer, _ = box_view()
    path = trajectory("shake", completer.photo_camera, 0.3, DepthRange.of(completer.base), frames=8)
    aux = completer.complete_scene(path)
    depth = box_before_wall().depth
    uv, z = completer.photo_camera.project(aux.means)
    x, y = uv.floor().long().unbind(-1)
    inside = (z > 0) & (x >= 0) & (x < 96) & (y >= 0) & (y < 72)
    assert int(inside.sum()) > 100
    assert bool((z[inside] > depth[y[inside], x[inside]] * 1.0005).all())


def test_scene_completion_repeats_bit_for_bit() -> None:
    completer, _ = box_view()
    path = trajectory("swipe", completer.photo_camera, 0.3, DepthRange.of(completer.base), frames=4)
    assert same_bits(completer.complete_scene(path), completer.complete_scene(path))


def test_a_slanted_floor_is_continued_beyond_the_frame() -> None:
    scene = slanted_plane(1.5, 6, 0, width=96, height=72, focal=90)
    completer = Completer(scene.base(), scene.camera, CPU)
    path = trajectory("swipe", scene.camera, 0.3, DepthRange.of(completer.base), frames=3)
    aux = completer.complete_scene(path)
    for camera in (path[0], path[-1]):
        before, after = CPU.render(completer.base, camera), CPU.render([completer.base, aux], camera)
        assert hole_area_ratio(before.alpha) > 0.03
        assert hole_area_ratio(after.alpha) < 0.03 * hole_area_ratio(before.alpha)


# Motorcycle, a real photo with real depth, at Middlebury's quarter size


@dataclasses.dataclass(frozen=True)
class Completed:
    """The right camera's view of Motorcycle before and after completion, and what it should show."""

    before: Rendering
    after: Rendering
    truth: Tensor
    photo_before: Rendering
    photo_after: Rendering


@pytest.fixture(scope="module")
def right_view() -> Completed:
    pair, found = motorcycle(), motorcycle_base()
    completer = Completer(found.gaussians, found.camera, CPU)
    aux = completer.complete_view(pair.right, [completer.photo_guard()])
    views = [CPU.render(s, c) for c in (pair.right, found.camera) for s in (completer.base, [completer.base, aux])]
    return Completed(views[0], views[1], pair.right_rgb, views[2], views[3])


def test_motorcycle_the_right_cameras_holes_are_closed(right_view: Completed) -> None:
    assert hole_area_ratio(right_view.before.alpha) > 0.08
    assert hole_area_ratio(right_view.after.alpha) <= 0.03 * hole_area_ratio(right_view.before.alpha)


def test_motorcycle_seeds_alone_fill_the_holes_plausibly(right_view: Completed) -> None:
    hole = hole_mask(right_view.before.alpha)
    assert psnr(right_view.after.rgb[hole], right_view.truth[hole]) >= 16.3


def test_motorcycle_what_the_right_camera_saw_already_stays(right_view: Completed) -> None:
    seen = ~hole_mask(right_view.before.alpha)
    before = psnr(right_view.before.rgb[seen], right_view.truth[seen])
    assert psnr(right_view.after.rgb[seen], right_view.truth[seen]) >= before - 0.1


def test_motorcycle_the_photo_stays_when_the_right_view_is_completed(right_view: Completed) -> None:
    assert psnr(right_view.photo_after.rgb, right_view.photo_before.rgb) >= 45


def test_motorcycle_a_swipe_is_completed_as_one_scene(right_view: Completed) -> None:
    found = motorcycle_base()
    completer = Completer(found.gaussians, found.camera, CPU)
    depths = DepthRange.of(completer.base)
    aux = completer.complete_scene(trajectory("swipe", found.camera, 0.3, depths, frames=5))
    photo = CPU.render([completer.base, aux], found.camera)
    assert psnr(photo.rgb, right_view.photo_before.rgb) >= 45
    for camera in extremes(found.camera, 0.3, depths):
        before = hole_area_ratio(CPU.render(completer.base, camera).alpha)
        assert before > 0.2
        assert hole_area_ratio(CPU.render([completer.base, aux], camera).alpha) <= 0.03 * before
