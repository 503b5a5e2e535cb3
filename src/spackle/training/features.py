"""Frozen networks that see images as a person does, roughly: for the perceptual loss, and for measuring.

The paper's is a ResNet-50 ("Training Details and Loss Weights"); SqueezeNet 1.0 is the small one, 3 MB and many times
faster. Both give the last map of each of their four resolutions: 1/4 to 1/32 of the image, and 1/2 to 1/16.
"""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Literal

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from spackle.errors import InputError, reading
from spackle.files import check_file

IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of sRGB 0..1, as torchvision takes it
CAFFE_MEAN = (104.0, 117.0, 123.0)  # of BGR 0..255
# Inputs and squeezed channels of fire2 to fire9.
SQUEEZED = dict(enumerate([(96, 16), (128, 16), (128, 32), (256, 32), (256, 48), (384, 48), (384, 64), (512, 64)], 2))


class FeatureNet(nn.Module):
    """[B, 3, H, W] sRGB 0..1 to feature maps [B, C, h, w], fine to coarse; gradients go to the images alone."""

    name: str  # in reports
    head: str  # how the classifier's names begin, which a file may hold and nothing here uses


class Bottleneck(nn.Module):
    """ResNet's block: [B, inside, h, w] to [B, 4 width, h / stride, w / stride], with torchvision's names."""

    def __init__(self, inside: int, width: int, stride: int) -> None:
        super().__init__()
        self.conv1, self.bn1 = nn.Conv2d(inside, width, 1, bias=False), nn.BatchNorm2d(width)
        self.conv2, self.bn2 = nn.Conv2d(width, width, 3, stride, 1, bias=False), nn.BatchNorm2d(width)
        self.conv3, self.bn3 = nn.Conv2d(width, 4 * width, 1, bias=False), nn.BatchNorm2d(4 * width)
        self.downsample = nn.Sequential()
        if inside != 4 * width:
            self.downsample.extend([nn.Conv2d(inside, 4 * width, 1, stride, bias=False), nn.BatchNorm2d(4 * width)])

    def forward(self, x: Tensor) -> Tensor:
        y = self.bn1(self.conv1(x)).relu()
        y = self.bn2(self.conv2(y)).relu()
        return torch.relu(self.bn3(self.conv3(y)) + self.downsample(x))


class ResNet50(FeatureNet):
    """The paper's feature extractor, with torchvision's names; sides of images are 32 pixels or more.

    Gives the ends of layer1 to layer4: 256, 512, 1024, 2048 channels at 1/4, 1/8, 1/16, 1/32.
    """

    name, head = "resnet50", "fc."

    def __init__(self) -> None:
        super().__init__()
        self.conv1, self.bn1 = nn.Conv2d(3, 64, 7, 2, 3, bias=False), nn.BatchNorm2d(64)
        for number, (inside, width, blocks) in enumerate([(64, 64, 3), (256, 128, 4), (512, 256, 6), (1024, 512, 3)]):
            rest = [Bottleneck(4 * width, width, 1) for _ in range(blocks - 1)]
            self.add_module(f"layer{number + 1}", nn.Sequential(Bottleneck(inside, width, min(2, number + 1)), *rest))

    def forward(self, images: Tensor) -> list[Tensor]:
        x = (images - _channels(IMAGENET_MEAN, images)) / _channels(IMAGENET_STD, images)
        maps = [F.max_pool2d(self.bn1(self.conv1(x)).relu(), 3, 2, 1)]
        for number in range(1, 5):
            maps.append(self.get_submodule(f"layer{number}")(maps[-1]))
        return maps[1:]


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
    """SqueezeNet 1.0 as Caffe computes it; sides of images are 35 pixels or more.

    Gives conv1, fire4, fire8, fire9: 96, 256, 512, 512 channels at 1/2, 1/4, 1/8, 1/16. Its first convolution is not
    padded: cells lie up to 5 pixels further in than an even division of the image would have them.
    """

    name, head = "squeezenet", "conv10."

    def __init__(self) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(3, 96, 7, 2)
        for number, (inside, squeeze) in SQUEEZED.items():
            self.add_module(f"fire{number}", Fire(inside, squeeze))

    def forward(self, images: Tensor) -> list[Tensor]:
        maps = {1: self.conv1(255 * images.flip(1) - _channels(CAFFE_MEAN, images)).relu()}
        for number in SQUEEZED:
            x = maps[number - 1]
            if number in (2, 5, 9):  # Caffe's pooling: a window that stands half over the edge counts too
                x = F.max_pool2d(x, 3, 2, ceil_mode=True)
            maps[number] = self.get_submodule(f"fire{number}")(x)
        return [maps[number] for number in (1, 4, 8, 9)]


def load_features(
    name: Literal["resnet50", "squeezenet", "none"], path: Path | None, device: torch.device | str = "cpu"
) -> FeatureNet | None:
    """A frozen network from a file on this machine; nothing in the file is run.

    Args:
        name: which network; "none" gives None.
        path: ResNet-50 as torchvision publishes it (.pth); SqueezeNet 1.0 as .npz with `conv1.w`, `conv1.b`,
            `fire2/conv1x1_1.w`, ... The classifier may be there, and is not used.
        device: where the network is to run.

    Raises:
        InputError: a missing, broken or foreign file.
    """
    if name == "none":
        return None
    if path is None:
        raise InputError(f"{name}: its weights are not given: name their file, or choose none")
    check_file(path, "weight file")
    network: FeatureNet = ResNet50() if name == "resnet50" else SqueezeNet()
    with reading(path, f"not the weights of {name} ({{reason}}): give another file"):
        read = (_read_pth if name == "resnet50" else _read_npz)(path)
        found = {key: value.float() for key, value in read.items() if not key.startswith(network.head)}
        network.load_state_dict(found)
        if endless := [key for key, value in found.items() if not value.isfinite().all()]:
            raise ValueError(f"{endless[0]} holds numbers that are not finite")
    return network.requires_grad_(False).eval().to(device)


def _read_pth(path: Path) -> dict[str, Tensor]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about kinds of tensors that are refused
        return dict(torch.load(path, map_location="cpu", weights_only=True))


def _read_npz(path: Path) -> dict[str, Tensor]:
    """The tensors of an .npz, `fire2/conv1x1_1.w` as `fire2.conv1x1_1.weight`."""
    with open(path, "rb") as file, np.load(file, allow_pickle=False) as arrays:
        names = {name: name[:-1].replace("/", ".") + {"w": "weight", "b": "bias"}[name[-1]] for name in arrays.files}
        return {ours: torch.from_numpy(arrays[name]) for name, ours in names.items()}


def _channels(numbers: tuple[float, ...], images: Tensor) -> Tensor:
    """[3, 1, 1] on the images' device."""
    return torch.tensor(numbers, dtype=images.dtype).to(images.device, non_blocking=True)[:, None, None]
