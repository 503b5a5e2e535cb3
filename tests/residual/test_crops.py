"""The network looks only around the holes, and says the same there as if it looked everywhere."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import Scene, box_before_wall, texture
from torch import Tensor, nn

from spackle.camera import Camera
from spackle.camera_path import DepthRange, extremes
from spackle.render import CpuRenderer
from spackle.residual import Completer, Cues, ResidualNet, Seeds, hole_area_ratio, make_seeds
from spackle.residual.complete import SEEDS_HAR
from spackle.residual.network import STRIDE, predict_deltas, shipped_network
from spackle.residual.seeds import Rim
from spackle.residual.sparse import Crop, crops_around


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
    mask[10:20, 30:40] = mask[600:640, 700:710] = True
    pairs = crops_around(mask, STRIDE)
    assert len(pairs) == 2
    assert sum(outer.area for _, outer in pairs) < 0.1 * mask.numel()
    assert crops_around(~mask, STRIDE) == [(Crop(0, 0, 768, 768),) * 2]


def test_a_frame_of_holes_is_cut_into_its_sides() -> None:
    mask = torch.zeros(768, 768, dtype=torch.bool)
    mask[:, :12] = mask[:10, :400] = mask[758:, :400] = True
    mask[160:310, 190:230] = mask[270:420, 560:615] = True
    pairs = crops_around(mask, STRIDE)
    assert len(pairs) >= 5
    assert sum(outer.area for _, outer in pairs) < 0.52 * mask.numel()


class Counting(nn.Module):
    """A network that keeps how many cells it was shown."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network, self.cells = network, 0

    def forward(self, features: Tensor) -> Tensor:
        self.cells += features[0, 0].numel()
        out: Tensor = self.network(features)
        return out


@pytest.fixture(scope="module")
def view() -> tuple[Cues, Seeds, Rim]:
    """A board before the left end of a long wall, seen from the side."""
    height, width = 96, 640
    depth = torch.full((height, width), 4.0)
    depth[20:70, 40:90] = 2.0
    scene = Scene(texture(height, width), depth, Camera.from_focal(500, width, height))
    base = scene.base()
    beside = extremes(scene.camera, 0.1, DepthRange.of(base))[1]
    cues = Cues.of(CpuRenderer().render(base, beside))
    seeds = make_seeds(cues, beside, scene.camera)
    return cues, seeds, Rim.of(cues, seeds, beside, scene.camera)


@pytest.fixture(scope="module")
def network() -> ResidualNet:
    shipped = shipped_network()
    assert shipped is not None
    return shipped


def test_crops_give_what_the_whole_picture_gives(view: tuple[Cues, Seeds, Rim], network: ResidualNet) -> None:
    mask = view[0].mask
    whole, cropped = Counting(network), Counting(network)
    one = predict_deltas(whole, *view, "fp32", dense=True)
    other = predict_deltas(cropped, *view, "fp32")
    assert whole.cells == mask.numel()
    assert 0 < cropped.cells < 0.8 * whole.cells
    torch.testing.assert_close(other[mask], one[mask], rtol=0, atol=0.01)
    assert float((other - one)[mask].abs().mean()) < 1e-3
    bf16 = predict_deltas(network, *view, "bf16")
    assert float((other - one)[mask].abs().mean()) < 0.1 * float((bf16 - other)[mask].abs().mean())


def test_dense_deltas_are_those_of_every_cell(view: tuple[Cues, Seeds, Rim], network: ResidualNet) -> None:
    dense = predict_deltas(network, *view, "fp32", dense=True)
    for y, x in itertools.product((0, 47), (0, 150, 319)):
        assert bool(dense[y, x].any())


def test_an_empty_mask_costs_the_network_nothing(view: tuple[Cues, Seeds, Rim], network: ResidualNet) -> None:
    cues, seeds, rim = view
    counting = Counting(network)
    predict_deltas(counting, dataclasses.replace(cues, mask=torch.zeros_like(cues.mask)), seeds, rim)
    assert counting.cells == 0


def test_specks_of_a_path_are_the_seeds_alone_and_great_holes_the_networks(network: ResidualNet) -> None:
    scene = box_before_wall(width=160, height=120, focal=133)
    counting = Counting(network)
    subject = Completer(scene.base(), scene.camera, CpuRenderer(), counting)  # type: ignore[arg-type]
    depths = DepthRange.of(subject.base)
    wide, little = (extremes(scene.camera, disparity, depths)[1] for disparity in (0.3, 0.006))
    holes = [hole_area_ratio(subject.renderer.render(subject.base, camera).alpha) for camera in (wide, little)]
    assert holes[1] < SEEDS_HAR < holes[0]
    assert len(subject.complete_scene([little])) > 0
    assert counting.cells == 0
    assert len(subject.complete_scene([little], exact=True)) > 0
    assert counting.cells > 0
    counting.cells = 0
    subject.complete_scene([wide])
    assert counting.cells > 0
