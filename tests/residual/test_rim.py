"""What stands at a hole's far rim: by hand, and against a walk written plainly."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from torch import Tensor

from spackle.camera import Camera
from spackle.residual.hole_features import Cues
from spackle.residual.seeds import SAME_DEPTH, Rim, Seeds, cell_centers

HEIGHT, WIDTH = 12, 20  # cells
CAMERA = Camera.from_focal(40.0, 2 * WIDTH, 2 * HEIGHT)


def moved(*eye: float) -> Camera:
    """The camera with its eye elsewhere, looking the same way."""
    matrix = torch.eye(4)
    matrix[:3, 3] = -torch.tensor(eye)
    return dataclasses.replace(CAMERA, world_to_camera=matrix)


def look(mask: Tensor, inverse_depth: Tensor, camera: Camera, rgb: Tensor | None = None) -> Rim:
    if rgb is None:
        rgb = torch.rand(HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(0))
    cues = Cues(rgb, inverse_depth, (~mask).float(), mask)
    seeds = Seeds(cell_centers(camera), inverse_depth, torch.zeros(HEIGHT, WIDTH, 2), rgb)
    return Rim.of(cues, seeds, camera, CAMERA)


def ramp() -> Tensor:
    """A colour that tells the column: [h, w, 3]."""
    return torch.arange(WIDTH).float().expand(HEIGHT, WIDTH)[..., None].repeat(1, 1, 3) / 100


def strip(first: int, last: int) -> Tensor:
    mask = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    mask[:, first : last + 1] = True
    return mask


@pytest.mark.parametrize("far_left", [True, False])
def test_after_a_sideways_move_a_row_goes_on_from_its_farther_side(far_left: bool) -> None:
    depth = torch.full((HEIGHT, WIDTH), 0.5)
    depth[:, :8] = 0.1 if far_left else 1.0
    rim = look(strip(8, 11), depth, moved(0.3, 0, 0), ramp())
    columns = (100 * rim.rgb[5, 8:12, 0]).round().tolist()
    mirrored = (100 * rim.mirrored[5, 8:12, 0]).round().tolist()
    assert columns == ([7] * 4 if far_left else [12] * 4)
    assert mirrored == ([6, 5, 4, 3] if far_left else [16, 15, 14, 13])
    assert rim.distance[5, 8:12].tolist() == ([1, 2, 3, 4] if far_left else [4, 3, 2, 1])
    assert torch.equal(rim.rgb[:, :8], ramp()[:, :8])
    assert not rim.distance[:, 12:].any()


def test_beyond_the_border_the_only_rim_counts() -> None:
    depth = torch.full((HEIGHT, WIDTH), 1.0)
    rim = look(strip(15, WIDTH - 1), depth, moved(0.3, 0, 0), ramp())
    assert (100 * rim.rgb[3, 15:, 0]).round().tolist() == [14] * 5
    assert (100 * rim.mirrored[3, 15:, 0]).round().tolist() == [13, 12, 11, 10, 9]


def test_another_surface_is_not_mirrored() -> None:
    depth = torch.full((HEIGHT, WIDTH), 0.2)
    depth[:, :6] = 0.2 * SAME_DEPTH * 1.01
    rim = look(strip(8, 11), depth, moved(0.3, 0, 0), ramp())
    # The right side is as far: of two equal sides the first, in the direction of the line, counts.
    beyond = (100 * rim.mirrored[4, 8:12, 0]).round().tolist()
    assert beyond in ([6, 7, 7, 7], [16, 15, 14, 13])


def test_after_a_move_up_columns_count() -> None:
    depth = torch.full((HEIGHT, WIDTH), 0.5)
    depth[:4] = 0.1
    mask = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    mask[4:7] = True
    rgb = torch.arange(HEIGHT).float()[:, None, None].expand(HEIGHT, WIDTH, 3) / 100
    rim = look(mask, depth, moved(0, 0.3, 0), rgb.contiguous())
    assert (100 * rim.rgb[4:7, 9, 0]).round().tolist() == [3] * 3


def test_where_no_line_meets_anything_the_seed_stays() -> None:
    rgb = torch.rand(HEIGHT, WIDTH, 3)
    rim = look(torch.ones(HEIGHT, WIDTH, dtype=torch.bool), torch.ones(HEIGHT, WIDTH), moved(0.3, 0, 0), rgb)
    assert torch.equal(rim.rgb, rgb)
    assert torch.equal(rim.mirrored, rgb)
    assert not rim.distance.any()


def plain_rim(mask: Tensor, depth: Tensor, rgb: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Colour and distance, cell by cell, the epipole found from two points of one line of sight."""
    color, distance = rgb.clone(), torch.zeros(HEIGHT, WIDTH)
    centers = cell_centers(camera)
    for y in range(HEIGHT):
        for x in range(WIDTH):
            if not mask[y, x]:
                continue
            here = camera.unproject(centers[y, x].double(), torch.tensor(3.0, dtype=torch.float64))
            eye = CAMERA.position.double()
            other, _ = camera.project(here + 0.01 * (here - eye))  # the photo sees both points at one place
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
    return color, distance


@pytest.mark.parametrize("eye", [(0.3, 0.0, 0.0), (-0.2, 0.31, 0.0), (0.1, -0.05, 0.6), (0.013, 0.007, -0.5)])
def test_any_move_agrees_with_a_plain_walk(eye: tuple[float, float, float]) -> None:
    generator = torch.Generator().manual_seed(3)
    mask = torch.rand(HEIGHT, WIDTH, generator=generator) < 0.6
    depth = 0.1 + torch.rand(HEIGHT, WIDTH, generator=generator)
    rgb = torch.rand(HEIGHT, WIDTH, 3, generator=generator)
    rim = look(mask, depth, moved(*eye), rgb)
    color, distance = plain_rim(mask, depth, rgb, moved(*eye))
    # A line through the corner of a cell may round to either side.
    same = (rim.distance == distance) & (rim.rgb == color).all(-1)
    assert float(same[mask].float().mean()) > 0.97
