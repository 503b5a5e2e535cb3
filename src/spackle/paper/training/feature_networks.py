"""Networks that turn images into features, by which images are compared.

ResNet-50 is the paper's; SqueezeNet is faster.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from spackle.paper.training.deep_compression import read_deep_compression
from spackle.runtime.errors import InputError, as_input_error
from spackle.runtime.files import check_file
from spackle.weights.checkpoints import load_strict, read_tensors

# Mean and standard deviation of the red, green and blue of ImageNet's photos, sRGB 0..1, as in
# torchvision.
IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)
# Mean of the blue, green and red of ImageNet's photos, 0..255, as in Caffe.
CAFFE_MEAN_BGR = (104.0, 117.0, 123.0)
# The names of the published weights, by the network's name.
PUBLISHED_FEATURES = {"resnet50": "features", "squeezenet": "squeezenet"}
# ResNet-50's four layers: input channels and inner channels of the first block, and number of
# blocks.
RESNET50_LAYERS = ((64, 64, 3), (256, 128, 4), (512, 256, 6), (1024, 512, 3))
SQUEEZENET_LAYERS = 26  # convolutions, with that of the classifier
# SqueezeNet's blocks by the number in their names: input channels and squeezed channels.
SQUEEZENET_BLOCKS = {
    2: (96, 16),
    3: (128, 16),
    4: (128, 32),
    5: (256, 32),
    6: (256, 48),
    7: (384, 48),
    8: (384, 64),
    9: (512, 64),
}


class FeatureNet(nn.Module):
    """Maps [B, 3, H, W] sRGB 0..1 to four feature maps [B, C, h, w], fine to coarse.

    The weights get no gradients.
    """

    head: str  # prefix of the names of the classifier's tensors, which are ignored


class Bottleneck(nn.Module):
    """A block of ResNet: maps [B, channels_in, h, w] to [B, 4 width, h / stride, w / stride]."""

    def __init__(self, channels_in: int, width: int, stride: int) -> None:
        """Create the block; the attributes have torchvision's names, by which weights are loaded.

        Args:
            channels_in: channels of the input.
            width: channels inside of the block; the output has four times as many.
            stride: factor by which height and width shrink.
        """
        super().__init__()
        channels_out = 4 * width
        self.conv1 = nn.Conv2d(channels_in, width, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.conv2 = nn.Conv2d(width, width, 3, stride, padding=1, bias=False)
        self.bn2 = nn.BatchNorm2d(width)
        self.conv3 = nn.Conv2d(width, channels_out, 1, bias=False)
        self.bn3 = nn.BatchNorm2d(channels_out)

        # The input is added to the output, so it must get the output's shape.
        self.downsample = nn.Sequential()
        if channels_in != channels_out:
            self.downsample.append(nn.Conv2d(channels_in, channels_out, 1, stride, bias=False))
            self.downsample.append(nn.BatchNorm2d(channels_out))

    def forward(self, x: Tensor) -> Tensor:
        y = self.bn1(self.conv1(x)).relu()
        y = self.bn2(self.conv2(y)).relu()
        return torch.relu(self.bn3(self.conv3(y)) + self.downsample(x))


class ResNet50(FeatureNet):
    """The paper's feature network, for images of at least 32 pixels a side.

    The tensors have torchvision's names.

    The feature maps are the outputs of layer1 to layer4: 256, 512, 1024, 2048 channels at 1/4, 1/8,
    1/16, 1/32 of the image's size.
    """

    head = "fc."

    def __init__(self) -> None:
        """Create the network with random weights.

        The attributes have torchvision's names: conv1, bn1, layer1 to layer4.
        """
        super().__init__()
        self.conv1 = nn.Conv2d(3, 64, 7, stride=2, padding=3, bias=False)
        self.bn1 = nn.BatchNorm2d(64)
        for number, (channels_in, width, block_count) in enumerate(RESNET50_LAYERS, 1):
            # The image was pooled before layer1, so only the other layers halve its size.
            stride = 1 if number == 1 else 2
            blocks = [Bottleneck(channels_in, width, stride)]
            for _ in range(block_count - 1):
                blocks.append(Bottleneck(4 * width, width, 1))
            self.add_module(f"layer{number}", nn.Sequential(*blocks))

    def forward(self, images: Tensor) -> list[Tensor]:
        """The outputs of layer1 to layer4 for images [B, 3, H, W] sRGB 0..1."""
        mean = channel_constants(IMAGENET_MEAN, images)
        std = channel_constants(IMAGENET_STD, images)
        x = self.bn1(self.conv1((images - mean) / std)).relu()  # [B, 64, H/2, W/2]
        x = F.max_pool2d(x, 3, stride=2, padding=1)  # [B, 64, H/4, W/4]

        feature_maps = []
        for number in range(1, len(RESNET50_LAYERS) + 1):
            x = self.get_submodule(f"layer{number}")(x)
            feature_maps.append(x)
        return feature_maps


class Fire(nn.Module):
    """A block of SqueezeNet: maps [B, channels_in, h, w] to [B, 8 squeeze, h, w]."""

    def __init__(self, channels_in: int, squeeze: int) -> None:
        super().__init__()
        self.conv1x1_1 = nn.Conv2d(channels_in, squeeze, 1)
        self.conv1x1_2 = nn.Conv2d(squeeze, 4 * squeeze, 1)
        self.conv3x3_2 = nn.Conv2d(squeeze, 4 * squeeze, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        x = self.conv1x1_1(x).relu()
        return torch.cat([self.conv1x1_2(x), self.conv3x3_2(x)], dim=1).relu()


class SqueezeNet(FeatureNet):
    """SqueezeNet 1.0 as in Caffe, for images of at least 32 pixels a side.

    Its weights take 3 MB, and it is much faster than ResNet-50.

    The feature maps are the outputs of conv1, fire4, fire8, fire9: 96, 256, 512, 512 channels at
    about 1/2, 1/4, 1/8, 1/16 of the image's size.
    """

    head = "conv10."

    def __init__(self) -> None:
        """Create the network with random weights.

        The attributes have Caffe's names: conv1, fire2 to fire9.
        """
        super().__init__()
        self.conv1 = nn.Conv2d(3, 96, 7, stride=2)
        for number, (channels_in, squeeze) in SQUEEZENET_BLOCKS.items():
            self.add_module(f"fire{number}", Fire(channels_in, squeeze))

    def forward(self, images: Tensor) -> list[Tensor]:
        """The outputs of conv1, fire4, fire8 and fire9 for images [B, 3, H, W] sRGB 0..1."""
        # Caffe's networks take blue, green, red in 0..255.
        x = 255 * images.flip(1) - channel_constants(CAFFE_MEAN_BGR, images)
        x = self.conv1(x).relu()

        outputs = {1: x}  # by the number in the block's name
        for number in SQUEEZENET_BLOCKS:
            if number in (2, 5, 9):  # the pooling layers of SqueezeNet 1.0 lie before these blocks
                # Caffe's pooling windows may extend beyond the edge.
                x = F.max_pool2d(x, 3, stride=2, ceil_mode=True)
            x = self.get_submodule(f"fire{number}")(x)
            outputs[number] = x
        return [outputs[number] for number in (1, 4, 8, 9)]


def load_features(
    name: Literal["resnet50", "squeezenet", "none"],
    path: Path | None,
    device: torch.device | str = "cpu",
) -> FeatureNet | None:
    """Load a frozen feature network; None for the name "none".

    Args:
        name: which network.
        path: torchvision's .pth file of ResNet-50; or for SqueezeNet 1.0 the .net file of its
            authors, or an .npz with the names of Caffe: `conv1.w`, `conv1.b`, `fire2/conv1x1_1.w`,
            ...
        device: where the network computes.

    Raises:
        InputError: the file is missing, broken, or holds another network.
    """
    if name == "none":
        return None
    if path is None:
        raise InputError(
            f"loss.features_path: missing: give the weights of {name} "
            f"(`spackle weights get {PUBLISHED_FEATURES[name]}` downloads them), or choose "
            "loss.features=none"
        )

    advice = f"give another file with {name}'s weights"
    network: FeatureNet
    if name == "resnet50":
        network = ResNet50()
        tensors = read_tensors(path, advice)
    else:
        network = SqueezeNet()
        tensors = read_squeezenet(path, advice)
    # The classifier at the end of the network, its head, is not needed.
    tensors = {name: value for name, value in tensors.items() if not name.startswith(network.head)}
    return load_strict(network, tensors, path, advice).to(device)


def read_squeezenet(path: Path, advice: str) -> dict[str, Tensor]:
    """SqueezeNet's weights from its authors' .net file, or an .npz, under torch's names.

    `fire2/conv1x1_1.w`, for example, becomes `fire2.conv1x1_1.weight`.

    InputError if the file is missing or holds no such arrays; the message ends with `advice`.
    """
    check_file(path, "weight file")
    if path.suffix.lower() == ".net":
        layers = {
            name.removesuffix(".weight"): tuple(tensor.shape)
            for name, tensor in SqueezeNet().state_dict().items()
            if name.endswith(".weight")
        }
        arrays = read_deep_compression(path, layers, SQUEEZENET_LAYERS, advice)
    else:
        with (
            as_input_error(path, f"not a file of weights ({{reason}}): {advice}"),
            open(path, "rb") as file,
            np.load(file, allow_pickle=False) as archive,
        ):
            arrays = {name: archive[name] for name in archive.files}

    suffixes = {"w": "weight", "b": "bias"}
    tensors = {}
    with as_input_error(path, f"not a file of weights ({{reason}}): {advice}"):
        for caffe_name, array in arrays.items():
            # "fire2/conv1x1_1.w" is "fire2.conv1x1_1." and the suffix "w".
            layer_and_dot = caffe_name[:-1].replace("/", ".")
            torch_name = layer_and_dot + suffixes[caffe_name[-1]]
            tensors[torch_name] = torch.from_numpy(array.copy())
    return tensors


def channel_constants(numbers: tuple[float, ...], images: Tensor) -> Tensor:
    """One number a channel, as a tensor [C, 1, 1] that fits images [B, C, H, W].

    It has the images' dtype and device.
    """
    # Made on the CPU and sent without waiting: making them on a GPU would wait for the GPU.
    constants = torch.tensor(numbers, dtype=images.dtype)
    return constants.to(images.device, non_blocking=True)[:, None, None]
