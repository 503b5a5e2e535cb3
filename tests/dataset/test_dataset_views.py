"""Targets of views: only the holes change, and geometry is calm from view to view."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from scenes import Scene, box_before_wall, cast, shifted
from torch import Tensor
from torch.nn.functional import grid_sample

from spackle.camera import Camera
from spackle.camera_path import TRAJECTORIES, DepthRange, TrajectoryKind
from spackle.dataset.views import APART, PathChoice, ViewStack, open_completion, paint, path_cameras, render_views
from spackle.inpaint import InpainterOptions
from spackle.render import get_renderer
from spackle.scene_fill import FillContext, fill_view


@pytest.mark.parametrize("kind", TRAJECTORIES)
@pytest.mark.parametrize("views", [2, 3, 20])
def test_no_two_views_are_alike_and_the_first_is_the_photos(kind: TrajectoryKind, views: int) -> None:
    camera = Camera.from_focal(80.0, 96, 72)
    cameras = path_cameras(PathChoice(kind, 0.4), camera, DepthRange(2.0, 3.0), views)
    assert len(cameras) == views
    assert cameras[0] is camera
    eyes = torch.stack([view.position.double() for view in cameras])
    assert float(torch.nn.functional.pdist(eyes).min()) > APART
    with pytest.raises(ValueError, match="different views"):
        path_cameras(PathChoice(kind, 0.0), camera, DepthRange(2.0, 3.0), views)


def completed(name: str, stack: ViewStack) -> Tensor:
    return open_completion(name, InpainterOptions(), get_renderer()).complete(stack)


def stack_of(*rights: float) -> ViewStack:
    scene = box_before_wall()
    views = [scene.camera, *(shifted(scene.camera, right) for right in rights)]
    return render_views(scene.lift(), views, get_renderer())


@pytest.mark.parametrize("name", ["geometry", "opencv", "none"])
def test_completion_touches_the_holes_alone(name: str) -> None:
    if name == "opencv":
        pytest.importorskip("cv2")
    stack = stack_of(0.4, -0.3)
    targets = completed(name, stack)
    assert torch.equal(targets[~stack.mask], stack.rgb[~stack.mask])
    assert bool((targets[stack.mask].amax(-1) > 0.2).all()) == (name != "none")
    whole = dataclasses.replace(stack, mask=torch.zeros_like(stack.mask))
    assert torch.equal(completed(name, whole), stack.rgb)


class Numbering:
    """Paints every hole with its view's place in the input, and keeps that."""

    def paint(self, rgb: Tensor, hole: Tensor, inverse_depth: Tensor) -> Tensor:
        self.inputs = rgb, hole, inverse_depth
        return torch.where(hole[..., None], torch.arange(len(rgb)).float().view(-1, 1, 1, 1), rgb)


def test_an_inpainter_gets_the_views_in_the_order_of_the_path() -> None:
    stack = stack_of(0.3, -0.3, -0.4)
    inpainter, order = Numbering(), [1, 0, 2, 3]
    targets = paint(inpainter, stack)  # type: ignore[arg-type]  # no inpainter in all respects
    rgb, hole, inverse_depth = inpainter.inputs
    assert torch.equal(rgb, stack.rgb[order])
    assert torch.equal(hole, stack.mask[order])
    assert not bool(inverse_depth[hole].any())
    torch.testing.assert_close(inverse_depth[~hole] * stack.depth[order][~hole], torch.ones(int((~hole).sum())))
    places = [target[mask].unique().tolist() for target, mask in zip(targets, stack.mask, strict=True)]
    assert places == [[], [0], [2], [3]]


FAR = 5.0  # metres of a wall that the photo's camera faces


def pattern(points: Tensor) -> Tensor:
    """The wall's colour [..., 3]."""
    x, y = points[..., 0], points[..., 1]
    waves = [torch.sin(9 * x + 4 * y), torch.sin(7 * y - 2 * x), torch.cos(6 * x + 5 * y)]
    broad = torch.stack([0.15 * torch.sin(0.9 * x), 0.1 * torch.sin(1.3 * y), 0.15 * torch.cos(0.8 * x)], -1)
    return (torch.tensor([0.35, 0.45, 0.6]) + 0.1 * torch.stack(waves, -1) + broad).clamp(0, 1)


def flicker(stack: ViewStack, targets: Tensor) -> tuple[float, float]:
    """Mean difference of the holes' colours between neighbouring views, followed along the wall, and from the truth."""
    between, truth = [], []
    for one in range(1, len(targets) - 1):
        points, colors = cast(stack.cameras[one], FAR)[stack.mask[one]], targets[one][stack.mask[one]]
        truth.append((colors - pattern(points)).abs().mean(-1))
        uv, _ = stack.cameras[one + 1].project(points)
        grid = (2 * uv / torch.tensor([targets.shape[2], targets.shape[1]]) - 1)[None, None]
        images = torch.cat([targets[one + 1], stack.mask[one + 1][..., None]], -1).permute(2, 0, 1)[None]
        found = grid_sample(images, grid, align_corners=False)[0, :, 0].T
        inside = found[:, 3] > 0.999  # a hole there too
        between.append((colors - found[:, :3]).abs().mean(-1)[inside])
    return float(torch.cat(between).mean()), float(torch.cat(truth).mean())


def test_geometry_is_calmer_than_views_completed_one_by_one() -> None:
    height, width = 96, 128
    camera = Camera.from_focal(0.85 * width, width, height)
    box = torch.zeros(height, width, dtype=torch.bool)
    box[height // 4 : height * 3 // 4, width * 3 // 8 : width * 5 // 8] = True
    points = cast(camera, FAR)
    front = torch.tensor([0.75, 0.3, 0.2]) + 0.1 * torch.sin(20 * points[..., :1])
    scene = Scene(torch.where(box[..., None], front, pattern(points)), torch.where(box, 2.0, FAR), camera)
    cameras = path_cameras(PathChoice("swipe", 0.4), camera, DepthRange.of(scene.base()), 8)
    stack = render_views(scene.lift(), cameras, get_renderer())
    context = FillContext(stack.prediction.gaussians, camera, get_renderer())
    guards = [context.photo_guard()]
    with torch.no_grad():
        alone = torch.stack([fill_view(context, view, guards).rendering.rgb for view in cameras])
    calm, off = flicker(stack, completed("geometry", stack))
    restless, other_off = flicker(stack, torch.where(stack.mask[..., None], alone, stack.rgb))
    assert calm < restless / 3
    assert off < 1.1 * other_off
