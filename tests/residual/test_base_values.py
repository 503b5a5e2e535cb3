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

from spackle.camera import Camera
from spackle.render.protocol import Rendering
from spackle.residual import Seeds, ViewFeatures, make_seeds
from spackle.residual.base_values import BEHIND, BLOB_CELLS, inside_photo
from spackle.residual.epipolar_walk import CRISP, SAME_DEPTH, WIDENING
from spackle.residual.rim import Rim, find_rim
from spackle.residual.view_features import cell_centers


@settings(deadline=None, max_examples=60)
@given(st.integers(0, 2**32 - 1), st.tuples(st.integers(1, 40), st.integers(1, 40)))
def test_seeds_of_any_view_lie_behind_what_is_seen(seed: int, size: tuple[int, int]) -> None:
    features, camera = ViewFeatures.of(random_view(seed, *size)), Camera.from_focal(25, size[1], size[0])
    seeds = make_seeds(features, camera, camera)
    assert all(bool(t.isfinite().all()) for t in (seeds.uv, seeds.inverse_depth, seeds.slope, seeds.rgb))
    assert float(seeds.inverse_depth.min()) > 0
    assert 0 <= float(seeds.rgb.min()) <= float(seeds.rgb.max()) <= 1
    for y, x in features.mask.nonzero().tolist():
        near = (slice(max(y - BLOB_CELLS, 0), y + BLOB_CELLS + 1), slice(max(x - BLOB_CELLS, 0), x + BLOB_CELLS + 1))
        seen = features.inverse_depth[near]
        if bool((seen > 0).any()):
            assert float(seeds.inverse_depth[y, x]) <= float(seen[seen > 0].min()) * (1 - BEHIND / 2)
    chosen = seeds.select(features.mask)
    for name in ("uv", "inverse_depth", "slope", "rgb"):
        assert torch.equal(getattr(chosen, name), getattr(seeds, name)[features.mask])


def test_the_photos_frame_is_found_point_by_point() -> None:
    photo = Camera.from_focal(25, 40, 30)
    camera = photo.looking(torch.tensor([0.4, -0.2, 0.1]), torch.tensor([0.1, 0.2, 3.0]))
    inverse = 0.1 + torch.rand(15, 20, generator=torch.Generator().manual_seed(0))
    place, z = photo.project(camera.unproject(cell_centers(camera), 1 / inverse))
    expected = (z > 0) & ((place >= 0) & (place < torch.tensor([40, 30]))).all(-1)
    assert 10 < int(expected.sum()) < 290
    assert torch.equal(inside_photo(inverse, camera, photo), expected)


def test_where_nothing_is_seen_seeds_make_a_grey_wall() -> None:
    camera = Camera.from_focal(20, 5, 3)
    centers = cell_centers(camera)
    assert (centers.shape, centers[1, 2].tolist()) == ((2, 3, 2), [5.0, 3.0])
    empty = Rendering(torch.zeros(3, 5, 3), torch.zeros(3, 5), torch.zeros(3, 5))
    seeds = make_seeds(ViewFeatures.of(empty), camera, camera)
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
    cues = ViewFeatures(rgb, inverse_depth, (~mask).float(), mask)
    seeds = Seeds(cell_centers(camera), inverse_depth, torch.zeros(HEIGHT, WIDTH, 2), rgb)
    return find_rim(cues, seeds, camera, CAMERA)[0]


def strip(first: int, last: int) -> Tensor:
    mask = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    mask[:, first : last + 1] = True
    return mask


# A colour that tells the column, and what columns such colours tell.
RAMP = (torch.arange(WIDTH).float() / 100).expand(HEIGHT, WIDTH)[..., None].repeat(1, 1, 3)


def told(colors: Tensor) -> list[int]:
    return [round(100 * value) for value in colors[..., 0].tolist()]


@pytest.mark.parametrize("far_left", [True, False])
def test_after_a_sideways_move_a_row_extends_its_farther_side(far_left: bool) -> None:
    depth = torch.full((HEIGHT, WIDTH), 0.5)
    depth[:, :8] = 0.1 if far_left else 1.0
    rim = rim_of(strip(8, 11), depth, moved(*SIDEWAYS), RAMP)
    assert told(rim.rgb[5, 8:12]) == ([7] * 4 if far_left else [12] * 4)
    assert told(rim.mirrored[5, 8:12]) == ([6, 5, 4, 3] if far_left else [16, 15, 14, 13])
    assert rim.distance[5, 8:12].tolist() == ([1, 2, 3, 4] if far_left else [4, 3, 2, 1])
    assert torch.equal(rim.rgb[:, :8], RAMP[:, :8])
    assert not rim.distance[:, 12:].any()


def test_one_rim_counts_none_keeps_the_seed_and_none_is_mirrored() -> None:
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


def test_a_speck_at_the_border_fades_soon() -> None:
    rgb = torch.full((64, 128, 3), 0.3)
    rgb[31:33, :41] = torch.tensor([0.9, 0.1, 0.1])
    mask = torch.zeros(64, 128, dtype=torch.bool)
    mask[:, 41:] = True
    depth, camera = torch.ones(64, 128), dataclasses.replace(moved(*SIDEWAYS), width=256, height=128)
    seeds = Seeds(cell_centers(Camera.from_focal(40, 256, 128)), depth, torch.zeros(64, 128, 2), rgb)
    rim, _ = find_rim(ViewFeatures(rgb, depth, (~mask).float(), mask), seeds, camera, CAMERA)
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
