"""The network at some cells alone says there what it says when it computes all."""

from __future__ import annotations

import copy

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import box_before_wall
from torch import Tensor, nn
from torch.nn.functional import interpolate

from spackle.camera_path import DepthRange, extremes
from spackle.evaluation.timing import count_flops
from spackle.render import CpuRenderer
from spackle.residual import Cues, ResidualNet, make_seeds
from spackle.residual import network as residual_network
from spackle.residual.network import IN_CHANNELS, network_input, predict_deltas, shipped_network
from spackle.residual.seeds import Rim
from spackle.residual.sparse import Cells, conv_rows, relu_rows, upsampled


@pytest.fixture(scope="module")
def network() -> ResidualNet:
    shipped = shipped_network()
    assert shipped is not None
    return shipped


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


# The pieces


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


def test_cells_grow_to_all_sides_and_stay_in_the_grid() -> None:
    cells = torch.zeros(6, 9, dtype=torch.bool)
    cells[0, 3] = True
    grown = Cells(cells).grown(2).grid
    assert grown.nonzero().tolist() == [[row, column] for row in range(3) for column in range(1, 6)]


# The network


@pytest.mark.parametrize("few", [0.0, 0.45, 2.0])  # all by convolutions, as it comes, all by rows
@pytest.mark.parametrize(("height", "width", "share"), [(37, 53, 0.002), (64, 48, 0.03), (1, 1, 1.0), (20, 90, 0.4)])
def test_some_cells_get_the_deltas_that_all_would_get(
    network: ResidualNet, monkeypatch: pytest.MonkeyPatch, height: int, width: int, share: float, few: float
) -> None:
    monkeypatch.setattr(residual_network, "FEW", few)
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


def test_few_cells_cost_little_more_than_the_encoder(network: ResidualNet) -> None:
    features, mask = torch.randn(1, IN_CHANNELS, 128, 128), torch.zeros(128, 128, dtype=torch.bool)
    mask[60:64, 60:80] = True
    with torch.no_grad():
        costs = [count_flops(call) for call in (lambda: network.deltas_at(features, mask), lambda: network(features))]
        assert costs[0] < 0.55 * costs[1]
        assert count_flops(lambda: network.deltas_at(features, torch.ones_like(mask))) == costs[1]


def test_a_view_is_predicted_at_its_masked_cells_alone(network: ResidualNet, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = box_before_wall()
    base = scene.base()
    camera = extremes(scene.camera, 0.2, DepthRange.of(base))[1]
    cues = Cues.of(CpuRenderer().render(base, camera))
    seeds = make_seeds(cues, camera, scene.camera)
    rim = Rim.of(cues, seeds, camera, scene.camera)
    with torch.no_grad():
        plain = network(network_input(cues, seeds, rim))[0].permute(1, 2, 0)
    found = predict_deltas(network, cues, seeds, rim, "fp32")
    assert cues.mask.any()
    close(found[cues.mask], plain[cues.mask], 1e-5)
    assert not found[~cues.mask].any()
    monkeypatch.setattr(ResidualNet, "deltas_at", None)
    with pytest.raises(TypeError):
        predict_deltas(network, cues, seeds, rim, "fp32")
    twin = copy.copy(network)
    twin.compiled = True  # of such a one, `forward` is what is compiled
    close(predict_deltas(twin, cues, seeds, rim, "fp32")[cues.mask], plain[cues.mask], 1e-5)
