"""Targets of views: only the holes change."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from helpers.scenes import box_before_wall, cast, shifted
from torch import Tensor

from spackle.core.camera import Camera
from spackle.core.trajectories import SHARP_TRAJECTORIES, DepthRange, SharpTrajectory
from spackle.inpaint import INPAINTERS, InpainterOptions, get_inpainter, known_inverse_depth
from spackle.paper.dataset.views import (
    SAME_VIEW_DISTANCE,
    ViewStack,
    cameras_along_path,
    complete_views,
    paint_video,
    render_views,
)
from spackle.render import get_renderer


@pytest.mark.parametrize("kind", SHARP_TRAJECTORIES)
@pytest.mark.parametrize("views", [2, 10, 20, 22])
def test_no_two_views_are_alike_and_the_first_is_the_photos(
    kind: SharpTrajectory, views: int
) -> None:
    camera = Camera.from_focal(80.0, 96, 72)
    cameras = cameras_along_path(kind, 0.4, camera, DepthRange(2.0, 3.0), views)
    assert len(cameras) == views
    assert cameras[0] is camera
    eyes = torch.stack([view.position.double() for view in cameras])
    assert float(torch.nn.functional.pdist(eyes).min()) > SAME_VIEW_DISTANCE
    with pytest.raises(ValueError, match="different views"):
        cameras_along_path(kind, 0.0, camera, DepthRange(2.0, 3.0), views)


def stack_of(*rights: float) -> ViewStack:
    scene = box_before_wall()
    views = [scene.camera, *(shifted(scene.camera, right) for right in rights)]
    return render_views(scene.lift(), views, get_renderer())


@pytest.mark.parametrize("name", ["exemplar", "geometry", "none"])
def test_completion_touches_the_holes_alone(name: str) -> None:
    stack = stack_of(0.4, -0.3)
    inpainter = get_inpainter(name, InpainterOptions()) if name in INPAINTERS else None
    targets = complete_views(stack, name, inpainter, get_renderer())
    assert torch.equal(targets[~stack.mask], stack.rgb[~stack.mask])
    assert bool((targets[stack.mask].amax(-1) > 0.2).all()) == (name != "none")
    whole = dataclasses.replace(stack, mask=torch.zeros_like(stack.mask))
    assert torch.equal(complete_views(whole, name, inpainter, get_renderer()), stack.rgb)


def test_views_that_are_painted_in_turn_show_the_same_wall() -> None:
    stack, inpainter = stack_of(0.4, 0.3, 0.2), get_inpainter("exemplar", InpainterOptions())
    in_turn = complete_views(stack, "exemplar", inpainter, get_renderer())
    alone = inpainter.paint(stack.rgb, stack.mask, known_inverse_depth(stack.depth, stack.mask))

    def difference(targets: Tensor) -> float:
        """Mean difference at spots of the wall where two views have a hole."""
        found = []
        for here, there in ((1, 2), (1, 3), (2, 3)):
            uv, _ = stack.cameras[there].project(cast(stack.cameras[here], 6.0))
            x, y = uv.long().unbind(-1)
            inside = (uv >= 0).all(-1) & (x < 96) & (y < 72)
            x, y = x.clamp(0, 95), y.clamp(0, 71)
            both = inside & stack.mask[here] & stack.mask[there][y, x]
            assert int(both.sum()) > 200
            found.append((targets[here] - targets[there][y, x]).abs()[both].mean())
        return float(torch.stack(found).mean())

    assert difference(in_turn) < 0.4 * difference(alone)


class Numbering:
    """Paints every hole with the view's index, and keeps the input."""

    def paint(self, rgb: Tensor, hole: Tensor, inverse_depth: Tensor) -> Tensor:
        self.inputs = rgb, hole, inverse_depth
        return torch.where(hole[..., None], torch.arange(len(rgb)).float().view(-1, 1, 1, 1), rgb)


def test_an_inpainter_gets_the_views_in_the_order_of_the_path() -> None:
    stack = stack_of(0.3, -0.3, -0.4)
    inpainter, order = Numbering(), [1, 0, 2, 3]
    # It is no inpainter in all respects.
    targets = paint_video(inpainter, stack)  # type: ignore[arg-type]
    rgb, hole, inverse_depth = inpainter.inputs
    assert torch.equal(rgb, stack.rgb[order])
    assert torch.equal(hole, stack.mask[order])
    assert not bool(inverse_depth[hole].any())
    torch.testing.assert_close(
        inverse_depth[~hole] * stack.depth[order][~hole], torch.ones(int((~hole).sum()))
    )
    places = [
        target[mask].unique().tolist() for target, mask in zip(targets, stack.mask, strict=True)
    ]
    assert places == [[], [0], [2], [3]]
