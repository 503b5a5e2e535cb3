"""SHARP (Apple, 2025): predict two layers of Gaussians from one picture, with DPT's decoders (Ranftl 2021).

Modules are named as in the checkpoint.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, max_pool2d, softplus

from spackle.bases.sharp.encoder import (
    CELL_STRIDE,
    LAYER_COUNT,
    Float32Conv,
    SharpConfig,
    SlidingPyramid,
)
from spackle.core.color import srgb_to_linear
from spackle.core.gaussians import Gaussians
from spackle.runtime.progress import Progress

NORM_GROUPS = 8  # channel groups of the group norms


class Residual(nn.Module):
    """Adds the output of a few layers to their input."""

    def __init__(self, *layers: nn.Module) -> None:
        super().__init__()
        self.residual = nn.Sequential(*layers)

    def forward(self, x: Tensor) -> Tensor:
        delta: Tensor = self.residual(x)
        return delta.add_(x)


class GroupNorm(nn.GroupNorm):
    """torch's group norm with exact sums on a CPU, where float32 sums of half a million pixels lose three digits."""

    def forward(self, x: Tensor) -> Tensor:
        """Normalise [1, C, H, W]; the shape stays the same."""
        if x.device.type != "cpu" or x.dtype != torch.float32 or len(x) != 1:
            return super().forward(x)
        rows = x[0].permute(1, 2, 0)  # [H, W, C]
        count = rows.numel() // self.num_groups
        mean, square = (
            moment.double().sum(0).view(self.num_groups, -1).sum(1) / count
            for moment in (rows.sum(1), rows.square().sum(1))
        )
        scale = torch.rsqrt(square - mean.square() + self.eps)
        each = self.num_channels // self.num_groups
        scale, mean = (n.repeat_interleave(each) for n in (scale, mean))
        factor = (self.weight * scale).float()
        shift = (self.bias - self.weight * scale * mean).float()
        return torch.addcmul(shift, rows, factor).permute(2, 0, 1)[None]


def plain_residual(dim: int) -> Residual:
    """A residual block of two 3×3 convolutions, each after a ReLU; the first ReLU does not overwrite its input."""
    first, second = (nn.Conv2d(dim, dim, 3, padding=1) for _ in range(2))
    return Residual(nn.ReLU(), first, nn.ReLU(inplace=True), second)


def normed_residual(dim: int, out: int) -> Residual:
    """A residual block of two 3×3 convolutions with group norms; the first has half as many output channels."""
    first, second = nn.Conv2d(dim, out // 2, 3, padding=1), nn.Conv2d(out // 2, out, 3, padding=1)
    norms = GroupNorm(NORM_GROUPS, dim), GroupNorm(NORM_GROUPS, out // 2)
    return Residual(norms[0], nn.ReLU(inplace=True), first, norms[1], nn.ReLU(inplace=True), second)


class Fusion(nn.Module):
    """Adds finer features to coarser features, and doubles the size if `doubles` is set."""

    def __init__(self, dim: int, doubles: bool) -> None:
        super().__init__()
        self.resnet1 = plain_residual(dim)
        self.resnet2 = plain_residual(dim)
        self.deconv = (
            nn.ConvTranspose2d(dim, dim, 2, stride=2, bias=False) if doubles else nn.Identity()
        )
        self.out_conv = nn.Conv2d(dim, dim, 1)

    def forward(self, coarse: Tensor, fine: Tensor | None = None) -> Tensor:
        """Fuse features [1, C, H, W] into features of the same or twice the size."""
        x = coarse if fine is None else coarse + self.resnet1(fine)
        out: Tensor = self.out_conv(self.deconv(self.resnet2(x)))
        return out


class Decoder(nn.Module):
    """Fuses feature maps, from coarse to fine, into one map of the finest size."""

    def __init__(self, dims: Sequence[int], width: int) -> None:
        super().__init__()
        finest = nn.Identity() if dims[0] == width else nn.Conv2d(dims[0], width, 1, bias=False)
        coarser = (nn.Conv2d(dim, width, 3, padding=1, bias=False) for dim in dims[1:])
        self.convs = nn.ModuleList([finest, *coarser])
        self.fusions = nn.ModuleList(Fusion(width, doubles=level > 0) for level in range(len(dims)))

    def forward(self, maps: Sequence[Tensor], features: Tensor | None = None) -> Tensor:
        """Fuse maps [1, dims[i], H/2^i, W/2^i], fine to coarse, and still coarser `features` into [1, width, H, W]."""
        for level in reversed(range(len(maps))):
            projected = self.convs[level](maps[level])
            fuse = self.fusions[level]
            features = fuse(projected) if features is None else fuse(features, projected)
        assert features is not None
        return features


DISPARITY_RANGE = (1e-4, 1e4)  # the depth head's output is clamped to it
HEAD_CHANNELS = 32  # channels before the last layer of the depth head


@dataclasses.dataclass(frozen=True)
class SharpOutput:
    initial: InitialGaussians  # Gaussians on the two surfaces
    deltas: Tensor  # [14, 2, side/2, side/2] float32 changes of these Gaussians


@dataclasses.dataclass(frozen=True)
class DecoderInput:
    """Outputs of the encoder and the depth network for one picture: the input of the Gaussian decoder."""

    initial: InitialGaussians
    image_and_disparity: (
        Tensor  # [1, 5, side, side] float32 in -1..1: sRGB, and the disparity of both layers
    )
    encoder_maps: list[
        Tensor
    ]  # the encoder's, fine to coarse: [1, C, side/2, side/2] to [1, C, side/32, side/32]


class SharpNetwork(nn.Module):
    """The whole network, without the parts that inference never uses."""

    def __init__(self, config: SharpConfig) -> None:
        super().__init__()
        self.config = config
        self.monodepth_model = nn.Module()
        self.monodepth_model.monodepth_predictor = DepthNetwork(config)
        self.feature_model = FeatureNetwork(config)
        self.prediction_head = PredictionHead(config.feature_width)

    def forward(
        self,
        image: Tensor,
        disparity_factor: float | Tensor,
        batch: int,
        progress: Progress | None = None,
    ) -> SharpOutput:
        """Predict from the photo, stretched to [1, 3, side, side] sRGB in 0..1, float32.

        `disparity_factor` is the focal length over the width in the photo's pixels. `batch` windows go through the
        transformer at once; `progress` gets the number of windows done and the number of all windows.
        """
        encoded = self.encode(image, disparity_factor, batch, progress)
        deltas: Tensor = self.gaussian_decoder()(encoded.image_and_disparity, encoded.encoder_maps)
        return SharpOutput(encoded.initial, deltas)

    def encode(
        self,
        image: Tensor,
        disparity_factor: float | Tensor,
        batch: int,
        progress: Progress | None = None,
    ) -> DecoderInput:
        """Everything before the Gaussian decoder; the arguments are `forward`'s."""
        depth_network: DepthNetwork = self.monodepth_model.monodepth_predictor  # type: ignore[assignment]
        maps = depth_network.encoder(image * 2 - 1, batch, progress)
        disparity = depth_network.disparity(maps)
        start = make_initial_gaussians(
            image, disparity.clamp(*DISPARITY_RANGE).reciprocal() * disparity_factor
        )
        return DecoderInput(start, torch.cat([image, start.disparity_map], dim=1) * 2 - 1, maps)

    def gaussian_decoder(self) -> GaussianDecoder:
        """The Gaussian decoder alone: the same modules under the same names."""
        return GaussianDecoder(self.feature_model, self.prediction_head)


class DepthNetwork(nn.Module):
    """Predicts two layers of disparity, as Depth Pro does."""

    def __init__(self, config: SharpConfig) -> None:
        super().__init__()
        width = config.depth_width
        self.encoder = SlidingPyramid(config)
        self.decoder = Decoder((width, *config.pyramid), width)
        self.head = nn.Sequential(
            nn.Conv2d(width, width // 2, 3, padding=1),
            nn.ConvTranspose2d(width // 2, width // 2, 2, stride=2),
            nn.Conv2d(width // 2, HEAD_CHANNELS, 3, padding=1),
            nn.ReLU(inplace=True),
            Float32Conv(HEAD_CHANNELS, LAYER_COUNT, 1),
            nn.ReLU(inplace=True),
        )

    def disparity(self, maps: list[Tensor]) -> Tensor:
        out: Tensor = self.head(self.decoder(maps))
        return out


GEOMETRY_CHANNELS, TEXTURE_CHANNELS = (
    3,
    11,
)  # delta channels: offset; scale 3, quaternion 4, colour 3, opacity 1


class FeatureNetwork(nn.Module):
    """Computes features from the pyramid, the picture and its disparity; deltas are predicted from these features."""

    def __init__(self, config: SharpConfig) -> None:
        super().__init__()
        width = config.gaussian_width
        self.decoder = Decoder((config.depth_width, *config.pyramid), width)
        self.image_encoder = nn.Module()
        self.image_encoder.conv = Float32Conv(
            3 + LAYER_COUNT, width, CELL_STRIDE, stride=CELL_STRIDE
        )
        self.fusion = Fusion(width, doubles=False)
        self.texture_head = _head(width, config.feature_width)
        self.geometry_head = _head(width, config.feature_width)

    def forward(
        self, picture: Tensor, maps: list[Tensor], coarser: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Texture and geometry features [1, F, side/2, side/2] of [1, 5, side, side] in -1..1; see `Decoder`."""
        features = self.decoder(maps, coarser)
        features = self.fusion(features, self.image_encoder.conv(picture).to(features))  # type: ignore[operator]
        return self.texture_head(features), self.geometry_head(features)


class PredictionHead(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.geometry_prediction_head = Float32Conv(width, GEOMETRY_CHANNELS * LAYER_COUNT, 1)
        self.texture_prediction_head = Float32Conv(width, TEXTURE_CHANNELS * LAYER_COUNT, 1)

    def forward(self, texture: Tensor, geometry: Tensor) -> Tensor:
        """Deltas [14, 2, H, W] float32 from texture and geometry features [1, F, H, W]."""
        geometry = self.geometry_prediction_head(geometry)[0].unflatten(
            0, (GEOMETRY_CHANNELS, LAYER_COUNT)
        )
        texture = self.texture_prediction_head(texture)[0].unflatten(
            0, (TEXTURE_CHANNELS, LAYER_COUNT)
        )
        return torch.cat([geometry, texture])


class GaussianDecoder(nn.Module):
    """Feature network and heads as one module, which can be trained alone; 7,784,028 weights as published."""

    def __init__(self, feature_model: FeatureNetwork, prediction_head: PredictionHead) -> None:
        super().__init__()
        self.feature_model = feature_model
        self.prediction_head = prediction_head

    def enable_training(self) -> GaussianDecoder:
        """Enable gradients, except for unused weights: 295,168 in the published checkpoint."""
        self.requires_grad_()
        coarsest: Fusion = self.feature_model.decoder.fusions[-1]  # type: ignore[assignment]
        coarsest.resnet1.requires_grad_(
            False
        )  # for finer features, which the coarsest level does not get
        return self

    def forward(self, picture: Tensor, maps: list[Tensor]) -> Tensor:
        """Deltas [14, 2, side/2, side/2] float32 of a picture [1, 5, side, side] and its maps (see `DecoderInput`)."""
        deltas: Tensor = self.prediction_head(*self.feature_model(picture, maps))
        return deltas


def _head(width: int, out: int) -> nn.Sequential:
    blocks, last = [normed_residual(width, width) for _ in range(2)], nn.Conv2d(width, out, 1)
    return nn.Sequential(*blocks, nn.ReLU(inplace=True), last, nn.ReLU(inplace=True))


NEAREST_DEPTH, FARTHEST_DEPTH = (
    1.0,
    100.0,
)  # depths are scaled so that the nearest is 1, and cut off at 100
FARTHEST_INVERSE = 1e-3  # added to inverse depth, which keeps depth finite
SMALLEST_INVERSE = 1e-6
COLOR_MARGIN = 0.01  # keeps the inverse sigmoid of a colour finite
MAX_SCALE = 10.0  # largest scale of a Gaussian, relative to its initial scale

# How much a delta of one changes an attribute, before the sigmoid if there is one.
XY_GAIN = Z_GAIN = 0.001
COLOR_GAIN = 0.1


@dataclasses.dataclass(frozen=True)
class InitialGaussians:
    """Gaussians on the predicted surfaces, one for each 2×2 pixels and layer, before any delta."""

    disparity_map: (
        Tensor  # [1, 2, side, side] of the scaled depths, an input of the feature network
    )
    disparity: Tensor  # [2, side/2, side/2] of the nearest pixel in each cell
    color: Tensor  # [3, side/2, side/2] sRGB, the cell's mean
    unscale: Tensor  # [] float64: multiplies means and scales to undo the scaling of the depths


def make_initial_gaussians(image: Tensor, depth: Tensor) -> InitialGaussians:
    """The initial Gaussians of a picture [1, 3, side, side] with depth layers [1, 2, side, side]."""
    factor = NEAREST_DEPTH / (depth.min().double() + SMALLEST_INVERSE)
    disparity = 1.0 / (depth * factor).clamp_max(FARTHEST_DEPTH)
    return InitialGaussians(
        disparity,
        max_pool2d(disparity, CELL_STRIDE)[0],
        avg_pool2d(image, CELL_STRIDE)[0],
        1.0 / factor,
    )


def apply_deltas(start: InitialGaussians, deltas: Tensor) -> Gaussians:
    """Apply deltas [14, 2, H, W]; the Gaussians come layer by layer, each in row-major order.

    Means are (x·z, y·z, z), where x and y run from -1 to 1 over the picture.
    """
    height, width = deltas.shape[-2:]
    x, y = (
        (2 * torch.arange(n, device=deltas.device) + 1) / n - 1 for n in (width, height)
    )  # of the cells' centres
    inverse = softplus(_inverse_softplus(start.disparity) + Z_GAIN * deltas[2])
    z = 1.0 / (inverse + FARTHEST_INVERSE)
    means = torch.stack([z * (x + XY_GAIN * deltas[0]), z * (y[:, None] + XY_GAIN * deltas[1]), z])
    # A cell's width at that depth, times a factor between 0 and MAX_SCALE, which has value 1 and slope 1 at zero.
    slope, shift = MAX_SCALE / (MAX_SCALE - 1), -math.log(MAX_SCALE - 1)
    scales = (2.0 / width) * z * (MAX_SCALE * torch.sigmoid(slope * deltas[3:6] + shift))
    quats = torch.cat([deltas[6:7] + 1, deltas[7:10]])
    color = start.color.clamp(COLOR_MARGIN, 1 - COLOR_MARGIN)
    colors = srgb_to_linear(torch.sigmoid(torch.logit(color)[:, None] + COLOR_GAIN * deltas[10:13]))
    opacities = torch.sigmoid(deltas[13])
    return Gaussians(
        _rows(means * start.unscale),
        _rows(quats),
        _rows(scales * start.unscale),
        opacities.flatten(),
        _rows(colors),
    )


def _inverse_softplus(y: Tensor) -> Tensor:
    """log(eʸ - 1) for y > 0 without overflow."""
    y = y.clamp_min(SMALLEST_INVERSE)
    return y + torch.log(-torch.expm1(-y))


def _rows(attribute: Tensor) -> Tensor:
    """[C, 2, H, W] to [2·H·W, C]."""
    return attribute.flatten(1).T.contiguous()
