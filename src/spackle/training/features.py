"""Frozen networks that see images as a person does, roughly: for the perceptual loss, and for measuring.

The paper's is a ResNet-50 ("Training Details and Loss Weights"); SqueezeNet 1.0 is the small one, 3 MB and many times
faster. Both give the last map of each of their four resolutions: 1/4 to 1/32 of the image, and 1/2 to 1/16. Fine maps
see edges and grain, coarse ones see things; the last of a resolution has seen most at that price.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Literal

import numpy as np
import torch
import torch.nn.functional as F
from safetensors.torch import load_file
from torch import Tensor, nn

from spackle.errors import InputError, reason_in_a_line
from spackle.files import check_file

Shapes = dict[str, tuple[int, ...]]

IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of sRGB 0..1, as torchvision takes it
CAFFE_MEAN = (104.0, 117.0, 123.0)  # of BGR 0..255

RESNET50_HEAD: Shapes = {"fc.weight": (1000, 2048), "fc.bias": (1000,)}
COUNTER = "num_batches_tracked"
SQUEEZENET_HEAD: Shapes = {"conv10.w": (1000, 512, 1, 1), "conv10.b": (1000,)}


class FeatureNet(nn.Module):
    """[B, 3, H, W] sRGB 0..1 to feature maps [B, C, h, w], fine to coarse; gradients go to the images alone."""

    name: str  # as reports have it

    def train(self, mode: bool = True) -> FeatureNet:
        """Stay as it is: a frozen network normalises by its stored statistics."""
        return super().train(False)


class Bottleneck(nn.Module):
    """ResNet's block: [B, inside, h, w] to [B, 4 width, h / stride, w / stride], with torchvision's names."""

    def __init__(self, inside: int, width: int, stride: int, project: bool) -> None:
        super().__init__()
        self.conv1, self.bn1 = nn.Conv2d(inside, width, 1, bias=False), nn.BatchNorm2d(width)
        self.conv2, self.bn2 = nn.Conv2d(width, width, 3, stride, 1, bias=False), nn.BatchNorm2d(width)
        self.conv3, self.bn3 = nn.Conv2d(width, 4 * width, 1, bias=False), nn.BatchNorm2d(4 * width)
        shortcut = (nn.Conv2d(inside, 4 * width, 1, stride, bias=False), nn.BatchNorm2d(4 * width)) if project else ()
        self.downsample = nn.Sequential(*shortcut)

    def forward(self, x: Tensor) -> Tensor:
        y = self.bn1(self.conv1(x)).relu()
        y = self.bn2(self.conv2(y)).relu()
        return torch.relu(self.bn3(self.conv3(y)) + self.downsample(x))


class ResNet50(FeatureNet):
    """The paper's feature extractor, without its classifier; tensors are named as torchvision names them.

    Called with [B, 3, H, W] sRGB 0..1, sides of 32 pixels or more; gives the ends of layer1 to layer4: 256, 512, 1024,
    2048 channels at 1/4, 1/8, 1/16, 1/32.
    """

    name = "resnet50"

    def __init__(self) -> None:
        super().__init__()
        self.conv1, self.bn1 = nn.Conv2d(3, 64, 7, 2, 3, bias=False), nn.BatchNorm2d(64)
        self.layer1, self.layer2 = _layer(64, 64, 3, 1), _layer(256, 128, 4, 2)
        self.layer3, self.layer4 = _layer(512, 256, 6, 2), _layer(1024, 512, 3, 2)
        self.requires_grad_(False).eval()

    def forward(self, images: Tensor) -> list[Tensor]:
        mean, std = _channels(IMAGENET_MEAN, images), _channels(IMAGENET_STD, images)
        x = F.max_pool2d(self.bn1(self.conv1((images - mean) / std)).relu(), 3, 2, 1)
        maps = [self.layer1(x)]
        for layer in (self.layer2, self.layer3, self.layer4):
            maps.append(layer(maps[-1]))
        return maps


class Fire(nn.Module):
    """SqueezeNet's block: [B, inside, h, w] to [B, 8 squeeze, h, w], with the names of its weight file."""

    def __init__(self, inside: int, squeeze: int) -> None:
        super().__init__()
        self.conv1x1_1 = nn.Conv2d(inside, squeeze, 1)
        self.conv1x1_2 = nn.Conv2d(squeeze, 4 * squeeze, 1)
        self.conv3x3_2 = nn.Conv2d(squeeze, 4 * squeeze, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        x = self.conv1x1_1(x).relu()
        return torch.cat([self.conv1x1_2(x), self.conv3x3_2(x)], dim=1).relu()


class SqueezeNet(FeatureNet):
    """SqueezeNet 1.0 as Caffe computes it, without its classifier.

    Called with [B, 3, H, W] sRGB 0..1, sides of 35 pixels or more; gives conv1, fire4, fire8, fire9: 96, 256, 512, 512
    channels at 1/2, 1/4, 1/8, 1/16. Its first convolution is not padded: cells lie up to 5 pixels further in than
    an even division of the image would have them.
    """

    name = "squeezenet"

    def __init__(self) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(3, 96, 7, 2)
        self.fire2, self.fire3, self.fire4 = Fire(96, 16), Fire(128, 16), Fire(128, 32)
        self.fire5, self.fire6, self.fire7 = Fire(256, 32), Fire(256, 48), Fire(384, 48)
        self.fire8, self.fire9 = Fire(384, 64), Fire(512, 64)
        self.requires_grad_(False).eval()

    def forward(self, images: Tensor) -> list[Tensor]:
        conv1 = self.conv1(255 * images.flip(1) - _channels(CAFFE_MEAN, images)).relu()
        fire4 = self.fire4(self.fire3(self.fire2(_half(conv1))))
        fire8 = self.fire8(self.fire7(self.fire6(self.fire5(_half(fire4)))))
        return [conv1, fire4, fire8, self.fire9(_half(fire8))]


def load_features(
    name: Literal["resnet50", "squeezenet", "none"], path: Path | None, device: torch.device | str = "cpu"
) -> FeatureNet | None:
    """A frozen network from a file on this machine; nothing in the file is run.

    Args:
        name: which network; "none" gives None.
        path: ResNet-50 as torchvision publishes it (.pth) or as safetensors with the same names; SqueezeNet 1.0 as .npz
            with `conv1.w`, `conv1.b`, `fire2/conv1x1_1.w`, ... The classifier may be there, and is not used.
        device: where the network is to run.

    Raises:
        InputError: a missing, broken or foreign file.
    """
    if name == "none":
        return None
    if path is None:
        raise InputError(f"{name}: its weights are not given: name their file, or choose none")
    check_file(path, "weight file")
    network: ResNet50 | SqueezeNet = ResNet50() if name == "resnet50" else SqueezeNet()
    state = network.state_dict()
    ours = {key: value for key, value in state.items() if not key.endswith(COUNTER)}  # older files lack counters
    found = {key: value for key, value in _read(path, name).items() if key not in state or key in ours}
    names = {_file_name(key, name): key for key in ours}
    expected = {file_name: tuple(ours[key].shape) for file_name, key in names.items()}
    _check(found, expected, RESNET50_HEAD if name == "resnet50" else SQUEEZENET_HEAD, path, name)
    network.load_state_dict({key: found[file_name].float() for file_name, key in names.items()}, strict=False)
    return network.to(device)


def _file_name(key: str, network: str) -> str:
    """What a tensor of ours is called in the network's file."""
    if network == "resnet50":
        return key
    *places, kind = key.split(".")
    return "/".join(places) + {"weight": ".w", "bias": ".b"}[kind]


def _read(path: Path, network: str) -> dict[str, Tensor]:
    """Named tensors of a stranger's file, its kind told by its first bytes: people rename files."""
    try:
        if network == "squeezenet":
            with open(path, "rb") as file, np.load(file, allow_pickle=False) as arrays:
                return {name: torch.from_numpy(arrays[name]) for name in arrays.files}
        with open(path, "rb") as file:
            if file.read(9)[8:] == b"{":
                return load_file(path)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about kinds of tensors that are refused
            loaded = torch.load(path, map_location="cpu", weights_only=True)
        if not isinstance(loaded, Mapping) or not all(map(_is_dense, loaded.values())):
            raise TypeError("it holds more than named tensors")
        return {str(name): value for name, value in loaded.items()}
    except Exception as error:  # a stranger's bytes can raise anything
        kind = "an .npz file" if network == "squeezenet" else "a .pth or .safetensors file"
        reason = reason_in_a_line(error)
        raise InputError(f"{path}: cannot be read as {kind} ({reason}): give the weights of {network} again") from error


def _is_dense(value: object) -> bool:
    return isinstance(value, Tensor) and value.layout == torch.strided and value.device.type == "cpu"


def _check(found: Mapping[str, Tensor], expected: Shapes, head: Shapes, path: Path, network: str) -> None:
    """InputError unless names, shapes and numbers are the network's; its head may be missing."""
    allowed = expected | head
    wrong = [f"{name!r} is missing" for name in expected if name not in found]
    wrong += [f"{name[:80]!r} is unknown" for name in found if name not in allowed]
    for name, value in found.items():
        if name not in allowed:
            continue
        if tuple(value.shape) != allowed[name]:
            wrong.append(f"{name!r} is {list(value.shape)} instead of {list(allowed[name])}")
        elif not value.is_floating_point() or not value.isfinite().all():
            wrong.append(f"{name!r} holds something else than finite numbers")
    if wrong:
        more = f" and {len(wrong) - 1} more" if len(wrong) > 1 else ""
        raise InputError(f"{path}: not the weights of {network} ({wrong[0]}{more}): give another file")


def _layer(inside: int, width: int, blocks: int, stride: int) -> nn.Sequential:
    first = Bottleneck(inside, width, stride, project=True)
    return nn.Sequential(first, *(Bottleneck(4 * width, width, 1, project=False) for _ in range(blocks - 1)))


def _channels(numbers: tuple[float, ...], images: Tensor) -> Tensor:
    """[3, 1, 1] on the images' device."""
    return torch.tensor(numbers, dtype=images.dtype).to(images.device, non_blocking=True)[:, None, None]


def _half(x: Tensor) -> Tensor:
    """Caffe's pooling: a window that stands half over the edge counts too."""
    return F.max_pool2d(x, 3, 2, ceil_mode=True)
