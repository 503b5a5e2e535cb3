"""Values at a hole's far rim, against hand-computed values and lines traced in plain Python."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from torch import Tensor

from spackle.core.camera import Camera
from spackle.render.protocol import Rendering
from spackle.residual import InitialGaussians, ViewFeatures
from spackle.residual.epipolar import SAME_SURFACE_RATIO
from spackle.residual.features import cell_centers
from spackle.scene_fill.view_completion import FarRim, SceneViewCompletion

HEIGHT, WIDTH = 12, 20  # cells
CAMERA = Camera.from_focal(40.0, 2 * WIDTH, 2 * HEIGHT)
SIDEWAYS = (0.3, 0.0, 0.0)
# The colour encodes the column.
RAMP = (torch.arange(WIDTH).float() / 100).expand(HEIGHT, WIDTH)[..., None].repeat(1, 1, 3)


def moved(*eye: float, width: int = WIDTH, height: int = HEIGHT) -> Camera:
    """The camera at another position with the same direction."""
    matrix = torch.eye(4)
    matrix[:3, 3] = -torch.tensor(eye)
    return dataclasses.replace(CAMERA, world_to_camera=matrix, width=2 * width, height=2 * height)


def rim_of(mask: Tensor, inverse_depth: Tensor, rgb: Tensor, *eye: float) -> FarRim:
    """The rims of a view with these cells, whose initial Gaussians have the cells' own values."""
    height, width = mask.shape
    camera = moved(*eye, width=width, height=height)
    empty = torch.zeros(2 * height, 2 * width)
    view = SceneViewCompletion(
        Rendering(empty[..., None].repeat(1, 1, 3), empty, empty), camera, CAMERA
    )
    view.features = ViewFeatures(rgb, inverse_depth, (~mask).float(), mask)
    slope = torch.zeros(*mask.shape, 2)
    view.initial = InitialGaussians(cell_centers(camera), inverse_depth, slope, rgb)
    return view.far_rim


def row_of(first: int, last: int, depth: Tensor) -> tuple[list[int], list[int], list[int]]:
    """For a hole in columns first..last: the columns found at the rim, the mirrored columns, and
    the distances.
    """
    mask = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    mask[:, first : last + 1] = True
    rim = rim_of(mask, depth.expand(HEIGHT, WIDTH).contiguous(), RAMP, *SIDEWAYS)
    assert torch.equal(rim.rgb[~mask], RAMP[~mask])
    assert not rim.distance[~mask].any()
    rgb, mirrored = (
        torch.round(100 * colors[5, mask[5], 0]).int().tolist()
        for colors in (rim.rgb, rim.mirrored)
    )
    return rgb, mirrored, rim.distance[5, mask[5]].int().tolist()


def test_a_sideways_move_finds_the_farther_side_of_a_row() -> None:
    right, ones = torch.arange(WIDTH) >= 8, torch.ones(WIDTH)
    assert row_of(8, 11, torch.where(right, 0.5, 0.1)) == ([7] * 4, [6, 5, 4, 3], [1, 2, 3, 4])
    assert row_of(8, 11, torch.where(right, 0.5, 1.0)) == ([12] * 4, [16, 15, 14, 13], [4, 3, 2, 1])
    assert row_of(15, 19, ones) == ([14] * 5, [13, 12, 11, 10, 9], [1, 2, 3, 4, 5])  # one rim
    assert row_of(0, 19, ones) == (
        list(range(20)),
        list(range(20)),
        [0] * 20,
    )  # no rim: the initial colours are kept
    _, mirrored, _ = row_of(
        8, 11, torch.where(torch.arange(WIDTH) < 6, 0.2 * SAME_SURFACE_RATIO * 1.01, 0.2)
    )
    assert mirrored in ([6, 7, 7, 7], [16, 15, 14, 13])  # other surfaces are not mirrored


def plain_rim(mask: Tensor, depth: Tensor, rgb: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Colour and distance, cell by cell; two points on a ray give the epipolar line."""
    color, distance = rgb.clone(), torch.zeros(HEIGHT, WIDTH)
    centers = cell_centers(camera)
    for y, x in mask.nonzero().tolist():
        here = camera.unproject(centers[y, x].double(), torch.tensor(3.0, dtype=torch.float64))
        other, _ = camera.project(here + 0.01 * (here - CAMERA.position.double()))  # on one ray
        line = other - centers[y, x]
        dx, dy = (line / line.norm()).tolist()
        best = math.inf
        for sign in (1, -1):
            for k in range(1, HEIGHT + WIDTH):
                v, u = math.floor(y + sign * k * dy + 0.5), math.floor(x + sign * k * dx + 0.5)
                if not (0 <= v < HEIGHT and 0 <= u < WIDTH):
                    break
                if not mask[v, u]:
                    if float(depth[v, u]) < best:
                        best = float(depth[v, u])
                        color[y, x], distance[y, x] = rgb[v, u], k
                    break
        if (
            1.4 * float(depth[y, x]) < best < math.inf
        ):  # a nearer surface does not continue into the hole
            color[y, x] = rgb[y, x]
    return color, distance


@pytest.mark.parametrize(
    "eye", [SIDEWAYS, (-0.2, 0.31, 0.0), (0.1, -0.05, 0.6), (0.013, 0.007, -0.5)]
)
def test_any_move_matches_lines_in_plain_python(eye: tuple[float, float, float]) -> None:
    generator = torch.Generator().manual_seed(3)
    mask = torch.rand(HEIGHT, WIDTH, generator=generator) < 0.6
    depth = 0.1 + torch.rand(HEIGHT, WIDTH, generator=generator)
    rgb = torch.rand(HEIGHT, WIDTH, 3, generator=generator)
    rim = rim_of(mask, depth, rgb, *eye)
    color, distance = plain_rim(mask, depth, rgb, moved(*eye))
    # A line through a cell's corner may round to either side.
    same = (rim.distance == distance) & (rim.rgb == color).all(-1)
    assert float(same[mask].float().mean()) > 0.97
