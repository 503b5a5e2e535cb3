"""f_res where it is needed: crops around the holes, and its fine layers at some cells, say what the whole says."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from holes import CPU, CountingNetwork, box_view, features_of, shipped
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import Scene, texture
from torch import Tensor, nn
from torch.nn.functional import interpolate

from spackle.camera import Camera
from spackle.camera_path import DepthRange, extremes
from spackle.residual import Seeds, ViewFeatures, hole_area_ratio
from spackle.residual import network as residual_network
from spackle.residual.network import IN_CHANNELS, STRIDE, predict_deltas
from spackle.residual.rim import Rim
from spackle.residual.sparse import Cells, Crop, conv_rows, crops_around, relu_rows, upsampled
from spackle.scene_fill import fill_scene
from spackle.scene_fill.fill import SEEDS_HAR


@settings(deadline=None, max_examples=60)
@given(st.integers(0, 2**31), st.integers(1, 150), st.integers(1, 150), st.integers(0, 6), st.sampled_from([0, 5, 40]))
def test_each_masked_cell_is_in_one_crop_and_has_its_surroundings(
    seed: int, height: int, width: int, spots: int, margin: int
) -> None:
    rng = np.random.default_rng(seed)
    mask = torch.zeros(height, width, dtype=torch.bool)
    for _ in range(spots):
        y, x = int(rng.integers(height)), int(rng.integers(width))
        mask[y : y + int(rng.integers(1, 20)), x : x + int(rng.integers(1, 20))] = True
    times = torch.zeros(height, width, dtype=torch.int32)
    pairs = crops_around(mask, STRIDE, margin)
    for inner, outer in pairs:
        times[inner.slices] += 1
        assert outer.top % STRIDE == outer.left % STRIDE == 0
        for low, own, end, full in (
            (outer.top, inner.top, outer.bottom, height),
            (outer.left, inner.left, outer.right, width),
        ):
            assert low <= max(0, own - margin)
            assert end == full or end % STRIDE == 0
        assert outer.bottom >= min(inner.bottom + margin, height)
        assert outer.right >= min(inner.right + margin, width)
    assert bool((times[mask] == 1).all())
    assert bool((times <= 1).all())
    assert sum(outer.area for _, outer in pairs) <= height * width


def test_holes_far_apart_are_looked_at_apart_and_a_full_mask_at_once() -> None:
    mask = torch.zeros(768, 768, dtype=torch.bool)
    assert crops_around(mask, STRIDE) == []
    assert crops_around(~mask, STRIDE) == [(Crop(0, 0, 768, 768),) * 2]
    mask[10:20, 30:40] = mask[600:640, 700:710] = True
    pairs = crops_around(mask, STRIDE)
    assert len(pairs) == 2
    assert sum(outer.area for _, outer in pairs) < 0.1 * mask.numel()
    mask[:, :12] = mask[:10, :400] = mask[758:, :400] = True  # a frame of holes is cut into its sides
    pairs = crops_around(mask, STRIDE)
    assert len(pairs) >= 5
    assert sum(outer.area for _, outer in pairs) < 0.52 * mask.numel()


@pytest.fixture(scope="module")
def view() -> tuple[ViewFeatures, Seeds, Rim]:
    """A board before the left end of a long wall, seen from the side."""
    height, width = 96, 640
    depth = torch.full((height, width), 4.0)
    depth[20:70, 40:90] = 2.0
    scene = Scene(texture(height, width), depth, Camera.from_focal(500, width, height))
    base = scene.base()
    return features_of(base, extremes(scene.camera, 0.1, DepthRange.of(base))[1], scene.camera)


def test_crops_give_what_the_whole_picture_gives(view: tuple[ViewFeatures, Seeds, Rim]) -> None:
    mask = view[0].mask
    whole, cropped = CountingNetwork(shipped()), CountingNetwork(shipped())
    one = predict_deltas(whole, *view, "fp32", dense=True)
    other = predict_deltas(cropped, *view, "fp32")
    assert whole.cells == mask.numel()
    assert 0 < cropped.cells < 0.8 * whole.cells
    assert bool(one.any(-1)[::47, ::53].all())  # dense deltas are those of every cell
    torch.testing.assert_close(other[mask], one[mask], rtol=0, atol=0.01)
    assert float((other - one)[mask].abs().mean()) < 1e-3
    bf16 = predict_deltas(shipped(), *view, "bf16")
    assert not bf16[~mask].any()
    close(predict_deltas(shipped(), *view, "fp32")[mask], other[mask], 1e-4)
    assert float((other - one)[mask].abs().mean()) < 0.1 * float((bf16 - other)[mask].abs().mean())
    nothing = CountingNetwork(shipped())
    predict_deltas(nothing, dataclasses.replace(view[0], mask=torch.zeros_like(mask)), *view[1:])
    assert nothing.cells == 0


def test_specks_of_a_path_are_the_seeds_alone_and_great_holes_the_networks() -> None:
    subject, wide = box_view(0.3, width=160, height=120)
    _, little = box_view(0.006, width=160, height=120)
    counting = CountingNetwork(shipped())
    subject = dataclasses.replace(subject, network=counting)  # type: ignore[arg-type]
    holes = [hole_area_ratio(CPU.render(subject.base, camera).alpha) for camera in (wide, little)]
    assert holes[1] < SEEDS_HAR < holes[0]
    for camera, exact, asked in ((little, False, False), (little, True, True), (wide, False, True)):
        counting.cells = 0
        assert len(fill_scene(subject, [camera], exact=exact).aux) > 0
        assert bool(counting.cells) == asked


def some_cells(height: int, width: int, share: float, seed: int) -> Tensor:
    """[height, width] bool, one corner among them."""
    mask = torch.rand(height, width, generator=torch.Generator().manual_seed(seed)) < share
    mask[-1, -1] = True
    return mask


def table_of(grid: Tensor, cells: Cells) -> Tensor:
    """[C, h, w] to [n, C]."""
    return grid.permute(1, 2, 0)[cells.grid]


def close(found: Tensor, expected: Tensor, tolerance: float) -> None:
    torch.testing.assert_close(found, expected, rtol=0, atol=tolerance * float(expected.abs().max()))


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 2**31), st.integers(1, 9), st.integers(1, 9), st.floats(0, 0.6))
def test_rows_give_what_convolution_and_interpolation_of_the_grid_give(
    seed: int, height: int, width: int, share: float
) -> None:
    torch.manual_seed(seed)
    wanted = Cells(some_cells(2 * height, 2 * width, share, seed))
    fine, coarse = torch.randn(5, 2 * height, 2 * width), torch.randn(5, height, width)
    conv = nn.Conv2d(5, 3, 3, padding=1)
    with torch.no_grad():
        found = conv_rows(conv, relu_rows(table_of(fine, wanted.grown(1))), wanted.grown(1).around(wanted))
        torch.testing.assert_close(found, table_of(conv(fine[None].relu())[0], wanted), rtol=1e-4, atol=1e-5)
    read = wanted.halved()
    twice = interpolate(coarse[None], scale_factor=2, mode="bilinear", align_corners=False)[0]
    torch.testing.assert_close(upsampled(table_of(coarse, read), read, wanted), table_of(twice, wanted))


@pytest.mark.parametrize("few", [0.0, 0.45, 2.0])  # all by convolutions, as it comes, all by rows
@pytest.mark.parametrize(("height", "width", "share"), [(37, 53, 0.002), (64, 48, 0.03), (1, 1, 1.0), (20, 90, 0.4)])
def test_some_cells_get_the_deltas_that_all_would_get(
    monkeypatch: pytest.MonkeyPatch, height: int, width: int, share: float, few: float
) -> None:
    monkeypatch.setattr(residual_network, "FEW", few)
    network = shipped()
    features = torch.randn(1, IN_CHANNELS, height, width, generator=torch.Generator().manual_seed(1))
    mask = some_cells(height, width, share, 2)
    with torch.no_grad():
        expected = network(features)[0].permute(1, 2, 0)[mask]
        close(network.deltas_at(features, mask), expected, 1e-5)
        with torch.autocast("cpu", torch.bfloat16):
            dense, found = network(features)[0].permute(1, 2, 0)[mask], network.deltas_at(features, mask)
    lost = (dense - expected).abs().mean()
    assert float((found - expected).abs().mean()) <= 1.2 * float(lost)
    assert float((found - dense).abs().mean()) <= 0.5 * float(lost)
