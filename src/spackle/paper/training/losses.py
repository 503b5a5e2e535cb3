"""The four terms of eq. 12, two measures of a filled hole's error, and the feature networks.

Arguments of the terms: `rgb` [B, H, W, 3] sRGB 0..1 and `alpha` [B, H, W] of completed views, the base's view
`base_rgb` [B, H, W, 3], the `target` [B, H, W, 3], the `hole` [B, H, W] bool. A term averages over an image's pixels
inside or outside of the hole, then over images. An image without such pixels counts as a differentiable 0.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Literal

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from spackle.core.filters import gaussian_blur, maximum_filter
from spackle.paper.training.recipe import LossRecipe
from spackle.runtime.errors import InputError, as_input_error
from spackle.runtime.files import check_file
from spackle.weights.checkpoints import load_strict, read_tensors

ALPHA_FLOOR = 1e-3  # less than 1/255, the least alpha that is rendered: the clamp removes no visible splat's gradient
NO_LENGTH = 1e-10  # least divisor of feature vectors, as in LPIPS
TINY = 1e-6  # avoids division by zero
IMAGENET_MEAN, IMAGENET_STD = (
    (0.485, 0.456, 0.406),
    (0.229, 0.224, 0.225),
)  # of sRGB 0..1, as in torchvision
CAFFE_MEAN = (104.0, 117.0, 123.0)  # of BGR 0..255
# The input channels and squeezed channels of fire2 to fire9.
SQUEEZED = dict(
    enumerate(
        [(96, 16), (128, 16), (128, 32), (256, 32), (256, 48), (384, 48), (384, 64), (512, 64)], 2
    )
)


# Feature networks ---------------------------------------------------------------------------------


class FeatureNet(nn.Module):
    """Maps [B, 3, H, W] sRGB 0..1 to four feature maps [B, C, h, w], fine to coarse; weights get no gradients."""

    head: str  # prefix of the classifier's tensors, which are ignored


class Bottleneck(nn.Module):
    """ResNet's block: maps [B, inside, h, w] to [B, 4 width, h / stride, w / stride]."""

    def __init__(self, inside: int, width: int, stride: int) -> None:
        super().__init__()
        self.conv1, self.bn1 = nn.Conv2d(inside, width, 1, bias=False), nn.BatchNorm2d(width)
        self.conv2, self.bn2 = (
            nn.Conv2d(width, width, 3, stride, 1, bias=False),
            nn.BatchNorm2d(width),
        )
        self.conv3, self.bn3 = nn.Conv2d(width, 4 * width, 1, bias=False), nn.BatchNorm2d(4 * width)
        self.downsample = nn.Sequential()
        if inside != 4 * width:
            self.downsample.extend(
                [nn.Conv2d(inside, 4 * width, 1, stride, bias=False), nn.BatchNorm2d(4 * width)]
            )

    def forward(self, x: Tensor) -> Tensor:
        y = self.bn1(self.conv1(x)).relu()
        y = self.bn2(self.conv2(y)).relu()
        return torch.relu(self.bn3(self.conv3(y)) + self.downsample(x))


class ResNet50(FeatureNet):
    """The paper's feature network, with torchvision's names of tensors, for images of at least 32 pixels a side.

    Outputs of layer1 to layer4: 256, 512, 1024, 2048 channels at 1/4, 1/8, 1/16, 1/32 of the image's size.
    """

    head = "fc."

    def __init__(self) -> None:
        super().__init__()
        self.conv1, self.bn1 = nn.Conv2d(3, 64, 7, 2, 3, bias=False), nn.BatchNorm2d(64)
        for number, (inside, width, blocks) in enumerate(
            [(64, 64, 3), (256, 128, 4), (512, 256, 6), (1024, 512, 3)]
        ):
            rest = [Bottleneck(4 * width, width, 1) for _ in range(blocks - 1)]
            self.add_module(
                f"layer{number + 1}",
                nn.Sequential(Bottleneck(inside, width, min(2, number + 1)), *rest),
            )

    def forward(self, images: Tensor) -> list[Tensor]:
        x = (images - _channels(IMAGENET_MEAN, images)) / _channels(IMAGENET_STD, images)
        maps = [F.max_pool2d(self.bn1(self.conv1(x)).relu(), 3, 2, 1)]
        for number in range(1, 5):
            maps.append(self.get_submodule(f"layer{number}")(maps[-1]))
        return maps[1:]


class Fire(nn.Module):
    """SqueezeNet's block: maps [B, inside, h, w] to [B, 8 squeeze, h, w]."""

    def __init__(self, inside: int, squeeze: int) -> None:
        super().__init__()
        self.conv1x1_1 = nn.Conv2d(inside, squeeze, 1)
        self.conv1x1_2 = nn.Conv2d(squeeze, 4 * squeeze, 1)
        self.conv3x3_2 = nn.Conv2d(squeeze, 4 * squeeze, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        x = self.conv1x1_1(x).relu()
        return torch.cat([self.conv1x1_2(x), self.conv3x3_2(x)], dim=1).relu()


class SqueezeNet(FeatureNet):
    """SqueezeNet 1.0 as in Caffe: 3 MB, much faster than ResNet-50, for images of at least 32 pixels a side.

    Outputs of conv1, fire4, fire8, fire9: 96, 256, 512, 512 channels at about 1/2, 1/4, 1/8, 1/16 of the image's size.
    """

    head = "conv10."

    def __init__(self) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(3, 96, 7, 2)
        for number, (inside, squeeze) in SQUEEZED.items():
            self.add_module(f"fire{number}", Fire(inside, squeeze))

    def forward(self, images: Tensor) -> list[Tensor]:
        maps = {1: self.conv1(255 * images.flip(1) - _channels(CAFFE_MEAN, images)).relu()}
        for number in SQUEEZED:
            x = maps[number - 1]
            if number in (2, 5, 9):  # Caffe's pooling windows may extend beyond the edge
                x = F.max_pool2d(x, 3, 2, ceil_mode=True)
            maps[number] = self.get_submodule(f"fire{number}")(x)
        return [maps[number] for number in (1, 4, 8, 9)]


def load_features(
    name: Literal["resnet50", "squeezenet", "none"],
    path: Path | None,
    device: torch.device | str = "cpu",
) -> FeatureNet | None:
    """Load a frozen feature network; "none" gives None.

    `path` is torchvision's .pth file of ResNet-50, or an .npz of SqueezeNet 1.0 with the names of Caffe: `conv1.w`,
    `conv1.b`, `fire2/conv1x1_1.w`, ... InputError if the file is missing, broken, or holds another network.
    """
    if name == "none":
        return None
    if path is None:
        raise InputError(
            f"loss.features_path: missing: give the weights of {name}, download the weights of resnet50 with "
            "`spackle weights get features`, or choose loss.features=none"
        )
    network: FeatureNet = ResNet50() if name == "resnet50" else SqueezeNet()
    advice = f"give another file with {name}'s weights"
    tensors = read_tensors(path, advice) if name == "resnet50" else _read_npz(path, advice)
    tensors = {key: value for key, value in tensors.items() if not key.startswith(network.head)}
    return load_strict(network, tensors, path, advice).to(device)


def _read_npz(path: Path, advice: str) -> dict[str, Tensor]:
    check_file(path, "weight file")
    broken = as_input_error(path, f"not a file of weights ({{reason}}): {advice}")
    with broken, open(path, "rb") as file, np.load(file, allow_pickle=False) as arrays:
        names = {
            name: name[:-1].replace("/", ".") + {"w": "weight", "b": "bias"}[name[-1]]
            for name in arrays.files
        }
        return {ours: torch.from_numpy(arrays[name]) for name, ours in names.items()}


def _channels(numbers: tuple[float, ...], images: Tensor) -> Tensor:
    return torch.tensor(numbers, dtype=images.dtype).to(images.device, non_blocking=True)[
        :, None, None
    ]


# Losses -------------------------------------------------------------------------------------------


def color_loss(rgb: Tensor, target: Tensor, hole: Tensor, blur: float = 0.0) -> Tensor:
    """[] mean |rgb - target| over a hole's pixels and the channels.

    With `blur` > 0 a Gaussian with this standard deviation in pixels first blurs the difference within the hole. The
    perceptual term alone then determines texture.
    """
    apart = torch.where(hole[..., None], rgb - target, 0)
    if blur > 0:
        mass = gaussian_blur(hole[..., None].to(rgb), blur).clamp_min(TINY)
        apart = torch.where(hole[..., None], gaussian_blur(apart, blur) / mass, 0)
    return _mean_of_images(apart.abs().mean(-1), hole)


def alpha_loss(alpha: Tensor, hole: Tensor) -> Tensor:
    """[] mean -log(max(alpha, 0.001)) over a hole: cross entropy towards 1."""
    opaque = torch.where(hole, alpha, 1).clamp_min(ALPHA_FLOOR)
    return _mean_of_images(-opaque.log(), hole)


def preserve_loss(rgb: Tensor, base_rgb: Tensor, hole: Tensor) -> Tensor:
    """[] mean |rgb - base_rgb| over pixels outside of the hole and channels; `base_rgb` gets no gradient."""
    return color_loss(rgb, base_rgb.detach(), ~hole)


def perceptual_loss(
    features: FeatureNet,
    rgb: Tensor,
    target: Tensor,
    hole: Tensor,
    *,
    dilation: int = 21,
    size: int | None = 512,
    gram: float = 1.0,
) -> Tensor:
    """[] differences of features and of Gram matrices near the hole, summed over layers.

    F and T are a layer's features [C, h, w] of prediction and target, divided by the root mean square of T. The weight
    w [h, w] is the fraction of each cell that the dilated hole covers. A layer adds

        sum(w |F - T|) / (C sum(w))  +  gram · mean |G(F) - G(T)|,    G(F) = (F w) F^T / sum(w),  [C, C].

    Args:
        features: the network.
        rgb, target, hole: as in the other terms. Outside of the dilated hole, the target replaces the prediction.
        dilation: side in pixels of the max-pool that dilates the hole.
        size: longer side in pixels to which images are resized for the network; None: not resized.
        gram: weight of the Gram matrices.
    """
    near = maximum_filter(hole, dilation // 2)
    if (
        near.device.type == "cpu" and not near.any()
    ):  # reading a mask on a GPU would wait for the GPU
        return rgb[:0].sum()  # 0, and a gradient of zeros, without the network
    ours = features(_resized(torch.where(near[..., None], rgb, target), size))
    with torch.no_grad():
        theirs = features(_resized(target, size))
    terms = [
        _layer_terms(f, t, covered_fraction(near, f)) for f, t in zip(ours, theirs, strict=True)
    ]
    return torch.stack([layer + gram * texture for layer, texture in terms]).sum()


def total_loss(
    rgb: Tensor,
    alpha: Tensor,
    target: Tensor,
    base_rgb: Tensor,
    hole: Tensor,
    recipe: LossRecipe,
    features: FeatureNet | None = None,
) -> tuple[Tensor, dict[str, Tensor]]:
    """The weighted sum [] of eq. 12, and the unweighted, detached terms [] by name.

    If `features` is None, there is no perceptual term.
    """
    terms = {
        "color": color_loss(rgb, target, hole, recipe.color_blur),
        "alpha": alpha_loss(alpha, hole),
        "preserve": preserve_loss(rgb, base_rgb, hole),
    }
    if features is not None:
        size, dilation, gram = recipe.feature_size, recipe.dilation, recipe.gram
        terms["perceptual"] = perceptual_loss(
            features, rgb, target, hole, dilation=dilation, size=size, gram=gram
        )
    total = torch.stack([getattr(recipe, name) * term for name, term in terms.items()]).sum()
    return total, {name: term.detach() for name, term in terms.items()}


@torch.no_grad()
def hole_distance(features: FeatureNet, rgb: Tensor, target: Tensor, hole: Tensor) -> float:
    """Perceptual distance inside a hole, like LPIPS without learned weights; 0 if equal, NaN if the hole is empty.

    Feature vectors are scaled to unit length. Their squared difference is averaged over a layer's cells, weighted by
    the fraction of each cell that the hole covers, and summed over layers. Only distances by the same network are
    comparable. `rgb` and `target` are [H, W, 3] sRGB 0..1, `hole` is [H, W] bool.
    """
    if not hole.any():
        return math.nan
    shown = torch.where(hole[..., None], rgb, target)
    total = 0.0
    for both in features(torch.stack([shown, target]).movedim(-1, 1)):  # [2, C, h, w]
        ours, theirs = both / both.norm(dim=1, keepdim=True).clamp_min(NO_LENGTH)
        weight = covered_fraction(hole[None], both)[0, 0]
        total += float(((ours - theirs).square().sum(0) * weight).sum() / weight.sum())
    return total


def hole_psnr(rgb: Tensor, target: Tensor, hole: Tensor) -> float:
    """PSNR in dB over a hole's pixels; infinite for equal images, NaN for an empty hole.

    `rgb` and `target` are [H, W, 3] sRGB 0..1, `hole` is [H, W] bool.
    """
    if not hole.any():
        return math.nan
    error = float((rgb - target)[hole].double().square().mean())
    return math.inf if error == 0 else -10 * math.log10(error)


def covered_fraction(mask: Tensor, features: Tensor) -> Tensor:
    """[B, 1, h, w]: the fraction of each cell of a feature map [B, C, h, w] that a mask [B, H, W] covers."""
    height, width = features.shape[-2:]
    return F.adaptive_avg_pool2d(mask[:, None].to(features.dtype), (height, width))


def _mean_of_images(values: Tensor, where: Tensor) -> Tensor:
    """[] mean over each image's mask `where`, then over images, of values [B, H, W] that are 0 outside of the mask."""
    return (values.sum((1, 2)) / where.sum((1, 2)).clamp_min(1)).mean()


def _resized(images: Tensor, size: int | None) -> Tensor:
    images = images.movedim(-1, 1)
    height, width = images.shape[-2:]
    if size is None or size == max(height, width):
        return images
    scale = size / max(height, width)
    small = max(1, round(height * scale)), max(1, round(width * scale))
    return F.interpolate(images, small, mode="bilinear", antialias=True, align_corners=False)


def _layer_terms(ours: Tensor, theirs: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """The feature term and the Gram term of a layer, from features [B, C, h, w] and cell weights [B, 1, h, w]."""
    rms = (theirs.square().mean(dim=(1, 2, 3), keepdim=True) + TINY**2).sqrt()
    ours, theirs = ours / rms, theirs / rms
    area = weight.sum(dim=(1, 2, 3))  # [B], 0 without a hole
    apart = (weight * (ours - theirs).abs()).mean(1).sum((1, 2)) / area.clamp_min(TINY)
    textures = (_gram(ours, weight, area) - _gram(theirs, weight, area)).abs().mean((1, 2))
    return apart.mean(), textures.mean()


def _gram(features: Tensor, weight: Tensor, area: Tensor) -> Tensor:
    together = (features * weight).flatten(2) @ features.flatten(2).mT
    return together / area.clamp_min(TINY)[:, None, None]
