"""Seeds continue what lies behind; at the far rim, by hand and against a walk written plainly."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from holes import random_view
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d

from spackle.camera import Camera
from spackle.fill import far_fill
from spackle.render.protocol import Rendering
from spackle.residual import CELL, Cues, Seeds, make_seeds
from spackle.residual.beyond_border import fill_around
from spackle.residual.epipolar_walk import CRISP, SAME_DEPTH, WIDENING
from spackle.residual.seeds import BEHIND, BLOB_CELLS, Rim, cell_centers
from spackle.surface import surface_slope


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
    filled, rgb = fill_around(cues, across, uv, known, inside, camera, photo_camera)
    seen = torch.where(cues.inverse_depth > 0, cues.inverse_depth, torch.inf)
    close = -max_pool2d(-seen[None, None], 2 * BLOB_CELLS + 1, stride=1, padding=BLOB_CELLS)[0, 0]
    inverse_depth = torch.where(cues.mask, torch.minimum(filled, close) * (1.0 - BEHIND), filled)
    slope = surface_slope(inverse_depth) / CELL
    return Seeds(uv, inverse_depth, slope, rgb.permute(1, 2, 0), float(inverse_depth.median()))


@settings(deadline=None, max_examples=60)
@given(st.integers(0, 2**32 - 1), st.tuples(st.integers(1, 40), st.integers(1, 40)), st.floats(0, 1))
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
    chosen = found.select(cues.mask)
    for name in ("uv", "inverse_depth", "slope", "rgb"):
        assert torch.equal(getattr(chosen, name), getattr(found, name)[cues.mask])
    assert chosen.unit == found.unit
    any_view = make_seeds(Cues.of(view), photo_camera, photo_camera)  # it may show nothing at all
    assert all(bool(t.isfinite().all()) for t in (any_view.uv, any_view.inverse_depth, any_view.slope, any_view.rgb))
    assert float(any_view.inverse_depth.min()) > 0
    assert 0 <= float(any_view.rgb.min()) <= float(any_view.rgb.max()) <= 1


def test_where_nothing_is_seen_seeds_make_a_grey_wall() -> None:
    camera = Camera.from_focal(20, 5, 3)
    centers = cell_centers(camera)
    assert (centers.shape, centers[1, 2].tolist()) == ((2, 3, 2), [5.0, 3.0])
    empty = Rendering(torch.zeros(3, 5, 3), torch.zeros(3, 5), torch.zeros(3, 5))
    seeds = make_seeds(Cues.of(empty), camera, camera)
    assert torch.equal(seeds.inverse_depth, torch.full((2, 3), 0.1))
    assert torch.equal(seeds.rgb, torch.full((2, 3, 3), 0.5))


HEIGHT, WIDTH = 12, 20  # cells
CAMERA = Camera.from_focal(40.0, 2 * WIDTH, 2 * HEIGHT)
SIDEWAYS = (0.3, 0.0, 0.0)


def moved(*eye: float) -> Camera:
    """The camera with its eye elsewhere, looking the same way."""
    matrix = torch.eye(4)
    matrix[:3, 3] = -torch.tensor(eye)
    return dataclasses.replace(CAMERA, world_to_camera=matrix)


def rim_of(mask: Tensor, inverse_depth: Tensor, camera: Camera, rgb: Tensor) -> Rim:
    cues = Cues(rgb, inverse_depth, (~mask).float(), mask)
    seeds = Seeds(cell_centers(camera), inverse_depth, torch.zeros(HEIGHT, WIDTH, 2), rgb)
    return Rim.of(cues, seeds, camera, CAMERA)


def strip(first: int, last: int) -> Tensor:
    mask = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    mask[:, first : last + 1] = True
    return mask


# A colour that tells the column, and what columns such colours tell.
RAMP = (torch.arange(WIDTH).float() / 100).expand(HEIGHT, WIDTH)[..., None].repeat(1, 1, 3)


def told(colors: Tensor) -> list[int]:
    return [round(100 * value) for value in colors[..., 0].tolist()]


@pytest.mark.parametrize("far_left", [True, False])
def test_after_a_sideways_move_a_row_goes_on_from_its_farther_side(far_left: bool) -> None:
    depth = torch.full((HEIGHT, WIDTH), 0.5)
    depth[:, :8] = 0.1 if far_left else 1.0
    rim = rim_of(strip(8, 11), depth, moved(*SIDEWAYS), RAMP)
    assert told(rim.rgb[5, 8:12]) == ([7] * 4 if far_left else [12] * 4)
    assert told(rim.mirrored[5, 8:12]) == ([6, 5, 4, 3] if far_left else [16, 15, 14, 13])
    assert rim.distance[5, 8:12].tolist() == ([1, 2, 3, 4] if far_left else [4, 3, 2, 1])
    assert torch.equal(rim.rgb[:, :8], RAMP[:, :8])
    assert not rim.distance[:, 12:].any()


def test_at_the_border_one_rim_counts_without_any_the_seed_stays_and_another_surface_is_not_mirrored() -> None:
    rim = rim_of(strip(15, WIDTH - 1), torch.full((HEIGHT, WIDTH), 1.0), moved(*SIDEWAYS), RAMP)
    assert told(rim.rgb[3, 15:]) == [14] * 5
    assert told(rim.mirrored[3, 15:]) == [13, 12, 11, 10, 9]
    rim = rim_of(strip(0, WIDTH - 1), torch.ones(HEIGHT, WIDTH), moved(*SIDEWAYS), RAMP)
    assert torch.equal(rim.rgb, RAMP)
    assert torch.equal(rim.mirrored, RAMP)
    assert not rim.distance.any()
    depth = torch.full((HEIGHT, WIDTH), 0.2)
    depth[:, :6] = 0.2 * SAME_DEPTH * 1.01
    rim = rim_of(strip(8, 11), depth, moved(*SIDEWAYS), RAMP)
    # The right side is as far: of two equal sides the first, in the direction of the line, counts.
    assert told(rim.mirrored[4, 8:12]) in ([6, 7, 7, 7], [16, 15, 14, 13])


def test_a_speck_at_the_border_fades_within_a_few_times_its_size() -> None:
    rgb = torch.full((64, 128, 3), 0.3)
    rgb[31:33, :41] = torch.tensor([0.9, 0.1, 0.1])
    mask = torch.zeros(64, 128, dtype=torch.bool)
    mask[:, 41:] = True
    depth, camera = torch.ones(64, 128), moved(*SIDEWAYS)
    seeds = Seeds(cell_centers(Camera.from_focal(40, 256, 128)), depth, torch.zeros(64, 128, 2), rgb)
    rim = Rim.of(Cues(rgb, depth, (~mask).float(), mask), seeds, camera, CAMERA)
    for found in (rim.rgb, rim.mirrored[:, 82:]):  # what is farther than the photo is wide is not mirrored
        assert float((found[..., 0] - 0.3)[:, -25:].abs().max()) < 0.1  # of 0.6
    assert float(rim.rgb[31:33, 41:45, 0].min()) > 0.6
    assert torch.allclose(rim.rgb[:8, 41:], torch.tensor(0.3), atol=0.02)


def plain_rim(mask: Tensor, depth: Tensor, rgb: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Colour and distance, cell by cell, the epipole found from two points of one line of sight."""
    color, distance = rgb.clone(), torch.zeros(HEIGHT, WIDTH)
    centers = cell_centers(camera)
    for y, x in mask.nonzero().tolist():
        here = camera.unproject(centers[y, x].double(), torch.tensor(3.0, dtype=torch.float64))
        other, _ = camera.project(here + 0.01 * (here - CAMERA.position.double()))  # the photo sees both at one place
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
        if 1.4 * float(depth[y, x]) < best < math.inf:  # what stands in front does not go on behind
            color[y, x] = rgb[y, x]
    return color, distance


@pytest.mark.parametrize("eye", [SIDEWAYS, (-0.2, 0.31, 0.0), (0.1, -0.05, 0.6), (0.013, 0.007, -0.5)])
def test_any_move_agrees_with_a_plain_walk(eye: tuple[float, float, float]) -> None:
    generator = torch.Generator().manual_seed(3)
    mask = torch.rand(HEIGHT, WIDTH, generator=generator) < 0.6
    depth = 0.1 + torch.rand(HEIGHT, WIDTH, generator=generator)
    rgb = torch.rand(HEIGHT, WIDTH, 3, generator=generator)
    rim = rim_of(mask, depth, moved(*eye), rgb)
    color, distance = plain_rim(mask, depth, rgb, moved(*eye))
    # A line through the corner of a cell may round to either side.
    same = (rim.distance == distance) & ((rim.rgb == color).all(-1) | (distance > CRISP * WIDTH + 1 / WIDENING))
    assert float(same[mask].float().mean()) > 0.97
