"""The feature networks: their shapes, their files, and that they stay as they are."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from spackle.errors import InputError
from spackle.training.losses import ResNet50, SqueezeNet, load_features

WITHOUT_HEAD = 25_557_032 - 2048 * 1000 - 1000  # parameters of torchvision's ResNet-50 less its classifier

# Inputs, squeezed and expanded channels of fire2 to fire9, as the paper of SqueezeNet has them in its table 1.
FIRES = [(96, 16, 64), (128, 16, 64), (128, 32, 128), (256, 32, 128), (256, 48, 192), (384, 48, 192), (384, 64, 256)]
FIRES += [(512, 64, 256)]


@pytest.fixture(scope="module")
def resnet() -> dict[str, Tensor]:
    """Random weights, with statistics that are not those of a fresh network, and a classifier."""
    torch.manual_seed(0)
    state = dict(ResNet50().state_dict())
    for name, value in state.items():
        if name.endswith("running_var"):
            value.uniform_(0.5, 2)
    return state | {"fc.weight": torch.randn(1000, 2048), "fc.bias": torch.randn(1000)}


@pytest.fixture
def squeezed() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    shapes = {"conv1": (96, 3, 7, 7), "conv10": (1000, 512, 1, 1)}
    for number, (inside, squeeze, expand) in enumerate(FIRES, 2):
        shapes[f"fire{number}/conv1x1_1"] = (squeeze, inside, 1, 1)
        shapes |= {f"fire{number}/conv{k}x{k}_2": (expand, squeeze, k, k) for k in (1, 3)}
    arrays = {}
    for name, shape in shapes.items():
        fan = np.prod(shape[1:])
        arrays[f"{name}.w"] = (rng.standard_normal(shape) * np.sqrt(2 / fan)).astype(np.float32)
        arrays[f"{name}.b"] = rng.standard_normal(shape[0]).astype(np.float32)
    return arrays


@pytest.fixture
def squeezenet(squeezed: dict[str, np.ndarray], tmp_path: Path) -> SqueezeNet:
    np.savez(tmp_path / "squeeze.npz", **squeezed)
    network = load_features("squeezenet", tmp_path / "squeeze.npz")
    assert isinstance(network, SqueezeNet)
    return network


def refusal(name: str, path: Path | None) -> str:
    """The one line with which a file is refused."""
    with pytest.raises(InputError) as caught:
        load_features(name, path)
    message = str(caught.value)
    assert "\n" not in message
    assert path is None or str(path) in message
    return message


def test_resnet_has_torchvisions_names_shapes_and_input() -> None:
    network = ResNet50().eval()
    shapes = {name: tuple(value.shape) for name, value in network.state_dict().items()}
    assert sum(parameter.numel() for parameter in network.parameters()) == WITHOUT_HEAD
    assert len(shapes) == 320 - 2  # torchvision's, less its classifier
    assert shapes["bn1.num_batches_tracked"] == ()
    assert shapes["layer1.0.downsample.0.weight"] == (256, 64, 1, 1)
    assert shapes["layer3.5.bn3.running_var"] == (1024,)
    seen: list[Tensor] = []
    network.conv1.register_forward_pre_hook(lambda _, args: seen.append(args[0]))
    network(torch.tensor([0.485, 0.456 + 0.224, 0.0]).view(1, 3, 1, 1).expand(1, 3, 32, 32))
    assert seen[0][0, :, 0, 0].tolist() == pytest.approx([0, 1, -0.406 / 0.225], abs=1e-6)


@pytest.mark.parametrize("older", [False, True])
def test_resnet_reads_torchvisions_file(resnet: dict[str, Tensor], tmp_path: Path, older: bool) -> None:
    """Older files have no counters."""
    path = tmp_path / "resnet.pth"
    torch.save({name: v for name, v in resnet.items() if not (older and "num_batches" in name)}, path)
    network = load_features("resnet50", path)
    assert isinstance(network, ResNet50)
    assert all(torch.equal(value, resnet[name]) for name, value in network.state_dict().items())
    images = torch.rand(1, 3, 64, 96)
    maps = network(images)
    assert [tuple(m.shape) for m in maps] == [(1, 256, 16, 24), (1, 512, 8, 12), (1, 1024, 4, 6), (1, 2048, 2, 3)]
    assert all(m.min() >= 0 for m in maps)


def test_squeezenet_has_caffes_sizes_and_input(squeezenet: SqueezeNet, squeezed: dict[str, np.ndarray]) -> None:
    shapes = [tuple(m.shape[1:]) for m in squeezenet(torch.rand(1, 3, 227, 227))]
    assert shapes == [(96, 111, 111), (256, 55, 55), (512, 27, 27), (512, 13, 13)]  # table 1, 227 for its 224
    assert [len(m) for m in squeezenet(torch.rand(2, 3, 35, 35))] == [2] * 4
    image = torch.rand(3, 48, 48, generator=torch.Generator().manual_seed(2))
    bgr = 255 * image.numpy()[::-1] - np.array([104, 117, 123])[:, None, None]
    window = bgr[:, 2 * 4 : 2 * 4 + 7, 2 * 9 : 2 * 9 + 7]
    cell = np.maximum((squeezed["conv1.w"] * window).sum((1, 2, 3)) + squeezed["conv1.b"], 0)
    np.testing.assert_allclose(squeezenet(image[None])[0][0, :, 4, 9].numpy(), cell, rtol=1e-4, atol=1e-3)


def test_networks_are_frozen_and_pass_gradients_on(squeezenet: SqueezeNet) -> None:
    images = torch.rand(2, 3, 48, 48, requires_grad=True)
    torch.stack([m.mean() for m in squeezenet(images)]).sum().backward()
    assert images.grad is not None
    assert images.grad.any()
    assert not any(parameter.requires_grad for parameter in squeezenet.parameters())


def test_what_is_not_a_networks_weights_is_refused(
    resnet: dict[str, Tensor], squeezed: dict[str, np.ndarray], tmp_path: Path
) -> None:
    assert load_features("none", None) is None
    assert "name their file" in refusal("resnet50", None)
    assert "no such weight file" in refusal("squeezenet", tmp_path / "missing.npz")
    path = tmp_path / "other.pth"
    path.write_bytes(b"\x80\x02cos\nsystem\n.")  # a pickle that would run a command
    assert "not the weights of resnet50" in refusal("resnet50", path)
    torch.save({name: value for name, value in resnet.items() if name != "bn1.bias"}, path)
    assert '"bn1.bias"' in refusal("resnet50", path)
    torch.save([1, 2], path)
    assert "not the weights of resnet50" in refusal("resnet50", path)
    path = tmp_path / "other.npz"
    first = squeezed["conv1.w"]
    for change, words in [
        ({"conv1.w": first[:, :, :3, :3]}, "size mismatch for conv1.weight"),
        ({"conv1.w": np.full_like(first, np.nan)}, "conv1.weight holds numbers that are not finite"),
        ({"fire10/conv1x1_1.w": first}, '"fire10.conv1x1_1.weight"'),
        ({"conv1.w": np.array([{}])}, "not the weights of squeezenet"),  # an object: would have to be unpickled
    ]:
        np.savez(path, **(squeezed | change))
        assert words in refusal("squeezenet", path)
