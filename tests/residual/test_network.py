"""f_res (eq. 5): its size, and what it is given."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from holes import CPU, box_view, features_of, random_network

from spackle.residual import ResidualNet
from spackle.residual.network import DELTA_CHANNELS, IN_CHANNELS, network_input


@pytest.mark.parametrize("size", [(1, 1), (1, 40), (17, 31)])
def test_the_network_takes_any_size_and_does_not_mix_a_batch(size: tuple[int, int]) -> None:
    network = random_network()
    assert sum(parameter.numel() for parameter in network.parameters()) == pytest.approx(8.02e6, abs=0.02e6)
    features = torch.randn(2, IN_CHANNELS, *size, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        deltas, alone = network(features), torch.cat([network(f[None]) for f in features])
    assert deltas.shape == (2, DELTA_CHANNELS, *size)
    assert bool((deltas != 0).any())
    assert not ResidualNet()(features).any()  # untrained: the view is the seeds
    torch.testing.assert_close(deltas, alone, rtol=1e-3, atol=1e-4)


def test_the_networks_input_knows_no_unit_of_length() -> None:
    context, camera = box_view()
    view, found = CPU.render(context.base, camera), []
    for unit in (1.0, 1000.0):
        pose = camera.world_to_camera.clone()
        pose[:3, 3] *= unit
        seen = dataclasses.replace(view, depth=view.depth * unit)
        scaled = dataclasses.replace(camera, world_to_camera=pose)
        found.append(network_input(*features_of(seen, scaled, context.photo_camera)))
    assert found[0].shape == (1, IN_CHANNELS, 36, 48)
    assert bool(found[0].isfinite().all())
    torch.testing.assert_close(found[1], found[0], rtol=0, atol=0.02)
