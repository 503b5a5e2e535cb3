"""f_res on crops around holes gives the same deltas as on the whole view."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from helpers.holes import shipped, view_of
from helpers.scenes import Scene, texture
from hypothesis import given, settings
from hypothesis import strategies as st

from spackle.core.camera import Camera
from spackle.core.crop import crops_around_mask
from spackle.core.trajectories import DepthRange, leftmost_and_rightmost
from spackle.residual.network import STRIDE


@settings(deadline=None, max_examples=60)
@given(
    st.integers(0, 2**31),
    st.tuples(*[st.integers(1, 150)] * 2),
    st.integers(0, 6),
    st.sampled_from([0, 5, 40]),
)
def test_each_masked_cell_is_in_one_crop_with_a_margin(
    seed: int, size: tuple[int, int], spots: int, margin: int
) -> None:
    rng = np.random.default_rng(seed)
    mask, times = torch.zeros(size, dtype=torch.bool), torch.zeros(size)
    for y, x, height, width in rng.integers([0, 0, 1, 1], [*size, 20, 20], (spots, 4)):
        mask[y : y + height, x : x + width] = True
    pairs = crops_around_mask(mask, STRIDE, margin)
    for inner, outer in pairs:
        times[inner.slices] += 1
        inside, shown = dataclasses.astuple(inner), dataclasses.astuple(outer)
        for low, high, full in ((0, 2, size[0]), (1, 3, size[1])):
            assert shown[low] % STRIDE == 0
            assert shown[low] <= max(0, inside[low] - margin)
            assert shown[high] >= min(inside[high] + margin, full)
            assert shown[high] == full or shown[high] % STRIDE == 0
    assert bool((times[mask] == 1).all())
    assert bool((times <= 1).all())
    assert sum(outer.area for _, outer in pairs) <= mask.numel()


def test_crops_give_the_deltas_of_the_whole_view() -> None:
    depth = torch.full((96, 640), 4.0)
    depth[20:70, 40:90] = 2.0  # a board in front of a long wall
    scene = Scene(texture(96, 640), depth, Camera.from_focal(500, 640, 96))
    base = scene.base()
    view = view_of(
        base,
        leftmost_and_rightmost(scene.camera, 0.1, DepthRange.of(base, is_metric=True))[1],
        scene.camera,
    )
    mask = view.mask
    one = view.deltas(shipped(), "fp32", cells=torch.ones_like(view.mask))
    other = view.deltas(shipped(), "fp32")
    bf16 = view.deltas(shipped(), "bf16")
    assert one is not None
    assert other is not None
    assert bf16 is not None
    assert bool(one.any(-1)[::47, ::53].all())
    assert not bf16[~mask].any()
    difference = (other - one)[mask].abs()
    assert float(difference.max()) < 0.02
    assert float(difference.mean()) < min(1e-3, 0.1 * float((bf16 - other)[mask].abs().mean()))
