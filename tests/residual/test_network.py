"""f_res (eq. 5), and its input: the mask of a view (eq. 4), and the view's features."""

from __future__ import annotations

import dataclasses
import math
import sys
import types
from pathlib import Path

import pytest
import torch
from helpers.holes import CPU, box_view, random_network, random_view, view_of
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.torch import save_file

from spackle.core.camera import Camera
from spackle.core.color import linear_to_srgb, srgb_to_linear
from spackle.paper.training.residual import first_network
from spackle.render.protocol import Rendering
from spackle.residual import ViewFeatures, hole_area_ratio, hole_mask
from spackle.residual.architectures import ARCHITECTURE_KEY, load_residual, open_residual
from spackle.residual.composer import DELTA_CHANNELS
from spackle.residual.initializer import sample_photo
from spackle.residual.network import ResidualNet
from spackle.residual.sharp_decoder import SharpDecoder
from spackle.runtime.errors import InputError
from spackle.scene_fill import fill_view
from spackle.scene_fill.unet import UNet
from spackle.scene_fill.view_completion import SceneViewCompletion
from spackle.weights.checkpoints import read_tensors, to_channels_last

ARCHITECTURES = ("unet", "sharp-decoder")


def channels_of(network: ResidualNet) -> int:
    """The number of channels of a network's input."""
    return sum(SceneViewCompletion.INPUT_CHANNELS[name] for name in network.inputs)


def test_hole_mask_and_ratio() -> None:
    alpha = torch.tensor([[0.0, 0.9499, 0.95, 1.0]])
    assert hole_mask(alpha).tolist() == [[True, True, False, False]]
    assert (hole_area_ratio(alpha), hole_area_ratio(alpha, threshold=0.5)) == (0.5, 0.25)


def plain_cell(view: Rendering, row: int, column: int) -> tuple[list[float], float, float, bool]:
    """The features of a cell in plain Python; an odd last row or column counts twice."""
    height, width = view.alpha.shape
    pixels = [
        (min(2 * row + dy, height - 1), min(2 * column + dx, width - 1))
        for dy in (0, 1)
        for dx in (0, 1)
    ]
    alphas = [float(view.alpha[p]) for p in pixels]
    light = [sum(float(srgb_to_linear(view.rgb[p])[c]) for p in pixels) for c in range(3)]
    rgb = [float(linear_to_srgb(torch.tensor(x / max(sum(alphas), 1e-6)))) for x in light]
    covered = [
        1 / float(view.depth[p]) for p, alpha in zip(pixels, alphas, strict=True) if alpha >= 0.95
    ]
    return rgb, min(covered, default=0.0), sum(alphas) / 4, len(covered) < 4


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 2**32 - 1), st.tuples(st.integers(1, 7), st.integers(1, 7)))
def test_features_match_a_plain_loop_and_are_detached(seed: int, size: tuple[int, int]) -> None:
    view = random_view(seed, *size)
    cues = ViewFeatures.of(
        Rendering(*(t.clone().requires_grad_() for t in (view.rgb, view.depth, view.alpha)))
    )
    assert not any(t.requires_grad for t in (cues.rgb, cues.inverse_depth, cues.alpha))
    rows, columns = math.ceil(size[0] / 2), math.ceil(size[1] / 2)
    assert cues.mask.shape == (rows, columns)
    for row in range(rows):
        for column in range(columns):
            rgb, inverse, alpha, mask = plain_cell(view, row, column)
            assert cues.rgb[row, column].tolist() == pytest.approx(rgb, abs=1e-4)
            assert float(cues.inverse_depth[row, column]) == pytest.approx(inverse, rel=1e-5)
            assert float(cues.alpha[row, column]) == pytest.approx(alpha, abs=1e-6)
            assert bool(cues.mask[row, column]) == mask


@pytest.mark.parametrize("name", ARCHITECTURES)
@pytest.mark.parametrize("size", [(1, 1), (1, 40), (17, 31)])
def test_the_network_takes_any_size_and_does_not_mix_a_batch(
    name: str, size: tuple[int, int]
) -> None:
    network = random_network(name=name)
    assert sum(parameter.numel() for parameter in network.parameters()) == pytest.approx(
        8.02e6, rel=2e-3
    )
    channels = channels_of(network)
    features = torch.randn(2, channels, *size, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        deltas, alone = network(features), torch.cat([network(f[None]) for f in features])
    assert deltas.shape == (2, DELTA_CHANNELS, *size)
    assert bool((deltas != 0).any())
    assert not open_residual(name)(features).any()  # untrained networks give zero
    torch.testing.assert_close(deltas, alone, rtol=1e-3, atol=1e-4)


def test_the_networks_input_does_not_depend_on_the_unit() -> None:
    context, camera = box_view()
    view, found = CPU.render(context.base, camera), []
    for unit in (1.0, 1000.0):
        pose = camera.world_to_camera.clone()
        pose[:3, 3] *= unit
        seen = dataclasses.replace(view, depth=view.depth * unit)
        scaled = dataclasses.replace(camera, world_to_camera=pose)
        found.append(view_of(seen, scaled, context.photo_camera).network_input(UNet.inputs))
    assert found[0].shape == (1, 21, 36, 48)
    assert bool(found[0].isfinite().all())
    torch.testing.assert_close(found[1], found[0], rtol=0, atol=0.02)


@pytest.mark.parametrize("name", ARCHITECTURES)
def test_a_loaded_network_equals_the_saved_one(name: str, tmp_path: Path) -> None:
    network, path = (
        random_network(name=name).half().float().eval(),
        tmp_path / "weights.safetensors",
    )
    to_channels_last(network)  # the memory format of loaded networks, so that sums have one order
    tensors = {key: value.half().contiguous() for key, value in network.state_dict().items()}
    save_file(tensors, path, {ARCHITECTURE_KEY: name})
    loaded = load_residual(path)
    assert loaded.name == name
    context, camera = box_view()
    view = view_of(
        context.base,
        camera,
        context.photo_camera,
        CPU.render(context.base, context.photo_camera).rgb,
    )
    expected = view.deltas(network, "fp32")
    found = view.deltas(loaded, "fp32")
    assert expected is not None
    assert found is not None
    assert torch.equal(found, expected)
    for wrong, said in (
        (next(n for n in ARCHITECTURES if n != name), "another network's"),
        ("vit", "unknown architecture"),
        ("os:remove", "not a subclass"),
        ("never_imported:Network", "add `residual_network` never_imported:Network"),
    ):
        save_file(tensors, path, {ARCHITECTURE_KEY: wrong})
        with pytest.raises(InputError, match=said):
            load_residual(path)


class TwoLayers(ResidualNet):
    """A network of another package."""

    name = "tests_own_network:TwoLayers"
    inputs = ("rgb", "initial")
    local = False

    def __init__(self) -> None:
        super().__init__()
        self.first = torch.nn.Conv2d(7, 8, 3, padding=1)
        self.last = torch.nn.Conv2d(8, DELTA_CHANNELS, 1)

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        deltas: torch.Tensor = self.last(self.first(features).relu())
        return deltas


def test_a_network_of_another_package_is_trained_saved_and_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    module = types.ModuleType("tests_own_network")
    vars(module).update(TwoLayers=TwoLayers, types=types)
    path = tmp_path / "weights.safetensors"
    tensors = {key: value.contiguous() for key, value in TwoLayers().state_dict().items()}
    save_file(tensors, path, {ARCHITECTURE_KEY: TwoLayers.name})
    with pytest.raises(InputError, match="add `residual_network` tests_own_network:TwoLayers"):
        load_residual(path)  # a file must not import modules

    monkeypatch.setitem(sys.modules, "tests_own_network", module)
    assert isinstance(first_network(TwoLayers.name), TwoLayers)
    assert isinstance(first_network(TwoLayers.name, path), TwoLayers)
    loaded = load_residual(path)
    context, camera = box_view()
    deltas = view_of(context.base, camera, context.photo_camera).deltas(loaded)
    assert deltas is not None
    assert deltas.any()
    assert len(fill_view(dataclasses.replace(context, network=loaded), camera).aux) > 100
    for wrong in ("tests_own_network:types", "no_such_module:Net", "nonsense"):
        with pytest.raises(InputError, match="`network`"):
            open_residual(wrong)


def test_colours_of_the_photo_at_projected_points() -> None:
    camera = Camera.from_focal(40, 64, 48)
    pose = torch.eye(4)
    pose[0, 3] = -0.8  # at two metres, a shift of 16 pixels or 8 cells
    photo, nowhere = (
        torch.rand(48, 64, 3, generator=torch.Generator().manual_seed(0)),
        torch.zeros(24, 32, 3),
    )
    cells = photo.unflatten(1, (32, 2)).unflatten(0, (24, 2)).mean((1, 3))
    view = dataclasses.replace(camera, world_to_camera=pose)
    seen = sample_photo(photo, nowhere, torch.full((24, 32), 0.5), view, camera)
    torch.testing.assert_close(seen[:, :24], cells[:, 8:])
    assert not seen[:, 24:].any()


def test_the_papers_network_starts_with_sharps_decoder(made: dict[str, Path]) -> None:
    network = first_network("sharp-decoder", made["sharp"])
    assert isinstance(network, SharpDecoder)
    theirs = read_tensors(made["sharp"], "give others")
    weights = {
        f"feature_model.{key}": value for key, value in network.feature_model.state_dict().items()
    }
    assert all(torch.equal(value, theirs[key]) for key, value in weights.items())
    assert not network(torch.randn(1, 13, 16, 16)).any()
    with pytest.raises(InputError, match=rf"{made['sharp'].name}: .*another network"):
        first_network("unet", made["sharp"])
