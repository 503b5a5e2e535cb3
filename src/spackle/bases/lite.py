"""The lite base: rough depth from one photo, by two small networks in the package.

`LiteBase` asks the networks at several input sizes and merges their outputs. A network (`LiteNet`)
consists of an EfficientNet-Lite encoder and a small decoder.
"""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NamedTuple

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

# --- The network

SIDE_MULTIPLE = 32  # both sides of a network's input are multiples of this number
EncoderSize = Literal["lite0", "lite2"]


class Stage(NamedTuple):
    """A stage of EfficientNet: blocks of one kind, of which the first may halve the resolution."""

    block_count: int
    kernel: int  # side of the depthwise convolution
    stride: int  # of the first block
    expansion: int  # factor by which a block widens its input
    channels: int  # of the output


# EfficientNet (Tan and Le 2019); Google's Lite variants have no squeeze-and-excitation.
STAGES: dict[EncoderSize, tuple[Stage, ...]] = {
    "lite0": (
        Stage(1, 3, 1, 1, 16),
        Stage(2, 3, 2, 6, 24),
        Stage(2, 5, 2, 6, 40),
        Stage(3, 3, 2, 6, 80),
        Stage(3, 5, 1, 6, 112),
        Stage(4, 5, 2, 6, 192),
        Stage(1, 3, 1, 6, 320),
    ),
    "lite2": (
        Stage(1, 3, 1, 1, 16),
        Stage(3, 3, 2, 6, 24),
        Stage(3, 5, 2, 6, 48),
        Stage(4, 3, 2, 6, 88),
        Stage(4, 5, 1, 6, 120),
        Stage(5, 5, 2, 6, 208),
        Stage(1, 3, 1, 6, 352),
    ),
}
STEM_CHANNELS = 32  # of the convolution before the first stage
# The decoder gets the features of these stages: 1/2, 1/4, 1/8, 1/16 and 1/32 of the input.
FEATURE_STAGES = (0, 1, 2, 4, 6)
DECODER_CHANNELS = (24, 40, 64, 96, 160)  # the decoder's channels at these scales
HEAD_CHANNELS = 16  # between the two last convolutions
# The pretrained encoder's normalisation of its input.
INPUT_MEAN = 127.0 / 255
INPUT_STD = 128.0 / 255


class SameConv(nn.Conv2d):
    """A convolution with TensorFlow's "same" padding, for sides that the stride divides.

    The batch norm that followed it in the pretrained encoder is folded into its weights.
    """

    def __init__(
        self, inputs: int, outputs: int, kernel: int, stride: int = 1, groups: int = 1
    ) -> None:
        """Build a convolution from `inputs` to `outputs` channels."""
        super().__init__(inputs, outputs, kernel, stride, groups=groups)
        # Padding is done in `forward`: nn.Conv2d would pad both sides alike, but the pretrained
        # network's sides differ if the margin is odd.
        total_margin = kernel - stride
        before = total_margin // 2
        after = total_margin - before  # of an odd margin, TensorFlow puts the extra pixel here
        self.margins = (before, after, before, after)  # left, right, top, bottom

    def forward(self, x: Tensor) -> Tensor:
        """Features [B, C, H, W] to [B, outputs, H / stride, W / stride]."""
        return super().forward(pad(x, self.margins) if any(self.margins) else x)


class MBConv(nn.Module):
    """EfficientNet's block: three convolutions, 1×1 to more channels, depthwise, 1×1 to fewer.

    The input is added to the result if the shapes agree.
    """

    def __init__(self, inputs: int, outputs: int, kernel: int, stride: int, expansion: int) -> None:
        """Build a block that widens `inputs` channels by `expansion` between its convolutions."""
        super().__init__()
        middle = inputs * expansion
        self.expand = SameConv(inputs, middle, 1) if expansion > 1 else None
        self.depthwise = SameConv(middle, middle, kernel, stride, groups=middle)
        self.project = SameConv(middle, outputs, 1)
        self.adds_input = stride == 1 and inputs == outputs

    def forward(self, x: Tensor) -> Tensor:
        """Features [B, inputs, H, W] to [B, outputs, H / stride, W / stride]."""
        y: Tensor = x if self.expand is None else relu6(self.expand(x))
        y = self.project(relu6(self.depthwise(y)))
        return x + y if self.adds_input else y


class EfficientNetEncoder(nn.Module):
    """EfficientNet-Lite without classifier."""

    def __init__(self, size: EncoderSize) -> None:
        """Build the encoder of one size; its weights are random."""
        super().__init__()
        self.size = size
        self.stem = SameConv(3, STEM_CHANNELS, 3, stride=2)
        self.stages = nn.ModuleList()
        inputs = STEM_CHANNELS
        for stage in STAGES[size]:
            blocks = []
            for block_index in range(stage.block_count):
                stride = stage.stride if block_index == 0 else 1
                blocks.append(MBConv(inputs, stage.channels, stage.kernel, stride, stage.expansion))
                inputs = stage.channels
            self.stages.append(nn.Sequential(*blocks))

    def forward(self, rgb: Tensor) -> list[Tensor]:
        """Five feature maps, finest first, of [B, 3, H, W], sRGB in 0..1.

        For lite2 they are [B, 16, H/2, W/2], [B, 24, H/4, W/4], [B, 48, H/8, W/8],
        [B, 120, H/16, W/16] and [B, 352, H/32, W/32].
        """
        x = relu6(self.stem((rgb - INPUT_MEAN) / INPUT_STD))
        features = []
        for index, stage in enumerate(self.stages):
            x = stage(x)
            if index in FEATURE_STAGES:  # the last stage at each of the five scales
                features.append(x)
        return features


class UpsampleAndAdd(nn.Module):
    """Upsamples features of the coarser scale, and adds the encoder's features of this scale."""

    def __init__(self, coarse_channels: int, fine_channels: int, outputs: int) -> None:
        """Build the layers; both inputs are projected to `outputs` channels."""
        super().__init__()
        self.lateral = nn.Conv2d(fine_channels, outputs, 1)
        self.reduce = nn.Conv2d(coarse_channels, outputs, 1)
        self.mix = nn.Conv2d(outputs, outputs, 3, padding=1)
        self.refine = nn.Conv2d(outputs, outputs, 3, padding=1)

    def forward(self, coarse: Tensor, fine: Tensor) -> Tensor:
        """Features [B, outputs, h, w] from coarse [B, C, h/2, w/2] and fine ones [B, C', h, w]."""
        upsampled = interpolate(
            self.reduce(coarse), size=fine.shape[-2:], mode="bilinear", align_corners=False
        )
        x = upsampled + self.lateral(fine)
        refined: Tensor = x + self.refine(relu(self.mix(relu(x))))
        return refined


class LiteNet(nn.Module):
    """Predicts the logarithm of a photo's inverse depth, up to a constant."""

    def __init__(self, size: EncoderSize = "lite2") -> None:
        """Build a network with an encoder of one size; its weights are random."""
        super().__init__()
        self.encoder = EfficientNetEncoder(size)
        # Both lists begin with the finest of the five scales, and end with the coarsest.
        encoder_channels = [STAGES[size][stage].channels for stage in FEATURE_STAGES]
        *fine_channels, coarsest_channels = encoder_channels
        *fine_outputs, top = DECODER_CHANNELS  # top: the decoder's channels at the coarsest scale

        # First the coarsest scale. Two more inputs are the x and y of each cell.
        self.top = nn.Conv2d(coarsest_channels + 2, top, 1)
        # This layer gets the mean of the features over the whole picture.
        self.context = nn.Conv2d(coarsest_channels, top, 1)
        # With a dilation of 2, each cell gets information from cells two steps away.
        self.spread = nn.Sequential(
            nn.Conv2d(top, top, 3, padding=2, dilation=2, groups=top),
            nn.ReLU(),
            nn.Conv2d(top, top, 1),
        )
        # Then one block for each finer scale.
        self.fuse = nn.ModuleList(
            UpsampleAndAdd(DECODER_CHANNELS[level + 1], fine_channels[level], fine_outputs[level])
            for level in reversed(range(len(fine_outputs)))  # from coarse to fine
        )
        # Last, the finest features become one number for each cell, the log inverse depth.
        finest_width = DECODER_CHANNELS[0]
        self.head = nn.Sequential(
            nn.Conv2d(finest_width, HEAD_CHANNELS, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(HEAD_CHANNELS, 1, 1),
        )

    def forward(self, rgb: Tensor) -> Tensor:
        """Log inverse depth [B, H/2, W/2], up to a constant, of photos [B, 3, H, W].

        The photos are sRGB in 0..1. H and W must be multiples of 32.
        """
        *finer, coarsest = self.encoder(rgb)  # feature maps of five scales, the finest first
        # The position of an object in the picture tells much about the object's distance.
        x = self.top(torch.cat([coarsest, _cell_positions(coarsest)], dim=1))
        # The mean over the whole picture tells whether it shows a room or a landscape.
        x = x + self.context(coarsest.mean(dim=(2, 3), keepdim=True))
        x = x + self.spread(relu(x))

        # From the second coarsest scale to the finest.
        for fuse, fine in zip(self.fuse, reversed(finer), strict=True):
            x = fuse(x, fine)
        log_inverse_depth: Tensor = self.head(relu(x))[:, 0]
        return log_inverse_depth


def _cell_positions(features: Tensor) -> Tensor:
    """[B, 2, h, w]: x and y, from -1 to 1 across the picture, of each cell of [B, C, h, w]."""
    batch, _, height, width = features.shape
    rows = torch.arange(height, device=features.device, dtype=features.dtype)
    columns = torch.arange(width, device=features.device, dtype=features.dtype)
    y = (rows + 0.5) * (2 / height) - 1
    x = (columns + 0.5) * (2 / width) - 1
    grid = torch.stack([x.expand(height, width), y[:, None].expand(height, width)])
    return grid.expand(batch, -1, -1, -1)


# --- The file of weights

ADVICE = "give lite's weights"  # if a file holds other weights
# Suffix of the tensor with the quantisation steps of 8-bit weights, one for each output channel.
SCALE_SUFFIX = "/scale"
# The length of this tensor, the last of the encoder, tells a network's size.
_SIZE_TENSOR = f"encoder.stages.{len(STAGES['lite2']) - 1}.0.project.bias"


def load_networks(path: str | os.PathLike[str]) -> list[LiteNet]:
    """Load the networks of a file for inference in float32.

    If the file holds several networks, the name of each tensor begins with its network's number,
    such as "1.encoder.stem.weight". InputError for a missing or broken file, or for weights of
    another architecture.
    """
    tensors = _dequantised(read_tensors(path, ADVICE))
    # A file with a single network has no numbers before the names. An empty file is loaded as one,
    # too, which raises an error that says what is missing.
    if _SIZE_TENSOR in tensors or not tensors:
        return [_load_network(tensors, path)]

    tensors_by_number: dict[str, dict[str, Tensor]] = {}
    for name, tensor in tensors.items():
        number, _, name_in_network = name.partition(".")
        tensors_by_number.setdefault(number, {})[name_in_network] = tensor
    # The numbers are strings: sorted by length first, "9" comes before "10".
    numbers = sorted(tensors_by_number, key=lambda number: (len(number), number))
    return [_load_network(tensors_by_number[number], path) for number in numbers]


def _load_network(tensors: dict[str, Tensor], path: str | os.PathLike[str]) -> LiteNet:
    """A frozen network with the weights `tensors`, which were read from the file `path`.

    InputError, which names the file, if they are not the weights of a lite network.
    """
    # The number of channels of the encoder's last stage tells the network's size. It is the length
    # of that stage's bias.
    size_tensor = tensors.get(_SIZE_TENSOR)
    for size, stages in STAGES.items():
        if size_tensor is not None and size_tensor.shape == (stages[-1].channels,):
            return load_strict(LiteNet(size), tensors, path, ADVICE, prepare=to_channels_last)
    raise InputError(
        f"{path}: another network's weights: "
        f"{_SIZE_TENSOR} is missing or of another length: {ADVICE}"
    )


def _dequantised(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """All tensors as floats: 8-bit weights are multiplied by their quantisation steps.

    The steps are a tensor of their own, one for each output channel. An 8-bit tensor without
    fitting steps is left out, so that it counts as missing.
    """
    values: dict[str, Tensor] = {}
    for name, tensor in tensors.items():
        steps = tensors.get(name + SCALE_SUFFIX)
        # Biases and small layers are stored as floats, and need no steps.
        if tensor.is_floating_point() and not name.endswith(SCALE_SUFFIX):
            values[name] = tensor
        elif steps is not None and tensor.dim() == 4 and steps.shape == tensor.shape[:1]:
            # [outputs, inputs, kernel, kernel], times one step for each output
            values[name] = tensor.float() * steps[:, None, None, None]
    return values


# --- The base

SHIPPED_WEIGHTS = Path(__file__).parents[1] / "weights" / "lite.safetensors"
# At a larger move of the camera upright objects lean, outlines fray and poles bend:
# docs/lab/lite.md.
MAX_DISPARITY = 0.1
# Share of the widest views that may be holes: more invented parts would be conspicuous.
MAX_HOLE_RATIO = 0.075
MAX_DEPTH_RATIO = 60.0  # depths are limited to this multiple of the nearest depth
# Objects grow by at least so many of the photo's pixels, and by one of the map's, so that no pixel
# with their colour stays behind when the camera moves: docs/lab/silhouettes.md.
MIN_OUTLINE_GROWTH_PX = 3


@dataclasses.dataclass(frozen=True)
class InputScale:
    """One input size: the resolution at which one of the networks receives a photo."""

    pixels: int  # of the network's input, approximately
    network: int = 0  # index of the network in the file
    mirrored: bool = True  # whether the network also gets the mirror image
    # Whether the output also contributes low frequencies, and not only outlines.
    gives_low_frequencies: bool = True


# Both networks were trained at up to 256×320. Small inputs show whole objects at once, large inputs
# show outlines: the mean output has a smaller error than the best single output. Mirroring the
# largest input costs most and gains nothing.
INPUT_SCALES = (
    InputScale(64 * 96),
    InputScale(96 * 128),
    InputScale(192 * 256),
    InputScale(192 * 256, network=1),
    InputScale(256 * 320),
    InputScale(448 * 608, mirrored=False, gives_low_frequencies=False),
)
# An output's low frequencies are its means in 3×4 cells, with 4 cells along the longer side.
COARSE_CELLS = (3, 4)


class LiteBase:
    """Lifts the depth that small networks estimate.

    It gives a plausible parallax, but is no measurement.
    """

    name = "lite"

    def __init__(self, networks: Sequence[LiteNet], device: torch.device) -> None:
        """Use loaded networks, which are moved to `device`."""
        self.networks = [network.to(device) for network in networks]
        self.device = device

    @classmethod
    def load(cls, path: Path | None = None, *, device: str | None = None) -> LiteBase:
        """Read the networks from a file that lite's training wrote, or from the package's file.

        `device` is cpu or a CUDA device; None: CUDA if available. InputError for a file or device
        that cannot be used.
        """
        return cls(load_networks(path or SHIPPED_WEIGHTS), pick_device(device))

    def predict(self, photo: Photo, progress: Progress | None = None) -> BasePrediction:
        """Gaussians of the photo's pixels, on the surfaces that lite guesses.

        The photo is first resized to its working size (the long side is at most 1536 pixels). The
        network knows no metres: the nearest surface is put at 1.5 m.
        """
        photo = resize_photo(photo)
        inverse_depth = self.inverse_depth(photo.rgb)
        # 1 at the nearest surface, towards 0 in the distance.
        nearness = inverse_depth / near_inverse_depth(inverse_depth.flatten())
        depth = RELATIVE_NEAR_M / nearness.clamp(1 / MAX_DEPTH_RATIO, 1)
        # Every pixel has a depth. The map needs no intrinsics (K), because the camera is passed
        # separately, and has no quantisation step (quantum), because nothing was rounded.
        depth_map = DepthMap(
            depth,
            torch.ones_like(depth, dtype=torch.bool),
            K=None,
            quantum=None,
            quantity="disparity",
            path=photo.path,
        )
        map_pixel_px = max(photo.width, photo.height) / max(depth.shape)
        prediction = lift_predicted_depth(
            photo,
            depth_map,
            photo.camera,
            outline_growth_px=max(MIN_OUTLINE_GROWTH_PX, round(map_pixel_px)),
        )
        notes = {
            **prediction.notes,
            "precision": "fp32",
            "depth_scale": f"relative, the nearest at {RELATIVE_NEAR_M:g} m",
        }
        # Because the geometry is rough, the camera may move less (max_disparity), and less of a
        # view may be holes, than with other bases.
        return dataclasses.replace(
            prediction, notes=notes, max_disparity=MAX_DISPARITY, max_hole_ratio=MAX_HOLE_RATIO
        )

    def inverse_depth(self, rgb: Tensor) -> Tensor:
        """Inverse depth of a photo [H, W, 3] (sRGB in 0..1), from the networks' merged outputs.

        Returns [h, w] float32 up to a factor, on the CPU: about 224×304, in the photo's aspect
        ratio.
        """
        # If the file of weights holds only the first network, the second one's scale is left out.
        scales = [scale for scale in INPUT_SCALES if scale.network < len(self.networks)]
        log_inverse_depths = self.at_scales(rgb, scales)
        # Maps of coarse inputs are right at large, those of fine inputs in detail: the merged map
        # takes its low frequencies from the scales that are marked for it.
        gives_low_frequencies = [scale.gives_low_frequencies for scale in scales]
        return merge_outputs(log_inverse_depths, gives_low_frequencies).exp()

    @torch.no_grad()
    def at_scales(self, rgb: Tensor, scales: Sequence[InputScale]) -> Tensor:
        """[n, h, w] log inverse depth of a photo [H, W, 3], one map for each of n input scales.

        All maps are resized to the size of the last scale's map, which is the finest, and are on
        the CPU. Each is known only up to a constant of its own.
        """
        picture = rgb.float().permute(2, 0, 1)[None].to(self.device)  # [1, 3, H, W]
        # Each output is [1, 1, its height, its width], as `interpolate` needs it.
        outputs = [self._run_network(picture, scale)[None, None] for scale in scales]
        finest_size = outputs[-1].shape[2:]
        resized = [interpolate(output, size=finest_size, mode="bilinear")[0] for output in outputs]
        return torch.cat(resized).cpu()

    def _run_network(self, picture: Tensor, scale: InputScale) -> Tensor:
        """[h/2, w/2] log inverse depth of a photo [1, 3, H, W], resized to (h, w) for the network.

        With `scale.mirrored` the network also gets the photo's mirror image; the result is the mean
        of both outputs, which errs less.
        """
        size = network_size(picture.shape[2], picture.shape[3], scale.pixels)
        resized = interpolate(picture, size=size, mode="bicubic", antialias=True).clamp(0, 1)
        inputs = torch.cat([resized, resized.flip(-1)]) if scale.mirrored else resized
        inputs = inputs.contiguous(memory_format=torch.channels_last)
        with without_autocast_or_tf32(self.device):
            # [1 or 2, h/2, w/2]; the second, if any, is for the mirror image
            outputs: Tensor = self.networks[scale.network](inputs).float()
        if not scale.mirrored:
            return outputs[0]
        # The mirror image's output is mirrored back.
        return torch.stack([outputs[0], outputs[1].flip(-1)]).mean(0)


def merge_outputs(outputs: Tensor, gives_low_frequencies: Sequence[bool]) -> Tensor:
    """Mean [h, w] of n maps of log inverse depth [n, h, w] for the same photo.

    Each map is split into its low frequencies (its means in 3×4 cells, interpolated) and the rest,
    its outlines. The mean outlines of all maps are added to the mean low frequencies of those maps
    for which `gives_low_frequencies` (n values) is true.
    """
    # A network's output for a large input has sharp outlines, but wrong slopes over the whole
    # picture: only its outlines are of use.
    height, width = outputs.shape[1:]
    # Four cells lie along the longer side.
    cells = COARSE_CELLS if height <= width else COARSE_CELLS[::-1]
    cell_means = interpolate(outputs[None], size=cells, mode="area")
    low_frequencies = interpolate(cell_means, size=(height, width), mode="bicubic")[0]
    outlines = outputs - low_frequencies
    contributing = low_frequencies[torch.tensor(gives_low_frequencies)]  # [≤ n, h, w]
    merged: Tensor = outlines.mean(0) + contributing.mean(0)
    return merged


def network_size(height: int, width: int, pixels: int) -> tuple[int, int]:
    """(height, width) of a network's input for a photo of height × width pixels.

    It has about the photo's aspect ratio, and about `pixels` pixels.
    """
    return scaled_size(height, width, math.sqrt(pixels / (height * width)))


def scaled_size(height: int, width: int, scale: float) -> tuple[int, int]:
    """The size closest to `scale` times (height, width) that a network accepts."""
    # The encoder halves the resolution five times: sides must be multiples of 2⁵.
    rows = max(SIDE_MULTIPLE, round(height * scale / SIDE_MULTIPLE) * SIDE_MULTIPLE)
    columns = max(SIDE_MULTIPLE, round(width * scale / SIDE_MULTIPLE) * SIDE_MULTIPLE)
    return rows, columns
