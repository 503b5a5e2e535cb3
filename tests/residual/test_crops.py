"""f_res where it is needed: crops around the holes say what the whole says."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from holes import CPU, CountingNetwork, box_view, features_of, shipped
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import Scene, texture

from spackle.camera import Camera
from spackle.camera_path import DepthRange, extremes
from spackle.residual import Seeds, ViewFeatures, hole_area_ratio
from spackle.residual.crops import Crop, crops_around
from spackle.residual.network import STRIDE, predict_deltas
from spackle.residual.rim import Rim
from spackle.scene_fill import fill_scene
from spackle.scene_fill.fill import SEEDS_HAR


@settings(deadline=None, max_examples=60)
@given(st.integers(0, 2**31), st.integers(1, 150), st.integers(1, 150), st.integers(0, 6), st.sampled_from([0, 5, 40]))
def test_each_masked_cell_is_in_one_crop_with_a_margin(
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


def test_holes_far_apart_have_crops_of_their_own() -> None:
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
    assert float((other - one)[mask].abs().mean()) < 0.1 * float((bf16 - other)[mask].abs().mean())
    nothing = CountingNetwork(shipped())
    predict_deltas(nothing, dataclasses.replace(view[0], mask=torch.zeros_like(mask)), *view[1:])
    assert nothing.cells == 0


def test_specks_of_a_path_are_the_seeds_alone() -> None:
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
