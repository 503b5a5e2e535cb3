"""SHARP (Apple, 2025): predict two layers of Gaussians from one picture.

`SharpNetwork` is the whole network: the encoder makes feature maps of the picture, `DepthNetwork`
predicts two layers of disparity, `make_initial_gaussians` places Gaussians on them, the
`GaussianDecoder` predicts how they change (deltas), and `apply_deltas` changes them. The decoders
are DPT's (Ranftl et al. 2021). Modules are named as in Apple's checkpoint.
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
        """Use these layers, one after the other."""
        super().__init__()
        self.residual = nn.Sequential(*layers)

    def forward(self, x: Tensor) -> Tensor:
        """Features [1, C, H, W] plus what the layers make of them."""
        delta: Tensor = self.residual(x)
        return delta.add_(x)


class GroupNorm(nn.GroupNorm):
    """torch's group norm with exact sums on a CPU.

    There float32 sums of half a million pixels lose three digits.
    """

    def forward(self, x: Tensor) -> Tensor:
        """Normalise [1, C, H, W] by the mean and variance of each group of channels."""
        # Only float32 on a CPU needs the exact sums. GPUs add in pairs, which is exact enough, and
        # bfloat16 has but three digits anyway.
        if x.device.type != "cpu" or x.dtype != torch.float32 or len(x) != 1:
            return super().forward(x)
        pixels = x[0].permute(1, 2, 0)  # [H, W, C]
        # Float32 is exact enough for the sums of single rows [H, C]; their sum is float64.
        mean = self._mean_by_group(pixels.sum(1), pixels.numel())  # [groups]
        mean_square = self._mean_by_group(pixels.square().sum(1), pixels.numel())
        scale = torch.rsqrt(mean_square - mean.square() + self.eps)

        channels_per_group = self.num_channels // self.num_groups
        scale = scale.repeat_interleave(channels_per_group)  # [C]
        mean = mean.repeat_interleave(channels_per_group)
        # (x - mean) · scale · weight + bias, as one multiplication and one addition for each value.
        factor = (self.weight * scale).float()
        shift = (self.bias - self.weight * scale * mean).float()
        return torch.addcmul(shift, pixels, factor).permute(2, 0, 1)[None]

    def _mean_by_group(self, row_sums: Tensor, value_count: int) -> Tensor:
        """Float64 means [groups] of all values of the channels in each group.

        `row_sums` are the float32 sums [H, C] of each row of pixels; `value_count` is the number of
        values of all groups together.
        """
        channel_sums = row_sums.double().sum(0)  # [C]
        return channel_sums.view(self.num_groups, -1).sum(1) / (value_count // self.num_groups)


def plain_residual(dim: int) -> Residual:
    """A residual block of two 3×3 convolutions, each after a ReLU."""
    return Residual(
        nn.ReLU(),  # not in place: the block's input is needed for the sum
        nn.Conv2d(dim, dim, 3, padding=1),
        nn.ReLU(inplace=True),
        nn.Conv2d(dim, dim, 3, padding=1),
    )


def normed_residual(dim: int, out: int) -> Residual:
    """A residual block of two 3×3 convolutions, each after a group norm and a ReLU.

    It turns `dim` channels into `out`; the first convolution has half as many output channels.
    """
    return Residual(
        GroupNorm(NORM_GROUPS, dim),
        nn.ReLU(inplace=True),
        nn.Conv2d(dim, out // 2, 3, padding=1),
        GroupNorm(NORM_GROUPS, out // 2),
        nn.ReLU(inplace=True),
        nn.Conv2d(out // 2, out, 3, padding=1),
    )


class Fusion(nn.Module):
    """Adds finer features to coarser features, and doubles the size if `upsample` is set."""

    def __init__(self, dim: int, upsample: bool) -> None:
        """Build the layers for features with `dim` channels.

        With `upsample` the output has twice the width and height of the input.
        """
        super().__init__()
        # Named as in the checkpoint: `resnet1` is for the finer features, `resnet2` for the sum.
        self.resnet1 = plain_residual(dim)
        self.resnet2 = plain_residual(dim)
        self.deconv = (
            nn.ConvTranspose2d(dim, dim, 2, stride=2, bias=False) if upsample else nn.Identity()
        )
        self.out_conv = nn.Conv2d(dim, dim, 1)

    def forward(self, coarse: Tensor, fine: Tensor | None = None) -> Tensor:
        """Add features [1, C, H, W] of two levels, and process the sum.

        `fine` is None at the coarsest level, where there is nothing to add. The result has the size
        H×W, or 2H×2W if the block upsamples.
        """
        x = coarse if fine is None else coarse + self.resnet1(fine)
        out: Tensor = self.out_conv(self.deconv(self.resnet2(x)))
        return out


class Decoder(nn.Module):
    """Fuses feature maps, from coarse to fine, into one map of the finest size."""

    def __init__(self, map_channels: Sequence[int], width: int) -> None:
        """Build a decoder that fuses feature maps into one map with `width` channels.

        `map_channels` are the channels of the feature maps, fine to coarse.
        """
        super().__init__()
        # First each map is projected to `width` channels, unless the finest map has them already.
        finest_channels, *coarser_channels = map_channels
        finest: nn.Module = nn.Identity()
        if finest_channels != width:
            finest = nn.Conv2d(finest_channels, width, 1, bias=False)
        coarser = [
            nn.Conv2d(channels, width, 3, padding=1, bias=False) for channels in coarser_channels
        ]
        self.convs = nn.ModuleList([finest, *coarser])
        # Each level's output has the size of the next finer map; the finest map keeps its size.
        self.fusions = nn.ModuleList(
            Fusion(width, upsample=level > 0) for level in range(len(map_channels))
        )

    def forward(self, maps: Sequence[Tensor], coarser: Tensor | None = None) -> Tensor:
        """Fuse feature maps into one map [1, width, H, W] of the finest map's size.

        Args:
            maps: fine to coarse; map i is [1, C, H/2^i, W/2^i].
            coarser: features [1, width, h, w] of the coarsest map's size, which are added to it.
        """
        # The work goes from the coarsest map to the finest.
        features = coarser
        for level in reversed(range(len(maps))):
            projected = self.convs[level](maps[level])
            fuse = self.fusions[level]
            features = fuse(projected) if features is None else fuse(features, projected)
        assert features is not None
        return features


# The depth head's output, focal length / width / depth, is clamped to this range.
MIN_CANONICAL_DISPARITY = 1e-4
MAX_CANONICAL_DISPARITY = 1e4
HEAD_CHANNELS = 32  # channels before the last layer of the depth head


@dataclasses.dataclass(frozen=True)
class SharpOutput:
    """The Gaussians as the network describes them: where they start, and how they change."""

    initial: InitialGaussians  # Gaussians on the two surfaces
    deltas: Tensor  # [14, 2, side/2, side/2] float32 changes of these Gaussians


@dataclasses.dataclass(frozen=True)
class DecoderInput:
    """What the encoder and the depth network make of a picture: the Gaussian decoder's input."""

    initial: InitialGaussians
    image_and_disparity: Tensor  # [1, 5, side, side] in -1..1: sRGB, the disparity of both layers
    # Fine to coarse: [1, C, side/2, side/2] to [1, C, side/32, side/32].
    encoder_maps: list[Tensor]


class SharpNetwork(nn.Module):
    """The whole network, without the parts that inference never uses."""

    def __init__(self, config: SharpConfig) -> None:
        """Build SHARP with the widths and depths of `config`; its weights are zeros or random.

        The depth network encodes the picture and predicts two layers of depth; the feature model
        and the prediction head then predict the Gaussians.
        """
        super().__init__()
        self.config = config
        # The depth network is nested in an empty module, because its tensors' names in the
        # checkpoint begin with monodepth_model.monodepth_predictor.
        self.monodepth_model = nn.Module()
        self.monodepth_model.monodepth_predictor = DepthNetwork(config)
        self.feature_model = FeatureNetwork(config)
        self.prediction_head = PredictionHead(config.feature_width)

    def forward(
        self,
        image: Tensor,
        disparity_factor: float | Tensor,
        windows_per_batch: int,
        progress: Progress | None = None,
    ) -> SharpOutput:
        """Predict Gaussians from a photo.

        Args:
            image: the photo, stretched to [1, 3, side, side], sRGB in 0..1, float32.
            disparity_factor: focal length over width, both in the photo's pixels.
            windows_per_batch: how many of the picture's 35 overlapping windows go through the
                transformer at once.
            progress: called with the number of windows done and that of all windows.
        """
        encoded = self.encode(image, disparity_factor, windows_per_batch, progress)
        decoder = self.gaussian_decoder()
        deltas: Tensor = decoder(encoded.image_and_disparity, encoded.encoder_maps)
        return SharpOutput(encoded.initial, deltas)

    def encode(
        self,
        image: Tensor,
        disparity_factor: float | Tensor,
        windows_per_batch: int,
        progress: Progress | None = None,
    ) -> DecoderInput:
        """Compute what the Gaussian decoder needs: feature maps of a photo, and two depth layers.

        Args:
            image: the photo, stretched to [1, 3, side, side], sRGB in 0..1, float32.
            disparity_factor: focal length over width, both in the photo's pixels.
            windows_per_batch: how many of the picture's 35 overlapping windows go through the
                transformer at once.
            progress: called with the number of windows done and that of all windows.
        """
        predictor = self.monodepth_model.monodepth_predictor
        depth_network: DepthNetwork = predictor  # type: ignore[assignment]
        encoder_maps = depth_network.encoder(image * 2 - 1, windows_per_batch, progress)
        # The network predicts canonical disparity, which is focal length / width / depth: it cannot
        # know the focal length.
        disparity = depth_network.disparity(encoder_maps)
        disparity = disparity.clamp(MIN_CANONICAL_DISPARITY, MAX_CANONICAL_DISPARITY)
        depth = disparity.reciprocal() * disparity_factor  # [1, 2, side, side] metres
        initial = make_initial_gaussians(image, depth)
        # From 0..1 to -1..1, like the encoder's input.
        image_and_disparity = torch.cat([image, initial.disparity_map], dim=1) * 2 - 1
        return DecoderInput(initial, image_and_disparity, encoder_maps)

    def gaussian_decoder(self) -> GaussianDecoder:
        """The Gaussian decoder alone: the same modules under the same names."""
        return GaussianDecoder(self.feature_model, self.prediction_head)


class DepthNetwork(nn.Module):
    """Predicts two layers of disparity, as Depth Pro does."""

    def __init__(self, config: SharpConfig) -> None:
        """Build the depth network with the widths and depths of `config`.

        Its weights are zeros or random.
        """
        super().__init__()
        width = config.depth_width
        self.encoder = SlidingPyramid(config)  # feature maps of five scales
        self.decoder = Decoder((width, *config.pyramid_channels), width)
        # From the decoder's map, of half the picture's size, to two layers of disparity of the
        # picture's size, none of it negative.
        self.head = nn.Sequential(
            nn.Conv2d(width, width // 2, 3, padding=1),
            nn.ConvTranspose2d(width // 2, width // 2, 2, stride=2),
            nn.Conv2d(width // 2, HEAD_CHANNELS, 3, padding=1),
            nn.ReLU(inplace=True),
            Float32Conv(HEAD_CHANNELS, LAYER_COUNT, 1),
            nn.ReLU(inplace=True),
        )

    def disparity(self, encoder_maps: list[Tensor]) -> Tensor:
        """Canonical disparity [1, 2, side, side] of both layers, from the encoder's maps."""
        out: Tensor = self.head(self.decoder(encoder_maps))
        return out


GEOMETRY_CHANNELS = 3  # of deltas: the offset of the centre
TEXTURE_CHANNELS = 11  # of deltas: scale 3, quaternion 4, colour 3, opacity 1


class FeatureNetwork(nn.Module):
    """Computes the features from which deltas of the Gaussians are predicted."""

    def __init__(self, config: SharpConfig) -> None:
        """Build the network with the widths of `config`; its weights are zeros or random."""
        super().__init__()
        width = config.gaussian_width
        self.decoder = Decoder((config.depth_width, *config.pyramid_channels), width)
        # The picture has five channels: sRGB, and the disparity of two layers. Each cell of 2×2
        # pixels becomes one vector of features. The checkpoint calls this layer image_encoder.conv.
        picture_channels = 3 + LAYER_COUNT
        self.image_encoder = nn.Module()
        self.image_encoder.conv = Float32Conv(
            picture_channels, width, CELL_STRIDE, stride=CELL_STRIDE
        )
        self.fusion = Fusion(width, upsample=False)
        self.texture_head = _feature_head(width, config.feature_width)
        self.geometry_head = _feature_head(width, config.feature_width)

    def forward(
        self,
        image_and_disparity: Tensor,
        encoder_maps: list[Tensor],
        coarser: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Features for the texture and the geometry of Gaussians, each [1, F, side/2, side/2].

        Args:
            image_and_disparity: [1, 5, side, side] in -1..1: sRGB, and the disparity of the visible
                surface and of what may be behind it.
            encoder_maps: the encoder's features, fine to coarse, [1, C, side/2, side/2] to
                [1, C, side/32, side/32].
            coarser: features of the coarsest map's size that are added to it.
        """
        features = self.decoder(encoder_maps, coarser)
        image_features = self.image_encoder.conv(image_and_disparity)  # type: ignore[operator]
        # The pixels themselves add details that the encoder's maps have lost.
        features = self.fusion(features, image_features.to(features))
        return self.texture_head(features), self.geometry_head(features)


def _feature_head(width: int, out: int) -> nn.Sequential:
    """Layers that turn features with `width` channels into features with `out` channels."""
    blocks = [normed_residual(width, width) for _ in range(2)]
    last = nn.Conv2d(width, out, 1)
    return nn.Sequential(*blocks, nn.ReLU(inplace=True), last, nn.ReLU(inplace=True))


class PredictionHead(nn.Module):
    """Predicts deltas from features, by one 1×1 convolution each for geometry and texture."""

    def __init__(self, width: int) -> None:
        """Build the convolutions for features with `width` channels."""
        super().__init__()
        self.geometry_prediction_head = Float32Conv(width, GEOMETRY_CHANNELS * LAYER_COUNT, 1)
        self.texture_prediction_head = Float32Conv(width, TEXTURE_CHANNELS * LAYER_COUNT, 1)

    def forward(self, texture: Tensor, geometry: Tensor) -> Tensor:
        """Deltas (changes of the initial Gaussians) from features [1, F, H, W].

        They are [14, 2, H, W] float32. The 14 channels are offset 3, scale 3, quaternion 4,
        colour 3 and opacity 1; the second axis counts the layers of Gaussians.
        """
        geometry_deltas = self.geometry_prediction_head(geometry)[0]  # [3 · 2, H, W]
        texture_deltas = self.texture_prediction_head(texture)[0]  # [11 · 2, H, W]
        return torch.cat(
            [
                geometry_deltas.unflatten(0, (GEOMETRY_CHANNELS, LAYER_COUNT)),
                texture_deltas.unflatten(0, (TEXTURE_CHANNELS, LAYER_COUNT)),
            ]
        )


class GaussianDecoder(nn.Module):
    """Feature network and heads as one module, which can be trained alone.

    It has 7,784,028 weights as published.
    """

    def __init__(self, feature_model: FeatureNetwork, prediction_head: PredictionHead) -> None:
        """Share the modules of a `SharpNetwork`."""
        super().__init__()
        self.feature_model = feature_model
        self.prediction_head = prediction_head

    def enable_training(self) -> GaussianDecoder:
        """Enable gradients of all weights but the unused ones (295,168 as published)."""
        self.requires_grad_()
        # These layers are unused: the coarsest level gets no finer features to process.
        coarsest: Fusion = self.feature_model.decoder.fusions[-1]  # type: ignore[assignment]
        coarsest.resnet1.requires_grad_(False)
        return self

    def forward(self, image_and_disparity: Tensor, encoder_maps: list[Tensor]) -> Tensor:
        """Deltas (changes) of the initial Gaussians, [14, 2, side/2, side/2] float32.

        Args:
            image_and_disparity: [1, 5, side, side] in -1..1: sRGB, and the disparity of the visible
                surface and of what may be behind it.
            encoder_maps: the encoder's features, fine to coarse, [1, C, side/2, side/2] to
                [1, C, side/32, side/32].
        """
        texture, geometry = self.feature_model(image_and_disparity, encoder_maps)
        deltas: Tensor = self.prediction_head(texture, geometry)
        return deltas


# Depths are scaled so that the nearest is 1, and cut off at 100 times that.
NEAREST_DEPTH = 1.0
FARTHEST_DEPTH = 100.0
FARTHEST_INVERSE = 1e-3  # added to inverse depth, which keeps depth finite
EPSILON = 1e-6  # keeps logarithms and quotients finite
COLOR_MARGIN = 0.01  # keeps the inverse sigmoid of a colour finite
MAX_SCALE = 10.0  # largest scale of a Gaussian, relative to its initial scale

# How much a delta of one changes an attribute, before the sigmoid if there is one.
XY_GAIN = 0.001
Z_GAIN = 0.001
COLOR_GAIN = 0.1


@dataclasses.dataclass(frozen=True)
class InitialGaussians:
    """Gaussians on the predicted surfaces, before any delta.

    There is one for each layer and each cell of 2×2 pixels.
    """

    # [1, 2, side, side] of the scaled depths, an input of the feature network
    disparity_map: Tensor
    disparity: Tensor  # [2, side/2, side/2] of the nearest pixel in each cell
    color: Tensor  # [3, side/2, side/2] sRGB, the cell's mean
    unscale: Tensor  # [] float64: multiplies means and scales to undo the scaling of the depths


def make_initial_gaussians(image: Tensor, depth: Tensor) -> InitialGaussians:
    """The initial Gaussians of a picture [1, 3, side, side] with depth layers [1, 2, side, side].

    There is one for each layer and each cell of 2×2 pixels. Depths are scaled so that the nearest
    is 1, because the network was trained so.
    """
    # In float64, so that dividing by the factor later restores the depths.
    factor = NEAREST_DEPTH / (depth.min().double() + EPSILON)
    disparity = 1.0 / (depth * factor).clamp_max(FARTHEST_DEPTH)
    # A cell gets the disparity of its nearest pixel, and its pixels' mean colour.
    return InitialGaussians(
        disparity_map=disparity,
        disparity=max_pool2d(disparity, CELL_STRIDE)[0],
        color=avg_pool2d(image, CELL_STRIDE)[0],
        unscale=1.0 / factor,  # turns scaled depths back into metres
    )


def apply_deltas(initial: InitialGaussians, deltas: Tensor) -> Gaussians:
    """Gaussians from initial Gaussians and their predicted changes (deltas).

    Args:
        initial: Gaussians on the two surfaces, one for each layer and each cell of 2×2 pixels.
        deltas: [14, 2, H, W] for both layers and H × W cells; the 14 channels are offset 3,
            scale 3, quaternion 4, colour 3 and opacity 1.

    Returns:
        The Gaussians layer by layer, each in row-major order. Means are (x·z, y·z, z), where x and
        y run from -1 to 1 over the picture.
    """
    offset, scale, quat, color, opacity = torch.split(deltas, [3, 3, 4, 3, 1])  # each [C, 2, H, W]
    height, width = deltas.shape[-2:]
    x = (2 * torch.arange(width, device=deltas.device) + 1) / width - 1  # of the cells' centres
    y = (2 * torch.arange(height, device=deltas.device) + 1) / height - 1

    # The gains (XY_GAIN and others) say how much a delta of 1 changes an attribute. The offset in z
    # changes inverse depth before a softplus, so that inverse depth stays positive.
    inverse = softplus(_inverse_softplus(initial.disparity) + Z_GAIN * offset[2])
    z = 1.0 / (inverse + FARTHEST_INVERSE)  # [2, H, W]; the summand keeps it finite
    moved_x = x + XY_GAIN * offset[0]
    moved_y = y[:, None] + XY_GAIN * offset[1]
    means = torch.stack([z * moved_x, z * moved_y, z])  # [3, 2, H, W]

    # A Gaussian is as wide as its cell at that depth, times a factor between 0 and MAX_SCALE. The
    # sigmoid is scaled and shifted so that a delta of 0 gives the factor 1, and a small delta
    # changes it by just this delta.
    slope = MAX_SCALE / (MAX_SCALE - 1)
    shift = -math.log(MAX_SCALE - 1)
    scales = (2.0 / width) * z * (MAX_SCALE * torch.sigmoid(slope * scale + shift))

    # Without a change the quaternion is (1, 0, 0, 0): no rotation.
    quats = torch.cat([quat[:1] + 1, quat[1:]])
    # Colours change before a sigmoid, so that they stay in 0..1.
    clamped = initial.color.clamp(COLOR_MARGIN, 1 - COLOR_MARGIN)  # [3, H, W]
    initial_color = torch.logit(clamped)
    srgb = torch.sigmoid(initial_color[:, None] + COLOR_GAIN * color)
    opacities = torch.sigmoid(opacity)
    # `unscale` undoes the scaling of the depths to a nearest depth of 1.
    return Gaussians(
        _as_rows(means * initial.unscale),
        _as_rows(quats),
        _as_rows(scales * initial.unscale),
        opacities.flatten(),
        _as_rows(srgb_to_linear(srgb)),
    )


def _inverse_softplus(y: Tensor) -> Tensor:
    """log(eʸ - 1) for y > 0 without overflow."""
    y = y.clamp_min(EPSILON)
    return y + torch.log(-torch.expm1(-y))


def _as_rows(attribute: Tensor) -> Tensor:
    """[C, 2, H, W] to [2·H·W, C]."""
    return attribute.flatten(1).T.contiguous()
