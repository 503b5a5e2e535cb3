"""Colours of blobs: those that the blended picture shows, from patches of the view or from an inpainter."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from holes import CPU, box_view, features_of
from torch import Tensor
from torch.nn.functional import interpolate, max_pool2d

from spackle.camera import Camera
from spackle.camera_path import DepthRange, trajectory
from spackle.filters import blurred
from spackle.inpaint import InpainterOptions
from spackle.inpaint.exemplar import Exemplar
from spackle.inpaint.protocol import PlainInpainter
from spackle.render.protocol import Rendering
from spackle.residual import Completer, Cues, Seeds, hole_mask
from spackle.residual.complete import PAINTED_VIEWS
from spackle.residual.compose import compose
from spackle.residual.hole_features import from_cells, in_cells
from spackle.residual.seeds import FINE_SPREAD_PX, Rim
from spackle.residual.texture import (
    BROAD,
    CONTINUED_CELLS,
    EXEMPLAR,
    SAME_DEPTH,
    SHOWN,
    TEXTURE_PX,
    ExemplarTexture,
    PaintedTexture,
    _in_proportion,
    _magnified,
    continued,
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


def test_a_cells_structure_is_magnified_without_what_is_seen_beside_it() -> None:
    cells = torch.rand(6, 8, 3, generator=torch.Generator().manual_seed(0))
    mask = torch.zeros(6, 8, dtype=torch.bool)
    mask[1:4, 2:5] = True
    found = _magnified(cells, mask)
    mixed = _magnified(torch.where(mask[..., None], cells, 9.0), mask)
    assert torch.equal(found, mixed)
    inner = interpolate(cells.permute(2, 0, 1)[None], scale_factor=2, mode="bilinear")[0].permute(1, 2, 0)[3:7, 5:9]
    torch.testing.assert_close(found[3:7, 5:9], inner)


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


def painted_box(size: tuple[int, int]) -> tuple[Completer, Camera, Paint]:
    subject, camera = box_view(0.3, width=size[0], height=size[1])
    painter = Paint(InpainterOptions())
    return dataclasses.replace(subject, texture=PaintedTexture(painter)), camera, painter


@pytest.mark.parametrize("size", [(96, 72), (95, 71)])
@pytest.mark.parametrize("threshold", [0.95, 0.98])
def test_a_painted_picture_is_asked_for_once_and_reaches_the_hole(size: tuple[int, int], threshold: float) -> None:
    subject, camera, painter = painted_box(size)
    view = CPU.render(subject.base, camera)
    new, drawn = dataclasses.replace(subject, threshold=threshold).completed_view(camera, rendering=view)
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


def test_a_scene_asks_for_its_widest_views_and_goes_on_from_the_exemplar(monkeypatch: pytest.MonkeyPatch) -> None:
    subject, _, painter = painted_box((96, 72))
    later: list[Tensor] = []
    monkeypatch.setattr(
        ExemplarTexture, "colors", lambda self, structure, *_: later.append(structure) or structure.repeat(2, 2, 1)
    )
    path = trajectory("rotate-forward", subject.photo_camera, 0.4, DepthRange.of(subject.base), 9)
    subject.complete_scene(path, exact=True)
    assert (len(painter.asked), len(later) > 0) == (PAINTED_VIEWS, True)


def test_the_exemplars_texture_leaves_low_frequencies_to_the_structure() -> None:
    subject, camera = box_view(0.3)
    view = CPU.render(subject.base, camera)
    cues, seeds, _ = features_of(view, camera, subject.photo_camera)
    rim, patches = Rim.with_patches(cues, seeds, camera, subject.photo_camera)
    rim = dataclasses.replace(rim, beyond=torch.zeros_like(rim.beyond))
    structure = torch.rand(cues.rgb.shape, generator=torch.Generator().manual_seed(0))
    found, plain = (
        EXEMPLAR.colors(
            structure, view, cues, seeds, rim, dataclasses.replace(patches, mismatch=patches.mismatch + bad)
        )
        for bad in (0, 100)
    )
    fine = found - plain
    assert float(in_cells(fine)[cues.mask].abs().mean()) > 1e-3
    assert float(blurred(fine, 4 * TEXTURE_PX).abs().max()) < 0.1 * float(fine.abs().max())
    smooth = in_cells(sharpened(from_cells(in_cells(view.rgb)), 1))[~cues.mask]
    assert float((in_cells(plain)[~cues.mask] - smooth).abs().mean()) < 0.02


def test_beyond_the_photos_border_more_of_patches_is_shown_but_nothing_broad() -> None:
    """Stripes on a wall, brighter where patches come from; the structure that meets them is grey."""
    stripes = (0.5 + 0.1 * torch.sin(torch.arange(192) * math.tau / 16)).view(1, -1, 1).repeat(96, 1, 3)
    stripes[:, :96] += 0.2
    mask = torch.zeros(48, 96, dtype=torch.bool)
    mask[:, 56:] = True
    rows, columns = torch.meshgrid(torch.arange(48), torch.arange(96), indexing="ij")
    matches = torch.stack([torch.zeros_like(rows), rows, columns - 48], dim=-1).where(mask[..., None], torch.tensor(-1))
    rgb, flat, nothing = in_cells(stripes).mean((2, 3)), torch.ones(48, 96), torch.zeros(48, 96)
    cues, seeds = Cues(rgb, flat, flat, mask), Seeds(torch.zeros(48, 96, 2), flat, torch.zeros(48, 96, 2), rgb)
    view = Rendering(stripes, torch.ones(96, 192), torch.ones(96, 192))
    structure, patches = torch.full_like(rgb, 0.5), Exemplar(rgb, nothing, matches)
    inner = slice(24, 72), slice(144, 176)
    amplitudes, means = [], []
    for beyond in (mask, torch.zeros_like(mask)):
        rim = Rim(rgb, rgb, nothing, rgb, nothing, beyond)
        found = EXEMPLAR.colors(structure, view, cues, seeds, rim, patches)[inner]
        amplitudes.append(float((found - found.mean()).abs().mean() / (stripes[inner] - 0.5).abs().mean()))
        means.append(float(found.mean()))
    fine, broad = (1 - math.exp(-2 * (math.pi * width / 16) ** 2) for width in (TEXTURE_PX, BROAD * 192))
    assert amplitudes == pytest.approx([(1 - SHOWN) * fine + SHOWN * broad, fine], rel=0.1)
    assert means == pytest.approx([0.5, 0.5], abs=0.02)


def test_beyond_the_photos_border_its_nearest_cells_go_on_if_they_are_as_far_away() -> None:
    subject, camera = box_view(0.3)
    cues, seeds, rim = features_of(subject.base, camera, subject.photo_camera)
    assert 100 < int(rim.beyond.sum()) < int(cues.mask.sum()) - 100
    structure = torch.rand(cues.rgb.shape, generator=torch.Generator().manual_seed(0))
    found, known = continued(structure, cues, seeds, rim), (~cues.mask).nonzero()
    assert torch.equal(found[~rim.beyond], structure[~rim.beyond])
    uv, z = subject.photo_camera.project(camera.unproject(seeds.uv, 1 / seeds.inverse_depth))
    outside = (uv < 0).any(-1) | (uv[..., 0] > 96) | (uv[..., 1] > 72) | (z <= 0)
    assert torch.equal(rim.beyond, outside & cues.mask)
    for y, x in rim.beyond.nonzero()[::17].tolist():
        apart = (known - torch.tensor([y, x])).double().norm(dim=-1)
        row, column = known[apart.argmin()].tolist()
        depths = math.log(float(seeds.inverse_depth[y, x] / cues.inverse_depth[row, column])) / SAME_DEPTH
        share = math.exp((1 - float(apart.min())) / CONTINUED_CELLS - depths**2)
        torch.testing.assert_close(found[y, x], (1 - share) * structure[y, x] + share * cues.rgb[row, column])


def test_texture_is_no_stronger_than_what_is_around_the_hole() -> None:
    """A calm wall and a lively one: noise that is as strong everywhere fits in one hole and not in the other."""
    mask = torch.zeros(48, 96, dtype=torch.bool)
    mask[16:32, 12:36] = mask[16:32, 60:84] = True
    noise = 0.1 * torch.randn(96, 192, 3, generator=torch.Generator().manual_seed(0))
    calm = ~from_cells(mask[..., None, None, None].expand(48, 96, 2, 2, 1))[..., 0]
    calm[:, 96:] = False
    flat = torch.ones(48, 96)
    cues = Cues(flat[..., None].expand(-1, -1, 3), flat, flat, mask)
    seeds = Seeds(torch.zeros(48, 96, 2), flat, torch.zeros(48, 96, 2), cues.rgb)
    rim = Rim(cues.rgb, cues.rgb, flat, cues.rgb, flat, mask)
    factors = _in_proportion(torch.where(calm[..., None], 0.1 * noise, noise), cues, seeds, rim)
    assert float(factors[20:28, 16:32].mean()) == pytest.approx(0.1, abs=0.04)
    assert float(factors[20:28, 64:80].mean()) > 0.85
    assert float(factors.max()) <= 1
