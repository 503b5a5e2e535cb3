"""Colours of filled holes, from patches of the view or from an inpainter."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import pytest
import torch
from helpers.holes import CPU, box_view, view_of
from helpers.plain_patches import Subject
from torch import Tensor

from spackle.core.camera import Camera
from spackle.core.filters import gaussian_blur, maximum_filter
from spackle.core.patch_matching import Patches
from spackle.core.surfels import PIXEL_SIGMA_PX
from spackle.core.trajectories import DepthRange, trajectory_cameras
from spackle.inpaint import InpainterOptions
from spackle.inpaint.plain import PlainInpainter
from spackle.residual import InitialGaussians, hole_mask
from spackle.residual.composer import compose
from spackle.scene_fill import FillContext, exemplar_texture, fill_scene, fill_view, painted_texture
from spackle.scene_fill import texture as room
from spackle.scene_fill.fill import OPPOSITE_VIEWS
from spackle.scene_fill.view_completion import SceneViewCompletion


@pytest.mark.parametrize("period", [4.0, 6.0, 8.0])  # pixels
def test_sharpening_balances_overlap(period: float) -> None:
    camera = Camera.from_focal(80, 96, 72)
    uv = camera.pixel_centers()
    x, y = (2 * torch.pi / period * uv).unbind(-1)
    wanted = 0.12 * torch.stack([x.sin(), y.cos(), (x + 1).sin()], dim=-1)
    depths = 4 + 0.01 * torch.randn(uv.shape[:2], generator=torch.Generator().manual_seed(0))

    def strength(colors: Tensor) -> float:
        grid = (uv, 1 / depths, torch.zeros_like(uv), 0.5 + colors)
        blobs = compose(
            InitialGaussians(*(field.flatten(0, 1) for field in grid)), None, camera, PIXEL_SIGMA_PX
        )
        shown, truth = (image[4:-4, 4:-4] for image in (CPU.render(blobs, camera).rgb, wanted))
        return float(((shown - shown.mean((0, 1))) * truth).sum() / truth.square().sum())

    assert strength(wanted) < 0.96
    assert (
        1.05 < strength(room.sharpen_for_overlap(wanted)) < 1.6
    )  # more than 1, to balance the blur of votes


class Paint(PlainInpainter):
    """Paints a ramp of colours, and records the inputs."""

    name, version = "paint", "1"

    def __init__(self, options: InpainterOptions) -> None:
        self.asked: list[tuple[Tensor, ...]] = []

    def paint(self, rgb: Tensor, hole: Tensor, inverse_depth: Tensor) -> Tensor:
        self.asked.append((rgb, hole, inverse_depth))
        return torch.where(hole[..., None], ramp(*hole.shape[1:]), rgb)


def ramp(height: int, width: int) -> Tensor:
    across = torch.linspace(0.2, 0.8, width).expand(height, width)
    return torch.stack([0.1 + 0 * across, across, 0.2 + 0 * across], dim=-1)


@pytest.mark.parametrize(("size", "threshold"), [((96, 72), 0.95), ((95, 71), 0.98)])
def test_painted_textures_are_visible(size: tuple[int, int], threshold: float) -> None:
    context, camera = box_view(0.3, width=size[0], height=size[1])
    painter = Paint(InpainterOptions())
    texture = functools.partial(painted_texture, painter)
    context = dataclasses.replace(context, texture=texture, threshold=threshold)
    view = CPU.render(context.base, camera)
    filled, hole = fill_view(context, camera, rendering=view), hole_mask(view.alpha, threshold)
    ((rgb, asked, inverse_depth),) = painter.asked
    assert torch.equal(rgb[0], view.rgb)
    assert torch.equal(asked[0], hole)
    torch.testing.assert_close(inverse_depth[0], torch.where(hole, 0, 1 / view.depth))
    inner = ~maximum_filter(~hole, 2)
    assert int(inner.sum()) > 2000
    assert float((filled.rendering.rgb - ramp(*hole.shape))[inner].abs().mean()) < 0.01
    assert bool((filled.aux.colors.sum(-1) > 0).all())  # no black cells
    painter.asked.clear()
    path = trajectory_cameras(
        "rotate-forward", context.photo_camera, 0.4, DepthRange.of(context.base, is_metric=True), 9
    )
    assert len(fill_scene(context, path, exact=True).aux)
    assert len(painter.asked) == OPPOSITE_VIEWS  # only the widest views


def hole_view() -> tuple[SceneViewCompletion, Tensor, FillContext]:
    """A view of the box, and random colours of its cells."""
    context, camera = box_view(0.3)
    view = view_of(context.base, camera, context.photo_camera)
    generator = torch.Generator().manual_seed(0)
    return view, torch.rand(view.features.rgb.shape, generator=generator), context


def test_texture_has_no_low_frequencies() -> None:
    view, structure, _ = hole_view()
    textured = exemplar_texture(view, structure)
    view.patches = dataclasses.replace(view.patches, mismatch=view.patches.mismatch + 100)
    plain = exemplar_texture(view, structure)
    fine, mask = textured - plain, view.mask
    assert float(room.group_by_cell(fine)[mask].abs().mean()) > 1e-3
    assert float(gaussian_blur(fine, 4 * room.TEXTURE_SIGMA_PX).abs().max()) < 0.1 * float(
        fine.abs().max()
    )
    rendered = room.group_by_cell(view.rendering.rgb)
    assert torch.equal(room.group_by_cell(plain)[~mask], rendered[~mask])


def test_colours_at_the_border_are_extended() -> None:
    view, structure, context = hole_view()
    features, beyond = view.features, view.beyond_photo
    points = view.camera.unproject(view.initial.uv, 1 / view.initial.inverse_depth)
    uv, z = context.photo_camera.project(points)
    outside = (uv < 0).any(-1) | (uv[..., 0] > 96) | (uv[..., 1] > 72) | (z <= 0)
    assert torch.equal(beyond, outside & features.mask)
    found = room.continue_border(view, structure)
    assert torch.equal(found[~beyond], structure[~beyond])
    cells, known = beyond.nonzero(), (~features.mask).nonzero()
    apart, nearest = torch.cdist(cells.float(), known.float()).min(1)
    near, far = apart == 1, apart == apart.max()
    shown = features.rgb[tuple(known[nearest].T)] - found[beyond]
    changed = (found - structure)[beyond].abs()
    assert float(shown[near].abs().mean()) < 0.3 * float(changed[near].mean())
    assert float(changed[far].mean()) < 0.3 * float(changed[near].mean())


def test_blocks_are_weighted_means_of_matches() -> None:
    subject, rng = Subject(24, 31), np.random.default_rng(3)
    places, costs = np.full((24, 31, 3), -1, np.int32), np.zeros((24, 31), np.float32)
    places[tuple(subject.cells.T)], costs[tuple(subject.cells.T)] = subject.places, subject.costs
    blocks = rng.random((24, 31, 2, 3, 1)).astype(np.float32)
    grids = [torch.from_numpy(grid) for grid in (subject.rgb.numpy(), np.sqrt(costs), places)]
    found = room.copy_patch_blocks(Patches(*grids), torch.from_numpy(blocks)).numpy()
    assert np.array_equal(found[~subject.hole], blocks[~subject.hole])
    sources = (blocks, blocks[:, ::-1, :, ::-1])
    for cell in subject.cells:
        over = np.abs(subject.cells - cell).max(1) <= 1
        moved = subject.places[over] + np.pad(cell - subject.cells[over], [(0, 0), (1, 0)])
        weights = np.exp(-subject.costs[over] / subject.costs.mean()) + 1e-6
        expected = np.average([sources[m][v, u] for m, v, u in moved], axis=0, weights=weights)
        np.testing.assert_allclose(found[tuple(cell)], expected, rtol=1e-4)
