"""Seeds continue what lies behind; at the far rim, by hand and against a walk written plainly."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from holes import CPU, box_view, random_view
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import box_mask, cast, shifted, slanted_plane, wall
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d

from spackle.camera import Camera
from spackle.fill import FAR_BIAS, far_fill
from spackle.render.protocol import Rendering
from spackle.residual import CELL, Cues, Seeds, make_seeds
from spackle.residual.seeds import BEHIND, BLOB_CELLS, SAME_DEPTH, Rim, cell_centers
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
    filled, rgb = far_fill(cues.inverse_depth, colors, known, far_bias=torch.where(inside, FAR_BIAS, 0.0))
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


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 2**32 - 1), st.tuples(st.integers(1, 7), st.integers(1, 7)))
def test_seeds_of_any_view_are_finite_and_in_front_of_the_camera(seed: int, size: tuple[int, int]) -> None:
    camera = Camera.from_focal(20, size[1], size[0])
    seeds = make_seeds(Cues.of(random_view(seed, *size)), camera, camera)
    assert all(bool(image.isfinite().all()) for image in (seeds.uv, seeds.inverse_depth, seeds.slope, seeds.rgb))
    assert float(seeds.inverse_depth.min()) > 0
    assert 0 <= float(seeds.rgb.min()) <= float(seeds.rgb.max()) <= 1


def test_where_nothing_is_seen_seeds_make_a_grey_wall() -> None:
    camera = Camera.from_focal(20, 5, 3)
    centers = cell_centers(camera)
    assert (centers.shape, centers[1, 2].tolist()) == ((2, 3, 2), [5.0, 3.0])
    empty = Rendering(torch.zeros(3, 5, 3), torch.zeros(3, 5), torch.zeros(3, 5))
    seeds = make_seeds(Cues.of(empty), camera, camera)
    assert torch.equal(seeds.inverse_depth, torch.full((2, 3), 0.1))
    assert torch.equal(seeds.rgb, torch.full((2, 3, 3), 0.5))


@pytest.mark.parametrize("side", [0, 1])
def test_behind_a_box_seeds_continue_the_wall_in_depth_and_colour(side: int) -> None:
    completer, camera = box_view(side=side)
    cues = Cues.of(CPU.render(completer.base, camera))
    seeds = make_seeds(cues, camera, completer.photo_camera)
    uv, _ = completer.photo_camera.project(cast(camera, 6.0)[1::2, 1::2])
    x, y = uv.long().unbind(-1)
    inside = (x >= 0) & (x < 96) & (y >= 0) & (y < 72)
    behind = cues.mask & inside & box_mask(96, 72)[y.clamp(0, 71), x.clamp(0, 95)]
    assert int(behind.sum()) > 20
    assert float((1 / seeds.inverse_depth[behind] > 4).float().mean()) > 0.75  # the box stands at 2, the wall at 6
    bluish = seeds.rgb[..., 2] > seeds.rgb[..., 0]
    assert float(bluish[behind].float().mean()) > 0.8


def test_beyond_the_photos_border_a_plane_goes_on() -> None:
    scene = wall()
    camera = shifted(scene.camera, 1.0)
    cues = Cues.of(CPU.render(scene.base(), camera))
    assert 0.05 < float(cues.mask.float().mean()) < 0.5
    seeds = make_seeds(cues, camera, scene.camera)
    z = camera.unproject(seeds.uv, 1 / seeds.inverse_depth)[..., 2]
    assert float((z[cues.mask] / 4 - 1).abs().max()) < 0.15


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


# The far rim

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


def ramp(axis: int = 1) -> Tensor:
    """A colour that tells the row or the column: [h, w, 3]."""
    line = torch.arange((HEIGHT, WIDTH)[axis]).float()
    return (line if axis else line[:, None]).expand(HEIGHT, WIDTH)[..., None].repeat(1, 1, 3) / 100


def strip(first: int, last: int) -> Tensor:
    mask = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    mask[:, first : last + 1] = True
    return mask


def told(colors: Tensor) -> list[int]:
    """The rows or columns that `ramp`'s colours tell."""
    return [round(100 * value) for value in colors[..., 0].tolist()]


@pytest.mark.parametrize("far_left", [True, False])
def test_after_a_sideways_move_a_row_goes_on_from_its_farther_side(far_left: bool) -> None:
    depth = torch.full((HEIGHT, WIDTH), 0.5)
    depth[:, :8] = 0.1 if far_left else 1.0
    rim = rim_of(strip(8, 11), depth, moved(*SIDEWAYS), ramp())
    assert told(rim.rgb[5, 8:12]) == ([7] * 4 if far_left else [12] * 4)
    assert told(rim.mirrored[5, 8:12]) == ([6, 5, 4, 3] if far_left else [16, 15, 14, 13])
    assert rim.distance[5, 8:12].tolist() == ([1, 2, 3, 4] if far_left else [4, 3, 2, 1])
    assert torch.equal(rim.rgb[:, :8], ramp()[:, :8])
    assert not rim.distance[:, 12:].any()


def test_beyond_the_border_the_only_rim_counts_and_without_one_the_seed_stays() -> None:
    rim = rim_of(strip(15, WIDTH - 1), torch.full((HEIGHT, WIDTH), 1.0), moved(*SIDEWAYS), ramp())
    assert told(rim.rgb[3, 15:]) == [14] * 5
    assert told(rim.mirrored[3, 15:]) == [13, 12, 11, 10, 9]
    rim = rim_of(strip(0, WIDTH - 1), torch.ones(HEIGHT, WIDTH), moved(*SIDEWAYS), ramp())
    assert torch.equal(rim.rgb, ramp())
    assert torch.equal(rim.mirrored, ramp())
    assert not rim.distance.any()


def test_another_surface_is_not_mirrored() -> None:
    depth = torch.full((HEIGHT, WIDTH), 0.2)
    depth[:, :6] = 0.2 * SAME_DEPTH * 1.01
    rim = rim_of(strip(8, 11), depth, moved(*SIDEWAYS), ramp())
    # The right side is as far: of two equal sides the first, in the direction of the line, counts.
    assert told(rim.mirrored[4, 8:12]) in ([6, 7, 7, 7], [16, 15, 14, 13])


def test_after_a_move_up_columns_count() -> None:
    depth, mask = torch.full((HEIGHT, WIDTH), 0.5), torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    depth[:4], mask[4:7] = 0.1, True
    rim = rim_of(mask, depth, moved(0, 0.3, 0), ramp(0))
    assert told(rim.rgb[4:7, 9]) == [3] * 3


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
    same = (rim.distance == distance) & (rim.rgb == color).all(-1)
    assert float(same[mask].float().mean()) > 0.97
