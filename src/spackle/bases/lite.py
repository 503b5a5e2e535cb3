"""The lite base: rough depth from one photo, by two small networks in the package.

A network consists of an EfficientNet-Lite encoder and a small decoder.
"""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate, pad, relu, relu6

from spackle.bases import BasePrediction
from spackle.bases.depth import lift_predicted_depth
from spackle.core.photo import Photo, resize_photo
from spackle.depth.depth_map import DepthMap
from spackle.depth.units import RELATIVE_NEAR_M, near_inverse_depth
from spackle.runtime.device import pick_device, without_autocast_or_tf32
from spackle.runtime.errors import InputError
from spackle.runtime.progress import Progress
from spackle.weights.checkpoints import load_strict, read_tensors, to_channels_last

SIDE_MULTIPLE = 32  # both sides of a network's input are multiples of this number
EncoderSize = Literal["lite0", "lite2"]
# Stages of EfficientNet (Tan and Le 2019; Google's Lite variants have no squeeze-and-excitation).
BLOCKS = (
    (3, 1, 1),
    (3, 2, 6),
    (5, 2, 6),
    (3, 2, 6),
    (5, 1, 6),
    (5, 2, 6),
    (3, 1, 6),
)  # kernel, stride, expansion
DEPTHS: dict[EncoderSize, tuple[int, ...]] = {
    "lite0": (1, 2, 2, 3, 3, 4, 1),
    "lite2": (1, 3, 3, 4, 4, 5, 1),
}  # blocks
WIDTHS: dict[EncoderSize, tuple[int, ...]] = {
    "lite0": (16, 24, 40, 80, 112, 192, 320),
    "lite2": (16, 24, 48, 88, 120, 208, 352),
}
STAGES = {  # each stage: number of blocks, kernel, stride, expansion, channels
    size: tuple((n, *block, c) for n, block, c in zip(depths, BLOCKS, WIDTHS[size], strict=True))
    for size, depths in DEPTHS.items()
}
STEM_CHANNELS = 32
FEATURE_STAGES = (
    0,
    1,
    2,
    4,
    6,
)  # the decoder gets the features of these stages: 1/2, 1/4, 1/8, 1/16 and 1/32 of the input
DECODER_CHANNELS = (24, 40, 64, 96, 160)  # the decoder's channels at these scales
INPUT_MEAN, INPUT_STD = (
    127.0 / 255,
    128.0 / 255,
)  # the pretrained encoder's normalisation of its input


class SameConv(nn.Conv2d):
    """A convolution with TensorFlow's "same" padding for sides that the stride divides; batch norm is folded in."""

    def __init__(
        self, inputs: int, outputs: int, kernel: int, stride: int = 1, groups: int = 1
    ) -> None:
        super().__init__(inputs, outputs, kernel, stride, groups=groups)
        total = kernel - stride
        self.margins = (total // 2, total - total // 2) * 2

    def forward(self, x: Tensor) -> Tensor:
        return super().forward(pad(x, self.margins) if any(self.margins) else x)


class MBConv(nn.Module):
    """MBConv: convolutions 1×1 (to more channels), depthwise, 1×1 (to fewer); adds the input if the shapes agree."""

    def __init__(self, inputs: int, outputs: int, kernel: int, stride: int, expansion: int) -> None:
        super().__init__()
        middle = inputs * expansion
        self.expand = SameConv(inputs, middle, 1) if expansion > 1 else None
        self.depthwise = SameConv(middle, middle, kernel, stride, groups=middle)
        self.project = SameConv(middle, outputs, 1)
        self.skips = stride == 1 and inputs == outputs

    def forward(self, x: Tensor) -> Tensor:
        y: Tensor = x if self.expand is None else relu6(self.expand(x))
        y = self.project(relu6(self.depthwise(y)))
        return x + y if self.skips else y


class EfficientNetEncoder(nn.Module):
    def __init__(self, size: EncoderSize) -> None:
        super().__init__()
        self.size = size
        self.stem = SameConv(3, STEM_CHANNELS, 3, 2)
        self.stages = nn.ModuleList()
        inputs = STEM_CHANNELS
        for count, kernel, stride, expansion, outputs in STAGES[size]:
            blocks = []
            for n in range(count):
                blocks.append(MBConv(inputs, outputs, kernel, stride if n == 0 else 1, expansion))
                inputs = outputs
            self.stages.append(nn.Sequential(*blocks))

    def forward(self, x: Tensor) -> list[Tensor]:
        """[B, 3, H, W] sRGB in 0..1 to the features of `FEATURE_STAGES`, finest first."""
        x = relu6(self.stem((x - INPUT_MEAN) / INPUT_STD))
        features = []
        for index, stage in enumerate(self.stages):
            x = stage(x)
            if index in FEATURE_STAGES:
                features.append(x)
        return features


class UpsampleAndAdd(nn.Module):
    """Upsamples the features of the coarser scale, and adds the features of this scale."""

    def __init__(self, coarse: int, skip: int, outputs: int) -> None:
        super().__init__()
        self.lateral = nn.Conv2d(skip, outputs, 1)
        self.reduce = nn.Conv2d(coarse, outputs, 1)
        self.mix = nn.Conv2d(outputs, outputs, 3, padding=1)
        self.refine = nn.Conv2d(outputs, outputs, 3, padding=1)

    def forward(self, coarse: Tensor, skip: Tensor) -> Tensor:
        up = interpolate(
            self.reduce(coarse), size=skip.shape[-2:], mode="bilinear", align_corners=False
        )
        x = up + self.lateral(skip)
        refined: Tensor = x + self.refine(relu(self.mix(relu(x))))
        return refined


class LiteNet(nn.Module):
    """Predicts a photo's inverse depth, up to a factor."""

    def __init__(self, size: EncoderSize = "lite2") -> None:
        super().__init__()
        self.encoder = EfficientNetEncoder(size)
        channels = [STAGES[size][stage][-1] for stage in FEATURE_STAGES]
        top = DECODER_CHANNELS[-1]
        self.top = nn.Conv2d(channels[-1] + 2, top, 1)
        self.context = nn.Conv2d(channels[-1], top, 1)
        self.spread = nn.Sequential(
            nn.Conv2d(top, top, 3, padding=2, dilation=2, groups=top),
            nn.ReLU(),
            nn.Conv2d(top, top, 1),
        )
        self.fuse = nn.ModuleList(
            UpsampleAndAdd(DECODER_CHANNELS[n + 1], channels[n], DECODER_CHANNELS[n])
            for n in reversed(range(len(FEATURE_STAGES) - 1))
        )
        self.head = nn.Sequential(
            nn.Conv2d(DECODER_CHANNELS[0], 16, 3, padding=1), nn.ReLU(), nn.Conv2d(16, 1, 1)
        )

    def forward(self, rgb: Tensor) -> Tensor:
        """[B, 3, H, W] sRGB in 0..1 to log inverse depth [B, H/2, W/2] up to a constant; 32 must divide H and W."""
        *finer, coarsest = self.encoder(rgb)
        # The place of an object in the picture tells much about the object's distance.
        x = self.top(torch.cat([coarsest, _places(coarsest)], dim=1))
        x = x + self.context(coarsest.mean(dim=(2, 3), keepdim=True))
        x = x + self.spread(relu(x))
        for fuse, skip in zip(self.fuse, reversed(finer), strict=True):
            x = fuse(x, skip)
        inverse_depth: Tensor = self.head(relu(x))[:, 0]
        return inverse_depth


def _places(x: Tensor) -> Tensor:
    """[B, 2, h, w]: x and y of each cell, -1..1 across the picture."""
    batch, _, height, width = x.shape
    rows = (torch.arange(height, device=x.device, dtype=x.dtype) + 0.5) * (2 / height) - 1
    columns = (torch.arange(width, device=x.device, dtype=x.dtype) + 0.5) * (2 / width) - 1
    grid = torch.stack([columns.expand(height, width), rows[:, None].expand(height, width)])
    return grid.expand(batch, -1, -1, -1)


ADVICE = "give lite's weights"  # if a file holds other weights
SCALE_SUFFIX = "/scale"  # suffix of the tensor with the quantisation steps of 8-bit weights, one for each output channel
LAST = f"encoder.stages.{len(STAGES['lite2']) - 1}.0.project.bias"  # the length of this tensor tells a network's size


def load_networks(path: str | os.PathLike[str]) -> list[LiteNet]:
    """Load the networks of a file for inference in float32.

    The names of tensors begin with the network's number, unless the file holds a single network. InputError for a
    missing or broken file, or for weights of another architecture.
    """
    tensors = _unpacked(read_tensors(path, ADVICE))
    if LAST in tensors:
        return [_network(tensors, path)]
    parts: dict[str, dict[str, Tensor]] = {}
    for name, tensor in tensors.items():
        number, _, rest = name.partition(".")
        parts.setdefault(number, {})[rest] = tensor
    numbers = sorted(parts, key=lambda number: (len(number), number))
    return [_network(parts[number], path) for number in numbers] or [_network({}, path)]


def _network(tensors: dict[str, Tensor], path: str | os.PathLike[str]) -> LiteNet:
    for size, widths in WIDTHS.items():
        if LAST in tensors and tensors[LAST].shape == (widths[-1],):
            return load_strict(LiteNet(size), tensors, path, ADVICE, prepare=to_channels_last)
    raise InputError(
        f"{path}: another network's weights: {LAST} is missing or of another length: {ADVICE}"
    )


def _unpacked(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """All tensors as floats; an 8-bit tensor without a fitting scale is left out, so that it counts as missing."""
    values: dict[str, Tensor] = {}
    for name, tensor in tensors.items():
        scale = tensors.get(name + SCALE_SUFFIX)
        if tensor.is_floating_point() and not name.endswith(SCALE_SUFFIX):
            values[name] = tensor
        elif scale is not None and tensor.dim() == 4 and scale.shape == tensor.shape[:1]:
            values[name] = tensor.float() * scale[:, None, None, None]
    return values


SHIPPED_WEIGHTS = Path(__file__).parents[1] / "weights" / "lite.safetensors"
MAX_DISPARITY = 0.15  # at a larger disparity upright objects lean and poles bend: docs/lab/lite.md
MAX_HOLE_RATIO = (
    0.075  # share of the widest views that may be holes: more invented parts would be conspicuous
)
MAX_DEPTH_RATIO = 60.0  # depths are limited to this multiple of the nearest depth


@dataclasses.dataclass(frozen=True)
class InputScale:
    """One input size: the resolution at which one of the networks receives a photo."""

    pixels: int  # of the network's input, approximately
    network: int = 0  # index of the network in the file
    mirrored: bool = True  # whether the network also gets the mirror image
    tilt: bool = True  # whether the output also contributes low frequencies, and not only outlines


# Both networks were trained at up to 256×320. Small inputs show whole objects at once, large inputs show outlines: the
# mean output has a smaller error than the best single output. Mirroring the largest input costs most and gains nothing.
INPUT_SCALES = (
    InputScale(64 * 96),
    InputScale(96 * 128),
    InputScale(192 * 256),
    InputScale(192 * 256, network=1),
    InputScale(256 * 320),
    InputScale(448 * 608, mirrored=False, tilt=False),
)
COARSE_CELLS = (
    3,
    4,
)  # an output's low frequencies are its means in 3×4 cells, with 4 cells along the longer side


class LiteBase:
    """Lifts the depth that small networks estimate; it gives a plausible parallax, but is no measurement."""

    name = "lite"

    def __init__(self, networks: Sequence[LiteNet], device: torch.device) -> None:
        self.networks = [network.to(device) for network in networks]
        self.device = device

    @classmethod
    def load(cls, path: Path | None = None, *, device: str | None = None) -> LiteBase:
        """Read the networks from a file that lite's training wrote, by default the file in the package.

        `device` is cpu or a CUDA device; None: CUDA if available. InputError for a file or device that cannot be used.
        """
        return cls(load_networks(path or SHIPPED_WEIGHTS), pick_device(device))

    def predict(self, photo: Photo, progress: Progress | None = None) -> BasePrediction:
        """Gaussians of the pixels of the photo at its working size, as `lift_rgbd` makes them."""
        photo = resize_photo(photo)
        inverse_depth = self.inverse_depth(photo.rgb)
        depth = RELATIVE_NEAR_M / (
            inverse_depth / near_inverse_depth(inverse_depth.flatten())
        ).clamp(1 / MAX_DEPTH_RATIO, 1)
        known = torch.ones_like(depth, dtype=torch.bool)
        depth_map = DepthMap(depth, known, None, None, "disparity", photo.path)
        prediction = lift_predicted_depth(photo, depth_map, photo.camera)
        notes = {
            **prediction.notes,
            "precision": "fp32",
            "depth_scale": f"relative, the nearest at {RELATIVE_NEAR_M:g} m",
        }
        return dataclasses.replace(
            prediction, notes=notes, max_disparity=MAX_DISPARITY, max_hole_ratio=MAX_HOLE_RATIO
        )

    def inverse_depth(self, rgb: Tensor) -> Tensor:
        """Inverse depth of a photo [H, W, 3] (sRGB in 0..1), by the mean logarithm over all `INPUT_SCALES`.

        Returns [h, w] float32 up to a factor, on the CPU: about 224×304, in the photo's aspect ratio.
        """
        scales = [scale for scale in INPUT_SCALES if scale.network < len(self.networks)]
        return merge_outputs(self.at_scales(rgb, scales), [scale.tilt for scale in scales]).exp()

    @torch.no_grad()
    def at_scales(self, rgb: Tensor, scales: Sequence[InputScale]) -> Tensor:
        """[n, h, w] log inverse depth of a photo [H, W, 3] from n input scales, at the resolution of the last scale."""
        picture = rgb.float().permute(2, 0, 1)[None].to(self.device)
        outputs = [self._ask(picture, scale)[None, None] for scale in scales]
        finest = outputs[-1].shape[2:]
        return torch.cat(
            [interpolate(output, size=finest, mode="bilinear")[0] for output in outputs]
        ).cpu()

    def _ask(self, picture: Tensor, scale: InputScale) -> Tensor:
        """[h/2, w/2] log inverse depth of a photo [1, 3, H, W], which is resized to (h, w) for the network."""
        size = network_size(picture.shape[2], picture.shape[3], scale.pixels)
        seen = interpolate(picture, size=size, mode="bicubic", antialias=True).clamp(0, 1)
        ways = torch.cat([seen, seen.flip(-1)]) if scale.mirrored else seen
        with without_autocast_or_tf32(self.device):
            outputs = self.networks[scale.network](
                ways.contiguous(memory_format=torch.channels_last)
            ).float()
        return (
            torch.stack([outputs[0], outputs[1].flip(-1)]).mean(0) if scale.mirrored else outputs[0]
        )


def merge_outputs(outputs: Tensor, tilt: Sequence[bool]) -> Tensor:
    """Mean [h, w] of outputs [n, h, w]; its low frequencies come only from the outputs for which `tilt` is true."""
    cells = COARSE_CELLS if outputs.shape[1] <= outputs.shape[2] else COARSE_CELLS[::-1]
    coarse = interpolate(
        interpolate(outputs[None], size=cells, mode="area"), size=outputs.shape[1:], mode="bicubic"
    )[0]
    return (outputs - coarse).mean(0) + coarse[torch.tensor(tilt)].mean(0)


def network_size(height: int, width: int, pixels: int) -> tuple[int, int]:
    """(height, width) of a network's input: about the photo's aspect ratio and about `pixels` pixels."""
    return scaled_size(height, width, math.sqrt(pixels / (height * width)))


def scaled_size(height: int, width: int, scale: float) -> tuple[int, int]:
    """The size closest to `scale` times (height, width) that a network accepts."""
    tall, wide = (
        max(SIDE_MULTIPLE, round(side * scale / SIDE_MULTIPLE) * SIDE_MULTIPLE)
        for side in (height, width)
    )
    return tall, wide
