"""Colours of blobs: those that the blended picture shows, from patches of the view or from an inpainter."""

from __future__ import annotations

import dataclasses
import functools
import math

import numpy as np
import pytest
import torch
from holes import CPU, box_view, features_of
from plain_patches import Subject
from torch import Tensor
from torch.nn.functional import max_pool2d

from spackle.camera import Camera
from spackle.camera_path import DepthRange, trajectory
from spackle.filters import blurred
from spackle.inpaint import InpainterOptions
from spackle.inpaint.protocol import PlainInpainter
from spackle.patches import Patches
from spackle.render.protocol import Rendering
from spackle.residual import Seeds, ViewFeatures, hole_mask
from spackle.residual.compose import compose
from spackle.residual.rim import Rim, find_rim
from spackle.scene_fill import FillContext, exemplar_texture, fill_scene, fill_view, painted_texture
from spackle.scene_fill.fill import FINE_SPREAD_PX, PAINTED_VIEWS
from spackle.scene_fill.texture import (
    BLOCK_CHOICE,
    BROAD,
    EXTENDED_CELLS,
    SAME_DEPTH,
    SHARE,
    TEXTURE_PX,
    HoleView,
    _in_proportion,
    extended,
    from_cells,
    in_cells,
    patch_blocks,
    repeat_counts,
    sharpened,
)


@pytest.mark.parametrize("period", [4.0, 6.0, 8.0])  # pixels
def test_sharpened_blobs_make_up_for_their_overlap(period: float) -> None:
    """On a rough wall: where blobs lie one behind the other in a row, the nearer ones also shift the picture."""
    camera = Camera.from_focal(80, 96, 72)
    uv = camera.pixel_centers()
    x, y = (2 * torch.pi / period * uv).unbind(-1)
    wanted = 0.12 * torch.stack([x.sin(), y.cos(), (x + 1).sin()], dim=-1)
    depths = 4 + 0.01 * torch.randn(uv.shape[:2], generator=torch.Generator().manual_seed(0))

    def strength(colors: Tensor) -> float:
        grid = (uv, 1 / depths, torch.zeros_like(uv), 0.5 + colors)
        blobs = compose(Seeds(*(field.flatten(0, 1) for field in grid)), None, camera, FINE_SPREAD_PX)
        shown, truth = (image[4:-4, 4:-4] for image in (CPU.render(blobs, camera).rgb, wanted))
        return float(((shown - shown.mean((0, 1))) * truth).sum() / truth.square().sum())

    assert strength(wanted) < 0.96
    assert 1.05 < strength(sharpened(wanted)) < 1.6  # more than one: for what votes have blurred


class Paint(PlainInpainter):
    """Paints a ramp, and keeps what it was asked for."""

    name, version = "paint", "1"

    def __init__(self, options: InpainterOptions) -> None:
        self.asked: list[tuple[Tensor, ...]] = []

    def paint(self, rgb: Tensor, hole: Tensor, inverse_depth: Tensor) -> Tensor:
        self.asked.append((rgb, hole, inverse_depth))
        return torch.where(hole[..., None], ramp(*hole.shape[1:]), rgb)


def ramp(height: int, width: int) -> Tensor:
    """[height, width, 3] of colours that no scene here has."""
    across = torch.linspace(0.2, 0.8, width).expand(height, width)
    return torch.stack([0.1 + 0 * across, across, 0.2 + 0 * across], dim=-1)


def painted_box(size: tuple[int, int]) -> tuple[FillContext, Camera, Paint]:
    context, camera = box_view(0.3, width=size[0], height=size[1])
    painter = Paint(InpainterOptions())
    return dataclasses.replace(context, texture=functools.partial(painted_texture, painter)), camera, painter


@pytest.mark.parametrize("size", [(96, 72), (95, 71)])
@pytest.mark.parametrize("threshold", [0.95, 0.98])
def test_a_painted_picture_is_asked_for_once_and_seen(size: tuple[int, int], threshold: float) -> None:
    subject, camera, painter = painted_box(size)
    view = CPU.render(subject.base, camera)
    filled = fill_view(dataclasses.replace(subject, threshold=threshold), camera, rendering=view)
    new, drawn = filled.aux, filled.rendering
    hole = hole_mask(view.alpha)
    ((rgb, asked, inverse_depth),) = painter.asked
    assert torch.equal(rgb[0], view.rgb)
    assert torch.equal(asked[0], hole)
    assert torch.equal(inverse_depth[0] > 0, ~hole)
    torch.testing.assert_close(inverse_depth[0][~hole], 1 / view.depth[~hole])
    inner = max_pool2d((~hole).float()[None], 5, 1, 2)[0] == 0
    assert int(inner.sum()) > 2000
    assert float((drawn.rgb - ramp(*hole.shape))[inner].abs().mean()) < 0.01
    assert bool((new.colors.sum(-1) > 0).all())  # no black where a cell is masked by a threshold of its own


def test_a_scenes_widest_views_are_painted_and_no_others() -> None:
    context, _, painter = painted_box((96, 72))
    path = trajectory("rotate-forward", context.photo_camera, 0.4, DepthRange.of(context.base), 9)
    assert len(fill_scene(context, path, exact=True).aux)
    assert len(painter.asked) == PAINTED_VIEWS


def hole_view(width: int = 96) -> tuple[HoleView, FillContext, Camera]:
    """A view of the box, its structure random."""
    context, camera = box_view(0.3)
    view = CPU.render(context.base, camera)
    features, seeds, _ = features_of(view, camera, context.photo_camera)
    structure = torch.rand(features.rgb.shape, generator=torch.Generator().manual_seed(0))
    rim = find_rim(features, seeds, camera, context.photo_camera)
    return HoleView(view, features, seeds, *rim, structure), context, camera


def test_the_texture_leaves_low_frequencies_to_the_structure() -> None:
    view, _, _ = hole_view()
    rim = dataclasses.replace(view.rim, beyond=torch.zeros_like(view.rim.beyond))
    bad = dataclasses.replace(view.patches, mismatch=view.patches.mismatch + 100)
    found, plain = (
        exemplar_texture(dataclasses.replace(view, rim=rim, patches=patches)) for patches in (view.patches, bad)
    )
    fine, mask = found - plain, view.features.mask
    assert float(in_cells(fine)[mask].abs().mean()) > 1e-3
    assert float(blurred(fine, 4 * TEXTURE_PX).abs().max()) < 0.1 * float(fine.abs().max())
    smooth = in_cells(sharpened(from_cells(in_cells(view.rendering.rgb)), 1))[~mask]
    assert float((in_cells(plain)[~mask] - smooth).abs().mean()) < 0.02


def test_beyond_the_border_patches_get_a_share_but_nothing_broad() -> None:
    """Stripes on a wall, brighter where patches come from; the structure that meets them is grey."""
    stripes = (0.5 + 0.1 * torch.sin(torch.arange(192) * math.tau / 16)).view(1, -1, 1).repeat(96, 1, 3)
    stripes[:, :96] += 0.2
    mask = torch.zeros(48, 96, dtype=torch.bool)
    mask[:, 56:] = True
    rows, columns = torch.meshgrid(torch.arange(48), torch.arange(96), indexing="ij")
    matches = torch.stack([torch.zeros_like(rows), rows, columns - 48], dim=-1).where(mask[..., None], torch.tensor(-1))
    rgb, flat, nothing = in_cells(stripes).mean((2, 3)), torch.ones(48, 96), torch.zeros(48, 96)
    features, seeds = (
        ViewFeatures(rgb, flat, flat, mask),
        Seeds(torch.zeros(48, 96, 2), flat, torch.zeros(48, 96, 2), rgb),
    )
    view = Rendering(stripes, torch.ones(96, 192), torch.ones(96, 192))
    structure, patches = torch.full_like(rgb, 0.5), Patches(rgb, nothing, matches)
    inner = slice(24, 72), slice(144, 176)
    amplitudes, means = [], []
    for beyond in (mask, torch.zeros_like(mask)):
        rim = Rim(rgb, rgb, nothing, rgb, nothing, beyond)
        found = exemplar_texture(HoleView(view, features, seeds, rim, patches, structure))[inner]
        amplitudes.append(float((found - found.mean()).abs().mean() / (stripes[inner] - 0.5).abs().mean()))
        means.append(float(found.mean()))
    fine, broad = (1 - math.exp(-2 * (math.pi * width / 16) ** 2) for width in (TEXTURE_PX, BROAD * 192))
    assert amplitudes == pytest.approx([(1 - SHARE) * fine + SHARE * broad, fine], rel=0.1)
    assert means == pytest.approx([0.5, 0.5], abs=0.02)


def test_beyond_the_border_the_nearest_cells_are_extended() -> None:
    view, context, camera = hole_view()
    features, seeds, beyond = view.features, view.seeds, view.rim.beyond
    assert 100 < int(beyond.sum()) < int(features.mask.sum()) - 100
    found, known = extended(view), (~features.mask).nonzero()
    assert torch.equal(found[~beyond], view.structure[~beyond])
    uv, z = context.photo_camera.project(camera.unproject(seeds.uv, 1 / seeds.inverse_depth))
    outside = (uv < 0).any(-1) | (uv[..., 0] > 96) | (uv[..., 1] > 72) | (z <= 0)
    assert torch.equal(beyond, outside & features.mask)
    for y, x in beyond.nonzero()[::17].tolist():
        apart = (known - torch.tensor([y, x])).double().norm(dim=-1)
        row, column = known[apart.argmin()].tolist()
        depths = math.log(float(seeds.inverse_depth[y, x] / features.inverse_depth[row, column])) / SAME_DEPTH
        share = math.exp((1 - float(apart.min())) / EXTENDED_CELLS - depths**2)
        expected = (1 - share) * view.structure[y, x] + share * features.rgb[row, column]
        torch.testing.assert_close(found[y, x], expected)


def test_texture_is_no_stronger_than_what_is_around_the_hole() -> None:
    """A calm wall and a lively one: noise that is as strong everywhere fits in one hole and not in the other."""
    mask = torch.zeros(48, 96, dtype=torch.bool)
    mask[16:32, 12:36] = mask[16:32, 60:84] = True
    noise = 0.1 * torch.randn(96, 192, 3, generator=torch.Generator().manual_seed(0))
    calm = ~from_cells(mask[..., None, None, None].expand(48, 96, 2, 2, 1))[..., 0]
    calm[:, 96:] = False
    flat = torch.ones(48, 96)
    features = ViewFeatures(flat[..., None].expand(-1, -1, 3), flat, flat, mask)
    seeds, rgb = Seeds(torch.zeros(48, 96, 2), flat, torch.zeros(48, 96, 2), features.rgb), features.rgb
    rim, patches = Rim(rgb, rgb, flat, rgb, flat, mask), Patches(rgb, flat, flat)
    view = HoleView(Rendering(noise, flat, flat), features, seeds, rim, patches, rgb)
    factors = _in_proportion(torch.where(calm[..., None], 0.1 * noise, noise), view)
    assert float(factors[20:28, 16:32].mean()) == pytest.approx(0.1, abs=0.04)
    assert float(factors[20:28, 64:80].mean()) > 0.85
    assert float(factors.max()) <= 1


def test_repeats_are_counted_by_squares_of_picture_and_mirror() -> None:
    matches = torch.full((8, 10, 3), -1)
    matches[0, :3] = torch.tensor([0, 5, 2])
    matches[1, 0] = torch.tensor([1, 4, 9 - 3])  # the same square, in the mirror
    matches[7, 9] = torch.tensor([0, 1, 9])
    expected = torch.zeros(8, 10)
    expected[0, :3] = expected[1, 0] = 4 / 16
    expected[7, 9] = 1 / 16
    assert torch.equal(repeat_counts(Patches(torch.zeros(8, 10, 3), torch.zeros(8, 10), matches)), expected)


def test_blocks_are_those_of_the_matches_around_a_cell() -> None:
    subject, rng = Subject(24, 31), np.random.default_rng(3)
    places, costs = np.full((24, 31, 3), -1, np.int32), np.zeros((24, 31), np.float32)
    places[tuple(subject.cells.T)], costs[tuple(subject.cells.T)] = subject.places, subject.costs
    blocks = rng.random((24, 31, 2, 3, 1)).astype(np.float32)
    grids = [torch.from_numpy(grid) for grid in (subject.level.rgb, np.sqrt(costs), places)]
    found = patch_blocks(Patches(*grids), torch.from_numpy(blocks)).numpy()
    assert np.array_equal(found[~subject.level.hole], blocks[~subject.level.hole])
    sources = (blocks, blocks[:, ::-1, :, ::-1])
    for cell in subject.cells:
        over = np.abs(subject.cells - cell).max(1) <= 1
        moved = subject.places[over] + np.pad(cell - subject.cells[over], [(0, 0), (1, 0)])
        weights = np.exp(-BLOCK_CHOICE * subject.costs[over] / subject.costs.mean()) + 1e-6
        expected = np.average([sources[m][v, u] for m, v, u in moved], axis=0, weights=weights)
        np.testing.assert_allclose(found[tuple(cell)], expected, rtol=1e-4)
